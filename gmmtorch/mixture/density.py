"""MixtureDensity: the density of a fitted Gaussian mixture, and queries and samples of it."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator
from typing import Any, TypeVar, cast
from weakref import WeakKeyDictionary

import numpy as np
import torch
from sklearn.base import BaseEstimator, DensityMixin
from sklearn.exceptions import NotFittedError as ScikitLearnNotFittedError
from sklearn.utils._param_validation import InvalidParameterError as ScikitLearnInvalidParameterError
from sklearn.utils.validation import validate_data
from torch import Tensor, nn

from gmmtorch.arrays import DeviceModule, check_dense
from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.linalg import inverse_factor, safe_cholesky
from gmmtorch.mixture.em import by_type
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.exact import Parameters, compact, count_free_entries, expand
from gmmtorch.mixture.validation import Array, RandomState, as_generator, checked_tensor

Known = tuple[list[tuple[Tensor, int]], by_type.Joint]
_JOINTS: WeakKeyDictionary[MixtureDensity, Known] = WeakKeyDictionary()
"""The log-densities of mixtures, with the parameters that they are of and their versions; apart from the
mixtures, because queries may not change an estimator's attributes."""

Self = TypeVar("Self", bound="MixtureDensity")


class NotFittedError(GmmTorchError, ScikitLearnNotFittedError):
    """A mixture was used before it was fitted."""


class InvalidParameterError(InvalidArgumentError, ScikitLearnInvalidParameterError):
    """A parameter of an estimator has an invalid value."""


