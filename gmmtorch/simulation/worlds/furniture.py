"""Furniture as triangle soups: each function draws one piece and says how to build it where it stands."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.simulation.worlds.floor_plan import Footprint, circle, rectangle, uniform
from gmmtorch.simulation.worlds.solids import ball, prism

CEILING = 4.0
_BOARD = 0.03


class Piece(NamedTuple):
    """Length and width (m), whether it stands at a wall, and its triangles (T, 3, 3) on a footprint."""

    size: tuple[float, float]
    at_wall: bool
    build: Callable[[Footprint], Tensor]


def table(generator: torch.Generator) -> Piece:
    """A top on four legs."""
    height = uniform(0.7, 0.8, generator)

    def build(spot: Footprint) -> Tensor:
        return torch.cat([_slab(spot, height - 0.05, height), _legs(spot, height - 0.05, 0.08)])

    return Piece((uniform(1.4, 2.0, generator), uniform(0.8, 1.0, generator)), False, build)


def chair(generator: torch.Generator) -> Piece:
    """A seat on four legs, with a back."""
    height = uniform(0.42, 0.48, generator)

    def build(spot: Footprint) -> Tensor:
        back = spot.to_world(rectangle(0.04, spot.width) + torch.tensor([spot.length / 2 - 0.02, 0.0]))
        return torch.cat(
            [_slab(spot, height - 0.04, height), _legs(spot, height - 0.04, 0.05), prism(back, height, 0.95)]
        )

    return Piece((0.45, 0.45), False, build)


def shelf(generator: torch.Generator) -> Piece:
    """Two cheeks, four boards, and boxes on the boards."""
    height = uniform(1.6, 2.2, generator)
    fill = [uniform(0.2, 0.6, generator) for _ in range(3)]

    def build(spot: Footprint) -> Tensor:
        reach = spot.length / 2 - _BOARD / 2
        cheeks = [
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
        return torch.cat([*cheeks, *boards, *goods])

    return Piece((uniform(1.2, 2.2, generator), uniform(0.35, 0.5, generator)), True, build)


def boxes(generator: torch.Generator) -> Piece:
    """A box with a smaller one on top."""
    low, high = uniform(0.4, 0.7, generator), uniform(0.2, 0.5, generator)

    def build(spot: Footprint) -> Tensor:
        lid = spot.to_world(rectangle(0.6 * spot.length, 0.7 * spot.width))
        return torch.cat([_slab(spot, 0.0, low), prism(lid, low, low + high)])

    return Piece((uniform(0.5, 1.0, generator), uniform(0.4, 0.7, generator)), False, build)


def pillar(generator: torch.Generator) -> Piece:
    """A round pillar from floor to ceiling."""
    diameter = uniform(0.4, 0.6, generator)
    return Piece((diameter, diameter), False, lambda spot: _drum(spot, CEILING, 16))


def barrel(generator: torch.Generator) -> Piece:
    """A drum."""
    height = uniform(0.7, 1.0, generator)
    return Piece((0.6, 0.6), False, lambda spot: _drum(spot, height, 12))


def globe(generator: torch.Generator) -> Piece:
    """A large ball on the floor."""
    diameter = uniform(0.7, 1.0, generator)

    def build(spot: Footprint) -> Tensor:
        return ball((spot.x, spot.y, diameter / 2), diameter / 2)

    return Piece((diameter, diameter), False, build)


def _slab(spot: Footprint, bottom: float, top: float) -> Tensor:
    return prism(spot.corners(), bottom, top)


def _drum(spot: Footprint, height: float, n_sides: int) -> Tensor:
    return prism(spot.to_world(circle(spot.length / 2, n_sides)), 0.0, height)


def _legs(spot: Footprint, height: float, width: float) -> Tensor:
    feet = rectangle(spot.length - width, spot.width - width)
    return torch.cat([prism(spot.to_world(rectangle(width, width) + foot), 0.0, height) for foot in feet])
