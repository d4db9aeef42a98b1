"""Mixtures and points of several tests."""

from __future__ import annotations

import numpy as np

from gmmtorch.mixture import GaussianMixture


def blobs(n: int = 400, dim: int = 2, seed: int = 0) -> np.ndarray:
    """Three overlapping clusters of different shapes."""
    rng = np.random.default_rng(seed)
    centers = np.array([[-2.0, 0.0, 1.0], [2.0, 1.0, -1.0], [0.5, -2.5, 0.0]])[:, :dim]
    shapes = rng.normal(size=(3, dim, dim)) * 0.5 + 0.5 * np.eye(dim)
    label = rng.integers(3, size=n)
    return centers[label] + np.einsum("nij,nj->ni", shapes[label], rng.normal(size=(n, dim)))


def given_start(dim: int, k: int = 3, seed: int = 1) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(k, dim, dim)) * 0.2
    weights = rng.random(k) + 0.5
    return {
        "weights_init": weights / weights.sum(),
        "means_init": rng.normal(size=(k, dim)) * 1.5,
        "precisions_init": np.eye(dim) + root @ root.transpose(0, 2, 1),
    }


def fitted(dim: int = 2, **options) -> GaussianMixture:
    return GaussianMixture(3, random_state=0, **options).fit(blobs(dim=dim))


def random_spd(rng: np.random.Generator, n: int, dim: int, scale: float = 1.0) -> np.ndarray:
    """Random covariances (n, dim, dim)."""
    root = rng.normal(size=(n, dim, dim)) * scale
    return root @ root.transpose(0, 2, 1) + 1e-3 * scale**2 * np.eye(dim)
