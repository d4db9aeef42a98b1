"""MixtureEstimator: the abstract base of all mixture estimators: parameters, and the steps of a fit."""

from __future__ import annotations

import math
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral, Real
from typing import Any, ClassVar, NamedTuple, TypeVar

import torch
from sklearn.base import BaseEstimator
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils._param_validation import Interval, StrOptions
from sklearn.utils._param_validation import InvalidParameterError as ScikitLearnInvalidParameterError
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, NumericalError
from gmmtorch.mixture.density import InvalidParameterError
from gmmtorch.mixture.em.exact import SOFTMAX_DTYPES, Parameters
from gmmtorch.mixture.em.initialization import INITIALIZATIONS
from gmmtorch.mixture.em.loop import EMResult, OnIteration, State
from gmmtorch.mixture.mixture_state import MixtureState
from gmmtorch.mixture.validation import (
    Array,
    check_component_count,
    check_weight_scale,
    checked_weight,
    warn_if_coarse,
)


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
        if not self._verbose:
            return
        seconds = time.monotonic() - self._begin
        details = (
            f" time lapse {seconds:.5f}s\t lower bound {found.lower_bound:.5f}." if self._verbose > 1 else ""
        )
        print(f"Initialization {'converged' if found.converged else 'did not converge'}.{details}")


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


class MixtureEstimator(MixtureState, ABC):
    """Abstract Gaussian mixture with scikit-learn's interface that is also a torch module.

    A subclass sets its parameters in `__init__`, declares their valid values in `_parameter_constraints`
    (of scikit-learn), and learns in `fit`: `_prepare` returns the checked, centred cloud, `_best_start` the
    best of several starts, and `_store_fit` stores the result. Further results (a posterior, a tree) are
    passed to `_store_fit` as the tensors that `_extra_names` lists. Files, states, copies and motions then
    include them.

    Parameters are float64, and clouds are centred during the fit, so that points 500 km from the
    origin lose no digits.

    Fitted attributes: those of `MixtureDensity`, and `lower_bound_`, `lower_bounds_`, `n_iter_`,
    `converged_`, `n_features_in_`.
    """

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

    def check_parameters(self, n_points: int | None = None) -> None:
        """Raise `InvalidArgumentError` for an invalid parameter, or for more components than points."""
        try:
            BaseEstimator._validate_params(self)
        except ScikitLearnInvalidParameterError as error:
            name = str(error).split("'")[1]
            raise InvalidParameterError(f"{name}={getattr(self, name)!r}: {error}") from None
        self._check_component_count(n_points)

    def _check_component_count(self, n_points: int | None) -> None:
        if self.n_components is not None and not self._finds_n_components:
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
        if bool((weight == 0).any()):
            points, weight = points[weight > 0], weight[weight > 0]
        if not self._accepts_any_total_weight:
            check_weight_scale(weight)
        if reset:
            self._check_component_count(points.shape[0])
        center = points.mT @ (weight / weight.sum())
        return Cloud((points - center).contiguous(), weight, center)

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
        self, run: Callable[[OnIteration | None], EMResult[State]], on_iteration: OnIteration | None
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
        """Warn the caller of `fit` that it stopped at `max_iter`.

        With tol=0 or max_iter=0 that is intended, so no warning.
        """
        if not self.converged_ and self.tol > 0 and self.max_iter > 0:
            warnings.warn(
                f"{_NOT_CONVERGED} (max_iter={self.max_iter}, tol={self.tol:g})",
                ConvergenceWarning,
                stacklevel=3,
            )
