"""MixtureEstimator: the abstract base of all mixture estimators: fitting, files, states and motions."""

from __future__ import annotations

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar, cast

import torch
from sklearn.base import BaseEstimator
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils.metaestimators import available_if
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_choice, check_number, check_whole
from gmmtorch.linalg import check_rigid, check_symmetric, safe_cholesky
from gmmtorch.mixture import mixture_file
from gmmtorch.mixture.density import MixtureDensity
from gmmtorch.mixture.em.exact import SOFTMAX_DTYPES, Parameters
from gmmtorch.mixture.em.initialization import INITIALIZATIONS
from gmmtorch.mixture.validation import (
    Array,
    as_generator,
    check_component_count,
    check_weight_scale,
    checked_parameter,
    checked_weight,
    warn_if_coarse,
)

Self = TypeVar("Self", bound="MixtureEstimator")


class Cloud(NamedTuple):
    """Input of a fit: points (N, D) relative to `center` (D,), and weights (N,) above zero; float64."""

    points: Tensor
    weight: Tensor
    center: Tensor


class MixtureEstimator(MixtureDensity, ABC):
    """Abstract Gaussian mixture with scikit-learn's interface that is also a torch module.

    A subclass sets its parameters in `__init__`, where it also calls `nn.Module.__init__`. It checks
    them in `check_parameters` and learns in `fit`: `_prepare` returns the checked, centred cloud, and
    `_store_fit` stores the result. Further results (a posterior, a tree) are passed to `_store_fit` as
    the tensors that `_extra_names` lists. Files, states, copies and motions then include them.

    Parameters are float64, and clouds are centred during the fit, so that points 500 km from the
    origin lose no digits.

    Fitted attributes: those of `MixtureDensity`, and `lower_bound_`, `lower_bounds_`, `n_iter_`,
    `converged_`, `n_features_in_`.
    """

    n_components: Any  # a whole number; None if a subclass determines it
    tol: float
    max_iter: int
    _extra_names: ClassVar[tuple[str, ...]] = ()  # buffers besides weights, means and covariances
    _init_choices: ClassVar[tuple[str, ...]] = tuple(INITIALIZATIONS)
    _optional_n_components: ClassVar[bool] = False  # whether n_components may be None
    _finds_n_components: ClassVar[bool] = False  # whether n_components is only an upper limit
    _accepts_any_total_weight: ClassVar[bool] = False  # true if a prior counts in points

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
        """A fitted mixture with given weights (K,), means (K, D) and covariances (K, D, D).

        `lower_bounds` and `converged` describe the fit, if known; `options` are those of the
        constructor. Raises `InvalidArgumentError` or `NumericalError` for invalid parameters.
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

    def check_parameters(self, n_points: int | None = None) -> None:
        """Raise `InvalidArgumentError` for an invalid parameter, or for more components than points.

        This checks the parameters that several estimators share. A subclass adds its own checks.
        """
        options = BaseEstimator.get_params(self, deep=False)
        for name in ("max_iter", "n_init"):
            if name in options:
                check_whole(name, options[name], 1)
        for name in ("tol", "reg_covar"):
            check_number(name, options[name])
        if "init_params" in options:
            check_choice("init_params", options["init_params"], self._init_choices)
        if "dtype" in options:
            check_choice("dtype", options["dtype"], SOFTMAX_DTYPES)
        as_generator(options["random_state"])
        if self.n_components is None and self._optional_n_components:
            return
        check_whole("n_components", self.n_components, 1)
        if not self._finds_n_components:
            check_component_count(self.n_components, n_points)

    @abstractmethod
    def fit(self: Self, X: Array, y: Any = None, sample_weight: Array | None = None) -> Self:
        """Fit the mixture to points X (N, D).

        Args:
            X: points, finite.
            y: ignored, as in scikit-learn.
            sample_weight: (N,) number of points that each row stands for: not negative, not all zero.
            on_iteration (all subclasses): called with the iteration (from 1) and its lower bound.

        Raises:
            InvalidArgumentError (a ValueError): an invalid argument, weight or point; more components
                than points of non-zero weight.
            NumericalError: a component collapsed, which happens with reg_covar = 0.
        """

    def fit_predict(self, X: Array, y: Any = None, sample_weight: Array | None = None) -> Array:
        """Fit, then return the most likely component (N,) of each point."""
        return self.fit(X, y, sample_weight).predict(X)

    # -- steps that every fit begins and ends with ------------------------------------------------

    def _prepare(self, X: Array, sample_weight: Array | None, reset: bool = True) -> Cloud:
        """The checked points of non-zero weight, relative to their weighted mean.

        Without `reset` the points extend an earlier fit: D must match, and there may be fewer points
        than components.
        """
        self.check_parameters()
        points = self._as_points(X, reset=reset).detach()
        warn_if_coarse(X, points)
        weight = checked_weight(sample_weight, points)
        points, weight = points[weight > 0], weight[weight > 0]
        if not self._accepts_any_total_weight:
            check_weight_scale(weight)
        if reset:
            self.check_parameters(points.shape[0])
        center = (points * (weight / weight.sum())[:, None]).sum(0)
        return Cloud(points - center, weight, center)

    def _store_fit(
        self,
        parameters: Parameters,
        center: Tensor,
        lower_bounds: Sequence[float],
        converged: bool,
        extra: Mapping[str, Tensor] | None = None,
    ) -> None:
        """Store a fit: parameters relative to `center`, and `extra` tensors in the frame of the points."""
        weights, means, covariances = parameters
        self._set_buffers(weights / weights.sum(), means + center, covariances)
        self._set_history(lower_bounds, converged)
        self._set_extra(extra or {})

    def _warn_unless_converged(self, what: str, where: str = "") -> None:
        """Warn the caller of `fit` that it stopped at `max_iter`.

        With tol=0 that is intended, so no warning.
        """
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

    # -- extra tensors of a subclass --------------------------------------------------------------

    def _extra_tensors(self) -> dict[str, Tensor]:
        """The existing tensors of `_extra_names`: float64, int64 or bool."""
        return {name: getattr(self, name) for name in self._extra_names if name in self._buffers}

    def _set_extra(self, tensors: Mapping[str, Tensor]) -> None:
        """Replace the extra tensors. Called after the weights, means and covariances are set.

        The tensors may come from a file or a state dict, so a subclass checks them first and raises
        `InvalidArgumentError`. An empty mapping is valid: a mixture of given parameters has none.
        """
        for name in self._extra_names:
            self._buffers.pop(name, None)
            if name in tensors:
                self.register_buffer(name, tensors[name])

    def _transformed_extra(self, rotation: Tensor, translation: Tensor) -> dict[str, Tensor]:
        """The extra tensors after a rigid motion x ↦ R x + t. A subclass transforms those that need it."""
        return self._extra_tensors()

    # -- states, motions and files ----------------------------------------------------------------

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Load the state of a fitted mixture with any K and D, whether this one is fitted or not."""
        given = [state_dict.get(prefix + name) for name in ("weights", "means", "covariances")]
        if all(isinstance(value, Tensor) for value in given):
            weights, means, covariances = (cast(Tensor, value).double().clone() for value in given)
            self._set_buffers(weights, means, covariances)
            self.n_features_in_ = means.shape[1]
            if self.n_components is not None:  # None means: determined by the fit
                self.n_components = means.shape[0]
            extra = ((name, state_dict.get(prefix + name)) for name in self._extra_names)
            self._set_extra({name: value.clone() for name, value in extra if isinstance(value, Tensor)})
            if not hasattr(self, "lower_bounds_"):
                self._tensors = True
                self._set_history((), True)
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def _scalar_options(self) -> dict[str, Any]:
        """Constructor options that JSON can represent."""
        options = BaseEstimator.get_params(self, deep=False)
        return {key: value for key, value in options.items() if isinstance(value, int | float | str | None)}

    # scikit-learn treats every object with `transform` as a feature transformer. Only a fitted mixture
    # can be moved, so the method exists only after the fit.
    @available_if(lambda self: self._fitted() is not None)
    def transform(self: Self, transform: Array) -> Self:
        """A copy moved by a rigid motion (D+1, D+1): means R μ + t, covariances R Σ Rᵀ."""
        means = self._fitted()
        matrix = torch.as_tensor(transform, dtype=torch.float64, device=means.device)
        rotation, translation = check_rigid(matrix, means.shape[1])
        moved = type(self)(**BaseEstimator.get_params(self, deep=False))
        for name in ("_tensors", "n_features_in_", "lower_bounds_", "lower_bound_", "n_iter_", "converged_"):
            setattr(moved, name, getattr(self, name))
        moved._set_buffers(
            self.weights.clone(), means @ rotation.T + translation, rotation @ self.covariances @ rotation.T
        )
        moved._set_extra({k: v.clone() for k, v in self._transformed_extra(rotation, translation).items()})
        return moved

    def save(self, path: str | Path) -> None:
        """Write the fitted mixture to a safetensors file, atomically."""
        self._fitted()
        stored = mixture_file.StoredMixture(
            self.weights,
            self.means,
            self.covariances,
            self.lower_bounds_,
            self.converged_,
            arrays=not self._tensors,
            parameters=self._scalar_options(),
            extra=self._extra_tensors(),
        )
        mixture_file.write(path, stored)

    @classmethod
    def load(cls: type[Self], path: str | Path) -> Self:
        """Read a mixture that `save` wrote. Raises `DataError` if the file is not a valid mixture."""
        stored = mixture_file.read(path)
        known = set(cls._get_param_names())
        stored_n = stored.parameters.get("n_components", 0)
        if stored_n is not None and not (cls._finds_n_components and isinstance(stored_n, int)):
            known.remove("n_components")  # then it is the number of stored components
        with mixture_file.errors_naming(path):
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
