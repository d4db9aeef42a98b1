"""Points sampled from the surface of a triangle mesh, as a data set."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from gmmtorch.datasets.base import Dataset, Ranges, require_path
from gmmtorch.datasets.point_files.mesh_files import read_triangles
from gmmtorch.errors import DataError, InvalidArgumentError, check_whole
from gmmtorch.scan import Scan


class MeshSamples(Dataset):
    """One scan of `n_points` points, uniform on the surface, with isotropic Gaussian noise.

    The sensor origin is the centre of the bounding box. Points at or beyond `max_range` from it have no
    return.

    Args:
        path: PLY, OBJ or STL; metres.
        ranges: how readings are interpreted.
        stride: see `Dataset`.
        n_points: number of points.
        noise: standard deviation (m) along each axis.
        seed: of the random numbers.
    """

    def __init__(
        self,
        path: str | Path,
        ranges: Ranges,
        stride: int = 1,
        n_points: int = 100_000,
        noise: float = 0.0,
        seed: int = 0,
    ) -> None:
        self._path = require_path(
            path,
            "file",
            "a triangle mesh (PLY, OBJ, STL)",
            "The Stanford 3D scanning repository publishes well-known meshes.",
        )
        super().__init__(self._path.stem, ranges, stride)
        self.n_points = check_whole("n_points", n_points, 1)
        self.seed = check_whole("seed", seed, 0)
        if not 0 <= noise < math.inf:
            raise InvalidArgumentError(f"noise={noise} must be a standard deviation of at least 0 m.")
        self.noise = noise

    def _count(self) -> int:
        return 1

    def _read(self, index: int) -> Scan:
        triangles = read_triangles(self._path)
        generator = torch.Generator().manual_seed(self.seed)
        points = sample_surface(triangles, self.n_points, generator)
        points += self.noise * torch.randn(points.shape, generator=generator, dtype=points.dtype)
        corners = triangles.reshape(-1, 3)
        return self.ranges.scan(points, (corners.amin(0) + corners.amax(0)) / 2)


def sample_surface(triangles: Tensor, n_points: int, generator: torch.Generator) -> Tensor:
    """Points (n_points, 3), uniformly distributed over the area of triangles (T, 3, 3).

    For u and v uniform in [0, 1], a + (1 − v) √u (b − a) + v √u (c − a) is uniform on a triangle. Raises
    `DataError` if no triangle has an area.
    """
    a, b, c = triangles.unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=1)
    if not bool(area.sum() > 0):
        raise DataError("The mesh has no area: every triangle is a line or a point.")
    share = torch.cumsum(area, 0)
    drawn = torch.rand(n_points, generator=generator, dtype=torch.float64) * share[-1]
    chosen = torch.searchsorted(share, drawn, right=True).clamp_max(len(area) - 1)
    u, v = torch.rand(2, n_points, 1, generator=generator, dtype=torch.float64)
    a, b, c = triangles[chosen].unbind(1)
    return a + u.sqrt() * ((1 - v) * (b - a) + v * (c - a))
