"""A mine: galleries on slopes between junction chambers, dead ends, rough rock.

The rock is where a field is above zero: the distance to the nearest gallery or chamber, less its half width,
disturbed by smooth noise. Its zero surface is triangulated on a grid, closed all around.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import GmmTorchError, InvalidArgumentError, check_whole
from gmmtorch.simulation.worlds.floor_plan import uniform
from gmmtorch.simulation.worlds.mesh_checks import have_area

_CELL = 0.4
"""Metres between the points of the field's grid."""

_ROUGH = 0.25
"""Metres by which walls and floor are out of true."""

_ROCK = 1.5
"""The field where nothing was dug: farther than this from a gallery it is not worked out."""

_HALF_WIDTH, _HEIGHT = 1.75, 3.1
_CHAMBER = 3.4
_APART = 13.0
_SLOPE = 0.15
_MARGIN = 6.5
"""Metres between junctions and the end of the world: a chamber and the sway of a gallery."""

_FLOOR = 1.0
_HEADROOM = 5.4
"""Metres from the floor of the highest junction to the top of the world: a chamber, and rock above it."""

_LEAST = (40.0, 40.0, 7.0)
_MOST = 600.0


def tunnels(seed: int = 0, size: Sequence[float] = (60.0, 60.0, 10.0)) -> Tensor:
    """Triangles (T, 3, 3), float64, of a mine within a box of `size` (m) whose lowest corner is the origin.

    Galleries are 3 to 4 m wide and 3 m high. The same seed and size give the same mine. Raises
    `InvalidArgumentError` for a size below 40 × 40 × 7 m or above 600 m, and `GmmTorchError` where
    Open3D does not load.
    """
    extent = tuple(float(x) for x in size)
    if len(extent) != 3 or not all(low <= x <= _MOST for low, x in zip(_LEAST, extent, strict=True)):
        raise InvalidArgumentError(
            f"size={size} must be length, width and height of at least {_LEAST} and at most {_MOST:.0f} m."
        )
    generator = torch.Generator().manual_seed(check_whole("seed", seed, 0))
    nodes = _junctions(extent, generator)
    pairs, is_stub = _galleries(nodes, generator)
    field = torch.full([round(x / _CELL) for x in extent], _ROCK)
    for (first, last), stub in zip(pairs.tolist(), is_stub.tolist(), strict=True):
        way = _bent(nodes[first], nodes[last], generator)
        _dig(field, way[: len(way) // 2 + 1] if stub else way, _HALF_WIDTH, _HEIGHT)
    degree = torch.bincount(pairs[~is_stub].flatten(), minlength=len(nodes))
    for node, n in zip(nodes, degree.tolist(), strict=True):
        if n > 2:
            radius = _CHAMBER * uniform(0.75, 1.3, generator)
            _dig(field, node.expand(2, 3), radius, _HEIGHT + 0.3 * (radius - _HALF_WIDTH))
    field += _ROUGH * (_noise(field.shape, 2.8, generator) + 0.5 * _noise(field.shape, 1.2, generator))
    for axis in range(3):  # so that the rock is closed all around
        field.select(axis, 0).fill_(_ROCK)
        field.select(axis, -1).fill_(_ROCK)
    return _surface(field)


def _junctions(extent: tuple[float, ...], generator: torch.Generator) -> Tensor:
    """Places (N, 3) on the floor, metres, `_APART` from each other on the plan, their heights drifting."""
    low = torch.tensor([_MARGIN, _MARGIN])
    room = torch.tensor(extent[:2], dtype=torch.float64) - 2 * low
    plan = torch.zeros(0, 2, dtype=torch.float64)
    for place in low + room * torch.rand(int(room.prod()) + 200, 2, generator=generator, dtype=torch.float64):
        if bool(((plan - place).norm(dim=1) > _APART).all()):
            plan = torch.cat([plan, place[None]])
    wave = 2 * math.pi * torch.rand(2, generator=generator, dtype=torch.float64)
    drift = 0.5 + ((plan[:, 0] / 19 + wave[0]).sin() + (plan[:, 1] / 17 + wave[1]).sin()) / 4
    return torch.cat([plan, (_FLOOR + (extent[2] - _HEADROOM - _FLOOR) * drift)[:, None]], 1)


def _galleries(nodes: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Pairs (E, 2) of junctions (N, 3), and which of them (E,) are dead ends that stop half way.

    A tree of the shortest and least steep galleries keeps the mine together; a few more close loops.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import minimum_spanning_tree
    from scipy.spatial import Delaunay

    corners = torch.from_numpy(Delaunay(nodes[:, :2].numpy()).simplices).long()
    pairs = torch.cat([corners[:, :2], corners[:, 1:], corners[:, ::2]]).sort(1).values.unique(dim=0)
    run = nodes[pairs[:, 1]] - nodes[pairs[:, 0]]
    length = run[:, :2].norm(dim=1)
    cost = length * (1 + 20 * (run[:, 2].abs() / length - _SLOPE).clamp_min(0))
    weights = coo_matrix((cost.numpy(), pairs.T.numpy()), shape=(len(nodes), len(nodes)))
    tree = minimum_spanning_tree(weights).tocoo()
    ends = torch.from_numpy(np.stack([tree.row, tree.col], 1)).long().sort(1).values
    in_tree = (pairs[:, None] == ends).all(2).any(1)
    sound = (length < 2.2 * _APART) & (cost < 1.5 * length)
    chance = torch.rand(len(pairs), generator=generator)
    loop, stub = sound & (chance < 0.3), sound & ~in_tree & (chance > 0.7)
    kept = in_tree | loop | stub
    return pairs[kept], (stub & ~in_tree)[kept]


def _bent(start: Tensor, end: Tensor, generator: torch.Generator) -> Tensor:
    """A winding way (P, 3) between two places, its pieces about 2 m long."""
    run = end - start
    length = float(run[:2].norm())
    n = max(4, round(length / 2))
    share = torch.linspace(0, 1, n + 1, dtype=torch.float64)[:, None]
    sway = uniform(-0.12, 0.12, generator) * (math.pi * share).sin()
    sway = sway + uniform(-0.06, 0.06, generator) * (2 * math.pi * share).sin()
    aside = torch.stack([-run[1], run[0], torch.zeros_like(run[0])])
    return start + share * run + sway * aside


def _dig(field: Tensor, way: Tensor, half_width: float, height: float) -> None:
    """Take a gallery with its floor along a way (P, 3) out of the rock, in place.

    Its section is |x / w|³ + |2z / h − 1|³ = 1: upright walls, an arched roof, an almost level floor.
    """
    reach = half_width + _ROCK
    below = torch.tensor([reach, reach, _ROCK])
    above = torch.tensor([reach, reach, height + _ROCK])
    size = torch.tensor(field.shape)
    first = ((way.amin(0) - below) / _CELL).floor().long().clamp_min(0)
    last = torch.minimum(((way.amax(0) + above) / _CELL).ceil().long() + 1, size)
    part = tuple(slice(a, b) for a, b in zip(first.tolist(), last.tolist(), strict=True))
    x, y, z = ((torch.arange(s.start, s.stop) + 0.5).double() * _CELL for s in part)
    plan = torch.cartesian_prod(x, y)
    for a, b in itertools.pairwise(way):
        run = (b - a)[:2]
        share = (((plan - a[:2]) @ run) / run.square().sum().clamp_min(1e-12)).clamp(0, 1)
        aside = (plan - a[:2] - share[:, None] * run).norm(dim=1) / half_width
        up = 2 * (z - (a[2] + share * (b[2] - a[2]))[:, None]) / height - 1
        section = (aside[:, None] ** 3 + up.abs() ** 3) ** (1 / 3)
        depth = ((section - 1) * min(half_width, height / 2)).view(len(x), len(y), len(z))
        torch.minimum(field[part], depth.float(), out=field[part])


def _noise(shape: torch.Size, wavelength: float, generator: torch.Generator) -> Tensor:
    """Smooth noise between −1 and 1 on the grid."""
    coarse = [math.ceil(n * _CELL / wavelength) + 1 for n in shape]
    values = 2 * torch.rand(coarse, generator=generator) - 1
    return torch.nn.functional.interpolate(values[None, None], tuple(shape), mode="trilinear")[0, 0]


def _surface(field: Tensor) -> Tensor:
    """Triangles (T, 3, 3) where the field is 0, by Open3D's dual contouring."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise GmmTorchError(
            f"A mine cannot be built, because Open3D does not load: {error}. On Debian or Ubuntu "
            "scripts/setup.sh installs the libraries it needs."
        ) from error
    core: Any = open3d.core
    volume = core.Tensor(field.permute(2, 1, 0).contiguous().numpy())
    mesh = open3d.t.geometry.TriangleMesh.create_isosurfaces(volume)
    corners = torch.from_numpy(mesh.vertex.positions.numpy()).double()
    triangles = (corners[torch.from_numpy(mesh.triangle.indices.numpy()).long()] + 0.5) * _CELL
    return triangles[have_area(triangles)]
