"""World: a mesh, what of it is occupied, can be seen and flown through: the truth a mission is scored by."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets import read_triangles
from gmmtorch.errors import (
    DataError,
    InvalidArgumentError,
    MemoryLimitError,
    MissingDataError,
    OutputError,
    check_choice,
    check_number,
)
from gmmtorch.files import pack_tensors, read_tensors, require, write_bytes
from gmmtorch.kernels import row_major_strides
from gmmtorch.occupancy import Box, check_resolution, occupied_cells
from gmmtorch.report import Event, ignore
from gmmtorch.simulation import MeshWorld, checked_triangles, tunnels, warehouse, warehouse_start
from gmmtorch.team.exploration.planning.collision_checking import widened

_log = logging.getLogger(__name__)

ON_PLANE = 1e-6
"""Tolerance, as a share of a cell, for a length to lie on a plane of the lattice; larger than rounding."""


_CELLS = ("occupied", "observable", "navigable")
_Cells = dict[str, Tensor]  # bool tensors (nx, ny, nz) by these names
_KIND = "gmmtorch-world"
VERSION = 1
"""Increase it when the same mesh would give other cells."""


def cached_cells(
    triangles: Tensor, options: Mapping[str, Any], shape: tuple[int, ...], compute: Callable[[], _Cells]
) -> _Cells:
    """Return the cells of a world of this shape, from the cache, or computed and stored there.

    The folder is $GMMTORCH_CACHE, else gmmtorch in $XDG_CACHE_HOME, else in ~/.cache. The name of a file is a
    hash of the triangles (T, 3, 3), float64, the options (JSON), and the version; cells are packed as bits.
    """
    digest = hashlib.sha256(triangles.contiguous().numpy().tobytes())
    digest.update(json.dumps({"version": VERSION, **options}, sort_keys=True).encode())
    key, n_cells = digest.hexdigest(), math.prod(shape)
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "gmmtorch"
    path = Path(os.environ.get("GMMTORCH_CACHE") or home) / "worlds" / f"{key[:32]}.safetensors"
    try:
        tensors, facts = read_tensors(path, _KIND, VERSION)
        packed = [require(tensors, name, (math.ceil(n_cells / 8),), torch.uint8, path) for name in _CELLS]
        if facts.get("key") != key or facts.get("shape") != list(shape):
            raise DataError(f"{path} belongs to another world.")
        bits = (np.unpackbits(part.numpy(), count=n_cells).view(np.bool_) for part in packed)
        return {name: torch.from_numpy(bit).view(shape) for name, bit in zip(_CELLS, bits, strict=True)}
    except MissingDataError:
        pass
    except (DataError, OSError) as error:
        _log.warning("The cached world cannot be used and is computed again: %s", error)
    cells = compute()
    try:
        packed_bits = {name: torch.from_numpy(np.packbits(cell.numpy())) for name, cell in cells.items()}
        write_bytes(path, pack_tensors(packed_bits, _KIND, VERSION, key=key, shape=list(shape)))
    except OutputError as error:
        _log.warning("The world is not cached: %s", error)
    return cells


MAX_CELLS = 1 << 28
"""Largest number of cells of a world; computing it takes about 2 GB."""

_SPACING = 1.0  # metres between the viewpoints that determine the observable cells
_SHARP = 0.4  # share of the camera's range at which the rays that find observable cells are one cell apart
_FINEST = 0.01  # smallest angle (rad) between those rays


@dataclass(frozen=True, eq=False)
class World:
    """A mesh within bounds, on a lattice of cells.

    Attributes:
        name: in messages and results. mesh: casts rays. resolution: side of a cell (m).
        box: the lattice cells of the bounds.
        occupied: (nx, ny, nz) bool, cells that the mesh meets.
        navigable: bool, connected cells above a floor at whose centre a robot does not touch the mesh. Cells
            without a surface below them are outside, such as the rock around a mine without a roof.
        observable: bool, cells that a camera in the navigable space can see: occupied cells, and free cells
            above a floor.
        robot_radius: metres. start: (3,), metres, the default start of the robots.
    """

    name: str
    mesh: MeshWorld
    resolution: float
    box: Box
    occupied: Tensor
    observable: Tensor
    navigable: Tensor
    robot_radius: float
    start: Tensor | None = None

    @classmethod
    def from_mesh(
        cls,
        triangles: Tensor,
        resolution: float = 0.2,
        bounds: Sequence[float] | Tensor | None = None,
        *,
        vertical_fov: float = 1.0123,
        max_range: float = 6.0,
        robot_radius: float = 0.3,
        start: Sequence[float] | Tensor | None = None,
        cache: bool = True,
        on_event: Event = ignore,
        name: str = "mesh",
    ) -> World:
        """Compute a world, or read it from the cache.

        Args:
            triangles: (T, 3, 3) corners, metres, z up.
            bounds: x0, y0, z0, x1, y1, z1 (m); default: the box of the mesh. The world consists of the cells
                that touch the closed box. Rays end where they leave it.
            vertical_fov: of the camera (rad). The camera looks horizontally and turns about the vertical.
            max_range: of the camera (m).
            start: (3,), a point in the connected part to fly in. Default: the part with most places that are
                surrounded by walls (`MeshWorld.standing_places`), else the largest part.
            cache: read the result from disk, or store it there (see `cached_cells`).
            on_event: callback for the stages.

        Raises `DataError` for a mesh in which no rays can be cast, `InvalidArgumentError` for bounds that
        contain no surface, a camera that sees only the neighbouring cells, or a world without room for a
        robot, and `MemoryLimitError` for more than `MAX_CELLS` cells.
        """
        check_resolution(resolution)
        if not 0 < vertical_fov <= math.pi:
            raise InvalidArgumentError(f"vertical_fov={vertical_fov} must be above 0 and at most π rad.")
        check_number("max_range", max_range, above=True)
        check_number("robot_radius", robot_radius, above=True)
        if max_range <= robot_radius + 2 * resolution:
            raise InvalidArgumentError(
                f"max_range={max_range} m ends within two cells of the robot (‹robot_radius›={robot_radius} "
                f"m, ‹resolution›={resolution} m); use a longer range or finer cells."
            )
        triangles = checked_triangles(triangles, name)
        mesh = MeshWorld(triangles)
        box = _lattice_box(mesh, bounds, resolution, name)
        place = None if start is None else _point(start)
        options: dict[str, Any] = {  # what the cells depend on besides the triangles; the key of the cache
            "resolution": resolution,
            "low": box.low.tolist(),
            "high": box.high.tolist(),
            "vertical_fov": vertical_fov,
            "max_range": max_range,
            "robot_radius": robot_radius,
            "start": None if place is None else place.tolist(),
            "spacing": _SPACING,
        }

        def compute() -> _Cells:
            cells = _compute_cells(mesh, triangles, box, place, options, name, on_event)
            if cells is None:
                raise InvalidArgumentError(
                    f"bounds={_listed(bounds)} contain no surface of {name}, which extends from "
                    f"{_text(mesh.low, mesh.high)}; use wider bounds that include a floor."
                )
            return cells

        cells = cached_cells(triangles, options, box.shape, compute) if cache else compute()
        return cls(name, mesh, resolution, box, **cells, robot_radius=robot_radius, start=place)

    def centers(self, cells: Tensor) -> Tensor:
        """Centres (..., 3), metres, of cells (..., 3) relative to the low corner of the box."""
        return (cells + self.box.low + 0.5).double() * self.resolution


def _compute_cells(
    mesh: MeshWorld,
    triangles: Tensor,
    box: Box,
    start: Tensor | None,
    options: Mapping[str, Any],
    name: str,
    on_event: Event,
) -> _Cells | None:
    """Return the occupied, observable and navigable cells; None if no cell is occupied."""
    resolution, radius, max_range = (options[key] for key in ("resolution", "robot_radius", "max_range"))
    grounded = above_floor(mesh, resolution, box)
    occupied, clear = occupied_and_clear(mesh, triangles, resolution, box, grounded, radius, on_event)
    if not bool(occupied.any()):
        return None
    navigable = connected(clear, mesh, resolution, box, start, radius, name)
    places = viewpoints(navigable, max(1, round(_SPACING / resolution)))
    angle = max(resolution / (_SHARP * max_range), _FINEST)
    directions = view_directions(options["vertical_fov"], angle)
    seen = observable_cells(mesh, occupied, box, resolution, places, directions, max_range, on_event)
    seen = (seen | navigable) & (grounded | occupied)
    return {"occupied": occupied, "observable": seen, "navigable": navigable}


def _point(start: Sequence[float] | Tensor) -> Tensor:
    point = torch.as_tensor(start, dtype=torch.float64)
    if point.shape != (3,) or not bool(torch.isfinite(point).all()):
        raise InvalidArgumentError(f"start={start} must be three finite numbers: x, y, z in metres.")
    return point


def _listed(bounds: Sequence[float] | Tensor | None) -> list[float]:
    """Return the bounds as the user wrote them, for messages."""
    return torch.as_tensor(() if bounds is None else bounds, dtype=torch.float64).tolist()


def _text(low: Tensor, high: Tensor) -> str:
    return " to ".join(f"({', '.join(f'{x:.4g}' for x in end.tolist())})" for end in (low, high)) + " m"


def _lattice_box(
    mesh: MeshWorld, bounds: Sequence[float] | Tensor | None, resolution: float, name: str
) -> Box:
    low, high = mesh.low, mesh.high
    if bounds is not None:
        ends = torch.as_tensor(bounds, dtype=torch.float64)
        if ends.shape != (6,) or not bool(torch.isfinite(ends).all()):
            raise InvalidArgumentError(
                f"bounds={_listed(bounds)} must be six finite numbers, x0, y0, z0, x1, y1, z1 (m)."
            )
        low, high = ends[:3], ends[3:]
        if not bool((low < high).all()):
            raise InvalidArgumentError(f"bounds={ends.tolist()} are empty; give the low corner first.")
        if bool(((high < mesh.low) | (low > mesh.high)).any()):
            raise InvalidArgumentError(
                f"bounds={ends.tolist()} do not meet {name}, which extends from {_text(mesh.low, mesh.high)}."
            )
    first, last = ((end / resolution + ON_PLANE).floor() for end in (low, high))
    n_cells = float((last - first + 1).prod())
    if n_cells > MAX_CELLS:
        raise MemoryLimitError(
            f"{name}: {n_cells:.3g} cells of {resolution} m from {_text(low, high)} are more than "
            f"{MAX_CELLS:.3g}. Use a coarser ‹resolution› or tighter ‹bounds›; "
            "check that the mesh is in metres, not millimetres."
        )
    return Box(first.long(), last.long() + 1)


def open_world(
    name: str,
    *,
    path: str | Path | None = None,
    bounds: Sequence[float] | Tensor | None = None,
    seed: int = 0,
    size: Sequence[float] | None = None,
    **options: Any,
) -> World:
    """Open the world `name`: "warehouse" or "tunnels" with a seed and a size (m), or the "mesh" in a file.
    `options` are those of `World.from_mesh`, which also raises its errors. Raises `InvalidArgumentError` for
    an unknown name or an option that the world does not have, and `MissingDataError` for a missing file."""
    check_choice("world", name, ("warehouse", "tunnels", "mesh"))
    if name == "mesh":
        if size is not None:
            raise InvalidArgumentError(f"size={size}: a mesh has its own size; give bounds instead.")
        file = Path("" if path is None else path).expanduser()
        if not file.is_file():
            raise MissingDataError(
                f"‹path›={path} is not a file; give a triangle mesh (PLY, OBJ, STL) in metres, z up."
            )
        return World.from_mesh(read_triangles(file), bounds=bounds, name=file.stem, **options)
    if path is not None:
        raise InvalidArgumentError(f"path={path}: world={name} is generated and takes no path; drop it.")
    extent = () if size is None else (size,)
    if name == "warehouse":
        triangles = warehouse(seed, *extent)
        if bounds is None:
            options.setdefault("start", warehouse_start(*extent))
    else:
        triangles = tunnels(seed, *extent)
    return World.from_mesh(triangles, bounds=bounds, name=name, **options)


def occupied_and_clear(
    mesh: MeshWorld,
    triangles: Tensor,
    resolution: float,
    box: Box,
    grounded: Tensor,
    radius: float,
    on_event: Event,
) -> tuple[Tensor, Tensor]:
    """Return cells (nx, ny, nz) that the mesh meets; and grounded ones with centres beyond `radius` of it."""
    # A cell m cells away on some axis is at least (m − ½) cells from a cell's centre. Distances are therefore
    # computed only for cells that close to the mesh. The mesh just outside the box counts too.
    reach = math.floor(radius / resolution + 0.5 + ON_PLANE)
    on_event("occupied cells", 0, None)
    wider = occupied_cells(triangles, resolution, Box(box.low - reach, box.high + reach))
    inner = tuple(slice(reach, reach + n) for n in box.shape)
    occupied = wider[inner].clone()
    near = wider
    for axis in range(3):
        near = widened(near, axis, reach)
    near = near[inner]
    clear = grounded & ~near
    cells = (grounded & near).nonzero()
    for begin in range(0, len(cells), 1 << 20):
        part = cells[begin : begin + (1 << 20)]
        on_event("navigable cells", begin, len(cells))
        room = mesh.clearance((part + box.low + 0.5).double() * resolution)
        clear[part.unbind(1)] = room > radius
    return occupied, clear


def above_floor(mesh: MeshWorld, resolution: float, box: Box) -> Tensor:
    """Return cells (nx, ny, nz), bool, that have a surface of the mesh below their centre."""
    centers = [
        (torch.arange(low, high) + 0.5).double() * resolution
        for low, high in zip(box.low.tolist(), box.high.tolist(), strict=True)
    ]
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    bottom = mesh.low[2:] - 1
    floor = []
    for x in centers[0].split(max(1, (1 << 20) // len(centers[1]))):  # a million columns at a time
        columns = torch.cartesian_prod(x, centers[1])
        starts = torch.cat([columns, bottom.expand(len(columns), 1)], 1)
        floor.append((bottom + mesh.distances(starts, up.expand_as(starts))).view(len(x), -1))
    return torch.cat(floor)[:, :, None] < centers[2]


def connected(
    clear: Tensor,
    mesh: MeshWorld,
    resolution: float,
    box: Box,
    start: Tensor | None,
    radius: float,
    name: str,
) -> Tensor:
    """Return the connected part (nx, ny, nz), bool, of the clear cells that robots use. It is the part that
    contains the start. Without a start it is the part with the most standing room."""
    from scipy.ndimage import label

    parts, n_parts = label(clear.numpy())
    parts = torch.from_numpy(parts)
    if n_parts == 0:
        raise InvalidArgumentError(
            f"{name}: no cell of {resolution} m is above a floor and farther than ‹robot_radius›={radius} m "
            "from the mesh. Use a smaller radius or wider bounds; check that the mesh is in metres with z up."
        )
    if start is not None:
        cell = (start / resolution).floor().long() - box.low
        if bool((cell < 0).any()) or bool((cell >= torch.tensor(box.shape)).any()):
            raise InvalidArgumentError(f"{name}: start={start.tolist()} is outside the bounds.")
        part = int(parts[tuple(cell.tolist())])
        if part == 0:
            raise InvalidArgumentError(
                f"{name}: at start={start.tolist()} a robot of radius {radius} m touches the mesh or has no "
                "floor below it; move the start."
            )
        return parts == part
    places = (mesh.standing_places() / resolution).floor().long() - box.low
    places = places[((places >= 0) & (places < torch.tensor(box.shape))).all(1)]
    votes = torch.bincount(parts[places.unbind(1)], minlength=n_parts + 1)
    votes[0] = 0
    if not bool(votes.any()):
        votes = torch.bincount(parts.flatten())
        votes[0] = 0
    return parts == int(votes.argmax())


def collides(world: MeshWorld, positions: Tensor, radius: float) -> Tensor:
    """Flag (S,) the positions (S, 3), metres, that are closer than `radius` to a surface. The test does not
    detect positions deep inside a solid. Positions along a path must therefore be no farther apart than the
    robot's width, so that no step passes through a surface undetected."""
    if len(positions) == 0:
        return torch.zeros(0, dtype=torch.bool)
    return world.clearance(positions) < radius


