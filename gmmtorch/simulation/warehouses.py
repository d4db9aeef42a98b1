"""A furnished warehouse of any size: racks with goods, aisles, partitions with doors, pipes and rails.

Partition walls divide the floor into zones. A zone contains either rows of pallet racks along x or y with
cross aisles between blocks of racks, or stacks of crates with an office and a mezzanine. One corner of the
first zone is open: it is the receiving area, where robots start.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gmmtorch.errors import check_whole
from gmmtorch.simulation.furniture import (
    RACK_DEPTH,
    UNIT_CUBE,
    Bays,
    Room,
    box,
    checked_size,
    circle,
    copies,
    prism,
    racks,
    uniform,
)

_SHELL = 0.13
"""Thickness of floor, outer walls and ceiling (m). Only their inner faces are drawn. The faces do not lie on
the planes of usual grids, so all rays that end on a face fall into one layer of cells."""

_MIN_SIZE = (15.0, 12.0, 4.0)
_MAX_SIZE = 2000.0
_STAGING = 9.0
_CROSS_AISLE = 3.4
_AISLE = 2.5
_UNIT_CYLINDER = prism(circle(0.5, 10), -0.5, 0.5)
_UNIT_PIPE = _UNIT_CYLINDER[..., [2, 0, 1]]  # along x


def warehouse(seed: int = 0, size: Sequence[float] = (50.0, 40.0, 8.0)) -> Tensor:
    """Triangles (T, 3, 3), float64, of a warehouse in the box from the origin to `size` (m).

    The same seed and size give the same warehouse. Raises `InvalidArgumentError` for a size below
    15 × 12 × 4 m or above 2 km.
    """
    length, width, height = checked_size(size, _MIN_SIZE, _MAX_SIZE)
    generator = torch.Generator().manual_seed(check_whole("seed", seed, 0))
    ceiling = height - _SHELL
    xs, ys = _cuts(length, 25.0, (1.5, 1.0), generator), _cuts(width, 40.0, (1.0, 1.0), generator)
    low, high = (_SHELL, _SHELL, _SHELL), (length - _SHELL, width - _SHELL, ceiling)
    parts = [
        box(low, high),
        _partitions(xs, ys, ceiling, generator),
        _under_ceiling(length, width, ceiling, generator),
        _staging(generator),
    ]
    for i, (x0, x1) in enumerate(itertools.pairwise(xs)):
        for j, (y0, y1) in enumerate(itertools.pairwise(ys)):
            zone = Room(x0, y0, x1, y1)
            stacked = (i == 1 and j == 0) or (i + j > 0 and uniform(0, 1, generator) < 0.25)
            parts += (
                _stacks(zone, ceiling, generator) if stacked else _rack_zone(zone, ceiling, i + j, generator)
            )
    # Walls and girders are drawn over the full size; here they are cut at the inner faces.
    return torch.cat(parts).clamp(_size(*low), _size(*high))


def warehouse_start(size: Sequence[float] = (50.0, 40.0, 8.0)) -> Tensor:
    """Start position (3,), metres, in the open corner of a warehouse, with room for several robots."""
    checked_size(size, _MIN_SIZE, _MAX_SIZE)
    return torch.tensor([4.6, 4.6, 1.3], dtype=torch.float64)


def _cuts(
    length: float, about: float, weights: tuple[float, float], generator: torch.Generator
) -> list[float]:
    """Borders of zones along an axis, from 0 to `length`; zones are about `about` metres long."""
    n = max(1, round(length / about))
    share = torch.tensor([weights[k % 2] * uniform(0.95, 1.05, generator) for k in range(n)])
    return [0.0, *(length * (share.cumsum(0) / share.sum())).tolist()[:-1], length]


def _draw(low: float, high: float, n: int, generator: torch.Generator) -> Tensor:
    return low + (high - low) * torch.rand(n, generator=generator, dtype=torch.float64)


def _chance(probability: float, n: int, generator: torch.Generator) -> Tensor:
    return torch.rand(n, generator=generator, dtype=torch.float64) < probability


def _partitions(xs: list[float], ys: list[float], ceiling: float, generator: torch.Generator) -> Tensor:
    """Walls with doors between the zones. Some are lower than the ceiling."""
    parts = [torch.zeros(0, 3, 3, dtype=torch.float64)]
    for cuts, others, swap in ((xs, ys, False), (ys, xs, True)):
        for at in cuts[1:-1]:
            for begin, end in itertools.pairwise(others):
                top = ceiling if uniform(0, 1, generator) < 0.7 else min(ceiling, 4.0)
                wall = _wall(begin, end, top, generator)
                center = torch.tensor([(at, (a + b) / 2, (c + d) / 2) for a, b, c, d in wall]).double()
                extent = torch.tensor([(0.15, b - a, d - c) for a, b, c, d in wall]).double()
                if swap:
                    center, extent = center[:, [1, 0, 2]], extent[:, [1, 0, 2]]
                parts.append(copies(UNIT_CUBE, center, extent))
    return torch.cat(parts)


def _wall(begin: float, end: float, top: float, generator: torch.Generator) -> list[tuple[float, ...]]:
    """Rectangles (begin, end, bottom, top) of a wall: between its doors and above them."""
    n_doors = max(2, round((end - begin) / 14.0))
    span = (end - begin) / n_doors
    pieces, last = [], begin
    for k in range(n_doors):
        width = uniform(1.8, 3.0, generator) if span > 6 else 1.8
        middle = begin + (k + uniform(0.3, 0.7, generator)) * span
        left, right = middle - width / 2, middle + width / 2
        pieces += [(last, left, 0.0, top), (left, right, uniform(2.3, 3.2, generator), top)]
        last = right
    return [*pieces, (last, end, 0.0, top)]


def _under_ceiling(length: float, width: float, ceiling: float, generator: torch.Generator) -> Tensor:
    """Girders along y, lamps below them, and pipes along x."""
    girders = torch.arange(3.0, length - 1, 6.2, dtype=torch.float64)
    across = torch.full_like(girders, width / 2)
    pipes = torch.arange(2.5, width - 1, 7.7, dtype=torch.float64)
    depth = _draw(0.55, 1.0, len(pipes), generator)
    lamps = torch.cartesian_prod(girders + 2.9, torch.arange(3.1, width - 2, 5.1, dtype=torch.float64))
    lamps = lamps[lamps[:, 0] < length - 1.5]
    lamp = torch.cat([lamps, torch.full_like(lamps[:, :1], ceiling - 0.75)], 1)
    pipe = torch.stack([torch.full_like(pipes, length / 2), pipes, ceiling - depth], 1)
    thick = _draw(0.06, 0.16, len(pipes), generator)
    girder = torch.stack([girders, across, across * 0 + ceiling - 0.25], 1)
    return torch.cat(
        [
            copies(UNIT_CUBE, girder, _size(0.2, width, 0.5)),
            copies(UNIT_CUBE, lamp, _size(1.4, 0.18, 0.09)),
            copies(_UNIT_PIPE, pipe, torch.stack([thick * 0 + length, thick, thick], 1)),
        ]
    )


def _size(x: float, y: float, z: float) -> Tensor:
    return torch.tensor([x, y, z], dtype=torch.float64)


def _on_floor(places: Tensor, size: Tensor, base: float | Tensor = _SHELL) -> Tensor:
    """Centres (N, 3) of solids of size (N, 3) that stand at positions (N, 2), at height `base` (m)."""
    return torch.cat([places, (base + size[:, 2] / 2)[:, None]], 1)


def _staging(generator: torch.Generator) -> Tensor:
    """Pallets along the walls of the open corner, drums, and a handrail with a gap."""
    along = torch.arange(2.0, _STAGING - 0.5, 1.6, dtype=torch.float64)
    places = torch.cat([torch.stack([along, 0 * along + 0.9], 1), torch.stack([0 * along + 0.9, along], 1)])
    places = places[_chance(0.7, len(places), generator)]
    n = len(places)
    pallet = _size(1.1, 1.1, 0.14).expand(n, 3)
    load = torch.stack(
        [_draw(0.5, 1.05, n, generator), _draw(0.5, 1.05, n, generator), _draw(0.3, 1.3, n, generator)], 1
    )
    drums = torch.tensor([[8.3, 2.2], [8.6, 2.9], [7.8, 2.7]], dtype=torch.float64)
    drum = _size(0.6, 0.6, 0.9).expand(3, 3)
    parts = [
        copies(UNIT_CUBE, _on_floor(places, pallet), pallet),
        copies(UNIT_CUBE, _on_floor(places, load, _SHELL + 0.14), load, _draw(-0.2, 0.2, n, generator)),
        copies(_UNIT_CYLINDER, _on_floor(drums, drum), drum),
        _handrail(torch.tensor([[_STAGING, 0.4], [_STAGING, 3.4]]).double()),
        _handrail(torch.tensor([[_STAGING, 6.2], [_STAGING, _STAGING]]).double()),
    ]
    return torch.cat(parts)


def _handrail(ends: Tensor, base: float = _SHELL) -> Tensor:
    """Posts and two bars (T, 3, 3) between two points (2, 2) on a floor at height `base` (m)."""
    run = ends[1] - ends[0]
    length, heading = float(run.norm()), torch.atan2(run[1], run[0])
    share = torch.linspace(0, 1, max(2, round(length / 1.5) + 1), dtype=torch.float64)
    posts = ends[0] + share[:, None] * run
    post = _size(0.05, 0.05, 1.1).expand(len(posts), 3)
    bars = torch.cat([ends.mean(0).expand(2, 2), torch.tensor([[base + 0.55], [base + 1.1]]).double()], 1)
    return torch.cat(
        [
            copies(UNIT_CUBE, _on_floor(posts, post, base), post),
            copies(UNIT_CUBE, bars, _size(length, 0.045, 0.045), heading.expand(2)),
        ]
    )


def _rack_zone(zone: Room, ceiling: float, turn: int, generator: torch.Generator) -> list[Tensor]:
    """Double rows of racks, along x in even zones and along y in odd ones, with pillars between them."""
    swap = turn % 2 == 1
    low, high = (zone.x_min, zone.y_min), (zone.x_max, zone.y_max)
    if swap:
        low, high = low[::-1], high[::-1]
    double = 2 * RACK_DEPTH + 0.25
    depth = high[1] - low[1]
    n_rows = max(1, math.floor((depth - _AISLE) / (double + uniform(_AISLE, 3.2, generator))))
    aisle = (depth - n_rows * double) / (n_rows + 1)
    n_blocks = max(1, round((high[0] - low[0]) / 18.0))
    block = (high[0] - low[0] - (n_blocks + 1) * _CROSS_AISLE) / n_blocks
    n_bays = max(1, round(block / 2.7))
    rows = low[1] + aisle + double / 2 + (double + aisle) * torch.arange(n_rows, dtype=torch.float64)
    starts = low[0] + _CROSS_AISLE + (block + _CROSS_AISLE) * torch.arange(n_blocks, dtype=torch.float64)
    flue = torch.cartesian_prod(starts, rows)  # the start of each double row
    n = len(flue)
    levels_apart = _draw(1.45, 1.95, n, generator)
    n_levels = ((ceiling - 1.3) / levels_apart).floor().clamp(1, 5)
    n_levels = (n_levels - _chance(0.25, n, generator).double()).clamp_min(1)
    fill = _draw(0.45, 0.97, n, generator)
    bay = torch.arange(n_bays)
    side = torch.tensor([-1.0, 1.0], dtype=torch.float64) * (double - RACK_DEPTH) / 2
    which, k, s = (
        index.flatten() for index in torch.meshgrid(torch.arange(n), bay, torch.arange(2), indexing="ij")
    )
    width = block / n_bays
    place = torch.stack([flue[which, 0] + (k + 0.5) * width, flue[which, 1] + side[s]], 1)
    kept = ~_chance(0.06, len(place), generator)  # some bays are missing
    pillars = flue + torch.tensor([0.2, 0.0])
    if swap:
        place, pillars = place.flip(1), pillars.flip(1)
    if zone.x_min == 0 and zone.y_min == 0:
        kept &= ~(place < _STAGING + 1.5).all(1)
        pillars = pillars[~(pillars < _STAGING + 0.5).all(1)]
    which, place = which[kept], place[kept]
    bays = Bays(place, width, levels_apart[which], n_levels[which].long(), fill[which])
    pillar = _size(0.35, 0.35, ceiling - _SHELL).expand(len(pillars), 3)
    return [racks(bays, swap, _SHELL, generator), copies(UNIT_CUBE, _on_floor(pillars, pillar), pillar)]


def _stacks(zone: Room, ceiling: float, generator: torch.Generator) -> list[Tensor]:
    """Stacks of crates and drums in blocks with lanes between them, an office, and a mezzanine."""
    corner = torch.tensor([zone.x_max - 3.0, zone.y_max - 3.2], dtype=torch.float64)
    deck = torch.tensor([zone.x_min + 5.2, zone.y_max - 4.6], dtype=torch.float64)
    pitch = torch.tensor([3 * 1.3 + _AISLE, 2 * 1.2 + _AISLE + 0.2], dtype=torch.float64)
    first = torch.tensor([zone.x_min + _AISLE + 1.95, zone.y_min + _AISLE + 1.2], dtype=torch.float64)
    last = torch.tensor([zone.x_max - _AISLE - 1.95, zone.y_max - _AISLE - 1.2], dtype=torch.float64)
    axes = [
        torch.arange(float(a), float(b) + 1e-6, float(p), dtype=torch.float64)
        for a, b, p in zip(first, last, pitch, strict=True)
    ]
    blocks = torch.cartesian_prod(*axes)
    free = ((blocks - corner).abs() > torch.tensor([6.0, 6.0])).any(1)
    free &= ((blocks - deck).abs() > torch.tensor([7.0, 6.0])).any(1)
    blocks = blocks[free & _chance(0.85, len(blocks), generator)]
    cell = torch.cartesian_prod(torch.tensor([-1.3, 0.0, 1.3]), torch.tensor([-0.6, 0.6])).double()
    places = (blocks[:, None] + cell).flatten(0, 1)
    n = len(places)
    each = _draw(0.7, 1.1, n, generator)
    high = torch.minimum((_draw(0.3, 4.99, n, generator)).floor(), ((ceiling - 2.0) / each).floor())
    crates = [torch.zeros(0, 3, 3, dtype=torch.float64)]
    for level in range(5):
        on = high > level
        size = torch.stack([_draw(0.95, 1.2, n, generator), _draw(0.9, 1.1, n, generator), each - 0.02], 1)[
            on
        ]
        turned = _draw(-0.05, 0.05, n, generator)[on]
        crates.append(copies(UNIT_CUBE, _on_floor(places[on], size, _SHELL + level * each[on]), size, turned))
    drums = places[(high == 0) & _chance(0.6, n, generator)]
    drum = _size(0.6, 0.6, 0.9).expand(len(drums), 3)
    return [
        *crates,
        copies(_UNIT_CYLINDER, _on_floor(drums, drum), drum),
        _office(corner, generator),
        *_mezzanine(deck, ceiling),
    ]


def _office(center: Tensor, generator: torch.Generator) -> Tensor:
    """A room of 4.4 × 4.8 m around a point (2,), with a door, a window, a desk and a cupboard."""
    rows = [
        # x, y, z of the centre, then the size
        (-2.2, -1.6, 1.4, 0.1, 1.6, 2.8),
        (-2.2, 1.3, 1.4, 0.1, 2.2, 2.8),
        (-2.2, -0.3, 2.55, 0.1, 1.0, 0.5),  # above the door
        (0.0, -2.4, 0.5, 4.4, 0.1, 1.0),
        (0.0, -2.4, 2.4, 4.4, 0.1, 0.8),  # with the row above: a window between them
        (-1.7, -2.4, 1.5, 1.0, 0.1, 1.0),
        (1.7, -2.4, 1.5, 1.0, 0.1, 1.0),
        (2.2, 0.0, 1.4, 0.1, 4.8, 2.8),
        (0.0, 2.4, 1.4, 4.4, 0.1, 2.8),
        (0.0, 0.0, 2.85, 4.6, 5.0, 0.1),
        (0.6, -1.5, 0.73, 1.6, 0.8, 0.05),
        (0.6, -1.5, 0.35, 0.5, 0.5, 0.7),
        (1.8, 1.2, 0.9, 0.5, 1.6, 1.8),
    ]
    table = torch.tensor(rows, dtype=torch.float64)
    table[11, 0] += uniform(-0.4, 0.4, generator)
    base = torch.tensor([float(center[0]), float(center[1]), _SHELL], dtype=torch.float64)
    return copies(UNIT_CUBE, table[:, :3] + base, table[:, 3:])


def _mezzanine(center: Tensor, ceiling: float) -> list[Tensor]:
    """A platform of 7 × 5 m on posts, with a handrail around it; nothing if the ceiling is too low."""
    height = 3.1
    if ceiling < height + 2.5:
        return []
    half = torch.tensor([3.5, 2.5], dtype=torch.float64)
    signs = torch.tensor([[-1.0, -1], [1, -1], [1, 1], [-1, 1]], dtype=torch.float64)
    corners = center + signs * half
    inner = center + torch.cat([signs * (half - 0.2), torch.tensor([[0.0, -2.3], [0.0, 2.3]]).double()])
    post = _size(0.16, 0.16, height - _SHELL).expand(6, 3)
    slab = torch.tensor([[float(center[0]), float(center[1]), height + 0.1]], dtype=torch.float64)
    rails = [_handrail(torch.stack([corners[k], corners[k - 1]]), height + 0.2) for k in range(4)]
    return [
        copies(UNIT_CUBE, _on_floor(inner, post), post),
        copies(UNIT_CUBE, slab, _size(7.0, 5.0, 0.2)),
        *rails,
    ]
