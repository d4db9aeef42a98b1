"""MixtureDensity: the density of a fitted Gaussian mixture, and queries and samples of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import torch
from sklearn.base import BaseEstimator, DensityMixin
from sklearn.exceptions import NotFittedError as ScikitLearnNotFittedError
from sklearn.utils.validation import validate_data
from torch import Tensor, nn

from gmmtorch.errors import GmmTorchError, InvalidArgumentError, check_whole
from gmmtorch.linalg import inverse_factor, safe_cholesky
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.validation import Array, RandomState, as_generator, checked_tensor

_FAR = 1e4  # distance from the centre (m) beyond which products of features lose digits


class NotFittedError(GmmTorchError, ScikitLearnNotFittedError):
    """A mixture was used before it was fitted."""


class MixtureDensity(DensityMixin, BaseEstimator, nn.Module):
    """The queries of a fitted mixture, with the interfaces of scikit-learn and of a torch module.

    Arrays give arrays and tensors give tensors. The buffers `weights` (K,), `means` (K, D) and
    `covariances` (K, D, D) are always float64 tensors, and move with `.to(device)`. The attributes
    `weights_`, `means_`, `covariances_` and `precisions_` are of the kind (array or tensor) of the
    points given to `fit`.
    """

    random_state: RandomState
    weights: Tensor
    means: Tensor
    covariances: Tensor
    _tensors: bool  # whether fit was given a tensor

    def score_samples(self, X: Array) -> Array:
        """log p(x) of each point, (N,), nats."""
        points = self._as_points(X)
        return self._as_kind_of(X, torch.cat([torch.logsumexp(part, 1) for part in self._joint(points)]))

    def forward(self, X: Tensor) -> Tensor:
        """log p(x) of each point, (N,), nats: `score_samples` for use inside a network."""
        return cast(Tensor, self.score_samples(X))

    def score(self, X: Array, y: Any = None) -> float:
        """Mean log-likelihood of the points, nats."""
        return float(self.score_samples(X).mean())

    def predict_proba(self, X: Array) -> Array:
        """Responsibilities γ (N, K). Each row sums to one."""
        points = self._as_points(X)
        return self._as_kind_of(X, torch.cat([torch.softmax(part, 1) for part in self._joint(points)]))

    def predict(self, X: Array) -> Array:
        """Index (N,) of the most likely component of each point."""
        points = self._as_points(X)
        labels = torch.cat([part.argmax(1) for part in self._joint(points)])
        return labels if isinstance(X, Tensor) else labels.cpu().numpy()

    def _joint(self, points: Tensor) -> list[Tensor]:
        """log π_k + log N(x|k), in chunks (n, K)."""
        center = (self.weights[:, None] * self.means).sum(0)
        centered = points - center
        parameters = Parameters(self.weights, self.means - center, self.covariances)
        rows = max(64, em.CHUNK_ELEMENTS // self.weights.shape[0])
        if em.is_ill_conditioned(parameters) or bool((centered.abs() > _FAR).any()):
            return [em.log_joint(part, parameters) for part in centered.split(rows)]
        natural = em.natural_parameters(parameters).T.contiguous()
        return [em.quadratic_features(part) @ natural for part in centered.split(rows)]

    def n_parameters(self) -> int:
        """Number of free parameters: K(1 + D + D(D+1)/2) − 1."""
        k, dim = self._fitted().shape
        return k * (1 + dim + dim * (dim + 1) // 2) - 1

    def bic(self, X: Array) -> float:
        """Bayesian information criterion on X; lower is better."""
        return -2 * self.score(X) * len(X) + self.n_parameters() * math.log(len(X))

    def aic(self, X: Array) -> float:
        """Akaike information criterion on X; lower is better."""
        return -2 * self.score(X) * len(X) + 2 * self.n_parameters()

    def sample(self, n_samples: int = 1, random_state: RandomState = None) -> tuple[Array, Array]:
        """Draw points (n, D) and their components (n,), ordered by component.

        `random_state` defaults to that of the estimator. If that is a seed, every call returns the
        same samples.
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
        return self._as_fit_kind(self.weights)

    @property
    def means_(self) -> Array:
        """Means (K, D)."""
        return self._as_fit_kind(self._fitted())

    @property
    def covariances_(self) -> Array:
        """Covariances (K, D, D)."""
        self._fitted()
        return self._as_fit_kind(self.covariances)

    @property
    def precisions_(self) -> Array:
        """Inverse covariances (K, D, D)."""
        self._fitted()
        whiten = inverse_factor(safe_cholesky(self.covariances))
        return self._as_fit_kind(whiten @ whiten.transpose(-2, -1))

    # -- buffers and conversions ------------------------------------------------------------------

    def _set_buffers(self, weights: Tensor, means: Tensor, covariances: Tensor) -> None:
        for name, value in (("weights", weights), ("means", means), ("covariances", covariances)):
            self.register_buffer(name, value)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> MixtureDensity:
        """Moves buffers between devices. They stay float64 if the surrounding network changes its dtype."""
        super()._apply(lambda tensor: tensor.to(fn(tensor.new_empty(0)).device), recurse)
        return self

    def _as_points(self, X: Array, reset: bool = False) -> Tensor:
        """X as a checked float64 tensor (N, D). With `reset`, stores D and the kind of X."""
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
        """The means. Raises `NotFittedError` if there are none."""
        if "means" not in self._buffers:
            raise NotFittedError(f"This {type(self).__name__} is not fitted yet; call fit with points first.")
        return self.means

    def _as_fit_kind(self, value: Tensor) -> Array:
        return value if self._tensors else value.cpu().numpy()

    def _as_kind_of(self, X: Array, value: Tensor) -> Array:
        """`value` as an array or tensor like X, in the dtype of X if that is a floating type."""
        if isinstance(X, Tensor):
            return value.to(X.dtype) if X.is_floating_point() else value
        dtype = getattr(X, "dtype", np.dtype(np.float64))
        return value.cpu().numpy().astype(dtype if dtype == np.float32 else np.float64, copy=False)

    def __sklearn_is_fitted__(self) -> bool:
        return "means" in self._buffers
