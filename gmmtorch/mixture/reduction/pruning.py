"""Removing components that no surface explains (thesis 2.1.4).

EM may spread a component over several surfaces, through free space. Such a component has few points,
or few for its size: a surface at range r is sampled with a density σ(r) that the sensor dictates, and
a component much sparser than that is no surface.
"""

from __future__ import annotations

import math
from typing import Any, TypeVar, cast

import torch
from sklearn.base import BaseEstimator
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.estimator import MixtureEstimator
from gmmtorch.mixture.estimators.sensor_model import SensorModel, cos_incidence

Mixture = TypeVar("Mixture", bound=Parameters | MixtureEstimator)


def support_density(support: Tensor, covariances: Tensor) -> Tensor:
    """Points (K,) per m² of a component's 2σ ellipse, N/(4π√(λ₀λ₁)), in 3D; per m, N/(4√λ₀), in 2D.

    λ₀ ≥ λ₁ are the largest eigenvalues of the covariances (K, D, D), support (K,) the points. The
    ellipse of a square evenly covered has 1.05 times its area, the interval of a segment 1.15 times
    its length: a surface well sampled has about the density of its points.
    """
    variances = torch.linalg.eigvalsh(covariances).clamp_min(torch.finfo(covariances.dtype).tiny)
    if covariances.shape[-1] == 3:
        return support / (4 * math.pi * variances[:, -1].sqrt() * variances[:, -2].sqrt())
    return support / (4 * variances[:, -1].sqrt())


def expected_density(
    means: Tensor, covariances: Tensor, sensor: SensorModel, origins: Tensor, counts: Tensor | None = None
) -> Tensor:
    """Points (K,) per m² (m in 2D) that surfaces where the components lie would have.

    The sensor's σ(r) at the component's mean, met at the angle of its smallest eigenvector. With one
    origin (D,) that is all. Of several (S, D) the nearest counts, as if only it had seen the
    component; unless `counts` (K, S) say how many of its points were seen from each. Then it is

        (Σ c_s σ_s)(Σ c_s) / Σ c_s²,

    which is Σ σ_s, all views together, if the views saw it in the proportions that they should,
    and σ of one view if one saw it.
    """
    origins = origins.to(means).reshape(-1, means.shape[1])
    k, s = means.shape[0], origins.shape[0]
    normals = torch.linalg.eigh(covariances)[1][:, :, 0]
    rows = torch.arange(k, device=means.device).repeat_interleave(s)
    views = torch.arange(s, device=means.device).repeat(k)
    cos = cos_incidence(means[rows], origins[views], normals[rows])
    distance = (means[rows] - origins[views]).norm(dim=1)
    density = sensor.point_density(distance, cos).view(k, s)
    if counts is None:
        return density.gather(1, distance.view(k, s).argmin(1, keepdim=True)).squeeze(1)
    seen = counts.to(means)
    total = (seen * density).sum(1) * seen.sum(1)
    return total / seen.square().sum(1).clamp_min(torch.finfo(means.dtype).tiny)


def prune(
    mixture: Mixture,
    n_points: float,
    *,
    min_support: float = 0.0,
    min_density_share: float = 0.0,
    sensor: SensorModel | None = None,
    origins: Tensor | None = None,
    counts: Tensor | None = None,
) -> tuple[Mixture, Tensor]:
    """The mixture without components of too little support, or too sparse for a surface.

    Returns what is left, its weights adding up to one, and which components (K,) of the old these are.

    Args:
        mixture: parameters, or a fitted estimator; it stays as it is.
        n_points: Σ p, the (weighted) number of points it was fitted to: N_j = π_j Σ p.
        min_support: components with N_j below it go, in points.
        min_density_share: components whose `support_density` is below this share of
            `expected_density` go. Needs sensor and origins, and 2D or 3D.
        sensor: see `sensor_model`.
        origins: (D,) or (S, D), where the points were measured from, world frame.
        counts: (K, S) points of each component seen from each origin, if that is known; a component
            with none is not judged by its density.

    Raises `InvalidArgumentError` for arguments that cannot be, and when no component would be left.
    """
    parameters = _parameters(mixture)
    weights, means, covariances = parameters
    for name, value in (("min_support", min_support), ("min_density_share", min_density_share)):
        if not 0 <= value < math.inf:
            raise InvalidArgumentError(f"{name}={value} must be a finite number of at least 0.")
    if not 0 < n_points < math.inf:
        raise InvalidArgumentError(f"n_points={n_points} must be a finite number above 0.")
    support = weights * n_points
    kept = support >= min_support
    largest = f"the largest support is {float(support.max()):.4g} points"
    if min_density_share > 0:
        counts = None if counts is None else torch.as_tensor(counts)
        sensor, origins = _checked(means, sensor, origins, counts)
        share = support_density(support, covariances) / expected_density(
            means, covariances, sensor, origins, counts
        )
        kept &= share >= min_density_share
        largest += f", the largest share of the expected density {float(share.max()):.3g}"
    if not bool((kept & (weights > 0)).any()):
        raise InvalidArgumentError(
            f"min_support={min_support}, min_density_share={min_density_share} would prune all "
            f"{len(weights)} components: {largest}; lower them."
        )
    left = Parameters(weights[kept] / weights[kept].sum(), means[kept], covariances[kept])
    return _rebuilt(mixture, left), kept


def _parameters(mixture: Mixture) -> Parameters:
    if isinstance(mixture, Parameters):
        return mixture
    mixture._fitted()
    return Parameters(mixture.weights, mixture.means, mixture.covariances)


def _rebuilt(mixture: Mixture, left: Parameters) -> Mixture:
    """The components left, as what the mixture was."""
    if isinstance(mixture, Parameters):
        return cast(Mixture, left)
    # Starting values for K components are of no use to fewer.
    options: dict[str, Any] = {
        name: value
        for name, value in BaseEstimator.get_params(mixture, deep=False).items()
        if name != "n_components" and isinstance(value, int | float | str | bool | None)
    }
    pruned = type(mixture).from_parameters(
        *left, lower_bounds=mixture.lower_bounds_, converged=mixture.converged_, **options
    )
    pruned._tensors = mixture._tensors
    return cast(Mixture, pruned)


def _checked(
    means: Tensor, sensor: SensorModel | None, origins: Tensor | None, counts: Tensor | None
) -> tuple[SensorModel, Tensor]:
    k, dim = means.shape
    if dim not in (2, 3):
        raise InvalidArgumentError(f"min_density_share needs a mixture in 2D or 3D; this one has D = {dim}.")
    if sensor is None or origins is None:
        raise InvalidArgumentError("min_density_share needs sensor and origins; give both.")
    origins = torch.as_tensor(origins)
    if origins.ndim not in (1, 2) or origins.shape[-1] != dim or origins.numel() == 0:
        raise InvalidArgumentError(
            f"origins has shape {tuple(origins.shape)}; expected ({dim},) or (S, {dim})."
        )
    expected = (k, origins.numel() // dim)
    if counts is not None and tuple(counts.shape) != expected:
        raise InvalidArgumentError(f"counts has shape {tuple(counts.shape)}; expected {expected}.")
    return sensor, origins