class MixtureDensity(DensityMixin, BaseEstimator, DeviceModule):
    """The queries of a fitted mixture, with the interfaces of scikit-learn and of a torch module.

    Arrays give arrays and tensors give tensors. The tensors `weights` (K,), `means` (K, D) and
    `covariances` (K, D, D) are always float64, and move with `.to(device)`; the state dict has the
    covariances in the shape of the covariance type. The attributes
    `weights_`, `means_`, `covariances_`, `precisions_` and `precisions_cholesky_` are of the kind (array or
    tensor) of the points given to `fit`. The last three have scikit-learn's shape for the covariance type:
    full (K, D, D), tied (D, D), diag (K, D), spherical (K,).
    """

    training = True  # of the class: scikit-learn allows no attribute but the parameters in __init__
    covariance_type: str = "full"
    random_state: RandomState
    weights: Tensor
    means: Tensor
    _tensors: bool  # whether fit was given a tensor
    _fitted_type: str  # the covariance type of the fit

    def __new__(cls: type[Self], *args: Any, **kwargs: Any) -> Self:
        estimator = super().__new__(cls)
        nn.Module.__init__(estimator)
        del estimator.training
        return estimator

    def __repr__(self) -> str:
        """The class and the parameters that differ from their defaults, in one line."""
        defaults = inspect.signature(type(self).__init__).parameters
        given = BaseEstimator.get_params(self, deep=False).items()
        changed = [f"{name}={_short(v)}" for name, v in given if _short(v) != _short(defaults[name].default)]
        return f"{type(self).__name__}({', '.join(changed)})"

    def score_samples(self, X: Array) -> Array:
        """log p(x) of each point, (N,), nats."""
        points = self._as_points(X)
        return self._as_kind_of(X, torch.cat([_log_sum(part) for part in self._joint(points)]))

    def forward(self, X: Tensor) -> Tensor:
        """log p(x) of each point, (N,), nats: `score_samples` for use inside a network."""
        return cast(Tensor, self.score_samples(X))

    def score(self, X: Array, y: Any = None) -> float:
        """Mean log-likelihood of the points (2.2), nats."""
        return float(self.score_samples(X).mean())

    def predict_proba(self, X: Array) -> Array:
        """Responsibilities γ (N, K). Each row sums to one."""
        points = self._as_points(X)
        return self._as_kind_of(X, torch.cat([torch.softmax(part, 0).T for part in self._joint(points)]))

    def predict(self, X: Array) -> Array:
        """Index (N,) of the most likely component of each point."""
        points = self._as_points(X)
        labels = torch.cat([part.max(0).indices for part in self._joint(points)])
        return labels if isinstance(X, Tensor) else labels.cpu().numpy()

    def _joint(self, points: Tensor) -> Iterator[Tensor]:
        """log π_k + log N(x|k), in chunks (K, n)."""
        k, dim = self.means.shape
        rows = by_type.rows_of_chunk(k, dim, self._fitted_type, points.device)
        joint = self._log_joint()
        return (joint(part) for part in points.split(rows))

    def _log_joint(self) -> by_type.Joint:
        """`by_type.log_joint` of the parameters, which is made anew if they change."""
        parameters = Parameters(self.weights, self.means, self._typed_covariances())
        if any(value.requires_grad or value.is_inference() for value in parameters):
            return by_type.log_joint(parameters, self._fitted_type)
        known = _JOINTS.get(self)
        if known is None or any(
            a is not b or a._version != v for a, (b, v) in zip(parameters, known[0], strict=True)
        ):
            of = [(value, value._version) for value in parameters]
            known = _JOINTS[self] = of, by_type.log_joint(parameters, self._fitted_type)
        return known[1]

    def n_parameters(self) -> int:
        """Number of free parameters: for full covariances K(1 + D + D(D+1)/2) − 1."""
        k, dim = self._fitted().shape
        return k * (1 + dim) - 1 + count_free_entries(self._fitted_type, k, dim)

    def bic(self, X: Array) -> float:
        """Bayesian information criterion on X; lower is better."""
        return -2 * self.score(X) * len(X) + self.n_parameters() * math.log(len(X))

    def aic(self, X: Array) -> float:
        """Akaike information criterion on X; lower is better."""
        return -2 * self.score(X) * len(X) + 2 * self.n_parameters()

    def sample(self, n_samples: int = 1, random_state: RandomState = None) -> tuple[Array, Array]:
        """Draw points (n, D) and their components (n,), ordered by component.

        `random_state` defaults to that of the estimator; of a seed, every call returns the same samples.
        """
        means = self._fitted()
        if not isinstance(n_samples, int | np.integer) or n_samples < 1:
            raise InvalidArgumentError(
                f"Invalid value for 'n_samples': {n_samples!r}. Give a whole number of at least 1."
            )
        generator = as_generator(self.random_state if random_state is None else random_state)
        # NumPy's normal numbers take half the time of torch's.
        numbers = np.random.default_rng(int(torch.randint(2**63 - 1, (), generator=generator)))
        share = self.weights.detach().cpu().numpy()
        sizes = torch.from_numpy(numbers.multinomial(n_samples, share / share.sum())).to(means.device)
        labels = torch.repeat_interleave(sizes, output_size=n_samples)
        points = torch.from_numpy(numbers.standard_normal((n_samples, means.shape[1]))).to(means.device)
        spread = self._typed_covariances()
        if self._fitted_type in ("full", "tied"):
            factors = safe_cholesky(spread.view(-1, *spread.shape[-2:])).expand(len(means), -1, -1)
            parts = zip(means, points.split(sizes.tolist()), factors, strict=True)
            points = torch.cat([torch.addmm(mean, part, factor.mT) for mean, part, factor in parts])
        else:
            scale, rows = spread.sqrt().view(len(means), -1), by_type.chunk_rows(points)
            for i in range(0, n_samples, rows):
                own = labels[i : i + rows]
                points[i : i + rows].mul_(scale[own]).add_(means[own])
        return (points, labels) if self._tensors else (points.cpu().numpy(), labels.cpu().numpy())

    @property
    def weights_(self) -> Array:
        """Mixing weights (K,)."""
        self._fitted()
        return self._as_fit_kind(self.weights)

    @property
    def means_(self) -> Array:
        """Means (K, D)."""
        return self._as_fit_kind(self._fitted())

    @property
    def covariances(self) -> Tensor:
        """Covariances (K, D, D)."""
        if "covariances" not in self._buffers:
            raise AttributeError("covariances")  # nn.Module then says so of the class
        return expand(self._typed_covariances(), self._fitted_type, *self.means.shape)

    def _typed_covariances(self) -> Tensor:
        """The buffer: covariances in the shape of the covariance type."""
        self._fitted()
        return cast(Tensor, self._buffers["covariances"])

    @property
    def covariances_(self) -> Array:
        """Covariances, in the shape of the covariance type."""
        return self._as_fit_kind(self._typed_covariances())

    @property
    def precisions_(self) -> Array:
        """Inverse covariances, in the shape of the covariance type."""
        whiten = self._whiten()
        diagonal = self._fitted_type in ("diag", "spherical")
        return self._as_fit_kind(whiten.square() if diagonal else whiten @ whiten.mT)

    @property
    def precisions_cholesky_(self) -> Array:
        """Upper triangular factors U of the precisions U Uᵀ, in the shape of the covariance type."""
        return self._as_fit_kind(self._whiten())

    def _whiten(self) -> Tensor:
        spread = self._typed_covariances()
        if self._fitted_type in ("diag", "spherical"):
            return spread.rsqrt()
        return inverse_factor(safe_cholesky(spread.view(-1, *spread.shape[-2:]))).view_as(spread)

    def _set_buffers(self, weights: Tensor, means: Tensor, covariances: Tensor) -> None:
        self._fitted_type = self.covariance_type
        if covariances.ndim == 3:
            covariances = compact(covariances, self._fitted_type)
        for name, value in zip(Parameters._fields, (weights, means, covariances), strict=True):
            self._buffers[name] = value

    def _as_points(self, X: Array, reset: bool = False) -> Tensor:
        """X as a checked float64 tensor (N, D). With `reset`, stores D and the kind of X."""
        if not reset:
            self._fitted()
        if (plain := self._shared(X, reset)) is not None:
            points = plain if reset else plain.to(self.means.device)
        elif not isinstance(X, Tensor):
            check_dense(X, "X")
            checked = validate_data(
                self, X, reset=reset, dtype=[np.float64, np.float32], ensure_min_samples=1
            )
            checked = checked.astype(np.float64, copy=not checked.flags.writeable or min(checked.strides) < 0)
            points = torch.from_numpy(checked)
            points = points if reset else points.to(self.means.device)
        else:
            points = checked_tensor(X).double()
            points = points.detach() if reset else points
        if reset and (plain is not None or isinstance(X, Tensor)):
            self.n_features_in_ = points.shape[1]
            self.__dict__.pop("feature_names_in_", None)
        if reset:
            self._tensors = isinstance(X, Tensor)
        elif points.shape[1] != self.n_features_in_:
            raise InvalidArgumentError(
                f"X has {points.shape[1]} features, but {type(self).__name__} is expecting "
                f"{self.n_features_in_} features as input."
            )
        return points

    def _shared(self, X: Array, reset: bool) -> Tensor | None:
        """The memory of a table that needs no `validate_data`, which takes longer than a small fit."""
        if type(X) is not np.ndarray or X.dtype != np.float64 or not X.dtype.isnative or X.ndim != 2:
            return None
        if X.size == 0 or not X.flags.writeable or any(step < 0 or step % 8 for step in X.strides):
            return None
        if not reset and ("feature_names_in_" in vars(self) or X.shape[1] != self.n_features_in_):
            return None
        points = torch.from_numpy(X)
        return points if math.isfinite(float(points.sum())) else None

    def _fitted(self) -> Tensor:
        """The means. Raises `NotFittedError` if there are none."""
        if "means" not in self._buffers:
            raise NotFittedError(
                f"This {type(self).__name__} instance is not fitted yet. Call 'fit' with appropriate "
                "arguments before using this estimator."
            )
        return self.means

    def _as_fit_kind(self, value: Tensor) -> Array:
        return value if self._tensors else value.cpu().numpy()

    def _as_kind_of(self, X: Array, value: Tensor) -> Array:
        """`value` as an array or tensor like X, in float32 for such an X: half precision has no −70,000."""
        value = value.float() if getattr(X, "dtype", None) in (torch.float32, np.float32) else value
        return value if isinstance(X, Tensor) else value.cpu().numpy()

    def __sklearn_is_fitted__(self) -> bool:
        return "means" in self._buffers


def _log_sum(joint: Tensor) -> Tensor:
    """log Σ_k exp (n,) of joint (K, n): several times as fast as `torch.logsumexp` where shares underflow."""
    peak = joint.detach().amax(0).clamp_min(torch.finfo(joint.dtype).min)
    shares = (joint - peak).clamp_(min=em.exponent_floor(joint.dtype)).exp_()
    return shares.sum(0).log() + peak


def _short(value: object) -> str:
    """The `repr` of a parameter; of an array only the shape."""
    if isinstance(value, Tensor | np.ndarray):
        return f"<{type(value).__name__} of shape {tuple(value.shape)}>"
    return " ".join(repr(value).split())
