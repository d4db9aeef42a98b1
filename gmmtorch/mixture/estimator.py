"""MixtureEstimator: what every mixture is and answers, however it was learned."""

from __future__ import annotations

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar, cast

import numpy as np
import torch
from sklearn.base import BaseEstimator, DensityMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.exceptions import NotFittedError as ScikitLearnNotFittedError
from sklearn.utils.metaestimators import available_if
from sklearn.utils.validation import validate_data
from torch import Tensor, nn

from gmmtorch.errors import GmmTorchError, InvalidArgumentError, check_whole
from gmmtorch.linalg import check_rigid, check_symmetric, inverse_factor, safe_cholesky
from gmmtorch.mixture import mixture_file as storage
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.validation import (
    Array,
    RandomState,
    as_generator,
    check_weight_scale,
    checked_parameter,
    checked_tensor,
    checked_weight,
    warn_if_coarse,
)

Self = TypeVar("Self", bound="MixtureEstimator")


class NotFittedError(GmmTorchError, ScikitLearnNotFittedError):
    """A mixture was used before it was fitted."""


class Cloud(NamedTuple):
    """What a fit works on: points (N, D) about their `center` (D,), of weights (N,) above zero; float64."""

    points: Tensor
    weight: Tensor
    center: Tensor


class MixtureEstimator(DensityMixin, BaseEstimator, nn.Module, ABC):
    """A Gaussian mixture with scikit-learn's interface and a torch module's: all but the learning.

    A subclass names its parameters in `__init__` (which sets them and calls `nn.Module.__init__`),
    checks them in `check_parameters`, and learns in `fit`: `_prepare` gives the checked, centred
    cloud, and `_keep` takes the result. What it learns beside the mixture (a posterior, a tree) it
    names in `_extra_names` and hands to `_keep`; it is then kept by files, states, copies and motions.

    Arrays in, arrays out; tensors in, tensors out. Parameters are kept in float64, and clouds are
    centred while they are worked on, so points 500 km away lose no digits.

    Fitted attributes, in the kind (array or tensor) of the points given to `fit`: `weights_` (K,),
    `means_` (K, D), `covariances_` (K, D, D), `precisions_` (K, D, D); and `lower_bound_`,
    `lower_bounds_`, `n_iter_`, `converged_`, `n_features_in_`. The buffers `weights`, `means` and
    `covariances` are tensors always, and move with `.to(device)`.
    """

    n_components: Any  # a whole number, or None where a subclass finds it by itself
    tol: float
    max_iter: int
    random_state: RandomState
    weights: Tensor
    means: Tensor
    covariances: Tensor
    _tensors: bool  # whether fit was given a tensor
    _extra_names: ClassVar[tuple[str, ...]] = ()  # buffers beside the mixture's own
    _finds_n_components: ClassVar[bool] = False  # whether n_components is but the most there may be
    _takes_any_total_weight: ClassVar[bool] = False  # as it does where a prior counts in points

    @classmethod
    def from_parameters(
        cls: type[Self],
        weights: Array,
        means: Array,
        covariances: Array,
        *,
        lower_bounds: Sequence[float] = (),
        converged: bool = True,
        **options: Any,
    ) -> Self:
        """A fitted mixture of given weights (K,), means (K, D) and covariances (K, D, D).

        `lower_bounds` and `converged` say how it was found, if that is known; `options` are those
        of the constructor. Raises `InvalidArgumentError` or `NumericalError` if it is no mixture.
        """
        mean = torch.as_tensor(means).double()
        if mean.ndim != 2 or 0 in mean.shape:
            raise InvalidArgumentError(f"means has shape {tuple(mean.shape)}; expected (K, D).")
        k, dim = mean.shape
        mixture = cls(**{"n_components": k, **options})
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
        mixture._set_extra({})
        return mixture

    @abstractmethod
    def check_parameters(self, n_points: int | None = None) -> None:
        """Raise `InvalidArgumentError` for a parameter that cannot be, or not with this many points."""

    @abstractmethod
    def fit(self: Self, X: Array, y: Any = None, sample_weight: Array | None = None) -> Self:
        """Learn the mixture of points X (N, D), each standing for `sample_weight` (N,) points."""

    def fit_predict(self, X: Array, y: Any = None, sample_weight: Array | None = None) -> Array:
        """Fit, and the most likely component (N,) of each point."""
        return self.fit(X, y, sample_weight).predict(X)

    # -- learning: what every fit begins and ends with --------------------------------------------

    def _prepare(self, X: Array, sample_weight: Array | None, reset: bool = True) -> Cloud:
        """The points of non-zero weight, checked, about their weighted mean.

        Without `reset` they add to what was learned: of its dimension, and as few as there are.
        """
        self.check_parameters()
        points = self._as_points(X, reset=reset).detach()
        warn_if_coarse(X, points)
        weight = checked_weight(sample_weight, points)
        points, weight = points[weight > 0], weight[weight > 0]
        if not self._takes_any_total_weight:
            check_weight_scale(weight)
        if reset:
            self.check_parameters(points.shape[0])
        center = (points * (weight / weight.sum())[:, None]).sum(0)
        return Cloud(points - center, weight, center)

    def _keep(
        self,
        parameters: Parameters,
        center: Tensor,
        lower_bounds: Sequence[float],
        converged: bool,
        extra: Mapping[str, Tensor] | None = None,
    ) -> None:
        """Take a fit's result: parameters about `center`, and `extra` tensors in the points' own frame."""
        weights, means, covariances = parameters
        self._set_buffers(weights / weights.sum(), means + center, covariances)
        self._set_history(lower_bounds, converged)
        self._set_extra(extra or {})

    def _warn_unless_converged(self, what: str, where: str = "") -> None:
        """Warn the caller of `fit` that it ended by `max_iter`, unless `tol` is zero: then that was meant."""
        if not self.converged_ and self.tol > 0:
            warnings.warn(
                f"{what} did not converge within max_iter={self.max_iter}{where}; raise it, or raise tol.",
                ConvergenceWarning,
                stacklevel=3,
            )

    def _set_history(self, lower_bounds: Sequence[float], converged: bool) -> None:
        self.lower_bounds_ = [float(x) for x in lower_bounds]
        self.lower_bound_ = self.lower_bounds_[-1] if self.lower_bounds_ else math.nan
        self.n_iter_ = len(self.lower_bounds_)
        self.converged_ = bool(converged)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> MixtureEstimator:
        """Moves between devices; parameters stay float64 whatever dtype a network around them takes."""
        super()._apply(lambda tensor: tensor.to(fn(tensor.new_empty(0)).device), recurse)
        return self

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Takes the state of a fitted mixture, whatever this one was fitted to, if at all."""
        given = [state_dict.get(prefix + name) for name in ("weights", "means", "covariances")]
        if all(isinstance(value, Tensor) for value in given):
            weights, means, covariances = (cast(Tensor, value).double().clone() for value in given)
            self._set_buffers(weights, means, covariances)
            self.n_features_in_ = means.shape[1]
            if self.n_components is not None:  # which says that it is found, whatever was found
                self.n_components = means.shape[0]
            extra = ((name, state_dict.get(prefix + name)) for name in self._extra_names)
            self._set_extra({name: value.clone() for name, value in extra if isinstance(value, Tensor)})
            if not hasattr(self, "lower_bounds_"):
                self._tensors = True
                self._set_history((), True)
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def _set_buffers(self, weights: Tensor, means: Tensor, covariances: Tensor) -> None:
        for name, value in (("weights", weights), ("means", means), ("covariances", covariances)):
            self.register_buffer(name, value)

    # -- what a subclass keeps beside the mixture -------------------------------------------------

    def _extra_tensors(self) -> dict[str, Tensor]:
        """The tensors named in `_extra_names`, those that are there: float64, int64 or bool."""
        return {name: getattr(self, name) for name in self._extra_names if name in self._buffers}

    def _set_extra(self, tensors: Mapping[str, Tensor]) -> None:
        """Keep these in place of any there are. Comes last: the mixture's own buffers are set.

        They may come from a file or another's state: a subclass checks them first, and raises
        `InvalidArgumentError`. None at all is no error: a mixture of given parameters has none.
        """
        for name in self._extra_names:
            self._buffers.pop(name, None)
            if name in tensors:
                self.register_buffer(name, tensors[name])

    def _moved_extra(self, rotation: Tensor, translation: Tensor) -> dict[str, Tensor]:
        """The extra tensors after a rigid motion x ↦ R x + t; a subclass moves those it moves."""
        return self._extra_tensors()

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
    def transform(self: Self, transform: Array) -> Self:
        """A copy moved by a rigid motion (D+1, D+1): means R μ + t, covariances R Σ Rᵀ."""
        means = self._fitted()
        matrix = torch.as_tensor(transform, dtype=torch.float64, device=means.device)
        rotation, translation = check_rigid(matrix, means.shape[1])
        moved = type(self)(**BaseEstimator.get_params(self, deep=False))
        facts = ("_tensors", "n_features_in_", "lower_bounds_", "lower_bound_", "n_iter_", "converged_")
        for name in facts:
            setattr(moved, name, getattr(self, name))
        moved._set_buffers(
            self.weights.clone(), means @ rotation.T + translation, rotation @ self.covariances @ rotation.T
        )
        moved._set_extra({k: v.clone() for k, v in self._moved_extra(rotation, translation).items()})
        return moved

    def save(self, path: str | Path) -> None:
        """Write the fitted mixture as safetensors, atomically."""
        self._fitted()
        plain = {
            key: value
            for key, value in BaseEstimator.get_params(self, deep=False).items()
            if isinstance(value, int | float | str | bool | None)
        }
        stored = storage.StoredMixture(
            self.weights,
            self.means,
            self.covariances,
            self.lower_bounds_,
            self.converged_,
            arrays=not self._tensors,
            parameters=plain,
            extra=self._extra_tensors(),
        )
        storage.write(path, stored)

    @classmethod
    def load(cls: type[Self], path: str | Path) -> Self:
        """Read a mixture that `save` wrote. Raises `DataError` when the file is not one."""
        stored = storage.read(path)
        known = set(cls._get_param_names())
        asked = stored.parameters.get("n_components", 0)
        if asked is not None and not (cls._finds_n_components and isinstance(asked, int)):
            known.remove("n_components")  # it is the number there are
        with storage.naming(path):
            mixture = cls.from_parameters(
                stored.weights,
                stored.means,
                stored.covariances,
                lower_bounds=stored.lower_bounds,
                converged=stored.converged,
                **{key: value for key, value in stored.parameters.items() if key in known},
            )
            mixture._set_extra(stored.extra)
        mixture._tensors = not stored.arrays
        return mixture

    # -- arguments --------------------------------------------------------------------------------

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
                f"X has {points.shape[1]} features, but {type(self).__name__} is expecting "
                f"{self.n_features_in_} features as input."
            )
        return points

    def _fitted(self) -> Tensor:
        """The means, if there are any."""
        if "means" not in self._buffers:
            raise NotFittedError(f"This {type(self).__name__} is not fitted yet; call fit with points first.")
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
