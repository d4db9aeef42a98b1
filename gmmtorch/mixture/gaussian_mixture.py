"""GaussianMixture: a torch module with scikit-learn's interface."""

from __future__ import annotations

import math
import numbers
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from sklearn.base import BaseEstimator, DensityMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.exceptions import NotFittedError as ScikitLearnNotFittedError
from sklearn.utils.metaestimators import available_if
from sklearn.utils.validation import validate_data
from torch import Tensor, nn

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, check_whole
from gmmtorch.files import pack_tensors, read_tensors, require, write_bytes
from gmmtorch.linalg import check_rigid, check_symmetric, inverse_factor, safe_cholesky
from gmmtorch.mixture import em
from gmmtorch.mixture.arguments import (
    Array,
    RandomState,
    as_generator,
    checked_parameter,
    checked_tensor,
    checked_weight,
    warn_if_coarse,
)
from gmmtorch.mixture.em import EMResult, Parameters
from gmmtorch.mixture.initialization import INITIALIZATIONS, start

_FILE_KIND, _FILE_VERSION = "gmmtorch.mixture", 1


class NotFittedError(GmmTorchError, ScikitLearnNotFittedError):
    """A mixture was used before it was fitted."""


class GaussianMixture(DensityMixin, BaseEstimator, nn.Module):
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

    weights: Tensor
    means: Tensor
    covariances: Tensor
    _tensors: bool  # whether fit was given a tensor

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

    @classmethod
    def from_parameters(
        cls,
        weights: Array,
        means: Array,
        covariances: Array,
        *,
        lower_bounds: Sequence[float] = (),
        converged: bool = True,
        **options: Any,
    ) -> GaussianMixture:
        """A fitted mixture of given weights (K,), means (K, D) and covariances (K, D, D).

        `lower_bounds` and `converged` say how it was found, if that is known; `options` are those
        of the constructor. Raises `InvalidArgumentError` or `NumericalError` if it is no mixture.
        """
        mean = torch.as_tensor(means).double()
        if mean.ndim != 2 or 0 in mean.shape:
            raise InvalidArgumentError(f"means has shape {tuple(mean.shape)}; expected (K, D).")
        k, dim = mean.shape
        mixture = cls(k, **options)
        checked = (
            checked_parameter(value, shape, name, mean.device)
            for value, shape, name in (
                (weights, (k,), "weights"),
                (means, (k, dim), "means"),
                (covariances, (k, dim, dim), "covariances"),
            )
        )
        weight, mean, covariance = checked
        if bool((weight < 0).any()) or abs(float(weight.sum()) - 1) > 1e-6:
            raise InvalidArgumentError(f"weights={weight.tolist()} must be at least zero and add up to one.")
        safe_cholesky(check_symmetric(covariance, "covariances"))
        mixture._tensors = isinstance(means, Tensor)
        mixture.n_features_in_ = dim
        mixture._set_history(lower_bounds, converged)
        mixture._set_buffers(weight, mean, covariance)
        return mixture

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
        self.check_parameters()
        points = self._as_points(X, reset=True)
        warn_if_coarse(X, points)
        weight = checked_weight(sample_weight, points)
        points, weight = points[weight > 0], weight[weight > 0]
        self.check_parameters(points.shape[0])
        center = (points * (weight / weight.sum())[:, None]).sum(0)
        centered = points - center
        dtype = em.SOFTMAX_DTYPES[self.dtype]
        features = em.quadratic_features(centered)
        step = em.natural_step(features, weight, float(self.reg_covar), dtype, centered)
        generator = as_generator(self.random_state)
        best: EMResult | None = None
        for _ in range(1 if self._continues() else self.n_init):
            first = self._start(centered, weight, center, generator)
            found = em.run_em(step, first, tol=self.tol, max_iter=self.max_iter, on_iteration=on_iteration)
            if best is None or found.lower_bounds[-1] > best.lower_bounds[-1]:
                best = found
        self._keep(cast(EMResult, best), center)
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

    def _keep(self, result: EMResult, center: Tensor) -> None:
        weights, means, covariances = result.parameters
        self._set_buffers(weights / weights.sum(), means + center, covariances)
        self._set_history(result.lower_bounds, result.converged)

    def _set_history(self, lower_bounds: Sequence[float], converged: bool) -> None:
        self.lower_bounds_ = [float(x) for x in lower_bounds]
        self.lower_bound_ = self.lower_bounds_[-1] if self.lower_bounds_ else math.nan
        self.n_iter_ = len(self.lower_bounds_)
        self.converged_ = bool(converged)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> GaussianMixture:
        """Moves between devices; parameters stay float64 whatever dtype a network around them takes."""
        super()._apply(lambda tensor: tensor.to(fn(tensor.new_empty(0)).device), recurse)
        return self

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Takes the state of a fitted mixture, whatever this one was fitted to, if at all."""
        given = [state_dict.get(prefix + name) for name in ("weights", "means", "covariances")]
        if all(isinstance(value, Tensor) for value in given):
            weights, means, covariances = (cast(Tensor, value).double().clone() for value in given)
            self._set_buffers(weights, means, covariances)
            self.n_components, self.n_features_in_ = means.shape[0], means.shape[1]
            if not hasattr(self, "lower_bounds_"):
                self._tensors = True
                self._set_history((), True)
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def _set_buffers(self, weights: Tensor, means: Tensor, covariances: Tensor) -> None:
        for name, value in (("weights", weights), ("means", means), ("covariances", covariances)):
            self.register_buffer(name, value)

    # -- reading ----------------------------------------------------------------------------------

    def score_samples(self, X: Array) -> Array:
        """log p(x) of each point, (N,), nats."""
        points = self._as_points(X)
        return self._like(torch.cat([torch.logsumexp(part, 1) for part in self._joint(points)]), X)

    def forward(self, X: Tensor) -> Tensor:
        """log p(x) of each point, (N,), nats: `score_samples` for use inside a network."""
        return cast(Tensor, self.score_samples(X))

    def score(self, X: Array, y: Any = None) -> float:
        """Mean log-likelihood of the points, nats."""
        return float(self.score_samples(X).mean())

    def predict_proba(self, X: Array) -> Array:
        """Responsibilities γ (N, K): rows sum to one."""
        points = self._as_points(X)
        return self._like(torch.cat([torch.softmax(part, 1) for part in self._joint(points)]), X)

    def predict(self, X: Array) -> Array:
        """The most likely component of each point, (N,)."""
        points = self._as_points(X)
        labels = torch.cat([part.argmax(1) for part in self._joint(points)])
        return labels if isinstance(X, Tensor) else labels.cpu().numpy()

    def _joint(self, points: Tensor) -> list[Tensor]:
        """log π_k + log N(x|k), in chunks (n, K)."""
        center = (self.weights[:, None] * self.means).sum(0)
        centered = points - center
        parameters = Parameters(self.weights, self.means - center, self.covariances)
        rows = max(64, em.CHUNK_ELEMENTS // self.weights.shape[0])
        if em.is_ill_conditioned(parameters) or bool((centered.abs() > 1e4).any()):
            return [em.log_joint(part, parameters) for part in centered.split(rows)]
        natural = em.natural_parameters(parameters).T.contiguous()
        return [em.quadratic_features(part) @ natural for part in centered.split(rows)]

    def n_parameters(self) -> int:
        """Free parameters: K(1 + D + D(D+1)/2) − 1."""
        k, dim = self._fitted().shape
        return k * (1 + dim + dim * (dim + 1) // 2) - 1

    def bic(self, X: Array) -> float:
        """Bayesian information criterion on X; the lower the better."""
        return -2 * self.score(X) * len(X) + self.n_parameters() * math.log(len(X))

    def aic(self, X: Array) -> float:
        """Akaike information criterion on X; the lower the better."""
        return -2 * self.score(X) * len(X) + 2 * self.n_parameters()

    def sample(self, n_samples: int = 1, random_state: RandomState = None) -> tuple[Array, Array]:
        """Draw points (n, D) and their components (n,), ordered by component.

        `random_state` defaults to the estimator's own: with a seed, every call gives the same.
        """
        means = self._fitted()
        check_whole("n_samples", n_samples, 1)
        generator = as_generator(self.random_state if random_state is None else random_state)
        weights = self.weights.cpu()
        labels = torch.multinomial(weights, n_samples, True, generator=generator).sort().values
        normals = torch.randn(n_samples, means.shape[1], dtype=torch.float64, generator=generator)
        labels, normals = labels.to(means.device), normals.to(means.device)
        factors = safe_cholesky(self.covariances)
        points = means[labels] + (factors[labels] @ normals[:, :, None]).squeeze(-1)
        return (points, labels) if self._tensors else (points.cpu().numpy(), labels.cpu().numpy())

    @property
    def weights_(self) -> Array:
        """Mixing weights (K,)."""
        self._fitted()
        return self._as_fitted(self.weights)

    @property
    def means_(self) -> Array:
        """Means (K, D)."""
        return self._as_fitted(self._fitted())

    @property
    def covariances_(self) -> Array:
        """Covariances (K, D, D)."""
        self._fitted()
        return self._as_fitted(self.covariances)

    @property
    def precisions_(self) -> Array:
        """Inverse covariances (K, D, D)."""
        self._fitted()
        whiten = inverse_factor(safe_cholesky(self.covariances))
        return self._as_fitted(whiten @ whiten.transpose(-2, -1))

    # -- moving and keeping -----------------------------------------------------------------------

    # scikit-learn takes whatever has `transform` for a feature transformer. Only a fitted mixture
    # can be moved, so only a fitted one has it.
    @available_if(lambda self: self._fitted() is not None)
    def transform(self, transform: Array) -> GaussianMixture:
        """A copy moved by a rigid motion (D+1, D+1): means R μ + t, covariances R Σ Rᵀ."""
        means = self._fitted()
        matrix = torch.as_tensor(transform, dtype=torch.float64, device=means.device)
        rotation, translation = check_rigid(matrix, means.shape[1])
        moved = GaussianMixture(**BaseEstimator.get_params(self, deep=False))
        facts = ("_tensors", "n_features_in_", "lower_bounds_", "lower_bound_", "n_iter_", "converged_")
        for name in facts:
            setattr(moved, name, getattr(self, name))
        moved._set_buffers(
            self.weights.clone(), means @ rotation.T + translation, rotation @ self.covariances @ rotation.T
        )
        return moved

    def save(self, path: str | Path) -> None:
        """Write the fitted mixture as safetensors, atomically."""
        self._fitted()
        tensors = {"weights": self.weights, "means": self.means, "covariances": self.covariances}
        facts = {
            "lower_bounds": self.lower_bounds_,
            "converged": self.converged_,
            "arrays": not self._tensors,
            "parameters": {
                k: v
                for k, v in BaseEstimator.get_params(self, deep=False).items()
                if isinstance(v, int | float | str | bool | None)
            },
        }
        write_bytes(path, pack_tensors(tensors, _FILE_KIND, _FILE_VERSION, **facts))

    @classmethod
    def load(cls, path: str | Path) -> GaussianMixture:
        """Read a mixture that `save` wrote. Raises `DataError` when the file is not one."""
        tensors, facts = read_tensors(path, _FILE_KIND, _FILE_VERSION)
        means = require(tensors, "means", (None, None), torch.float64, path)
        k, dim = means.shape
        weights = require(tensors, "weights", (k,), torch.float64, path)
        covariances = require(tensors, "covariances", (k, dim, dim), torch.float64, path)
        known = set(cls._get_param_names()) - {"n_components"}
        try:
            mixture = cls.from_parameters(
                weights,
                means,
                covariances,
                lower_bounds=facts["lower_bounds"],
                converged=facts["converged"],
                **{key: v for key, v in dict(facts["parameters"]).items() if key in known},
            )
            mixture._tensors = not facts["arrays"]
        except (KeyError, TypeError, ValueError, GmmTorchError) as error:
            raise DataError(f"{path} does not hold a mixture: {error}") from error
        return mixture

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

    def _as_points(self, X: Array, reset: bool = False) -> Tensor:
        """X as a float64 tensor (N, D), checked; with `reset`, D and the kind of X are remembered."""
        if not reset:
            self._fitted()
        if not isinstance(X, Tensor):
            checked = validate_data(
                self, X, reset=reset, dtype=[np.float64, np.float32], ensure_min_samples=1
            )
            points = torch.from_numpy(np.array(checked, dtype=np.float64))
            points = points if reset else points.to(self.means.device)
        else:
            points = checked_tensor(X).double()
            points = points.detach() if reset else points
            if reset:
                self.n_features_in_ = points.shape[1]
        if reset:
            self._tensors = isinstance(X, Tensor)
        elif points.shape[1] != self.n_features_in_:
            raise InvalidArgumentError(
                f"X has {points.shape[1]} features, but GaussianMixture is expecting {self.n_features_in_} "
                "features as input."
            )
        return points

    def _fitted(self) -> Tensor:
        """The means, if there are any."""
        if "means" not in self._buffers:
            raise NotFittedError("This GaussianMixture is not fitted yet; call fit with points first.")
        return self.means

    def _as_fitted(self, value: Tensor) -> Array:
        return value if self._tensors else value.cpu().numpy()

    def _like(self, value: Tensor, X: Array) -> Array:
        """`value` in the kind and, if it is a floating type, the dtype of X."""
        if isinstance(X, Tensor):
            return value.to(X.dtype) if X.is_floating_point() else value
        dtype = getattr(X, "dtype", np.dtype(np.float64))
        return value.cpu().numpy().astype(dtype if dtype == np.float32 else np.float64, copy=False)

    def __sklearn_is_fitted__(self) -> bool:
        return "means" in self._buffers