def finely(positions: Tensor) -> Tensor:
    """Interpolate positions (1 + S, 3) to (1 + 4 S, 3): a robot may collide between states."""
    share = torch.arange(1, 5, dtype=positions.dtype)[:, None] / 4
    between = positions[:-1, None] + share * (positions[1:, None] - positions[:-1, None])
    return torch.cat([positions[:1], between.reshape(-1, 3)])


def meets_others(positions: Tensor, radius: float) -> Tensor:
    """Flag (R, S) the robots that are closer than two radii to another, at positions (R, S, 3), metres."""
    apart = (positions[:, None] - positions[None]).norm(dim=-1)
    other = ~torch.eye(len(positions), dtype=torch.bool)[..., None]
    return ((apart < 2 * radius) & other).any(1)


_GOLDEN = (math.sqrt(5) - 1) / 2
_AT_SURFACE = 1e-3  # tolerance (m) for float32 rays. A ray can only end in a cell that the mesh meets.

_RAYS_AT_ONCE = 1 << 18


def viewpoints(navigable: Tensor, step: int) -> Tensor:
    """Return the navigable cell nearest to the middle of each block of `step`³ cells, (V, 3)."""
    cells = navigable.nonzero()
    shape = torch.tensor(navigable.shape)
    block = (cells // step * torch.tensor(row_major_strides(tuple(-(-shape // step))))).sum(1)
    off_middle = (2 * (cells % step) - (step - 1)).square().sum(1)
    order = (block * (3 * step**2) + off_middle).argsort(stable=True)
    block = block[order]
    first = torch.ones_like(block, dtype=torch.bool)
    first[1:] = block[1:] != block[:-1]
    return cells[order[first]]


def view_directions(vertical_fov: float, angle: float) -> Tensor:
    """Return unit vectors (N, 3) about `angle` rad apart: all yaws, elevations within the field of view."""
    rows = max(1, math.ceil(vertical_fov / angle)) + 1
    rings = []
    elevations = torch.linspace(-vertical_fov / 2, vertical_fov / 2, rows, dtype=torch.float64)
    for row, elevation in enumerate(elevations.tolist()):
        n_yaws = max(4, math.ceil(2 * math.pi * math.cos(elevation) / angle))
        # Rotating each row samples the sphere more evenly, and no ray runs along a lattice plane.
        yaw = (torch.arange(n_yaws, dtype=torch.float64) + (row + 0.5) * _GOLDEN) * (2 * math.pi / n_yaws)
        up = torch.full_like(yaw, math.sin(elevation))
        rings.append(torch.stack([math.cos(elevation) * yaw.cos(), math.cos(elevation) * yaw.sin(), up], 1))
    return torch.cat(rings)


def observable_cells(
    world: MeshWorld,
    occupied: Tensor,
    box: Box,
    resolution: float,
    points_of_view: Tensor,
    directions: Tensor,
    max_range: float,
    on_event: Event = ignore,
) -> Tensor:
    """Return cells (nx, ny, nz), bool, that some ray crosses or ends in. Rays end at the mesh, range or box.

    occupied: (nx, ny, nz) bool, the cells of the box that the mesh meets. points_of_view: (V, 3) int64, cells
    relative to the low corner of the box. directions: (N, 3) unit vectors. max_range: metres.
    """
    shape = box.shape
    strides = torch.tensor(row_major_strides(shape))
    seen = torch.zeros(math.prod(shape), dtype=torch.bool)
    seen_there = seen.numpy()  # indexed assignment is several times faster there
    surface = occupied.view(-1)
    start = (points_of_view * strides).sum(1)
    seen[start] = True
    centers = (points_of_view + box.low + 0.5).double() * resolution
    beyond = torch.tensor(shape) - 1 - points_of_view  # cells between the start and the end of the box
    reach, slack = max_range / resolution, _AT_SURFACE / resolution
    together = max(1, _RAYS_AT_ONCE // max(1, len(centers)))
    for begin in range(0, len(directions), together):
        some = directions[begin : begin + together]
        toward = some.repeat_interleave(len(centers), 0)
        free_path = world.distances(centers.repeat(len(some), 1), toward).view(len(some), -1) / resolution
        for direction, distance in zip(some, free_path, strict=True):
            entry, offset = _crossed(direction, reach, strides)
            room = torch.where(direction > 0, beyond, points_of_view) + 0.5
            limit = (room / direction.abs()).amin(1).clamp_max(reach)
            count = torch.searchsorted(entry, torch.minimum(distance - slack, limit))
            by_count = count.argsort(descending=True, stable=True)
            from_here = start[by_count].numpy()
            n_rays = (len(start) - torch.bincount(count).cumsum(0)).tolist()  # that cross more than k cells
            for step, n in zip(offset.tolist(), n_rays, strict=False):
                seen_there[from_here[:n] + step] = True
            ends = distance + slack < limit
            last = torch.searchsorted(entry, distance[ends] + slack) - 1
            struck = start[ends] + offset[last]
            seen[struck[surface[struck]]] = True
        on_event("observable cells", min(begin + together, len(directions)), len(directions))
    return seen.view(shape)


def _crossed(direction: Tensor, reach: float, strides: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distances (K,), in cells, at which a ray from a cell's centre enters cells, and the offsets
    (K,) of their flat indices. The first cell is the start, entered at distance 0."""
    plane = torch.arange(math.ceil(reach) + 1, dtype=torch.float64) + 0.5
    distance = (plane / direction.abs()[:, None]).flatten()  # infinite along planes
    step = (direction.sign().long() * strides)[:, None].expand(3, len(plane)).flatten()
    entry, order = distance.sort(stable=True)
    within = entry < reach
    zero = torch.zeros(1, dtype=torch.int64)
    return torch.cat([zero.double(), entry[within]]), torch.cat([zero, step[order[within]].cumsum(0)])
