"""World: a mesh, what of it is occupied, can be seen and flown through: the truth a mission is scored by."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gmmtorch.datasets.mesh_samples import read_triangles
from gmmtorch.errors import InvalidArgumentError, MemoryLimitError, MissingDataError
from gmmtorch.evaluation.events import Event, ignore
from gmmtorch.exploration.planning.primitives import Dynamics, Primitives
from gmmtorch.exploration.world.navigable import ON_PLANE, above_floor, connected, occupied_and_clear
from gmmtorch.exploration.world.observable import observable_cells, view_directions, viewpoints
from gmmtorch.exploration.world.starts import check_start, start_poses
from gmmtorch.exploration.world.world_cache import kept_cells
from gmmtorch.occupancy.grid import check_resolution
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.simulation.worlds.mesh_world import MeshWorld, checked_triangles
from gmmtorch.simulation.worlds.tunnels import tunnels
from gmmtorch.simulation.worlds.warehouse import warehouse, warehouse_start

MAX_CELLS = 1 << 28
"""Of a box: about 2 GB while a world is worked out."""

_SHARP = 0.4
"""Share of the camera's range at which the rays that find what is observable are a cell apart."""

_FINEST = 0.01
"""Radians between those rays, at least."""

_CELLS = ("occupied", "observable", "navigable")


