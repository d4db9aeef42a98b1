"""Pruning: removal of components that do not fit any surface (thesis 2.1.4).

EM may place a component across several surfaces, through free space. Such a component has few points,
absolutely or for its size: a sensor samples a surface at range r with a known density σ(r), and a
component with far fewer points is not a surface.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeVar, cast

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError, check_number
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.estimators.sensor_model import SensorModel, cos_incidence
from gmmtorch.mixture.reduction import parameters_of

if TYPE_CHECKING:
    from gmmtorch.mixture.estimator import MixtureEstimator

Mixture = TypeVar("Mixture", bound="Parameters | MixtureEstimator")


def support_density(support: Tensor, covariances: Tensor) -> Tensor:
    """Points (K,) per m² of a component's 2σ ellipse, N/(4π√(λ₀λ₁)), in 3D; per metre, N/(4√λ₀), in 2D.

    λ₀ ≥ λ₁ are the largest eigenvalues of the covariances (K, D, D), and support (K,) is the number of
    points N. The 2σ ellipse of an evenly covered square has 1.05 times the area of the square, and the
    interval of a segment 1.15 times its length. So a well-sampled surface has about its point density.
    """
    variances = torch.linalg.eigvalsh(covariances).clamp_min(torch.finfo(covariances.dtype).tiny)
    if covariances.shape[-1] == 3:
        return support / (4 * math.pi * variances[:, -1].sqrt() * variances[:, -2].sqrt())
    return support / (4 * variances[:, -1].sqrt())


def expected_density(
    means: Tensor, covariances: Tensor, sensor: SensorModel, origins: Tensor, counts: Tensor | None = None
) -> Tensor:
    """Points (K,) per m² (per metre in 2D) of a surface at the place of each component.

    The density is the sensor's σ(r), with r² = ‖μ − o‖² + tr Σ the mean squared distance of the component
    from the origin o, and with the smallest eigenvector as surface normal. With one origin (D,), this is
    the result. With several origins (S, D) and no `counts`, the nearest origin alone determines it. With
    `counts` (K, S), the points of each component seen from each origin, the density is

        (Σ c_s σ_s)(Σ c_s) / Σ c_s²,

    which equals Σ σ_s if the counts are in proportion to the expected densities σ_s, and σ_s if all
    points were seen from origin s.
    """
    origins = origins.to(means).reshape(-1, means.shape[1])
    k, s = means.shape[0], origins.shape[0]
    normals = torch.linalg.eigh(covariances)[1][:, :, 0]
    rows = torch.arange(k, device=means.device).repeat_interleave(s)
    views = torch.arange(s, device=means.device).repeat(k)
    cos = cos_incidence(means[rows], origins[views], normals[rows])
    distance = (means[rows] - origins[views]).norm(dim=1)
    spread = covariances.diagonal(dim1=1, dim2=2).sum(1)[rows]
    density = sensor.point_density((distance.square() + spread).sqrt(), cos).view(k, s)
    if counts is None:
        return density.gather(1, distance.view(k, s).argmin(1, keepdim=True)).squeeze(1)
    seen = counts.to(means)
    total = (seen * density).sum(1) * seen.sum(1)
    return total / seen.square().sum(1).clamp_min(torch.finfo(means.dtype).tiny)


def density_share(
    support: Tensor,
    parameters: Parameters,
    sensor: SensorModel,
    origins: Tensor,
    counts: Tensor | None = None,
) -> Tensor:
    """`support_density` of components with support (K,), as a share (K,) of their `expected_density`."""
    _, means, covariances = parameters
    expected = expected_density(means, covariances, sensor, origins, counts)
    return support_density(support, covariances) / expected


def prune(
    mixture: Mixture,
    n_points: float,
    *,
    min_support: float = 0.0,
    min_density_share: float = 0.0,
    sensor: SensorModel | None = None,
    origins: ArrayLike | None = None,
    counts: ArrayLike | None = None,
) -> tuple[Mixture, Tensor]:
    """Remove components with too little support, or with too low a density for a surface.

    Returns the remaining mixture, with weights that add up to one, and a mask (K,) of the components
    that it keeps.

    Args:
        mixture: parameters or a fitted estimator; it is not modified.
        n_points: Σ p, the (weighted) number of points of the fit; component j has N_j = π_j Σ p points.
        min_support: smallest number of points N_j of a component that is kept.
        min_density_share: smallest `density_share` of a component that is kept. If above zero, needs
            `sensor` (see `sensor_model`) and `origins`, and a mixture in 2D or 3D.
        origins: (D,) or (S, D), sensor origins, world frame.
        counts: (K, S) points of each component seen from each origin, if known. Components without
            any are kept at any density.

    Raises `InvalidArgumentError` for invalid arguments, and if no component would remain.
    """
    parameters = parameters_of(mixture, "mixture")
    weights, means, covariances = parameters
    check_number("min_support", min_support)
    check_number("min_density_share", min_density_share)
    check_number("n_points", n_points, above=True)
    support = weights * n_points
    kept = support >= min_support
    largest = f"the largest support is {float(support.max()):.4g} points"
    if min_density_share > 0:
        k, dim = means.shape
        if dim not in (2, 3):
            raise InvalidArgumentError(
                f"min_density_share needs a mixture in 2D or 3D; this one has D = {dim}."
            )
        if sensor is None or origins is None:
            raise InvalidArgumentError("min_density_share needs sensor and origins; pass both.")
        origins = checked_origins(origins, means)
        seen = None if counts is None else as_tensor(counts, "counts").to(means)
        if seen is not None and seen.shape != (k, len(origins)):
            raise InvalidArgumentError(f"counts has shape {tuple(seen.shape)}; expected {(k, len(origins))}.")
        share = density_share(support, parameters, sensor, origins, seen)
        kept &= share >= min_density_share
        largest += f", the largest share of the expected density {float(share.max()):.3g}"
    if not bool((kept & (weights > 0)).any()):
        raise InvalidArgumentError(
            f"min_support={min_support}, min_density_share={min_density_share} would prune all "
            f"{len(weights)} components: {largest}; lower these limits."
        )
    remaining = Parameters(weights[kept] / weights[kept].sum(), means[kept], covariances[kept])
    if isinstance(mixture, Parameters):
        return cast(Mixture, remaining), kept
    # The scalar options only: initial parameters for K components do not fit fewer.
    options = mixture._scalar_options()
    options.pop("n_components")
    pruned = type(mixture).from_parameters(
        *remaining, lower_bounds=mixture.lower_bounds_, converged=mixture.converged_, **options
    )
    pruned._tensors = mixture._tensors
    return cast(Mixture, pruned), kept


def checked_origins(origins: ArrayLike, like: Tensor) -> Tensor:
    """Sensor origins (S, D), given as (D,) or (S, D), in the dtype and on the device of `like` (…, D).

    Raises `InvalidArgumentError` for another shape.
    """
    dim = like.shape[-1]
    found = as_tensor(origins, "origins").to(like)
    if found.ndim not in (1, 2) or found.shape[-1] != dim or found.numel() == 0:
        raise InvalidArgumentError(
            f"origins has shape {tuple(found.shape)}; expected ({dim},) or (S, {dim})."
        )
    return found.reshape(-1, dim)
