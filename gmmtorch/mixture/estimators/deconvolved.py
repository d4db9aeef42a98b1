"""DeconvolvedGaussianMixture: the mixture of the noise-free positions of points with known noise."""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from gmmtorch.arrays import as_tensor
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.linalg import check_symmetric, safe_cholesky
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em import loop
from gmmtorch.mixture.em.initialization import initialize
from gmmtorch.mixture.estimator import MixtureEstimator
from gmmtorch.mixture.estimators import deconvolution
from gmmtorch.mixture.validation import Array, RandomState, as_generator


class DeconvolvedGaussianMixture(MixtureEstimator):
    """Extreme deconvolution (Bovy, Hogg & Roweis, 2011): EM with the noise covariance of every point.

    The fitted mixture is that of the noise-free positions: a wall measured with 2 cm of noise becomes as
    thin as the wall. `score_samples(X)` is the density of such positions; with `noise_covariances` it is
    the density of measurements. Without noise this is plain EM.

    Args:
        n_components: K, at most the number of points.
        tol: EM stops when the mean log-likelihood changes by less (nats per point). EM is slow if noise
            exceeds a component's thickness: after t iterations about R/t of the variance R remains.
        reg_covar: smallest variance of a component in any direction, in the squared unit of the points
            (m²). It is a lower bound, not added as in plain EM: added in every iteration it would
            accumulate here.
        thickness: upper limit of a component's smallest standard deviation (m); None: no limit. With
            reg_covar = thickness² every component has exactly this thickness.
        max_iter: largest number of EM iterations.
        init_params: as in `GaussianMixture`, without "auto".
        random_state: a seed, a `RandomState`, a `torch.Generator`, or None for a random seed.

    Fitted attributes: those of every `MixtureEstimator`. `lower_bound_` is the mean log-likelihood of
    the points with their noise, nats. It never decreases from one iteration to the next.
    """

    def __init__(
        self,
        n_components: int = 1,
        *,
        tol: float = 1e-3,
        reg_covar: float = 1e-6,
        thickness: float | None = None,
        max_iter: int = 100,
        init_params: str = "kmeans",
        random_state: RandomState = None,
    ) -> None:
        self.n_components = n_components
        self.tol = tol
        self.reg_covar = reg_covar
        self.thickness = thickness
        self.max_iter = max_iter
        self.init_params = init_params
        self.random_state = random_state

    def fit(
        self,
        X: Array,
        y: Any = None,
        sample_weight: Array | None = None,
        noise_covariances: Array | None = None,
        on_iteration: Callable[[int, float], None] | None = None,
    ) -> DeconvolvedGaussianMixture:
        """Fit the mixture of the noise-free positions of points X (N, D).

        Arguments and errors: see `MixtureEstimator.fit`, and in addition

        Args:
            noise_covariances: (N, D, D), or (D, D) for all points, m², positive semi-definite; see
                `sensor_model`. None: no noise. If far fewer covariances than points are distinct, the fit
                is faster.
        """
        points, weight, center = self._prepare(X, sample_weight)
        used = None if sample_weight is None else torch.as_tensor(sample_weight) > 0
        noise = checked_noise(noise_covariances, len(X), points)
        noise = noise[used] if used is not None and noise.ndim == 3 else noise
        least = float(self.reg_covar)
        generator = as_generator(self.random_state)
        first = initialize(self.init_params, points, weight, self.n_components, least, generator)
        first = first._replace(
            covariances=deconvolution.bound_variances(first.covariances, least, self.thickness)
        )
        blocks = deconvolution.group_by_noise(points, weight, noise)
        step = deconvolution.deconvolution_step(blocks, least, self.thickness)
        found = loop.run_em(step, first, tol=self.tol, max_iter=self.max_iter, on_iteration=on_iteration)
        safe_cholesky(found.parameters.covariances)  # raises if a component collapsed in the last step
        self._store_fit(found.parameters, center, found.lower_bounds, found.converged)
        self._warn_unless_converged()
        return self

    def score_samples(self, X: Array, noise_covariances: Array | None = None) -> Array:
        """log p(x) of each point, (N,), nats: of noise-free positions, or of measurements with noise.

        `noise_covariances` as in `fit`. The density is then Σ_k π_k N(x_n | μ_k, Σ_k + R_n).
        """
        if noise_covariances is None:
            return super().score_samples(X)
        points = self._as_points(X)
        noise = checked_noise(noise_covariances, len(X), points)
        center = (self.weights[:, None] * self.means).sum(0)
        parameters = em.Parameters(self.weights, self.means - center, self.covariances)
        return self._as_kind_of(X, deconvolution.log_likelihood(points - center, noise, parameters))

    def check_parameters(self, n_points: int | None = None) -> None:
        super().check_parameters(n_points)
        thickness: object = self.thickness
        least = float(self.reg_covar) ** 0.5
        if thickness is not None and not (
            isinstance(thickness, numbers.Real)
            and 0 < float(thickness) < math.inf
            and least <= float(thickness) * (1 + 1e-9)
        ):
            raise InvalidArgumentError(
                f"thickness={thickness!r} must be None, or a finite length above zero and at least "
                f"√reg_covar = {least:g} m."
            )


def checked_noise(noise: Array | None, n: int, points: Tensor) -> Tensor:
    """Noise covariances (D, D) or (N, D, D), float64, on the device of `points`; zero if None.

    Raises `InvalidArgumentError` unless they are finite, symmetric and positive semi-definite.
    """
    dim = points.shape[1]
    if noise is None:
        return points.new_zeros(dim, dim)
    noise = as_tensor(noise, "noise_covariances", torch.float64, points.device).detach()
    if noise.shape not in ((n, dim, dim), (dim, dim)):
        raise InvalidArgumentError(
            f"noise_covariances has shape {tuple(noise.shape)}; expected ({n}, {dim}, {dim}), one per point, "
            f"or ({dim}, {dim}), the same for all points."
        )
    each = noise.reshape(-1, dim, dim)
    finite = torch.isfinite(each).flatten(1).all(1)
    if not bool(finite.all()):
        row = int((~finite).nonzero()[0])
        raise InvalidArgumentError(
            f"noise_covariances[{row}] has NaN or infinite entries; remove such points first."
        )
    check_symmetric(each, "noise_covariances")
    # Semi-definite up to rounding: the added diagonal is far below the noise itself.
    slack = 1e-9 * each.diagonal(dim1=-2, dim2=-1).sum(-1).clamp_min(1e-290)
    eye = torch.eye(dim, dtype=noise.dtype, device=noise.device)
    bad = torch.linalg.cholesky_ex(each + slack[:, None, None] * eye)[1] != 0
    if bool(bad.any()):
        row = int(bad.nonzero()[0])
        raise InvalidArgumentError(
            f"noise_covariances[{row}] = {each[row].tolist()} has a negative eigenvalue."
        )
    return noise
