"""Floor plans and furniture: rooms, footprints, placing pieces beside a path, and solids, furniture
and pallet racks as triangles (T, 3, 3), metres, z up.

Each of the functions from `table` to `globe` draws one piece at random. `racks` builds rows of pallet racks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError

_ATTEMPTS = 40
_CLEARANCE = 0.6  # least distance of furniture from the path, metres
_GAP = 0.2  # least distance between two pieces of furniture, metres
CEILING = 4.0
_BOARD = 0.03

RACK_DEPTH = 1.1
_UPRIGHT = 0.1
_PALLET = 0.14
_FREE_ABOVE = 0.2  # least distance between goods and the deck above, metres

_SLOTS = 2


class Room(NamedTuple):
    """The inside of a room, from wall to wall, metres."""

    x_min: float
    y_min: float
    x_max: float
    y_max: float


@dataclass(frozen=True)
class Footprint:
    """A rectangle on the floor: centre (m), heading of its long side (rad), length and width (m)."""

    x: float
    y: float
    heading: float
    length: float
    width: float

    def to_world(self, local: Tensor) -> Tensor:
        """World points (N, 2) of points (N, 2) in the frame of the footprint."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        x = self.x + cos * local[:, 0] - sin * local[:, 1]
        return torch.stack([x, self.y + sin * local[:, 0] + cos * local[:, 1]], 1)

    def contains(self, points: Tensor, margin: float = 0.0) -> Tensor:
        """Whether each point (N, 2) lies in the rectangle grown by `margin` metres: (N,) bool."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        dx, dy = points[:, 0] - self.x, points[:, 1] - self.y
        along, across = (cos * dx + sin * dy).abs(), (cos * dy - sin * dx).abs()
        return (along <= self.length / 2 + margin) & (across <= self.width / 2 + margin)

    def corners(self) -> Tensor:
        """The four corners (4, 2), counter-clockwise."""
        return self.to_world(rectangle(self.length, self.width))

    def outline(self) -> Tensor:
        """Points (40, 2) along the four sides."""
        corners = self.corners()
        share = torch.arange(0, 1, 0.1, dtype=torch.float64)[:, None, None]
        return (corners * (1 - share) + corners.roll(-1, dims=0) * share).flatten(0, 1)


class Piece(NamedTuple):
    """A piece of furniture.

    size: length and width (m). at_wall: whether it stands at a wall. build: returns its surfaces on a
    footprint, as polygons (C, 2) in a plane world and triangles (T, 3, 3) in a 3D world.
    """

    size: tuple[float, float]
    at_wall: bool
    build: Callable[[Footprint], list[Tensor]]


def checked_size(size: Sequence[float], least: Sequence[float], most: float) -> tuple[float, float, float]:
    """Length, width and height (m) of a generated world. Raises `InvalidArgumentError` for a wrong size."""
    values = tuple(float(x) for x in size)
    if len(values) != 3 or not all(low <= x <= most for low, x in zip(least, values, strict=True)):
        raise InvalidArgumentError(
            f"size={size} must be length, width and height of at least {least} and at most {most:.0f} m."
        )
    return values


DrawPiece = Callable[[torch.Generator], Piece]


def rectangle(length: float, width: float) -> Tensor:
    """Corners (4, 2) of a rectangle centred on the origin, counter-clockwise."""
    a, b = length / 2, width / 2
    return torch.tensor([[-a, -b], [a, -b], [a, b], [-a, b]], dtype=torch.float64)


def circle(radius: float, n_sides: int) -> Tensor:
    """Corners (n_sides, 2) of a regular polygon centred on the origin, counter-clockwise."""
    angle = torch.arange(n_sides, dtype=torch.float64) * (2 * math.pi / n_sides)
    return radius * torch.stack([angle.cos(), angle.sin()], 1)


def uniform(low: float, high: float, generator: torch.Generator) -> float:
    """One number drawn uniformly from [low, high)."""
    return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))


def furnish(
    room: Room, path: Tensor, generator: torch.Generator, wanted: dict[DrawPiece, int]
) -> list[Tensor]:
    """Surfaces of furniture in a room that leaves the path (P, 2) free.

    `wanted` gives the number of pieces of each kind. A piece for which no free place is found is left out.
    """
    taken: list[Footprint] = []
    surfaces: list[Tensor] = []
    for draw, count in wanted.items():
        for _ in range(count):
            piece = draw(generator)
            footprint = place(room, piece.size, path, taken, generator, piece.at_wall)
            if footprint is not None:
                taken.append(footprint)
                surfaces += piece.build(footprint)
    return surfaces


def place(
    room: Room,
    size: tuple[float, float],
    path: Tensor,
    taken: Sequence[Footprint],
    generator: torch.Generator,
    at_wall: bool = False,
) -> Footprint | None:
    """A free footprint of `size` (length, width) in the room, or None if none was found.

    It stays `_CLEARANCE` metres away from the path (P, 2) and does not touch the `taken` footprints.
    """
    for _ in range(_ATTEMPTS):
        footprint = _drawn(room, *size, at_wall, generator)
        corners = footprint.corners()
        inside = (corners >= torch.tensor(room[:2])) & (corners <= torch.tensor(room[2:]))
        if not bool(inside.all()) or bool(footprint.contains(path, _CLEARANCE).any()):
            continue
        outline = footprint.outline()
        if not any(
            bool(footprint.contains(other.outline(), _GAP).any() or other.contains(outline, _GAP).any())
            for other in taken
        ):
            return footprint
    return None


def _drawn(room: Room, length: float, width: float, at_wall: bool, generator: torch.Generator) -> Footprint:
    """A footprint drawn anywhere in a room, or at one of its walls."""
    if not at_wall:
        x = uniform(room.x_min, room.x_max, generator)
        y = uniform(room.y_min, room.y_max, generator)
        return Footprint(x, y, uniform(0, math.pi, generator), length, width)
    offset = 0.02 + width / 2  # furniture stands 2 cm from the wall
    along_x = uniform(0, 1, generator) < 0.5
    near_side = uniform(0, 1, generator) < 0.5
    if along_x:
        y = room.y_min + offset if near_side else room.y_max - offset
        return Footprint(uniform(room.x_min, room.x_max, generator), y, 0.0, length, width)
    x = room.x_min + offset if near_side else room.x_max - offset
    return Footprint(x, uniform(room.y_min, room.y_max, generator), math.pi / 2, length, width)


def prism(outline: Tensor, bottom: float, top: float) -> Tensor:
    """A prism (4C − 4, 3, 3) over a convex, counter-clockwise outline (C, 2), between two heights (m)."""
    low = torch.cat([outline, torch.full_like(outline[:, :1], bottom)], 1)
    high = torch.cat([outline, torch.full_like(outline[:, :1], top)], 1)
    next_low, next_high = low.roll(-1, dims=0), high.roll(-1, dims=0)
    sides = torch.cat([torch.stack([low, next_low, next_high], 1), torch.stack([low, next_high, high], 1)])
    return torch.cat([sides, _fan(high), _fan(low.flip(0))])


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Tensor:
    """An axis-aligned box (12, 3, 3) between two opposite corners."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    return prism(torch.tensor([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=torch.float64), z0, z1)


