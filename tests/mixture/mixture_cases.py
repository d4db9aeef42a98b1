"""Points, components, mixtures and records of several tests."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import multivariate_normal
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from gmmtorch.files import pack_tensors, read_tensors
from gmmtorch.mixture import GaussianMixture, MixtureEstimator, Parameters, Rows
from gmmtorch.mixture.em import by_type
from gmmtorch.mixture.em.exact import quadratic_features


def cloud(n: int, dim: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(n, dim, generator=generator, dtype=torch.float64)


def rows_of(points: Tensor, weight: Tensor | None = None, are_points: bool = True) -> Rows:
    values = points if are_points else quadratic_features(points)
    return Rows(values, points.new_ones(len(points)) if weight is None else weight, are_points)


def random_weight(n: int, seed: int = 0) -> Tensor:
    return torch.rand(n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) + 0.1


def random_parameters(k: int, dim: int, seed: int = 0, spread: float = 1.5, size: float = 0.3) -> Parameters:
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(k, dim, dim, generator=generator, dtype=torch.float64) * size
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


def thin_wall(n: int, size: float, seed: int = 0, noise: float = 1e-4) -> Tensor:
    """Centred points of an oblique square wall with side `size`; `noise` (m) in all directions."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = (rng.random((n, 3)) - 0.5) * [size, size, 0] + noise * rng.normal(size=(n, 3))
    points = points @ turn.T
    return torch.from_numpy(points - points.mean(0))


def beads(n: int, k: int, dim: int = 2, gap: float = 4.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points of k unit clusters with distance `gap` in a square pattern, and the centers of the clusters."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(k)))
    centers = np.zeros((k, dim))
    centers[:, 0], centers[:, 1] = gap * (np.arange(k) % side), gap * (np.arange(k) // side)
    return centers[rng.integers(k, size=n)] + rng.normal(size=(n, dim)), centers


def scipy_log_joint(points: Tensor, parameters: Parameters) -> np.ndarray:
    """log π_k + log N(x_n | k), (N, K)."""
    columns = [
        np.log(float(w)) + multivariate_normal(m.numpy(), c.numpy()).logpdf(points.numpy()).reshape(-1)
        for w, m, c in zip(*parameters, strict=True)
    ]
    return np.stack(columns, 1)


def direct_step(
    points: Tensor, weight: Tensor, parameters: Parameters, reg_covar: float
) -> tuple[Parameters, Tensor]:
    """An EM step of full covariances in the direct form, and Σ_n p_n log p(x_n)."""
    factors = by_type.Factors(parameters, "full")
    gather = functools.partial(by_type.expected_moments, points, weight, factors, torch.float64)
    found = by_type.exact_step(gather, factors, reg_covar, parameters)
    return found.parameters, found.value


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


MISSING = object()


def changed_file(mixture: MixtureEstimator, folder: Path, changes: dict[str, Any], **facts: Any) -> Path:
    """The file of a mixture with other tensors and facts; `MISSING` ones are left out."""
    path = folder / "m.safetensors"
    mixture.save(path)
    tensors, known = read_tensors(path, "gmmtorch.mixture", 1)
    tensors, known = (
        {name: value for name, value in {**old, **new}.items() if value is not MISSING}
        for old, new in ((tensors, changes), (known, facts))
    )
    path.write_bytes(pack_tensors(tensors, "gmmtorch.mixture", 1, **known))
    return path


def random_spd(rng: np.random.Generator, n: int, dim: int, scale: float = 1.0) -> np.ndarray:
    """Random covariances (n, dim, dim)."""
    root = rng.normal(size=(n, dim, dim)) * scale
    return root @ root.transpose(0, 2, 1) + 1e-3 * scale**2 * np.eye(dim)


class DtypeRecorder(TorchDispatchMode):
    """Records every floating dtype of the inputs and outputs of operations."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: dict[torch.dtype, set[str]] = {}

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        for leaf in tree_leaves((args, kwargs, result)):
            if isinstance(leaf, Tensor) and leaf.is_floating_point():
                self.seen.setdefault(leaf.dtype, set()).add(str(func))
        return result
