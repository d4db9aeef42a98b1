"""Mixtures for the tests of merging."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.reduction import COSTS

dims = pytest.mark.parametrize("dim", [1, 2, 3, 5])
costs = pytest.mark.parametrize("cost", list(COSTS))


def mixture(k: int, dim: int, seed: int = 0, spread: float = 2.0) -> Parameters:
    """Random components whose weights are supports, so they do not add up to one."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(k, dim, dim)) * 0.5
    covariances = root @ root.transpose(0, 2, 1) + 0.05 * np.eye(dim)
    parts = (rng.random(k) * 20 + 0.5, rng.normal(size=(k, dim)) * spread, covariances)
    return Parameters(*(torch.from_numpy(part) for part in parts))


def take(parameters: Parameters, index: Tensor) -> Parameters:
    return Parameters(*(value[index] for value in parameters))


def total_moments(parameters: Parameters) -> tuple[float, np.ndarray, np.ndarray]:
    """Weight, mean and covariance of the whole mixture, by loops."""
    weights, means, covariances = (value.numpy() for value in parameters)
    total = math.fsum(weights)
    mean = sum(w / total * m for w, m in zip(weights, means, strict=True))
    covariance = sum(
        w / total * (c + np.outer(m - mean, m - mean))
        for w, m, c in zip(weights, means, covariances, strict=True)
    )
    return total, mean, covariance


def assert_same_moments(one: Parameters, other: Parameters, atol: float = 1e-12) -> None:
    for mine, theirs in zip(total_moments(one), total_moments(other), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=atol)


def numpy_merge(a: tuple, b: tuple) -> tuple:
    """(w, μ, Σ) of two merged, from raw moments."""
    w = a[0] + b[0]
    mean = (a[0] * a[1] + b[0] * b[1]) / w
    second = sum(x[0] / w * (x[2] + np.outer(x[1], x[1])) for x in (a, b))
    return w, mean, second - np.outer(mean, mean)


def numpy_cost(a: tuple, b: tuple, cost: str) -> float:
    """The cost by determinants and inverses, as printed in the papers."""
    det = np.linalg.det
    if cost == "kullback_leibler":
        w, _, merged = numpy_merge(a, b)
        return 0.5 * (w * np.log(det(merged)) - a[0] * np.log(det(a[2])) - b[0] * np.log(det(b[2])))
    middle, d = (a[2] + b[2]) / 2, a[1] - b[1]
    overlap = (
        (det(a[2]) * det(b[2])) ** 0.25 / det(middle) ** 0.5 * np.exp(-d @ np.linalg.inv(middle) @ d / 8)
    )
    return 1 - overlap
