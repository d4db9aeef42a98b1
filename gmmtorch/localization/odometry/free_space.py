"""Free space around a moving sensor: which points of a scan contradict what earlier scans saw.

Each scan is kept as a range image: the nearest return in each direction. A point of another scan is, in such
an image, in front of the surface (free space, which contradicts it), on the surface, or behind it or outside
the field of view (unknown).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

_CELL = {2: math.radians(1), 3: math.radians(3)}  # of an image
_MARGIN = 0.25, 0.02  # metres, and share of the range, that a point may be in front of or behind a surface
_POINTS = 200  # of each earlier scan, that a new scan must not look through
_NEVER = math.inf


class View(NamedTuple):
    """Of B poses: shares (B,) of the points that lie in free space, of the points that no earlier scan could
    see, and of the earlier points that the scan looks through.
    """

    in_free_space: Tensor
    unknown: Tensor
    looked_through: Tensor

    def at(self, rows: Tensor) -> View:
        return View(*(value[rows] for value in self))


class FreeSpace:
    """What some scans saw, as range images.

    Args:
        points: (N, D) of each scan, in the frame of its sensor, metres.
        poses: (K, D+1, D+1), world ← sensor, one for each scan.
    """

    def __init__(self, points: Sequence[Tensor], poses: Tensor) -> None:
        self.dim = poses.shape[1] - 1
        images = [range_image(one) for one in points]
        self._nearest, self._farthest = (torch.stack(part) for part in zip(*images, strict=True))
        self._inverse = torch.linalg.inv(poses)
        parts = []
        for one, pose in zip(points, poses, strict=True):
            some = one[:: math.ceil(len(one) / _POINTS) or 1]
            parts.append(some @ pose[:-1, :-1].T + pose[:-1, -1])
        self._points = torch.cat(parts)

    def view(self, points: Tensor, poses: Tensor) -> View:
        """How a scan's points (N, D) agree with the space that was seen, at poses (B, D+1, D+1)."""
        moved = points @ poses[:, :-1, :-1].mT + poses[:, None, :-1, -1]
        inverse = self._inverse[:, None]
        there = moved @ inverse[..., :-1, :-1].mT + inverse[..., None, :-1, -1]  # (K, B, N, D)
        free, known = _compared(there, self._nearest, self._farthest)
        free_anywhere = free.any(0)
        is_unknown = ~(known.any(0) | free_anywhere)
        back = torch.linalg.inv(poses)
        seen = self._points @ back[:, :-1, :-1].mT + back[:, None, :-1, -1]
        nearest, farthest = range_image(points)
        through, met = _compared(seen[None], nearest[None], farthest[None])
        through, met = through[0], met[0]
        share = through.sum(1) / (through | met).sum(1).clamp_min(_POINTS // 4)
        return View(free_anywhere.double().mean(1), is_unknown.double().mean(1), share.double())


def range_image(points: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest return (C,) around each direction, and the farthest in it; infinity and zero without."""
    dim = points.shape[1]
    cells, distance = _cells(points)
    across, high = _size(dim)
    nearest = torch.full((across * high,), _NEVER).to(points).scatter_reduce(0, cells, distance, "amin")
    farthest = torch.zeros(across * high).to(points).scatter_reduce(0, cells, distance, "amax")
    sides = nearest.view(high, across)
    sides = torch.minimum(sides, torch.minimum(sides.roll(1, 1), sides.roll(-1, 1)))
    if dim == 3:
        up = torch.nn.functional.pad(sides[None, None], (0, 0, 1, 1), value=_NEVER)[0, 0]
        sides = torch.minimum(sides, torch.minimum(up[2:], up[:-2]))
    around = torch.where(farthest > 0, sides.flatten(), _NEVER)
    return around, farthest


def _compared(points: Tensor, nearest: Tensor, farthest: Tensor) -> tuple[Tensor, Tensor]:
    """Whether points (K, B, N, D) are in front of the surfaces of K images, and whether they are on them."""
    cells, distance = _cells(points)
    flat = cells.flatten(1)
    near = nearest.gather(1, flat).view_as(distance)
    far = farthest.gather(1, flat).view_as(distance)
    margin = _MARGIN[0] + _MARGIN[1] * distance
    is_seen = torch.isfinite(near)
    return is_seen & (distance < near - margin), is_seen & (distance >= near - margin) & (
        distance <= far + margin
    )


def _cells(points: Tensor) -> tuple[Tensor, Tensor]:
    """The cell of each point's direction, and its distance."""
    dim = points.shape[-1]
    across, high = _size(dim)
    distance = points.norm(dim=-1)
    column = (torch.atan2(points[..., 1], points[..., 0]) / _CELL[dim]).round().long() % across
    if dim == 2:
        return column, distance
    sine = points[..., 2] / distance.clamp_min(1e-9)
    row = ((sine.clamp(-1, 1).asin() + math.pi / 2) / _CELL[dim]).long().clamp_max(high - 1)
    return row * across + column, distance


def _size(dim: int) -> tuple[int, int]:
    across = round(2 * math.pi / _CELL[dim])
    return across, 1 if dim == 2 else across // 2