def ball(centre: tuple[float, float, float], radius: float, n_sides: int = 12) -> Tensor:
    """A sphere (T, 3, 3) with `n_sides` meridians and half as many rows of latitude."""
    polar = torch.arange(n_sides // 2 + 1, dtype=torch.float64) * (math.pi / (n_sides // 2))
    ring = circle(1.0, n_sides)
    height = polar.cos()[:, None, None].expand(-1, n_sides, 1)
    rows = torch.cat([polar.sin()[:, None, None] * ring[None], height], 2)
    rows = rows * radius + torch.tensor(centre, dtype=torch.float64)
    a, b = rows[1:], rows[:-1]
    next_a, next_b = a.roll(-1, dims=1), b.roll(-1, dims=1)
    lower = torch.stack([a, next_a, next_b], 2)[:-1]  # the row at each pole has one triangle per side
    upper = torch.stack([a, next_b, b], 2)[1:]
    return torch.cat([lower.flatten(0, 1), upper.flatten(0, 1)])


def copies(template: Tensor, center: Tensor, size: Tensor, heading: Tensor | None = None) -> Tensor:
    """Copies (N·T, 3, 3) of a solid (T, 3, 3) that fills the cube of side 1 around the origin.

    Args:
        center: (N, 3), metres.
        size: (N, 3) or (3,), metres along the copy's own axes.
        heading: (N,) angles about the vertical axis (rad); default 0.
    """
    shapes = template * size.expand_as(center)[:, None, None]
    if heading is not None:
        cos, sin = heading.cos()[:, None, None], heading.sin()[:, None, None]
        x, y, z = shapes.unbind(-1)
        shapes = torch.stack([cos * x - sin * y, sin * x + cos * y, z], -1)
    return (shapes + center[:, None, None]).flatten(0, 1)


def _fan(corners: Tensor) -> Tensor:
    """Triangles (C − 2, 3, 3) that fill a convex polygon (C, 3)."""
    first = corners[:1].expand(corners.shape[0] - 2, 3)
    return torch.stack([first, corners[1:-1], corners[2:]], 1)


UNIT_CUBE = box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))


