"""A furnished hall, 14 × 10 × 4 m, as a triangle soup.

┌───────────────┬────────┐      a hall with pillars and a smaller room behind a partition with a
│               │        └──────────────┐
│     hall          room      corridor  │
│               │        ┌──────────────┘
└──── ═══ ── ═══┴─ ═══ ──┘      door; three windows to the south, through which nothing returns,
                                and a corridor to the east, 14 m long
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.simulation.sensors.mesh_raycasting import ray_triangles
from gmmtorch.simulation.sensors.trajectories import smooth_path
from gmmtorch.simulation.worlds.floor_plan import Footprint, Room, place
from gmmtorch.simulation.worlds.furniture import (
    CEILING,
    Piece,
    barrel,
    boxes,
    chair,
    globe,
    pillar,
    shelf,
    table,
)
from gmmtorch.simulation.worlds.solids import box

_THICKNESS = 0.2
_CORRIDOR_CEILING = 2.6
_HALL = Room(0.1, 0.1, 8.9, 9.9)
_ROOM = Room(9.1, 0.1, 13.9, 9.9)

Draw = Callable[[torch.Generator], Piece]

Opening = tuple[float, float, float, float]
"""From, to (m along the wall), sill and head (m above the floor)."""

# (fixed coordinate, from, to, height, openings) of the walls' middle lines
_WALLS_ALONG_X: tuple[tuple[float, float, float, float, tuple[Opening, ...]], ...] = (
    (0.0, 0.0, 14.0, CEILING, ((1.5, 4.0, 0.9, 2.6), (5.5, 8.0, 0.9, 2.6), (10.5, 12.5, 0.9, 2.6))),
    (10.0, 0.0, 14.0, CEILING, ()),
    (4.0, 14.0, 28.0, _CORRIDOR_CEILING, ()),
    (6.0, 14.0, 28.0, _CORRIDOR_CEILING, ()),
)
_WALLS_ALONG_Y: tuple[tuple[float, float, float, float, tuple[Opening, ...]], ...] = (
    (0.0, 0.0, 10.0, CEILING, ()),
    (9.0, 0.0, 10.0, CEILING, ((4.4, 5.6, 0.0, 2.2),)),
    (14.0, 0.0, 10.0, CEILING, ((4.1, 5.9, 0.0, 2.4),)),
    (28.0, 4.0, 6.0, _CORRIDOR_CEILING, ()),
)

# Three waypoints on a line at every door, so that the path passes it straight.
_TOUR = (
    *((1.6, 5.2), (1.6, 1.7), (5.0, 1.7), (7.2, 2.2), (7.2, 7.8), (4.6, 8.4), (4.2, 5.0), (7.6, 5.0)),
    *((9.0, 5.0), (10.4, 5.0), (11.0, 7.0), (11.5, 8.4), (12.6, 7.6), (12.6, 2.4), (11.5, 1.6)),
    *((10.6, 2.6), (10.9, 4.8), (12.6, 5.0), (14.0, 5.0), (15.4, 5.0), (21.0, 5.0)),
)


@dataclass(frozen=True, eq=False)
class World3D:
    """A world of surfaces.

    Attributes:
        triangles: (T, 3, 3) corners of the triangles that a sensor sees, metres.
        path: (P, 2) a walk through it that stays clear of them.
    """

    triangles: Tensor
    path: Tensor

    def distances(self, origin: Tensor, directions: Tensor) -> Tensor:
        """Metres (N,) from the origin (3,) along unit directions (N, 3) to the first triangle, or inf."""
        return ray_triangles(origin, directions, self.triangles)


def building_3d(generator: torch.Generator) -> World3D:
    """The building, its walls always the same, its furniture drawn by the generator."""
    path = smooth_path(torch.tensor(_TOUR, dtype=torch.float64))
    in_hall: dict[Draw, int] = {pillar: 3, table: 2, shelf: 4, chair: 3, boxes: 2, globe: 1, barrel: 1}
    in_room: dict[Draw, int] = {table: 1, shelf: 2, chair: 1, boxes: 2, barrel: 1}
    parts = [
        *_floors_and_ceilings(),
        *_walls(),
        *_furniture(_HALL, path, generator, in_hall),
        *_furniture(_ROOM, path, generator, in_room),
    ]
    return World3D(torch.cat(parts), path)


def _floors_and_ceilings() -> list[Tensor]:
    low, high = -_THICKNESS, CEILING + _THICKNESS
    return [
        box((-0.1, -0.1, low), (14.1, 10.1, 0.0)),
        box((-0.1, -0.1, CEILING), (14.1, 10.1, high)),
        box((14.1, 3.9, low), (28.1, 6.1, 0.0)),
        box((14.1, 3.9, _CORRIDOR_CEILING), (28.1, 6.1, _CORRIDOR_CEILING + _THICKNESS)),
    ]


def _walls() -> list[Tensor]:
    half = _THICKNESS / 2
    parts = []
    for along_y, walls in ((False, _WALLS_ALONG_X), (True, _WALLS_ALONG_Y)):
        for across, start, stop, height, openings in walls:
            for begin, end, bottom, top in _pieces(start - half, stop + half, height, openings):
                low, high = (begin, across - half), (end, across + half)
                if along_y:
                    low, high = low[::-1], high[::-1]
                parts.append(box((*low, bottom), (*high, top)))
    return parts


def _pieces(start: float, stop: float, height: float, openings: tuple[Opening, ...]) -> list[Opening]:
    """A wall cut into (from, to, bottom, top): between the openings, below their sills, above their heads."""
    pieces = []
    begin = start
    for left, right, sill, head in openings:
        pieces += [(begin, left, 0.0, height), (left, right, 0.0, sill), (left, right, head, height)]
        begin = right
    pieces.append((begin, stop, 0.0, height))
    return [piece for piece in pieces if piece[3] > piece[2]]


def _furniture(
    room: Room,
    path: Tensor,
    generator: torch.Generator,
    wanted: dict[Draw, int],
) -> list[Tensor]:
    taken: list[Footprint] = []
    parts: list[Tensor] = []
    for draw, count in wanted.items():
        for _ in range(count):
            piece = draw(generator)
            spot = place(room, piece.size, path, taken, generator, piece.at_wall)
            if spot is not None:
                taken.append(spot)
                parts.append(piece.build(spot))
    return parts
