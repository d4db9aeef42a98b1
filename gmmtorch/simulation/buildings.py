"""An office floor in the plane, and a furnished hall in space.

An office floor, 30 × 20 m, as line segments at the height of a planar laser.

┌──────┬──────┬───────────────┐
│ room │ room │     hall      │
├─ ────┴ ─────┴──  ────────  ─┤
│          corridor           │
├─ ────┬ ─────┐  ┌──────┬─ ───┤
│ room │ room │  │ room   room │
└──────┴──────┴──┴──────┴─────┘

The corridor is 30 m long, beyond the range of most lasers; a short corridor leads south. There are six rooms
and a hall with pillars. Walls are 20 cm thick.

A furnished hall, 14 × 10 × 4 m, as triangles.

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
from functools import cached_property

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.simulation.furniture import (
    CEILING,
    DrawPiece,
    Footprint,
    Piece,
    Room,
    barrel,
    box,
    boxes,
    chair,
    circle,
    furnish,
    globe,
    pillar,
    rectangle,
    shelf,
    table,
    uniform,
)
from gmmtorch.simulation.mesh_world import MeshWorld, checked_rays
from gmmtorch.simulation.sensors import smooth_path

_THICKNESS = 0.2
_CHUNK_PAIRS = 1 << 15  # ray and segment pairs processed at a time

_SLACK = 64 * torch.finfo(torch.float64).eps
"""Relative distance outside an end at which a ray still counts as a hit, so that no ray passes between two
adjacent segments. A ray whose angle to a segment is below four times this counts as parallel to it."""
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


def ray_segments(origins: ArrayLike, directions: ArrayLike, segments: ArrayLike) -> Tensor:
    """Distances (N,), float64, to the nearest segment, in multiples of the direction's length; inf if none.

    Worlds have few segments: each ray is tested against all of them.
    Solves o + t d = a + s (b − a) for t > 0 and 0 ≤ s ≤ 1. A ray parallel to a segment does not hit it.

    Args:
        origins: (N, 2), or (2,) if all rays start at one point.
        directions: (N, 2).
        segments: (S, 2, 2), the two end points of each segment.
    """
    origins, directions = checked_rays(origins, directions, 2)
    segments = as_tensor(segments, "segments", torch.float64)
    if segments.ndim != 3 or segments.shape[1:] != (2, 2):
        raise InvalidArgumentError(f"segments have shape {tuple(segments.shape)}; expected (S, 2, 2).")
    origins = origins.expand(directions.shape)
    best = torch.full_like(directions[:, 0], torch.inf)
    if segments.shape[0] == 0:
        return best
    a, edge = segments[:, 0], segments[:, 1] - segments[:, 0]
    flat = 4 * _SLACK * edge.norm(dim=1)
    step = max(1, _CHUNK_PAIRS // segments.shape[0])
    for start in range(0, directions.shape[0], step):
        rows = slice(start, start + step)
        d = directions[rows, None]
        to_start = a - origins[rows, None]
        turn = _cross_2d(d, edge)
        t = _cross_2d(to_start, edge) / turn
        s = _cross_2d(to_start, d) / turn
        hit = (t > 0) & (s >= -_SLACK) & (s <= 1 + _SLACK) & (turn.abs() > flat * d.norm(dim=2))
        best[rows] = torch.where(hit, t, torch.inf).amin(1)
    return best


def _cross_2d(u: Tensor, v: Tensor) -> Tensor:
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def building_2d(generator: torch.Generator) -> World2D:
    """The office with fixed walls and doors, and furniture drawn at random."""
    path = smooth_path(torch.tensor(_TOUR, dtype=torch.float64))
    polygons = [*_walls()]
    for room in _ROOMS:
        polygons += furnish(room, path, generator, {_shelf: 4, _table: 2, _desk: 2, _bin: 3})
    polygons += furnish(_HALL, path, generator, {_pillar: 6, _shelf: 4, _table: 4, _desk: 2, _bin: 4})
    polygons += furnish(_CORRIDOR, path, generator, {_cabinet: 5})
    sides = [torch.stack([polygon, polygon.roll(-1, dims=0)], 1) for polygon in polygons]
    return World2D(torch.cat(sides), path)


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


_CORRIDOR_CEILING = 2.6
_HALL_3D = Room(0.1, 0.1, 8.9, 9.9)
_ROOM_3D = Room(9.1, 0.1, 13.9, 9.9)

Opening = tuple[float, float, float, float]
"""Begin and end along the wall, and lower and upper edge above the floor, metres."""

# Centre lines of the walls: (fixed coordinate, begin, end, height, openings).
_HALL_WALLS_ALONG_X: tuple[tuple[float, float, float, float, tuple[Opening, ...]], ...] = (
    (0.0, 0.0, 14.0, CEILING, ((1.5, 4.0, 0.9, 2.6), (5.5, 8.0, 0.9, 2.6), (10.5, 12.5, 0.9, 2.6))),
    (10.0, 0.0, 14.0, CEILING, ()),
    (4.0, 14.0, 28.0, _CORRIDOR_CEILING, ()),
    (6.0, 14.0, 28.0, _CORRIDOR_CEILING, ()),
)
_HALL_WALLS_ALONG_Y: tuple[tuple[float, float, float, float, tuple[Opening, ...]], ...] = (
    (0.0, 0.0, 10.0, CEILING, ()),
    (9.0, 0.0, 10.0, CEILING, ((4.4, 5.6, 0.0, 2.2),)),
    (14.0, 0.0, 10.0, CEILING, ((4.1, 5.9, 0.0, 2.4),)),
    (28.0, 4.0, 6.0, _CORRIDOR_CEILING, ()),
)

# Three waypoints on a line at each door keep the path straight there.
_HALL_TOUR = (
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
        return self._mesh.distances(origin, directions)

    @cached_property
    def _mesh(self) -> MeshWorld:
        return MeshWorld(self.triangles)


def building_3d(generator: torch.Generator) -> World3D:
    """The hall with fixed walls and furniture drawn at random."""
    path = smooth_path(torch.tensor(_HALL_TOUR, dtype=torch.float64))
    in_hall: dict[DrawPiece, int] = {pillar: 3, table: 2, shelf: 4, chair: 3, boxes: 2, globe: 1, barrel: 1}
    in_room: dict[DrawPiece, int] = {table: 1, shelf: 2, chair: 1, boxes: 2, barrel: 1}
    surfaces = [
        *_floors_and_ceilings(),
        *_hall_walls(),
        *furnish(_HALL_3D, path, generator, in_hall),
        *furnish(_ROOM_3D, path, generator, in_room),
    ]
    return World3D(torch.cat(surfaces), path)


def _floors_and_ceilings() -> list[Tensor]:
    return [
        box((-0.1, -0.1, -_THICKNESS), (14.1, 10.1, 0.0)),
        box((-0.1, -0.1, CEILING), (14.1, 10.1, CEILING + _THICKNESS)),
        box((14.1, 3.9, -_THICKNESS), (28.1, 6.1, 0.0)),
        box((14.1, 3.9, _CORRIDOR_CEILING), (28.1, 6.1, _CORRIDOR_CEILING + _THICKNESS)),
    ]


def _hall_walls() -> list[Tensor]:
    half = _THICKNESS / 2
    walls = []
    for along_y, centre_lines in ((False, _HALL_WALLS_ALONG_X), (True, _HALL_WALLS_ALONG_Y)):
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
