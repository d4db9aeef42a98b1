"""Pallet racks as triangle soups: uprights, braces, beams, decks, and goods on pallets."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.simulation.worlds.solids import box, copies

RACK_DEPTH = 1.1
_UPRIGHT = 0.1
_PALLET = 0.14
_GAP = 0.2
"""Metres from the goods to the deck above, at least."""

_SLOTS = 2
_CUBE = box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))


class Bays(NamedTuple):
    """Bays between two uprights.

    place: (B, 2) their middles, metres. width: metres. spacing: (B,) metres from one level to the next.
    levels: (B,) int64. fill: (B,) the share of the places for a pallet that is taken.
    """

    place: Tensor
    width: float
    spacing: Tensor
    levels: Tensor
    fill: Tensor


class _Parts(NamedTuple):
    """Cuboids of bays: whose (N,), where from the bay's place on the floor (N, 3), how large (N, 3), metres.

    The axes are along the row, across it, and up.
    """

    bay: Tensor
    offset: Tensor
    size: Tensor


def racks(bays: Bays, along_y: bool, floor: float, generator: torch.Generator) -> Tensor:
    """Triangles (T, 3, 3) of bays that stand on a floor at this height, side by side along x or y.

    A level has a deck or, in some places, beams alone; the lowest pallets stand on the floor.
    """
    if len(bays.place) == 0:
        return torch.zeros(0, 3, 3, dtype=torch.float64)
    parts = [_frames(bays), _levels(bays, generator), _goods(bays, generator)]
    bay, offset, size = (torch.cat(column) for column in zip(*parts, strict=True))
    if along_y:
        offset, size = offset[:, [1, 0, 2]], size[:, [1, 0, 2]]
    base = torch.nn.functional.pad(bays.place, (0, 1), value=floor)
    return copies(_CUBE, base[bay] + offset, size)


def _frames(bays: Bays) -> _Parts:
    """Four uprights a bay, and bars between those on either side."""
    height = bays.spacing * bays.levels + 0.2
    reach = torch.tensor([bays.width - _UPRIGHT, RACK_DEPTH - _UPRIGHT], dtype=torch.float64) / 2
    feet = torch.cartesian_prod(torch.tensor([-1.0, 1.0]), torch.tensor([-1.0, 1.0])).double() * reach
    post, bay = _pairs(4, len(height))
    tall = height[bay]
    posts = _Parts(
        bay,
        torch.cat([feet[post], tall[:, None] / 2], 1),
        torch.stack([_like(tall, _UPRIGHT), _like(tall, _UPRIGHT), tall], 1),
    )
    bar, bay = _pairs(10, len(height))
    above = 0.4 + 1.2 * (bar // 2)
    along = (2.0 * (bar % 2) - 1) * reach[0]
    bars = _Parts(
        bay,
        torch.stack([along, 0 * along, above.double()], 1),
        torch.tensor([0.04, RACK_DEPTH - _UPRIGHT, 0.04], dtype=torch.float64).expand(len(bay), 3),
    )
    within = above < height[bay]
    return _joined(posts, _Parts(*(field[within] for field in bars)))


def _levels(bays: Bays, generator: torch.Generator) -> _Parts:
    """Two beams a level, and most often a deck on them."""
    level, bay = _pairs(int(bays.levels.max()), len(bays.levels))
    level, bay = level[level < bays.levels[bay]], bay[level < bays.levels[bay]]
    height = (level + 1) * bays.spacing[bay]
    flat = torch.zeros_like(height)
    edge = _like(height, (RACK_DEPTH - 0.05) / 2)
    beam = torch.tensor([bays.width, 0.05, 0.12], dtype=torch.float64).expand(len(bay), 3)
    decked = torch.rand(len(bay), generator=generator) < 0.85
    deck = torch.tensor([bays.width, RACK_DEPTH - 0.1, 0.03], dtype=torch.float64).expand(len(bay), 3)
    return _joined(
        _Parts(bay, torch.stack([flat, edge, height - 0.06], 1), beam),
        _Parts(bay, torch.stack([flat, -edge, height - 0.06], 1), beam),
        _Parts(bay[decked], torch.stack([flat, flat, height - 0.015], 1)[decked], deck[decked]),
    )


def _goods(bays: Bays, generator: torch.Generator) -> _Parts:
    """A pallet and a box on it where a place is taken, on the floor and on every level but the top one."""
    place, bay = _pairs(_SLOTS * int(bays.levels.max()), len(bays.levels))
    level, slot = place // _SLOTS, place % _SLOTS
    draw = torch.rand(6, len(bay), generator=generator, dtype=torch.float64)
    taken = (level < bays.levels[bay]) & (draw[0] < bays.fill[bay])
    level, slot, bay, draw = level[taken], slot[taken], bay[taken], draw[:, taken]
    slot_width = (bays.width - 2 * _UPRIGHT) / _SLOTS
    along = (slot - (_SLOTS - 1) / 2) * slot_width + 0.1 * (draw[1] - 0.5)
    across = 0.1 * (draw[2] - 0.5)
    base = level * bays.spacing[bay] + 0.01
    load = torch.stack(
        [
            (0.55 + 0.35 * draw[3]) * slot_width,
            0.6 + 0.35 * draw[4],
            (0.25 + 0.75 * draw[5]) * (bays.spacing[bay] - _PALLET - _GAP - 0.12),
        ],
        1,
    )
    pallet = torch.tensor([0.85 * slot_width, 0.95, _PALLET], dtype=torch.float64).expand(len(bay), 3)
    return _joined(
        _Parts(bay, torch.stack([along, across, base + _PALLET / 2], 1), pallet),
        _Parts(bay, torch.stack([along, across, base + _PALLET + load[:, 2] / 2], 1), load),
    )


def _pairs(n: int, n_bays: int) -> tuple[Tensor, Tensor]:
    """All pairs of a number below n and a bay, each (n·B,)."""
    both = torch.cartesian_prod(torch.arange(n), torch.arange(n_bays))
    return both[:, 0], both[:, 1]


def _like(values: Tensor, value: float) -> Tensor:
    return torch.full_like(values, value)


def _joined(*parts: _Parts) -> _Parts:
    return _Parts(*(torch.cat(column) for column in zip(*parts, strict=True)))
