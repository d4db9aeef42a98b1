"""MixtureEstimator, the base of all mixture estimators: the steps of a fit, and what a fit leaves behind."""

from __future__ import annotations

import functools
import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar, cast

import numpy as np
import torch
from sklearn.base import BaseEstimator
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils._param_validation import Interval, StrOptions
from sklearn.utils._param_validation import InvalidParameterError as ScikitLearnInvalidParameterError
from torch import Tensor

from gmmtorch.arrays import as_tensor
from gmmtorch.errors import DAMAGED_CONTENT, DataError, GmmTorchError, InvalidArgumentError, NumericalError
from gmmtorch.files import pack_tensors, read_tensors, require, write_bytes
from gmmtorch.linalg import check_symmetric, safe_cholesky
from gmmtorch.mixture.density import InvalidParameterError, MixtureDensity
from gmmtorch.mixture.em.exact import SOFTMAX_DTYPES, Parameters, check_type, compact, type_shape
from gmmtorch.mixture.em.initialization import INITIALIZATIONS
from gmmtorch.mixture.em.loop import EMResult, OnIteration, State
from gmmtorch.mixture.validation import (
    Array,
    check_weight_scale,
    checked_parameter,
    checked_weight,
    warn_if_coarse,
)
from gmmtorch.pose import Pose


class Report:
    """Receives the bounds of one start, prints every `interval`-th iteration, and passes all bounds on.

    verbose: 0 prints nothing, 1 the iterations, 2 also the seconds and the change of the bound.
    """

    def __init__(self, start: int, verbose: int, interval: int, on_iteration: OnIteration | None) -> None:
        self._verbose, self._interval, self._pass_on = verbose, interval, on_iteration
        self._bound = -math.inf
        self._begin = self._last = time.monotonic()
        if verbose:
            print(f"Initialization {start}")

    def __call__(self, iteration: int, bound: float) -> None:
        change, self._bound = bound - self._bound, bound
        if self._verbose and iteration % self._interval == 0:
            now = time.monotonic()
            seconds, self._last = now - self._last, now
            details = f"\t time lapse {seconds:.5f}s\t ll change {change:.5f}" if self._verbose > 1 else ""
            print(f"  Iteration {iteration}{details}")
        if self._pass_on is not None:
            self._pass_on(iteration, bound)

    def end(self, found: EMResult[Any]) -> None:
        """Prints whether the start converged."""
        if self._verbose:
            seconds = time.monotonic() - self._begin
            details = f" time lapse {seconds:.5f}s\t lower bound {found.lower_bound:.5f}."
            state = "converged" if found.converged else "did not converge"
            print(f"Initialization {state}.{details if self._verbose > 1 else ''}")


_FILE_KIND, _FILE_VERSION = "gmmtorch.mixture", 1
_EXTRA = "extra."  # prefix of the names of extra tensors in a file
_FITTED = (
    *("_tensors", "n_features_in_", "feature_names_in_"),
    *("lower_bounds_", "lower_bound_", "n_iter_", "converged_"),
)
_EXTRA_DTYPES = (torch.float64, torch.int64, torch.bool)

Self = TypeVar("Self", bound="MixtureEstimator")

AT_LEAST_ZERO = Interval(Real, 0, None, closed="left")
ABOVE_ZERO = Interval(Real, 0, None, closed="neither")
COUNT = Interval(Integral, 1, None, closed="left")
"""Values that parameters may have, for `_parameter_constraints`."""

_COLLAPSED = (
    "Fitting the mixture model failed because some components have ill-defined empirical covariance (for "
    "instance caused by singleton or collapsed samples). Try to decrease the number of components, increase "
    "reg_covar, or scale the input data."
)
_NOT_CONVERGED = (
    "Best performing initialization did not converge. Try different init parameters, or increase max_iter, "
    "tol, or check for degenerate data."
)


class Cloud(NamedTuple):
    """Input of a fit: points (N, D) relative to `center` (D,), and weights (N,) above zero; float64."""

    points: Tensor
    weight: Tensor
    center: Tensor


