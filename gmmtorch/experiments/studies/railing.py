"""A simulated railing in front of a wall, with known truth, for the study of thin structures (Fig 3.8)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.scan import Scan
from gmmtorch.simulation import box, ray_triangles, sense, spinning_lidar

_HALF, _HEIGHT = 3.0, 1.1  # half the length and the height (m) of the railing, which lies in the plane y = 0
_POSTS = (-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0)
_BARS = (0.55, _HEIGHT)
_NOISE = 0.01
_FLOOR = 0.15  # points below belong to the floor (m)


BOUNDS: tuple[tuple[float, ...], tuple[float, ...]] = ((-0.3, -0.5, _FLOOR), (3.3, 0.5, 1.35))
"""Lowest and highest corner (m) of a box around one half of the railing, without the floor."""


@dataclass(frozen=True)
class Railing:
    """Posts and two bars of square section, 3 m before a wall, on a floor; a lidar passes at 4 m.

    width: side of the section (m).
    """

    width: float

    def distances(self, origin: Tensor, directions: Tensor) -> Tensor:
        """Range (N,) in metres from the origin (3,) along unit directions (N, 3); inf without a hit."""
        return ray_triangles(origin, directions, self._triangles())

    def _triangles(self) -> Tensor:
        half = 0.5 * self.width
        parts = [
            box((-8.0, -8.0, -0.1), (8.0, 3.1, 0.0)),
            box((-8.0, 3.0, 0.0), (8.0, 3.1, 3.0)),
            *(box((x - half, -half, 0.0), (x + half, half, _HEIGHT)) for x in _POSTS),
            *(box((-_HALF, -half, z - half), (_HALF, half, z + half)) for z in _BARS),
        ]
        return torch.cat(parts)

    def scans(self, n_scans: int, seed: int) -> list[Scan]:
        """Scans (32 × 480 beams, range 12 m, noise 1 cm) from places along the railing."""
        sensor = spinning_lidar(32, 480, (-math.radians(20), math.radians(12)), 12.0, _NOISE)
        generator = torch.Generator().manual_seed(seed)
        found = []
        for x in torch.linspace(-4, 4, n_scans, dtype=torch.float64):
            pose = torch.eye(4, dtype=torch.float64)
            pose[:3, 3] = torch.stack([x, torch.tensor(-4.0).double(), torch.tensor(1.2).double()])
            ends, missed = sense(sensor, pose, self, generator)
            found.append(Scan(ends[~missed], pose[:3, 3], ends[missed]))
        return found

    def holds(self, scan: Scan) -> Tensor:
        """Mask (N,) of the points of a scan that the railing returned."""
        x, y, z = scan.points.unbind(1)
        reach = 0.5 * self.width + 5 * _NOISE
        return (y.abs() < reach) & (x.abs() < _HALF + reach) & (z > _FLOOR) & (z < _HEIGHT + reach)