def table(generator: torch.Generator) -> Piece:
    """A top on four legs."""
    height = uniform(0.7, 0.8, generator)

    def build(spot: Footprint) -> list[Tensor]:
        return [_slab(spot, height - 0.05, height), *_legs(spot, height - 0.05, 0.08)]

    return Piece((uniform(1.4, 2.0, generator), uniform(0.8, 1.0, generator)), False, build)


def chair(generator: torch.Generator) -> Piece:
    """A seat on four legs, with a back."""
    height = uniform(0.42, 0.48, generator)

    def build(spot: Footprint) -> list[Tensor]:
        back = spot.to_world(rectangle(0.04, spot.width) + torch.tensor([spot.length / 2 - 0.02, 0.0]))
        legs = _legs(spot, height - 0.04, 0.05)
        return [_slab(spot, height - 0.04, height), *legs, prism(back, height, 0.95)]

    return Piece((0.45, 0.45), False, build)


def shelf(generator: torch.Generator) -> Piece:
    """Two side panels, four boards, and boxes on the boards."""
    height = uniform(1.6, 2.2, generator)
    fill = [uniform(0.2, 0.6, generator) for _ in range(3)]

    def build(spot: Footprint) -> list[Tensor]:
        reach = spot.length / 2 - _BOARD / 2
        panels = [
            prism(spot.to_world(rectangle(_BOARD, spot.width) + torch.tensor([x, 0.0])), 0.0, height)
            for x in (-reach, reach)
        ]
        levels = [height * k / 3 for k in range(4)]
        boards = [_slab(spot, level, level + _BOARD) for level in levels]
        goods = []
        for share, level in zip(fill, levels, strict=False):
            length = share * spot.length
            shift = torch.tensor([(0.5 - share) * (spot.length - length) / 2, 0.0])
            outline = spot.to_world(rectangle(length, 0.7 * spot.width) + shift)
            goods.append(prism(outline, level + _BOARD, level + _BOARD + 0.55 * height / 3))
        return [*panels, *boards, *goods]

    return Piece((uniform(1.2, 2.2, generator), uniform(0.35, 0.5, generator)), True, build)


def boxes(generator: torch.Generator) -> Piece:
    """A box with a smaller box on top."""
    low, high = uniform(0.4, 0.7, generator), uniform(0.2, 0.5, generator)

    def build(spot: Footprint) -> list[Tensor]:
        upper = spot.to_world(rectangle(0.6 * spot.length, 0.7 * spot.width))
        return [_slab(spot, 0.0, low), prism(upper, low, low + high)]

    return Piece((uniform(0.5, 1.0, generator), uniform(0.4, 0.7, generator)), False, build)


def pillar(generator: torch.Generator) -> Piece:
    """A round pillar from floor to ceiling."""
    diameter = uniform(0.4, 0.6, generator)
    return Piece((diameter, diameter), False, lambda spot: [_cylinder(spot, CEILING, 16)])


def barrel(generator: torch.Generator) -> Piece:
    """An upright cylinder."""
    height = uniform(0.7, 1.0, generator)
    return Piece((0.6, 0.6), False, lambda spot: [_cylinder(spot, height, 12)])


def globe(generator: torch.Generator) -> Piece:
    """A large ball on the floor."""
    diameter = uniform(0.7, 1.0, generator)

    def build(spot: Footprint) -> list[Tensor]:
        return [ball((spot.x, spot.y, diameter / 2), diameter / 2)]

    return Piece((diameter, diameter), False, build)


def _slab(spot: Footprint, bottom: float, top: float) -> Tensor:
    return prism(spot.corners(), bottom, top)


def _cylinder(spot: Footprint, height: float, n_sides: int) -> Tensor:
    return prism(spot.to_world(circle(spot.length / 2, n_sides)), 0.0, height)


def _legs(spot: Footprint, height: float, width: float) -> list[Tensor]:
    feet = rectangle(spot.length - width, spot.width - width)
    return [prism(spot.to_world(rectangle(width, width) + foot), 0.0, height) for foot in feet]


class Bays(NamedTuple):
    """Rack bays, each between two pairs of uprights.

    place: (B, 2) centres, metres. width: metres. spacing: (B,) metres between levels.
    levels: (B,) int64 number of levels. fill: (B,) share of the pallet places that are occupied.
    """

    place: Tensor
    width: float
    spacing: Tensor
    levels: Tensor
    fill: Tensor


_Cuboids = tuple[Tensor, Tensor, Tensor]
"""Cuboids of bays: index of the bay (N,), centre relative to the bay (N, 3) and size (N, 3), metres; along
the row, across the row, and up."""


