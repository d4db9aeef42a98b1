"""GaussianMixture: expectation–maximisation with scikit-learn's interface."""

from __future__ import annotations

import math
import numbers
import warnings
from collections.abc import Callable
from typing import Any

import torch
from sklearn.exceptions import ConvergenceWarning
from torch import Tensor, nn

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.linalg import inverse_factor, safe_cholesky
from gmmtorch.mixture import em
from gmmtorch.mixture.arguments import Array, RandomState, as_generator, checked_parameter
from gmmtorch.mixture.em import EMResult, Parameters
from gmmtorch.mixture.estimator import MixtureEstimator
from gmmtorch.mixture.initialization import INITIALIZATIONS, start


class GaussianMixture(MixtureEstimator):
    """Weighted full-covariance EM (thesis 2.1.1) on any device.

    Arrays in, arrays out; tensors in, tensors out. Parameters are kept in float64, and
    clouds are centred while they are worked on, so points 500 km away lose no digits.

    Args:
        n_components: K, at most the number of points.
        tol: EM stops when the mean log-likelihood changes by less (nats a point).
        reg_covar: added to each variance, in the square of the points' unit (m²).
        max_iter: EM iterations at most, in each start.
        n_init: starts; the one with the best lower bound is kept.
        init_params: "kmeans" (scikit-learn's), "random_points" or "bounding_box".
        weights_init, means_init, precisions_init: (K,), (K, D), (K, D, D): given parameters, in
            place of those the initialization finds.
        random_state: a seed, a `RandomState`, a `torch.Generator`, or None for a fresh one.
        dtype: of the exponentials inside EM. The products always run in float64; with "float64"
            nothing at all runs in float32.
        warm_start: go on from the last fit's parameters.

    Fitted attributes, in the kind (array or tensor) of the points given to `fit`: `weights_` (K,),
    `means_` (K, D), `covariances_` (K, D, D), `precisions_` (K, D, D); and `lower_bound_`,
    `lower_bounds_`, `n_iter_`, `converged_`, `n_features_in_`. The buffers `weights`, `means` and
    `covariances` are tensors always, and move with `.to(device)`.
    """

    def __init__(
        self,
        n_components: int = 1,
        *,
        tol: float = 1e-3,
        reg_covar: float = 1e-6,
        max_iter: int = 100,
        n_init: int = 1,
        init_params: str = "kmeans",
        weights_init: Array | None = None,
        means_init: Array | None = None,
        precisions_init: Array | None = None,
        random_state: RandomState = None,
        dtype: str = "float32",
        warm_start: bool = False,
    ) -> None:
        nn.Module.__init__(self)
        self.n_components = n_components
        self.tol = tol
        self.reg_covar = reg_covar
        self.max_iter = max_iter
        self.n_init = n_init
        self.init_params = init_params
        self.weights_init = weights_init
        self.means_init = means_init
        self.precisions_init = precisions_init
        self.random_state = random_state
        self.dtype = dtype
        self.warm_start = warm_start

    # -- learning ---------------------------------------------------------------------------------

    def fit(
        self,
        X: Array,
        y: Any = None,
        sample_weight: Array | None = None,
        on_iteration: Callable[[int, float], None] | None = None,
    ) -> GaussianMixture:
        """Learn the mixture of points X (N, D).

        Args:
            X: points, finite.
            y: ignored, as in scikit-learn.
            sample_weight: (N,) how many points each row stands for: not negative, not all zero.
            on_iteration: called with the iteration (from 1) and the mean log-likelihood.

        Raises:
            InvalidArgumentError (a ValueError): a bad argument, weight or point; K above the
                number of points of non-zero weight.
            NumericalError: a component collapsed, as happens with reg_covar = 0.
        """
        points, weight, center = self._prepare(X, sample_weight)
        dtype = em.SOFTMAX_DTYPES[self.dtype]
        features = em.quadratic_features(points)
        step = em.natural_step(features, weight, float(self.reg_covar), dtype, points)
        generator = as_generator(self.random_state)
        best: EMResult | None = None
        for _ in range(1 if self._continues() else self.n_init):
            first = self._start(points, weight, center, generator)
            found = em.run_em(step, first, tol=self.tol, max_iter=self.max_iter, on_iteration=on_iteration)
            if best is None or found.lower_bounds[-1] > best.lower_bounds[-1]:
                best = found
        assert best is not None
        self._keep(best.parameters, center, best.lower_bounds, best.converged)
        if not self.converged_ and self.tol > 0:
            warnings.warn(
                f"EM did not converge within max_iter={self.max_iter}; raise it, or raise tol.",
                ConvergenceWarning,
                stacklevel=2,
            )
        return self

    def fit_predict(self, X: Array, y: Any = None, sample_weight: Array | None = None) -> Array:
        """Fit, and the most likely component (N,) of each point."""
        return self.fit(X, y, sample_weight).predict(X)

    def _continues(self) -> bool:
        return bool(self.warm_start) and hasattr(self, "means")

    def _start(
        self, points: Tensor, weight: Tensor, center: Tensor, generator: torch.Generator
    ) -> Parameters:
        """Where EM begins, in the centred frame."""
        if self._continues():
            if self.means.shape != (self.n_components, points.shape[1]):
                raise InvalidArgumentError(
                    f"warm_start=True goes on from means of shape {tuple(self.means.shape)}, but "
                    f"n_components={self.n_components} and the points have {points.shape[1]} dimensions; "
                    "set it to False."
                )
            means = self.means.to(points.device) - center
            return Parameters(self.weights.to(points.device), means, self.covariances.to(points.device))
        given = (self.weights_init, self.means_init, self.precisions_init)
        k, dim = self.n_components, points.shape[1]
        shapes = ((k,), (k, dim), (k, dim, dim))
        names = ("weights_init", "means_init", "precisions_init")
        first_weights, first_means, precisions = (
            None if value is None else checked_parameter(value, shape, name, points.device)
            for value, shape, name in zip(given, shapes, names, strict=True)
        )
        if first_weights is None or first_means is None or precisions is None:
            found = start(self.init_params, points, weight, k, float(self.reg_covar), generator)
        else:
            found = Parameters(first_weights, first_means, precisions)
        covariances = found.covariances
        if precisions is not None:
            whiten = inverse_factor(safe_cholesky(precisions, "precisions_init"))
            covariances = whiten @ whiten.transpose(-2, -1)
        return Parameters(
            found.weights if first_weights is None else first_weights / first_weights.sum(),
            found.means if first_means is None else first_means - center,
            covariances,
        )

    # -- arguments --------------------------------------------------------------------------------

    def check_parameters(self, n_points: int | None = None) -> None:
        """Raise `InvalidArgumentError` for a parameter that cannot be, or K above the number of points."""
        for name in ("n_components", "max_iter", "n_init"):
            value = getattr(self, name)
            if not isinstance(value, numbers.Integral) or int(value) < 1:
                raise InvalidArgumentError(f"{name}={value!r} must be a whole number of at least 1.")
        for name in ("tol", "reg_covar"):
            value = getattr(self, name)
            if not isinstance(value, numbers.Real) or not 0 <= float(value) < math.inf:
                raise InvalidArgumentError(f"{name}={value!r} must be a finite number of at least 0.")
        if not isinstance(self.init_params, str) or self.init_params not in INITIALIZATIONS:
            raise InvalidArgumentError(
                f"init_params={self.init_params!r} is not one of {', '.join(INITIALIZATIONS)}."
            )
        if not isinstance(self.dtype, str) or self.dtype not in em.SOFTMAX_DTYPES:
            raise InvalidArgumentError(f"dtype={self.dtype!r} is not one of {', '.join(em.SOFTMAX_DTYPES)}.")
        as_generator(self.random_state)
        if n_points is not None and n_points < self.n_components:
            raise InvalidArgumentError(
                f"n_components={self.n_components} is more than the n_samples={n_points} points of "
                "non-zero weight; ask for fewer components, or give more points."
            )
