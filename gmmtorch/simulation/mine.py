"""A mine: sloping galleries between junction chambers, dead ends, rough rock.

A scalar field on a grid describes the mine: the approximate distance (m) to the wall of the nearest gallery
or chamber, negative inside, plus smooth noise. Its zero surface is triangulated and closed on all sides.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import GmmTorchError, check_whole
from gmmtorch.optional_packages import load_open3d
from gmmtorch.simulation.furniture import checked_size, uniform
from gmmtorch.simulation.mesh_world import have_area

_CELL = 0.4  # spacing of the field's grid, metres

_ROUGHNESS = 0.25  # amplitude of the noise on walls and floor, metres

_ROCK = 1.5
"""Value of the field in solid rock, and largest distance from a gallery at which the field is computed."""

_HALF_WIDTH, _HEIGHT = 1.75, 3.1
_CHAMBER = 3.4
_JUNCTION_SPACING = 13.0
_MAX_SLOPE = 0.15
_MARGIN = 6.5
"""Distance of junctions from the border of the world, metres: room for a chamber and a bent gallery."""

_FLOOR = 1.0
_HEADROOM = 5.4
"""Height from the floor of the highest junction to the top of the world, metres: a chamber and rock."""

_MIN_SIZE = (40.0, 40.0, 7.0)
_MAX_SIZE = 600.0


def tunnels(seed: int = 0, size: Sequence[float] = (60.0, 60.0, 10.0)) -> Tensor:
    """Triangles (T, 3, 3), float64, of a mine in the box from the origin to `size` (m).

    Galleries are 3 to 4 m wide and 3 m high. The same seed and size give the same mine. Raises
    `InvalidArgumentError` for a size below 40 × 40 × 7 m or above 600 m, and `GmmTorchError` if
    Open3D does not load.
    """
    extent = checked_size(size, _MIN_SIZE, _MAX_SIZE)
    generator = torch.Generator().manual_seed(check_whole("seed", seed, 0))
    nodes = _junctions(extent, generator)
    pairs, is_dead_end = _galleries(nodes, generator)
    field = torch.full([round(x / _CELL) for x in extent], _ROCK)
    for (first, last), dead_end in zip(pairs.tolist(), is_dead_end.tolist(), strict=True):
        path = _bent_path(nodes[first], nodes[last], generator)
        _dig(field, path[: len(path) // 2 + 1] if dead_end else path, _HALF_WIDTH, _HEIGHT)
    degree = torch.bincount(pairs[~is_dead_end].flatten(), minlength=len(nodes))
    for node, n in zip(nodes, degree.tolist(), strict=True):
        if n > 2:
            radius = _CHAMBER * uniform(0.75, 1.3, generator)
            _dig(field, node.expand(2, 3), radius, _HEIGHT + 0.3 * (radius - _HALF_WIDTH))
    field += _ROUGHNESS * (_noise(field.shape, 2.8, generator) + 0.5 * _noise(field.shape, 1.2, generator))
    for axis in range(3):  # closes the surface on all sides
        field.select(axis, 0).fill_(_ROCK)
        field.select(axis, -1).fill_(_ROCK)
    return _surface(field)


def _junctions(extent: tuple[float, ...], generator: torch.Generator) -> Tensor:
    """Floor points (N, 3), metres, `_JUNCTION_SPACING` or more apart in the plane; heights vary slowly."""
    low = torch.tensor([_MARGIN, _MARGIN])
    room = torch.tensor(extent[:2], dtype=torch.float64) - 2 * low
    plan = torch.zeros(0, 2, dtype=torch.float64)
    for place in low + room * torch.rand(int(room.prod()) + 200, 2, generator=generator, dtype=torch.float64):
        if bool(((plan - place).norm(dim=1) > _JUNCTION_SPACING).all()):
            plan = torch.cat([plan, place[None]])
    wave = 2 * math.pi * torch.rand(2, generator=generator, dtype=torch.float64)
    drift = 0.5 + ((plan[:, 0] / 19 + wave[0]).sin() + (plan[:, 1] / 17 + wave[1]).sin()) / 4
    return torch.cat([plan, (_FLOOR + (extent[2] - _HEADROOM - _FLOOR) * drift)[:, None]], 1)


def _galleries(nodes: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Pairs (E, 2) of junctions (N, 3), and whether each gallery (E,) is a dead end that stops half way.

    A spanning tree of the shortest and least steep galleries connects all junctions; some more close loops.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import minimum_spanning_tree
    from scipy.spatial import Delaunay

    corners = torch.from_numpy(Delaunay(nodes[:, :2].numpy()).simplices).long()
    pairs = torch.cat([corners[:, :2], corners[:, 1:], corners[:, ::2]]).sort(1).values.unique(dim=0)
    run = nodes[pairs[:, 1]] - nodes[pairs[:, 0]]
    length = run[:, :2].norm(dim=1)
    cost = length * (1 + 20 * (run[:, 2].abs() / length - _MAX_SLOPE).clamp_min(0))
    weights = coo_matrix((cost.numpy(), pairs.T.numpy()), shape=(len(nodes), len(nodes)))
    tree = minimum_spanning_tree(weights).tocoo()
    ends = torch.from_numpy(np.stack([tree.row, tree.col], 1)).long().sort(1).values
    in_tree = (pairs[:, None] == ends).all(2).any(1)
    usable = (length < 2.2 * _JUNCTION_SPACING) & (cost < 1.5 * length)
    chance = torch.rand(len(pairs), generator=generator)
    loop, dead_end = usable & (chance < 0.3), usable & ~in_tree & (chance > 0.7)
    kept = in_tree | loop | dead_end
    return pairs[kept], dead_end[kept]


def _bent_path(start: Tensor, end: Tensor, generator: torch.Generator) -> Tensor:
    """A bent path (P, 3) between two points, in steps of about 2 m."""
    run = end - start
    length = float(run[:2].norm())
    n = max(4, round(length / 2))
    share = torch.linspace(0, 1, n + 1, dtype=torch.float64)[:, None]
    sway = uniform(-0.12, 0.12, generator) * (math.pi * share).sin()
    sway = sway + uniform(-0.06, 0.06, generator) * (2 * math.pi * share).sin()
    aside = torch.stack([-run[1], run[0], torch.zeros_like(run[0])])
    return start + share * run + sway * aside


def _dig(field: Tensor, path: Tensor, half_width: float, height: float) -> None:
    """Removes a gallery, with its floor along a path (P, 3), from the rock, in place.

    Its section is |x / w|³ + |2z / h − 1|³ = 1: vertical walls, an arched roof, an almost level floor.
    """
    reach = half_width + _ROCK
    below = torch.tensor([reach, reach, _ROCK])
    above = torch.tensor([reach, reach, height + _ROCK])
    size = torch.tensor(field.shape)
    first = ((path.amin(0) - below) / _CELL).floor().long().clamp_min(0)
    last = torch.minimum(((path.amax(0) + above) / _CELL).ceil().long() + 1, size)
    region = tuple(slice(a, b) for a, b in zip(first.tolist(), last.tolist(), strict=True))
    x, y, z = ((torch.arange(s.start, s.stop) + 0.5).double() * _CELL for s in region)
    plan = torch.cartesian_prod(x, y)
    for a, b in itertools.pairwise(path):
        run = (b - a)[:2]
        share = (((plan - a[:2]) @ run) / run.square().sum().clamp_min(1e-12)).clamp(0, 1)
        aside = (plan - a[:2] - share[:, None] * run).norm(dim=1) / half_width
        up = 2 * (z - (a[2] + share * (b[2] - a[2]))[:, None]) / height - 1
        section = (aside[:, None] ** 3 + up.abs() ** 3) ** (1 / 3)
        depth = ((section - 1) * min(half_width, height / 2)).view(len(x), len(y), len(z))
        torch.minimum(field[region], depth.float(), out=field[region])


def _noise(shape: torch.Size, wavelength: float, generator: torch.Generator) -> Tensor:
    """Smooth noise from −1 to 1 on the grid, of a wavelength in metres."""
    coarse = [math.ceil(n * _CELL / wavelength) + 1 for n in shape]
    values = 2 * torch.rand(coarse, generator=generator) - 1
    return torch.nn.functional.interpolate(values[None, None], tuple(shape), mode="trilinear")[0, 0]


def _surface(field: Tensor) -> Tensor:
    """Triangles (T, 3, 3) of the zero surface of the field, by Open3D's dual contouring."""
    open3d = load_open3d("A mine cannot be built")
    if not hasattr(open3d.t.geometry.TriangleMesh, "create_isosurfaces"):
        raise GmmTorchError(
            f"A mine (world=tunnels) needs Open3D 0.19; {open3d.__version__} is installed: "
            "pip install 'open3d>=0.19'."
        )
    volume = open3d.core.Tensor(field.permute(2, 1, 0).contiguous().numpy())
    mesh = open3d.t.geometry.TriangleMesh.create_isosurfaces(volume)
    corners = torch.from_numpy(mesh.vertex.positions.numpy()).double()
    triangles = (corners[torch.from_numpy(mesh.triangle.indices.numpy()).long()] + 0.5) * _CELL
    return triangles[have_area(triangles)]
