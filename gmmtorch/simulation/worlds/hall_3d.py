"""A furnished hall, 14 × 10 × 4 m, as triangles.

┌───────────────┬────────┐
│               │        └──────────────┐
│     hall          room      corridor  │
│               │        ┌──────────────┘
└──── ═══ ── ═══┴─ ═══ ──┘

A partition with a door separates the hall, which has pillars, from a smaller room. Beams through the three
southern windows have no return. The corridor to the east is 14 m long.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike
from gmmtorch.simulation.sensors.mesh_raycasting import ray_triangles
from gmmtorch.simulation.sensors.sensor_paths import smooth_path
from gmmtorch.simulation.worlds.floor_plan import DrawPiece, Room, furnish
from gmmtorch.simulation.worlds.furniture import (
    CEILING,
    barrel,
    box,
    boxes,
    chair,
    globe,
    pillar,
    shelf,
    table,
)

_THICKNESS = 0.2
_CORRIDOR_CEILING = 2.6
_HALL = Room(0.1, 0.1, 8.9, 9.9)
_ROOM = Room(9.1, 0.1, 13.9, 9.9)

Opening = tuple[float, float, float, float]
"""Begin and end along the wall, and lower and upper edge above the floor, metres."""

# Centre lines of the walls: (fixed coordinate, begin, end, height, openings).
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

# Three waypoints on a line at each door keep the path straight there.
_TOUR = (
    *((1.6, 5.2), (1.6, 1.7), (5.0, 1.7), (7.2, 2.2), (7.2, 7.8), (4.6, 8.4), (4.2, 5.0), (7.6, 5.0)),
    *((9.0, 5.0), (10.4, 5.0), (11.0, 7.0), (11.5, 8.4), (12.6, 7.6), (12.6, 2.4), (11.5, 1.6)),
    *((10.6, 2.6), (10.9, 4.8), (12.6, 5.0), (14.0, 5.0), (15.4, 5.0), (21.0, 5.0)),
)


@dataclass(frozen=True, eq=False)
class World3D:
    """A 3D world of triangles.

    Attributes:
        triangles: (T, 3, 3) corners of the visible triangles, metres.
        path: (P, 2) collision-free path through the world, metres.
    """

    triangles: Tensor
    path: Tensor

    def distances(self, origin: ArrayLike, directions: ArrayLike) -> Tensor:
        """Range (N,) in metres from the origin (3,) along unit directions (N, 3); inf without a hit."""
        return ray_triangles(origin, directions, self.triangles)


def building_3d(generator: torch.Generator) -> World3D:
    """The hall with fixed walls and furniture drawn at random."""
    path = smooth_path(torch.tensor(_TOUR, dtype=torch.float64))
    in_hall: dict[DrawPiece, int] = {pillar: 3, table: 2, shelf: 4, chair: 3, boxes: 2, globe: 1, barrel: 1}
    in_room: dict[DrawPiece, int] = {table: 1, shelf: 2, chair: 1, boxes: 2, barrel: 1}
    surfaces = [
        *_floors_and_ceilings(),
        *_walls(),
        *furnish(_HALL, path, generator, in_hall),
        *furnish(_ROOM, path, generator, in_room),
    ]
    return World3D(torch.cat(surfaces), path)


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
    walls = []
    for along_y, centre_lines in ((False, _WALLS_ALONG_X), (True, _WALLS_ALONG_Y)):
        for across, start, stop, height, openings in centre_lines:
            for begin, end, bottom, top in _wall_segments(start - half, stop + half, height, openings):
                low, high = (begin, across - half), (end, across + half)
                if along_y:
                    low, high = low[::-1], high[::-1]
                walls.append(box((*low, bottom), (*high, top)))
    return walls


def _wall_segments(start: float, stop: float, height: float, openings: tuple[Opening, ...]) -> list[Opening]:
    """Rectangles (begin, end, bottom, top) of a wall: between, below and above its openings."""
    segments = []
    begin = start
    for left, right, sill, head in openings:
        segments += [(begin, left, 0.0, height), (left, right, 0.0, sill), (left, right, head, height)]
        begin = right
    segments.append((begin, stop, 0.0, height))
    return [segment for segment in segments if segment[3] > segment[2]]