def racks(bays: Bays, along_y: bool, floor: float, generator: torch.Generator) -> Tensor:
    """Triangles (T, 3, 3) of bays in rows along x or y, on a floor at height `floor` (m).

    Most levels have a deck; the others have beams only. The lowest pallets stand on the floor.
    """
    if len(bays.place) == 0:
        return torch.zeros(0, 3, 3, dtype=torch.float64)
    bay, offset, size = _joined(_frames(bays), _levels(bays, generator), _goods(bays, generator))
    if along_y:
        offset, size = offset[:, [1, 0, 2]], size[:, [1, 0, 2]]
    base = torch.nn.functional.pad(bays.place, (0, 1), value=floor)
    return copies(UNIT_CUBE, base[bay] + offset, size)


def _frames(bays: Bays) -> _Cuboids:
    """Four uprights per bay, and cross bars between the uprights on either side."""
    height = bays.spacing * bays.levels + 0.2
    reach = torch.tensor([bays.width - _UPRIGHT, RACK_DEPTH - _UPRIGHT], dtype=torch.float64) / 2
    feet = torch.cartesian_prod(torch.tensor([-1.0, 1.0]), torch.tensor([-1.0, 1.0])).double() * reach
    post, bay = _pairs(4, len(height))
    tall = height[bay]
    width = torch.full_like(tall, _UPRIGHT)
    posts = bay, torch.cat([feet[post], tall[:, None] / 2], 1), torch.stack([width, width, tall], 1)
    bar, bay = _pairs(10, len(height))
    above = 0.4 + 1.2 * (bar // 2)
    within = above < height[bay]
    bar, bay, above = bar[within], bay[within], above[within]
    along = (2.0 * (bar % 2) - 1) * reach[0]
    size = torch.tensor([0.04, RACK_DEPTH - _UPRIGHT, 0.04], dtype=torch.float64).expand(len(bay), 3)
    return _joined(posts, (bay, torch.stack([along, 0 * along, above.double()], 1), size))


def _levels(bays: Bays, generator: torch.Generator) -> _Cuboids:
    """Two beams per level, and on most levels a deck."""
    level, bay = _pairs(int(bays.levels.max()), len(bays.levels))
    level, bay = level[level < bays.levels[bay]], bay[level < bays.levels[bay]]
    height = (level + 1) * bays.spacing[bay]
    flat = torch.zeros_like(height)
    edge = torch.full_like(height, (RACK_DEPTH - 0.05) / 2)
    beam = torch.tensor([bays.width, 0.05, 0.12], dtype=torch.float64).expand(len(bay), 3)
    decked = torch.rand(len(bay), generator=generator) < 0.85
    deck = torch.tensor([bays.width, RACK_DEPTH - 0.1, 0.03], dtype=torch.float64).expand(len(bay), 3)
    return _joined(
        (bay, torch.stack([flat, edge, height - 0.06], 1), beam),
        (bay, torch.stack([flat, -edge, height - 0.06], 1), beam),
        (bay[decked], torch.stack([flat, flat, height - 0.015], 1)[decked], deck[decked]),
    )


def _goods(bays: Bays, generator: torch.Generator) -> _Cuboids:
    """A pallet with a box at each occupied place: on the floor and on every level except the top one."""
    place, bay = _pairs(_SLOTS * int(bays.levels.max()), len(bays.levels))
    level, slot = place // _SLOTS, place % _SLOTS
    draw = torch.rand(6, len(bay), generator=generator, dtype=torch.float64)
    occupied = (level < bays.levels[bay]) & (draw[0] < bays.fill[bay])
    level, slot, bay, draw = level[occupied], slot[occupied], bay[occupied], draw[:, occupied]
    slot_width = (bays.width - 2 * _UPRIGHT) / _SLOTS
    along = (slot - (_SLOTS - 1) / 2) * slot_width + 0.1 * (draw[1] - 0.5)
    across = 0.1 * (draw[2] - 0.5)
    base = level * bays.spacing[bay] + 0.01
    high = (0.25 + 0.75 * draw[5]) * (bays.spacing[bay] - _PALLET - _FREE_ABOVE - 0.12)
    load = torch.stack([(0.55 + 0.35 * draw[3]) * slot_width, 0.6 + 0.35 * draw[4], high], 1)
    pallet = torch.tensor([0.85 * slot_width, 0.95, _PALLET], dtype=torch.float64).expand(len(bay), 3)
    return _joined(
        (bay, torch.stack([along, across, base + _PALLET / 2], 1), pallet),
        (bay, torch.stack([along, across, base + _PALLET + load[:, 2] / 2], 1), load),
    )


def _pairs(n: int, n_bays: int) -> tuple[Tensor, Tensor]:
    """All pairs of a number below `n` and a bay, each (n·B,)."""
    both = torch.cartesian_prod(torch.arange(n), torch.arange(n_bays))
    return both[:, 0], both[:, 1]


def _joined(*cuboids: _Cuboids) -> _Cuboids:
    bay, offset, size = map(torch.cat, zip(*cuboids, strict=True))
    return bay, offset, size
