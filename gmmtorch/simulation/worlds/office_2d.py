"""An office floor, 30 × 20 m, as line segments at the height of a planar laser.

┌──────┬──────┬───────────────┐
│ room │ room │     hall      │
├─ ────┴ ─────┴──  ────────  ─┤
│          corridor           │
├─ ────┬ ─────┐  ┌──────┬─ ───┤
│ room │ room │  │ room   room │
└──────┴──────┴──┴──────┴─────┘

The corridor is 30 m long, beyond the range of most lasers; a short corridor leads south. There are six rooms
and a hall with pillars. Walls are 20 cm thick.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike
from gmmtorch.simulation.sensors.mesh_raycasting import ray_segments
from gmmtorch.simulation.sensors.sensor_paths import smooth_path
from gmmtorch.simulation.worlds.floor_plan import (
    Footprint,
    Piece,
    Room,
    circle,
    furnish,
    rectangle,
    uniform,
)

_THICKNESS = 0.2
_CORRIDOR = Room(0.1, 9.1, 29.9, 11.3)
_ROOMS = (
    Room(0.1, 0.1, 6.9, 8.9),
    Room(7.1, 0.1, 13.9, 8.9),
    Room(16.1, 0.1, 22.9, 8.9),
    Room(23.1, 0.1, 29.9, 8.9),
    Room(0.1, 11.5, 6.9, 19.9),
    Room(7.1, 11.5, 13.9, 19.9),
)
_HALL = Room(14.1, 11.5, 29.9, 19.9)

# Centre lines of the walls: (fixed coordinate, begin, end, doors as (begin, end)), metres.
_WALLS_ALONG_X: tuple[tuple[float, float, float, tuple[tuple[float, float], ...]], ...] = (
    (0.0, 0.0, 30.0, ()),
    (20.0, 0.0, 30.0, ()),
    (9.0, 0.0, 30.0, ((2.9, 4.1), (9.9, 11.1), (14.1, 15.9), (26.0, 27.2))),
    (11.4, 0.0, 30.0, ((2.9, 4.1), (9.9, 11.1), (16.2, 18.0), (26.0, 27.8))),
)
_WALLS_ALONG_Y: tuple[tuple[float, float, float, tuple[tuple[float, float], ...]], ...] = (
    (0.0, 0.0, 20.0, ()),
    (30.0, 0.0, 20.0, ()),
    (7.0, 0.0, 9.0, ()),
    (14.0, 0.0, 9.0, ()),
    (16.0, 0.0, 9.0, ((2.4, 3.6),)),
    (23.0, 0.0, 9.0, ((5.4, 6.6),)),
    (7.0, 11.4, 20.0, ()),
    (14.0, 11.4, 20.0, ()),
)

# Three waypoints on a line at each door keep the path straight there.
_TOUR = (
    *((1.0, 10.2), (3.5, 10.2), (3.5, 9.0), (3.5, 7.8), (1.9, 7.0), (1.9, 1.9), (5.1, 1.9), (5.1, 7.0)),
    *((3.5, 7.8), (3.5, 9.0), (3.5, 10.2), (10.5, 10.2), (10.5, 9.0), (10.5, 7.8), (8.9, 7.0), (8.9, 1.9)),
    *((12.1, 1.9), (12.1, 7.0), (10.5, 7.8), (10.5, 9.0), (10.5, 10.2), (15.0, 10.2), (15.0, 8.0)),
    *((15.0, 3.0), (16.0, 3.0), (17.4, 3.0), (18.0, 1.8), (21.2, 1.8), (21.2, 4.0), (18.2, 5.4)),
    *((18.6, 7.2), (21.0, 6.0), (23.0, 6.0), (24.6, 6.0), (25.0, 1.9), (28.2, 1.9), (28.2, 6.4), (26.6, 7.6)),
    *((26.6, 9.0), (26.6, 10.2), (26.9, 10.4), (26.9, 11.4), (26.9, 13.0), (28.0, 14.6), (27.6, 18.0)),
    *((22.0, 18.0), (21.4, 15.4), (18.4, 17.8), (16.4, 17.6), (17.1, 13.4), (17.1, 11.4), (17.1, 10.2)),
    *((10.5, 10.2), (10.5, 11.4), (10.5, 12.8), (12.0, 13.4), (12.0, 18.0), (9.0, 18.0), (9.0, 13.4)),
    *((10.5, 12.8), (10.5, 11.4), (10.5, 10.2), (3.5, 10.2), (3.5, 11.4), (3.5, 12.8), (5.0, 13.4)),
    *((5.0, 18.0), (2.0, 18.0), (2.0, 14.6)),
)


@dataclass(frozen=True, eq=False)
class World2D:
    """A plane world of line segments.

    Attributes:
        segments: (S, 2, 2) end points of the visible line segments, metres.
        path: (P, 2) collision-free path through the world, metres.
    """

    segments: Tensor
    path: Tensor

    def distances(self, origin: ArrayLike, directions: ArrayLike) -> Tensor:
        """Range (N,) in metres from the origin (2,) along unit directions (N, 2); inf without a hit."""
        return ray_segments(origin, directions, self.segments)


def building_2d(generator: torch.Generator) -> World2D:
    """The office with fixed walls and doors, and furniture drawn at random."""
    path = smooth_path(torch.tensor(_TOUR, dtype=torch.float64))
    polygons = [*_walls()]
    for room in _ROOMS:
        polygons += furnish(room, path, generator, {_shelf: 4, _table: 2, _desk: 2, _bin: 3})
    polygons += furnish(_HALL, path, generator, {_pillar: 6, _shelf: 4, _table: 4, _desk: 2, _bin: 4})
    polygons += furnish(_CORRIDOR, path, generator, {_cabinet: 5})
    return World2D(torch.cat([_sides(polygon) for polygon in polygons]), path)


def _sides(polygon: Tensor) -> Tensor:
    """Segments (C, 2, 2) around a polygon (C, 2)."""
    return torch.stack([polygon, polygon.roll(-1, dims=0)], 1)


def _walls() -> list[Tensor]:
    polygons = []
    for along_y, walls in ((False, _WALLS_ALONG_X), (True, _WALLS_ALONG_Y)):
        for across, start, stop, doors in walls:
            begin = start - _THICKNESS / 2
            for door_start, door_stop in (*doors, (stop + _THICKNESS / 2, 0.0)):
                middle, length = (begin + door_start) / 2, door_start - begin
                size = (_THICKNESS, length) if along_y else (length, _THICKNESS)
                centre = (across, middle) if along_y else (middle, across)
                polygons.append(rectangle(*size) + torch.tensor(centre, dtype=torch.float64))
                begin = door_stop
    return polygons


def _solid(spot: Footprint) -> list[Tensor]:
    return [spot.corners()]


def _legs(spot: Footprint) -> list[Tensor]:
    feet = rectangle(spot.length - 0.1, spot.width - 0.1)
    return [spot.to_world(rectangle(0.07, 0.07) + foot) for foot in feet]


def _round(spot: Footprint) -> list[Tensor]:
    return [spot.to_world(circle(spot.length / 2, 20))]


def _shelf(g: torch.Generator) -> Piece:
    return Piece((uniform(1.0, 2.6, g), uniform(0.35, 0.55, g)), True, _solid)


def _cabinet(g: torch.Generator) -> Piece:
    return Piece((uniform(0.6, 1.4, g), 0.35), True, _solid)


def _table(g: torch.Generator) -> Piece:
    return Piece((uniform(1.2, 2.0, g), uniform(0.7, 1.0, g)), False, _legs)


def _desk(g: torch.Generator) -> Piece:
    return Piece((uniform(0.8, 1.5, g), uniform(0.5, 0.7, g)), False, _solid)


def _bin(g: torch.Generator) -> Piece:
    diameter = uniform(0.25, 0.5, g)
    return Piece((diameter, diameter), False, _round)


def _pillar(g: torch.Generator) -> Piece:
    return Piece((0.6, 0.6), False, _round)