@dataclass(frozen=True, eq=False)
class World:
    """A mesh within bounds, on the lattice.

    Attributes:
        name: for messages and results.
        mesh: casts rays.
        resolution: side (m) of the cells.
        box: the lattice cells of the bounds.
        occupied: (nx, ny, nz) bool, cells that the mesh meets.
        navigable: bool, connected cells at whose centre a robot does not touch the mesh, above a floor: what
            has no surface below it is outside, as is the rock beside a mine without a roof.
        observable: bool, cells that a camera somewhere in the navigable space can see, free or occupied;
            of the free ones those above a floor.
        robot_radius: metres.
        start: (3,), metres, where robots start if not told otherwise.
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
        spacing: float = 1.0,
        cache: bool = True,
        on_event: Event = ignore,
        name: str = "mesh",
    ) -> World:
        """Work out a world, or read it from the cache.

        Args:
            triangles: (T, 3, 3) corners, metres, z up.
            bounds: x0, y0, z0, x1, y1, z1 (m); the box of the mesh if not given. Cells that their closed
                box touches belong to the world, rays that leave it are cut off there.
            vertical_fov: of the camera (rad); it looks level and turns about the vertical.
            max_range: of the camera, metres.
            start: (3,), a place of the part to fly in. If not given that is the part where most of the
                places lie that are surrounded by walls (`MeshWorld.standing_places`), else the largest.
            spacing: metres between the places from which the world is looked at.
            cache: keep the result on disk, and take it from there (see `world_cache`).
            on_event: hears of the stages.

        Raises `DataError` for a mesh that no rays can be cast in, `InvalidArgumentError` for bounds that
        hold none of it, a camera that sees no farther than the next cells, or a world without room for a
        robot, and `MemoryLimitError` for more than `MAX_CELLS` cells.
        """
        check_resolution(resolution)
        if not 0 < vertical_fov <= math.pi:
            raise InvalidArgumentError(f"vertical_fov={vertical_fov} must be above 0 and at most π rad.")
        for key, value in {"max_range": max_range, "robot_radius": robot_radius, "spacing": spacing}.items():
            if not (math.isfinite(value) and value > 0):
                raise InvalidArgumentError(f"{key}={value} must be above zero metres.")
        if max_range <= robot_radius + 2 * resolution:
            raise InvalidArgumentError(
                f"max_range={max_range} m ends within two cells of the robot: robot_radius={robot_radius} m, "
                f"resolution={resolution} m; take a longer range, or finer cells."
            )
        triangles = checked_triangles(triangles, name)
        mesh = MeshWorld(triangles)
        box = _lattice_box(mesh, bounds, resolution, name)
        place = None if start is None else _point(start, "start")

        def work_out() -> dict[str, Tensor]:
            grounded = above_floor(mesh, resolution, box)
            occupied, clear = occupied_and_clear(
                mesh, triangles, resolution, box, grounded, robot_radius, on_event
            )
            if not bool(occupied.any()):
                raise InvalidArgumentError(
                    f"bounds={_listed(bounds)} hold no surface of {name}, which extends from "
                    f"{_text(mesh.low, mesh.high)}; take wider bounds, with a floor."
                )
            navigable = connected(clear, mesh, resolution, box, place, robot_radius, name)
            seen = observable_cells(
                mesh,
                occupied,
                box,
                resolution,
                viewpoints(navigable, max(1, round(spacing / resolution))),
                view_directions(vertical_fov, max(resolution / (_SHARP * max_range), _FINEST)),
                max_range,
                on_event,
            )
            seen = (seen | navigable) & (grounded | occupied)
            return {"occupied": occupied, "observable": seen, "navigable": navigable}

        options = {
            "resolution": resolution,
            "low": box.low.tolist(),
            "high": box.high.tolist(),
            "vertical_fov": vertical_fov,
            "max_range": max_range,
            "robot_radius": robot_radius,
            "start": None if place is None else place.tolist(),
            "spacing": spacing,
        }
        cells = kept_cells(triangles, options, _CELLS, box.shape, work_out) if cache else work_out()
        return cls(name, mesh, resolution, box, **cells, robot_radius=robot_radius, start=place)

    def start_poses(
        self,
        n: int,
        spacing: float = 1.5,
        at: Sequence[float] | Tensor | None = None,
        primitives: Primitives | None = None,
    ) -> Tensor:
        """See `starts.start_poses`: `at` (3,) is `start` if not given, the primitives the usual ones."""
        place = self.start if at is None else _point(at, "at")
        return start_poses(self, n, spacing, place, self._flown(primitives))

    def check_start(self, poses: Tensor, primitives: Primitives | None = None) -> Tensor:
        """See `starts.check_start`; the primitives are the usual ones if not given."""
        return check_start(self, poses, self._flown(primitives))

    def _flown(self, primitives: Primitives | None) -> Primitives:
        return Primitives(Dynamics(radius=self.robot_radius)) if primitives is None else primitives

    def centers(self, cells: Tensor) -> Tensor:
        """Centres (..., 3), metres, of cells (..., 3) relative to the low corner of the box."""
        return (cells + self.box.low + 0.5).double() * self.resolution


def _point(place: Sequence[float] | Tensor, name: str) -> Tensor:
    point = torch.as_tensor(place, dtype=torch.float64)
    if point.shape != (3,) or not bool(torch.isfinite(point).all()):
        raise InvalidArgumentError(f"{name}={place} must be three finite numbers: x, y, z in metres.")
    return point


def _listed(bounds: Sequence[float] | Tensor | None) -> list[float]:
    """As the user wrote them."""
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
            raise InvalidArgumentError(f"bounds={ends.tolist()} hold nothing; write the low corner first.")
        if bool(((high < mesh.low) | (low > mesh.high)).any()):
            raise InvalidArgumentError(
                f"bounds={ends.tolist()} miss {name}, which extends from {_text(mesh.low, mesh.high)}."
            )
    first, last = ((end / resolution + ON_PLANE).floor() for end in (low, high))
    n_cells = float((last - first + 1).prod())
    if n_cells > MAX_CELLS:
        raise MemoryLimitError(
            f"{name}: {n_cells:.3g} cells of {resolution} m from {_text(low, high)}, more than "
            f"{MAX_CELLS:.3g}; take a coarser resolution (world.resolution), or tighter bounds "
            "(world.bounds); is the mesh in metres, not in millimetres?"
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
    """The world `name`: "warehouse" or "tunnels", of a seed and a size (m), or the "mesh" of a file.

    `options` are those of `World.from_mesh`. Raises what that does, `InvalidArgumentError` for a name that
    is not known or a setting that the world does not have, and `MissingDataError` for a path that does
    not exist.
    """
    if name not in ("warehouse", "tunnels", "mesh"):
        raise InvalidArgumentError(f"world={name!r} is not known; choose warehouse, tunnels or mesh.")
    if name == "mesh":
        if size is not None:
            raise InvalidArgumentError(f"size={size} is given, but a mesh has its own; give bounds instead.")
        file = Path("" if path is None else path).expanduser()
        if not file.is_file():
            raise MissingDataError(
                f"world.path={path} is no file; give a triangle mesh (PLY, OBJ, STL) in metres, z up."
            )
        return World.from_mesh(read_triangles(file), bounds=bounds, name=file.stem, **options)
    if path is not None:
        raise InvalidArgumentError(f"path={path} is given, but world={name} needs none; drop it.")
    extent = () if size is None else (size,)
    if name == "warehouse":
        triangles = warehouse(seed, *extent)
        if bounds is None:
            options.setdefault("start", warehouse_start(*extent))
    else:
        triangles = tunnels(seed, *extent)
    return World.from_mesh(triangles, bounds=bounds, name=name, **options)