class MixtureEstimator(MixtureDensity):
    """Abstract Gaussian mixture with scikit-learn's interface that is also a torch module.

    A subclass has its parameters as fields of a dataclass, declares their valid values in
    `_parameter_constraints` (of scikit-learn), and defines one of two methods. `_learn` is enough if `fit`
    needs no further arguments. Otherwise the subclass overrides `fit` itself, as
    `HierarchicalGaussianMixture` does for sensor origins and `DeconvolvedGaussianMixture` for noise: such a
    `fit` begins with `_prepare`, ends with `_warn_unless_converged`, and needs no `_learn`.

    In both, `_best_start` returns the best of several starts, and `_store_fit` stores the result. Further
    results (a posterior, a tree) are passed to `_store_fit` as the tensors that `_extra_names` lists. Files,
    states, copies and motions then include them.

    Parameters are float64, and clouds are centred during the fit, so that points 500 km from the
    origin lose no digits.

    Fitted attributes: those of `MixtureDensity`, and `lower_bound_`, `lower_bounds_`, `n_iter_`,
    `converged_`, `n_features_in_`.
    """

    n_components: Any  # a whole number; None if the fit determines it
    tol: float
    max_iter: int
    n_init: int
    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "n_components": [COUNT],
        "tol": [AT_LEAST_ZERO],
        "reg_covar": [AT_LEAST_ZERO],
        "max_iter": [COUNT],
        "n_init": [COUNT],
        "init_params": [StrOptions(set(INITIALIZATIONS))],
        "random_state": ["random_state", torch.Generator, Interval(Integral, 0, 2**63 - 1, closed="both")],
        "dtype": [StrOptions(set(SOFTMAX_DTYPES))],
    }
    _accepts_any_total_weight: ClassVar[bool] = False  # true if a prior counts in points
    _extra_names: ClassVar[tuple[str, ...]] = ()  # buffers besides weights, means and covariances
    _finds_n_components: ClassVar[bool] = False  # whether n_components is only an upper limit

    def check_parameters(self, n_points: int | None = None) -> None:
        """Raise `InvalidArgumentError` for an invalid parameter, or for more components than points."""
        try:
            BaseEstimator._validate_params(self)
        except ScikitLearnInvalidParameterError as error:
            name = str(error).split("'")[1]
            raise InvalidParameterError(f"{name}={getattr(self, name)!r}: {error}") from None
        self._check_component_count(n_points)

    @classmethod
    @functools.cache
    def _get_param_names(cls) -> list[str]:  # of scikit-learn, which reads the signature each time
        return cast(list[str], super()._get_param_names())

    def _check_component_count(self, n_points: int | None) -> None:
        k = self.n_components
        if k is not None and not self._finds_n_components and n_points is not None and n_points < k:
            raise InvalidArgumentError(
                f"n_components={k} is more than the n_samples={n_points} points of non-zero weight; use "
                "fewer components or more points. Expected n_samples >= n_components but got "
                f"n_components = {k}, n_samples = {n_points}."
            )

    def fit(
        self: Self,
        X: Array,
        y: Any = None,
        sample_weight: Array | None = None,
        on_iteration: OnIteration | None = None,
    ) -> Self:
        """Fit the mixture to points X (N, D).

        Args:
            X: points, finite.
            y: ignored, as in scikit-learn.
            sample_weight: (N,) number of points that each row stands for: not negative, not all zero.
            on_iteration: called with the iteration (from 1) and its lower bound.

        Raises:
            InvalidArgumentError (a ValueError): an invalid argument, weight or point; more components
                than points of non-zero weight.
            NumericalError: a component collapsed, which happens with reg_covar = 0.
        """
        self._learn(self._prepare(X, sample_weight), on_iteration)
        self._warn_unless_converged()
        return self

    def _learn(self, cloud: Cloud, on_iteration: OnIteration | None) -> None:
        """Fit the mixture to a prepared cloud and store the result with `_store_fit`.

        Only `fit` of this class calls it. It is not abstract, because a subclass with a `fit` of its own has
        none.
        """
        raise NotImplementedError(f"{type(self).__name__} must define _learn, or a fit of its own.")

    def fit_predict(self, X: Array, y: Any = None, sample_weight: Array | None = None) -> Array:
        """Fit, then return the most likely component (N,) of each point."""
        return self.fit(X, y, sample_weight).predict(X)

    def _prepare(self, X: Array, sample_weight: Array | None, reset: bool = True) -> Cloud:
        """The checked points of non-zero weight, relative to their weighted mean.

        Without `reset` the points extend an earlier fit: D must match, and there may be fewer points
        than components.
        """
        self.check_parameters()
        points = self._as_points(X, reset=reset).detach()
        warn_if_coarse(X, points)
        weight = checked_weight(sample_weight, points)
        if bool((weight == 0).any()):
            points, weight = points[weight > 0], weight[weight > 0]
        if not self._accepts_any_total_weight:
            check_weight_scale(weight)
        if reset:
            self._check_component_count(points.shape[0])
        points = points.contiguous()  # sums round alike for every order in memory
        center = points.mT @ (weight / weight.sum())
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

    def _continues(self) -> bool:
        """Whether `fit` starts from the last fit."""
        return bool(getattr(self, "warm_start", False)) and hasattr(self, "means")

    def _previous_bound(self) -> float:
        """The last bound of the fit that `fit` continues; −∞ if it starts anew."""
        return self.lower_bound_ if self._continues() else -math.inf

    def _check_continues(self, points: Tensor) -> None:
        """Raise `InvalidArgumentError` unless the last fit has `n_components` and the points' dimension."""
        k = self.means.shape[0] if self.n_components is None else self.n_components
        if self.means.shape != (k, points.shape[1]):
            raise InvalidArgumentError(
                f"warm_start=True and partial_fit continue from means of shape {tuple(self.means.shape)}, "
                f"but n_components={self.n_components} and the points have {points.shape[1]} dimensions; "
                "restore n_components, or start a new fit with warm_start=False."
            )

    def _best_start(
        self, run: Callable[[OnIteration], EMResult[State]], on_iteration: OnIteration | None
    ) -> EMResult[State]:
        """The result with the largest bound of `n_init` starts, or of the one that continues the last fit.

        `run` makes one start and passes the bounds on. Raises `NumericalError` if a component collapses.
        """
        best: EMResult[State] | None = None
        verbose, interval = int(getattr(self, "verbose", 0)), int(getattr(self, "verbose_interval", 10))
        for start in range(1 if self._continues() else self.n_init):
            report = Report(start, verbose, interval, on_iteration)
            try:
                found = run(report)
            except NumericalError as error:
                raise NumericalError(f"{_COLLAPSED} {error}") from error
            report.end(found)
            if best is None or found.lower_bound > best.lower_bound:
                best = found
        assert best is not None
        return best

    def _warn_unless_converged(self) -> None:
        """Warn the caller of `fit` that it stopped at `max_iter`; with tol=0 or max_iter=0 it is meant to."""
        if not self.converged_ and self.tol > 0 and self.max_iter > 0:
            reason = f"{_NOT_CONVERGED} (max_iter={self.max_iter}, tol={self.tol:g})"
            warnings.warn(reason, ConvergenceWarning, stacklevel=3)

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
        """A fitted mixture with given weights (K,), means (K, D) and covariances.

        The covariances are (K, D, D), or have the shape of the covariance type. `lower_bounds` and
        `converged` describe the fit, if known; `options` are those of the constructor. Raises
        `InvalidArgumentError` or `NumericalError` for invalid parameters.
        """
        mean = as_tensor(means, "means", torch.float64)
        if mean.ndim != 2 or 0 in mean.shape:
            raise InvalidArgumentError(f"means has shape {tuple(mean.shape)}; expected (K, D).")
        k, dim = mean.shape
        mixture = cls(**{"n_components": k, **options})
        kind = mixture.covariance_type
        is_full = len(np.shape(covariances)) == 3
        shape = (k, dim, dim) if is_full else type_shape(kind, k, dim)
        weight = checked_parameter(weights, (k,), "weights", mean.device)
        mean = checked_parameter(means, (k, dim), "means", mean.device)
        covariance = checked_parameter(covariances, shape, "covariances", mean.device)
        if bool((weight < 0).any()) or abs(float(weight.sum()) - 1) > 1e-6:
            raise InvalidArgumentError(f"weights={weight.tolist()} must be at least zero and add up to one.")
        if is_full:
            covariance = compact(check_type(check_symmetric(covariance, "covariances"), kind), kind)
        if kind in ("full", "tied"):
            safe_cholesky(check_symmetric(covariance.view(-1, dim, dim), "covariances"))
        elif not bool((covariance > 0).all()):
            raise NumericalError(
                f"covariances has {float(covariance.min()):.3g}; variances must be above zero."
            )
        mixture._tensors, mixture.n_features_in_ = isinstance(means, Tensor), dim
        mixture._set_history(lower_bounds, converged)
        mixture._set_buffers(weight, mean, covariance)
        mixture._set_extra({})
        return mixture

    def _set_history(self, lower_bounds: Sequence[float], converged: bool) -> None:
        self.lower_bounds_ = [float(x) for x in lower_bounds]
        self.lower_bound_ = self.lower_bounds_[-1] if self.lower_bounds_ else -math.inf
        self.n_iter_ = len(self.lower_bounds_)
        self.converged_ = bool(converged)

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

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Load the state of a fitted mixture with any K and D, whether this one is fitted or not."""
        given = [state_dict.get(prefix + name) for name in Parameters._fields]
        if all(isinstance(value, Tensor) for value in given):
            weights, means, covariances = (cast(Tensor, value).double().clone() for value in given)
            if covariances.ndim == 3:
                check_type(covariances, self.covariance_type)
            self._set_buffers(weights, means, covariances)
            state_dict[prefix + "covariances"] = self._typed_covariances()
            self.n_features_in_ = means.shape[1]
            self.__dict__.pop("feature_names_in_", None)
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

    def moved(self: Self, transform: Array) -> Self:
        """A copy moved by a rigid motion (D+1, D+1): means R μ + t, covariances R Σ Rᵀ.

        A rotated diagonal covariance is not diagonal: the copy of a "diag" mixture has
        `covariance_type="full"`.
        """
        means = self._fitted()
        rotation, translation = Pose.checked(transform, means.shape[1], device=means.device).parts
        moved = type(self)(**BaseEstimator.get_params(self, deep=False))
        if self._fitted_type == "diag":
            moved.covariance_type = "full"
        moved.__dict__.update({name: vars(self)[name] for name in _FITTED if name in vars(self)})
        moved._set_buffers(
            self.weights.clone(), means @ rotation.T + translation, rotation @ self.covariances @ rotation.T
        )
        moved._set_extra({k: v.clone() for k, v in self._transformed_extra(rotation, translation).items()})
        return moved

    def save(self, path: str | Path) -> None:
        """Write the fitted mixture to a safetensors file, atomically."""
        self._fitted()
        tensors = {name: getattr(self, name) for name in Parameters._fields}
        tensors |= {_EXTRA + name: value for name, value in self._extra_tensors().items()}
        facts = {
            "lower_bounds": self.lower_bounds_,
            "converged": self.converged_,
            "arrays": not self._tensors,
            "parameters": self._scalar_options(),
        }
        if "feature_names_in_" in vars(self):
            facts["features"] = list(vars(self)["feature_names_in_"])
        write_bytes(path, pack_tensors(tensors, _FILE_KIND, _FILE_VERSION, **facts))

    @classmethod
    def load(cls: type[Self], path: str | Path) -> Self:
        """Read a mixture that `save` wrote. Raises `DataError` if the file is not a valid mixture."""
        tensors, facts = read_tensors(path, _FILE_KIND, _FILE_VERSION)
        means = require(tensors, "means", (None, None), torch.float64, path)
        k, dim = means.shape
        weights = require(tensors, "weights", (k,), torch.float64, path)
        covariances = require(tensors, "covariances", (k, dim, dim), torch.float64, path)
        extra = {}
        for name, tensor in tensors.items():
            if name.startswith(_EXTRA):
                if tensor.dtype not in _EXTRA_DTYPES:
                    raise DataError(f"{path}: {name} is {tensor.dtype}; expected one of {_EXTRA_DTYPES}.")
                shape = (None,) * tensor.ndim
                extra[name.removeprefix(_EXTRA)] = require(tensors, name, shape, tensor.dtype, path)
        known = set(cls._get_param_names())
        try:
            parameters = dict(facts["parameters"])
            stored_n = parameters.get("n_components", 0)
            if stored_n is not None and not (cls._finds_n_components and isinstance(stored_n, int)):
                known.remove("n_components")  # then it is the number of stored components
            mixture = cls.from_parameters(
                weights,
                means,
                covariances,
                lower_bounds=[float(x) for x in facts["lower_bounds"]],
                converged=bool(facts["converged"]),
                **{key: value for key, value in parameters.items() if key in known},
            )
            mixture._set_extra(extra)
            mixture._tensors = not facts["arrays"]
            names = facts.get("features", [])
            if names and [type(name) for name in names] != [str] * dim:
                raise DataError(f"features={names} are not the names of {dim} columns.")
            if names:
                mixture.__dict__["feature_names_in_"] = np.array(names, object)
        except (GmmTorchError, *DAMAGED_CONTENT) as error:
            raise DataError(f"{path} does not hold a mixture: {error}") from error
        return mixture
