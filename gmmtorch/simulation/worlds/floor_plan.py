"""Floor plans: rooms, footprints of furniture, and placing furniture so that a path stays free."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError

_ATTEMPTS = 40
_GAP = 0.2
"""Least distance between two pieces of furniture, metres."""


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
    clearance: float = 0.6,
) -> Footprint | None:
    """A free footprint of `size` (length, width) in the room, or None if none was found.

    It stays `clearance` metres away from the path (P, 2) and does not touch the `taken` footprints.
    """
    draw = _at_wall if at_wall else _anywhere
    for _ in range(_ATTEMPTS):
        footprint = draw(room, *size, generator)
        corners = footprint.corners()
        inside = (corners >= torch.tensor(room[:2])) & (corners <= torch.tensor(room[2:]))
        if not bool(inside.all()) or bool(footprint.contains(path, clearance).any()):
            continue
        outline = footprint.outline()
        if not any(
            bool(footprint.contains(other.outline(), _GAP).any() or other.contains(outline, _GAP).any())
            for other in taken
        ):
            return footprint
    return None


def _anywhere(room: Room, length: float, width: float, generator: torch.Generator) -> Footprint:
    x = uniform(room.x_min, room.x_max, generator)
    y = uniform(room.y_min, room.y_max, generator)
    return Footprint(x, y, uniform(0, math.pi, generator), length, width)


def _at_wall(room: Room, length: float, width: float, generator: torch.Generator) -> Footprint:
    offset = 0.02 + width / 2  # furniture stands 2 cm from the wall
    along_x = uniform(0, 1, generator) < 0.5
    near_side = uniform(0, 1, generator) < 0.5
    if along_x:
        y = room.y_min + offset if near_side else room.y_max - offset
        return Footprint(uniform(room.x_min, room.x_max, generator), y, 0.0, length, width)
    x = room.x_min + offset if near_side else room.x_max - offset
    return Footprint(x, uniform(room.y_min, room.y_max, generator), math.pi / 2, length, width)
