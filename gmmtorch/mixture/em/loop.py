"""The loop of EM, and its exact steps."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

import torch
from torch import Tensor

from gmmtorch.errors import NumericalError
from gmmtorch.kernels import in_spatial_order
from gmmtorch.mixture.em import by_type, exact
from gmmtorch.mixture.em.covariance_types import compact, constrain, expand
from gmmtorch.mixture.em.exact import Parameters

if TYPE_CHECKING:
    from gmmtorch.mixture.em.grouping import Rows

_STEPS_AHEAD = 8  # on a GPU: steps between two waits for their bounds
State = TypeVar("State")  # what an iteration improves: `Parameters`, or a posterior

Step = Callable[[State], tuple[State, float]]
"""One EM step: from a state to an improved one, and a mean lower bound (nats)."""

OnIteration = Callable[[int, float], None]
"""Called with the iteration, from 1, and its lower bound."""


@dataclass(frozen=True)
class EMResult(Generic[State]):
    """The last state, and the lower bound (mean log-likelihood, nats) that each iteration gave."""

    parameters: State
    lower_bounds: list[float]
    converged: bool

    @property
    def n_iter(self) -> int:
        return len(self.lower_bounds)

    @property
    def lower_bound(self) -> float:
        """The last bound; −∞ without an iteration."""
        return self.lower_bounds[-1] if self.lower_bounds else -math.inf


def run_em(
    step: Step[State],
    parameters: State,
    *,
    tol: float = 1e-3,
    max_iter: int = 100,
    on_iteration: OnIteration | None = None,
    lower_bounds: Sequence[float] = (),
    previous_bound: float = -math.inf,
) -> EMResult[State]:
    """EM until the mean log-likelihood changes by less than `tol` nats, or for `max_iter` iterations.

    To continue a run, pass as `lower_bounds` those of the iterations that led to `parameters`. To start a
    new count of iterations from an earlier result, pass its last bound as `previous_bound`.
    """
    bounds = list(lower_bounds)
    while not (converged := has_converged(bounds, tol, previous_bound)) and len(bounds) < max_iter:
        parameters, bound = step(parameters)
        bounds.append(bound)
        if on_iteration is not None:
            on_iteration(len(bounds), bound)
    return EMResult(parameters, bounds, converged)


def has_converged(bounds: Sequence[float], tol: float, previous_bound: float = -math.inf) -> bool:
    """Whether the last iteration changed the bound by less than `tol`."""
    return len(bounds) > 0 and abs(bounds[-1] - [previous_bound, *bounds][-2]) < tol


def em_step(
    rows: Rows, reg_covar: float, softmax_dtype: torch.dtype, covariance_type: str = "full"
) -> Step[Parameters]:
    """EM steps on points, centred, or cells. Covariances have the shape of their type."""
    points = rows.values if rows.are_points else None
    if points is not None and points.shape[1] > 3:
        return _typed_step(points, rows.weight, reg_covar, softmax_dtype, covariance_type)
    natural = natural_step(rows.features(), rows.weight, reg_covar, softmax_dtype, points, covariance_type)
    if covariance_type == "full":
        return natural
    known: list[tuple[Parameters, Parameters]] = []  # the last result, in both shapes

    def step(parameters: Parameters) -> tuple[Parameters, float]:
        if known and known[0][0] is parameters:
            given = known[0][1]
        else:
            given = parameters._replace(
                covariances=expand(parameters.covariances, covariance_type, *parameters.means.shape)
            )
        new, bound = natural(given)
        found = new._replace(covariances=compact(new.covariances, covariance_type))
        known[:] = [(found, new)]
        return found, bound

    return step


def _typed_step(
    points: Tensor, sample_weight: Tensor, reg_covar: float, softmax_dtype: torch.dtype, kind: str
) -> Step[Parameters]:
    """EM steps with the arithmetic of the covariance type; direct ones from the first that loses digits."""
    total = sample_weight.sum()
    direct = [False]

    given = points, sample_weight

    def step(parameters: Parameters) -> tuple[Parameters, Tensor]:
        k, dim = parameters.means.shape
        linear = by_type.has_linear_form(k, dim, kind) and not direct[0]
        factors = by_type.Factors(parameters, kind, check=False)
        found = by_type.em_step(*given, factors, softmax_dtype, reg_covar, parameters, linear)
        return found.parameters, (found.value / total).masked_fill(found.lost, math.nan)

    def checked(parameters: Parameters) -> tuple[Parameters, float]:
        direct[0] = True
        factors = by_type.Factors(parameters, kind)
        found = by_type.exact_step(*given, factors, softmax_dtype, reg_covar, parameters)
        bound = float(found.value / total)
        if not math.isfinite(bound):
            raise NumericalError(
                "The log-likelihood is not finite: columns of X are too large or too different in scale; "
                "scale X, for example with StandardScaler."
            )
        return found.parameters, bound

    return _ahead(step, checked, 1 if points.device.type == "cpu" else _STEPS_AHEAD)


def natural_step(
    features: Tensor,
    sample_weight: Tensor,
    reg_covar: float,
    softmax_dtype: torch.dtype = torch.float32,
    points: Tensor | None = None,
    covariance_type: str = "full",
) -> Step[Parameters]:
    """EM steps on features (N, F), float64, of points or cells.

    If `points` (N, D), the points of the features, are given, a step whose natural parameters would lose
    digits to cancellation uses the direct form instead.
    """
    rows = in_spatial_order(features, sample_weight)
    total = sample_weight.sum()

    def gather(parameters: Parameters) -> tuple[Tensor, Tensor]:
        return exact.expectation(*rows, exact.natural_parameters(parameters), softmax_dtype)

    if points is not None:
        direct = functools.partial(by_type.direct_step, points, sample_weight, reg_covar=reg_covar)
        return guarded_step(gather, direct, reg_covar, float(total), covariance_type)

    def maximized(parameters: Parameters, statistics: Tensor, value: Tensor) -> tuple[Parameters, Tensor]:
        new = of_type(exact.maximization(statistics, reg_covar, parameters), covariance_type)
        return new, value / total

    def step(parameters: Parameters) -> tuple[Parameters, Tensor]:
        return maximized(parameters, *exact.unchecked_expectation(*rows, parameters, softmax_dtype))

    def checked_step(parameters: Parameters) -> tuple[Parameters, float]:
        new, bound = maximized(parameters, *gather(parameters))
        return new, float(bound)

    return _ahead(step, checked_step, 1 if features.device.type == "cpu" else _STEPS_AHEAD)


def _ahead(
    step: Callable[[Parameters], tuple[Parameters, Tensor]], checked: Step[Parameters], n_ahead: int
) -> Step[Parameters]:
    """Steps of which `n_ahead` run before their bounds are read: Python then waits once for all of them.

    A step whose bound is NaN is taken again by `checked`. Steps beyond the last one asked for are lost.
    """
    ready: list[tuple[Parameters, Parameters, float]] = []  # from, to, bound: the next step last

    def take(parameters: Parameters) -> tuple[Parameters, float]:
        if not ready or ready[-1][0] is not parameters:
            states, bounds = [parameters], []
            for _ in range(n_ahead):
                state, unread = step(states[-1])
                states.append(state)
                bounds.append(unread)
            read = torch.stack(bounds).tolist()
            ready[:] = reversed(list(zip(states, states[1:], read, strict=False)))
        _, new, bound = ready.pop()
        if math.isnan(bound):
            ready.clear()
            return checked(parameters)
        return new, bound

    return take


def guarded_step(
    gather: Callable[[Parameters], tuple[Tensor, Tensor]],
    direct: Callable[[Parameters], tuple[Parameters, Tensor]],
    reg_covar: float,
    total: float,
    covariance_type: str = "full",
) -> Step[Parameters]:
    """EM steps with an E-step `gather`: parameters → S (K, F) and Σ_n p_n log p(x_n). `total` is Σ_n p_n.

    If the natural parameters or S lose digits to cancellation, `direct` takes the step.
    """

    def step(parameters: Parameters) -> tuple[Parameters, float]:
        if not exact.is_ill_conditioned(parameters):
            statistics, value = gather(parameters)
            new = of_type(exact.maximization(statistics, reg_covar, parameters), covariance_type)
            if not exact.has_cancelled(statistics, new):
                return new, float(value) / total
        new, value = direct(parameters)
        return of_type(new, covariance_type), float(value) / total

    return step


def of_type(parameters: Parameters, covariance_type: str) -> Parameters:
    """The parameters with the nearest covariances (K, D, D) of the type (see `covariance_types`)."""
    covariances = constrain(parameters.covariances, covariance_type, parameters.weights)
    return parameters._replace(covariances=covariances)
