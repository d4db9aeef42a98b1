"""Points, components and rows for the tests of truncated EM."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.em.grouping import (
    Rows,
)


def cloud(n: int, dim: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(n, dim, generator=generator, dtype=torch.float64)


def rows_of(points: Tensor, weight: Tensor | None = None, are_points: bool = True) -> Rows:
    values = points if are_points else em.quadratic_features(points)
    return Rows(values, points.new_ones(len(points)) if weight is None else weight, are_points)


def random_weight(n: int, seed: int = 0) -> Tensor:
    return torch.rand(n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) + 0.1


def random_parameters(k: int, dim: int, seed: int = 0, spread: float = 1.5) -> Parameters:
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(k, dim, dim, generator=generator, dtype=torch.float64) * 0.3
    covariances = root @ root.transpose(1, 2) + 0.2 * torch.eye(dim, dtype=torch.float64)
    weights = torch.rand(k, generator=generator, dtype=torch.float64) + 0.1
    means = spread * torch.randn(k, dim, generator=generator, dtype=torch.float64)
    return Parameters(weights / weights.sum(), means, covariances)


def room(n: int, seed: int = 0, noise: float = 0.005) -> np.ndarray:
    """Points on the walls, floor and ceiling of a room of 6 × 5 × 2.5 m."""
    rng = np.random.default_rng(seed)
    size = np.array([6.0, 5.0, 2.5])
    points = rng.random((n, 3)) * size
    face = rng.integers(6, size=n)
    points[np.arange(n), face % 3] = np.where(face < 3, 0, size[face % 3])
    return points + noise * rng.normal(size=points.shape)


def beads(n: int, k: int, dim: int = 2, gap: float = 4.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points of k unit clusters with distance `gap` in a square pattern, and the centers of the clusters."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(k)))
    centers = np.zeros((k, dim))
    centers[:, 0], centers[:, 1] = gap * (np.arange(k) % side), gap * (np.arange(k) // side)
    return centers[rng.integers(k, size=n)] + rng.normal(size=(n, dim)), centers
