"""The loop of EM, its exact steps, and steps that take a batch of points each."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, NumericalError, check_number
from gmmtorch.kernels import (
    fused_em,
    fused_exact_em,
    in_spatial_order,
    is_em_fused,
    is_small,
    takes_one_launch,
)
from gmmtorch.mixture.em import by_type
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.reduction import merge_pairs

if TYPE_CHECKING:
    from gmmtorch.mixture.em.truncated import Rows

_STEPS_AHEAD = 8  # on a GPU: steps between two waits for their bounds
State = TypeVar("State")  # what an iteration improves: `Parameters`, or a posterior

Step = Callable[[State], tuple[State, float]]
"""One EM step: from a state to an improved one, and a mean lower bound (nats)."""

Run = Callable[[State, float, int, float], tuple[State, list[float]]]
"""Several steps at once: from a state, a tolerance, the largest number of steps (1 or more) and the bound
before them, to the last state and the bounds. No step follows one that changes the bound by less than the
tolerance.
"""

OnIteration = Callable[[int, float], None]
"""Called with the iteration, from 1, and its lower bound; later, if several steps are taken at once."""


@dataclass(frozen=True)
class Steps(Generic[State]):
    """An EM step, of which `run` takes several before Python reads their bounds."""

    run: Run[State]

    def __call__(self, state: State) -> tuple[State, float]:
        state, (bound,) = self.run(state, 0.0, 1, -math.inf)
        return state, bound


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
        if isinstance(step, Steps):
            last = bounds[-1] if bounds else previous_bound
            parameters, found = step.run(parameters, tol, max_iter - len(bounds), last)
        else:
            parameters, *found = step(parameters)
        for bound in found:
            bounds.append(bound)
            if on_iteration is not None:
                on_iteration(len(bounds), bound)
    return EMResult(parameters, bounds, converged)


def has_converged(bounds: Sequence[float], tol: float, previous_bound: float = -math.inf) -> bool:
    """Whether the last iteration changed the bound by less than `tol`."""
    return len(bounds) > 0 and abs(bounds[-1] - [previous_bound, *bounds][-2]) < tol


def em_step(
    rows: Rows, reg_covar: float, softmax_dtype: torch.dtype = torch.float32, covariance_type: str = "full"
) -> Steps[Parameters]:
    """EM steps on points, centred, or cells. Covariances have the shape of their type.

    A step on points whose linear form loses digits takes the direct one; in many dimensions, so do all later
    steps. In few dimensions and on small tables, a fused kernel takes many steps in one launch where that is
    faster.
    """
    points, weight, kind = rows.points, rows.weight, covariance_type
    total, direct = weight.sum(), [False]
    few = (
        by_type.rows_of_few_dimensions(points, weight)
        if rows.are_points
        else in_spatial_order(rows.values, weight)
    )

    def gather(factors: by_type.Factors) -> by_type.Gather:
        return functools.partial(by_type.expected_moments, points, weight, factors, softmax_dtype, rows=few)

    def step(parameters: Parameters) -> tuple[Parameters, Tensor]:
        k, dim = parameters.means.shape
        linear = by_type.has_linear_form(k, dim, kind) and not direct[0]
        factors = by_type.Factors(parameters, kind, check=False)
        found = by_type.em_step(gather(factors), factors, reg_covar, parameters, linear)
        lost = found.lost if rows.are_points else factors.failed
        return found.parameters, (found.value / total).masked_fill(lost, math.nan)

    def checked(parameters: Parameters) -> tuple[Parameters, float]:
        direct[0] = few is None
        factors = by_type.Factors(parameters, kind)
        take = by_type.exact_step if rows.are_points else by_type.em_step
        found = take(gather(factors), factors, reg_covar, parameters, linear=not rows.are_points)
        bound = float(found.value / total)
        if not math.isfinite(bound):
            raise NumericalError(
                "The log-likelihood is not finite: columns of X are too large or too different in scale; "
                "scale X, for example with StandardScaler."
            )
        return found.parameters, bound

    steps = _ahead(step, checked, 1 if points.device.type == "cpu" else _STEPS_AHEAD)

    def run(parameters: Parameters, tol: float, n_most: int, last: float) -> tuple[Parameters, list[float]]:
        k = len(parameters.weights)
        fits = few is not None and kind == "full" and takes_one_launch(len(weight), k)
        if rows.are_points and is_small(points, weight, k, kind):
            start = Parameters(*(part[None].clone() for part in parameters))
            found = fused_em(points, weight, start, kind, reg_covar, tol, n_most, last)
            mixture = found.weights[0], found.means[0], found.covariances[0]
            (bounds,), (failed,) = found.bounds, found.failed
        elif few is None or not fits or not is_em_fused(*few, *parameters):
            return steps.run(parameters, tol, n_most, last)
        else:
            mixture, bounds, failed = fused_exact_em(
                *few, parameters, reg_covar, tol, n_most, last, guarded=rows.are_points
            )
        if not failed:
            return Parameters(*mixture), bounds
        new, bound = checked(Parameters(*mixture))
        return new, [*bounds, bound]

    return Steps(run)


def _ahead(
    step: Callable[[Parameters], tuple[Parameters, Tensor]], checked: Step[Parameters], n_ahead: int
) -> Steps[Parameters]:
    """Up to `n_ahead` steps before their bounds are read: Python then waits once for all of them.

    A step whose bound is NaN is taken again by `checked`. Steps beyond the last one asked for are lost.
    """

    def run(parameters: Parameters, tol: float, n_most: int, last: float) -> tuple[Parameters, list[float]]:
        states, unread = [parameters], []
        for _ in range(min(n_ahead, n_most)):
            state, not_read = step(states[-1])
            states.append(state)
            unread.append(not_read)
        bounds = torch.stack(unread).tolist()
        for number, bound in enumerate(bounds):
            if math.isnan(bound):
                new, bound = checked(states[number])
                return new, [*bounds[:number], bound]
            if abs(bound - last) < tol:
                return states[number + 1], bounds[: number + 1]
            last = bound
        return states[-1], bounds

    return Steps(run)


def blend(previous: Parameters, update: Parameters, step: float, kind: str = "full") -> Parameters:
    """The M-step on (1 − η) S + η s, η = `step`, where `previous` and `update` are the parameters of S and s.

    S are the running statistics, and s those of the batch, a point (Cappé & Moulines, 2009; Liang & Klein,
    2009). Weights, means and covariances are equivalent to S, so no statistics are stored: each update
    merges, component by component, the mixture with the result of one EM step on the batch. Nothing
    cancels at any distance from the origin, and covariances stay positive definite.

    `update` is an EM step from `previous`, in the same frame. The regularisation variance, which is part
    of both, is in the result once. Covariances have the shape of their type, `kind`.
    """
    first = previous._replace(weights=(1 - step) * previous.weights)
    second = update._replace(weights=step * update.weights)
    if kind == "full":
        return merge_pairs(first, second)
    weights = first.weights + second.weights
    share = torch.where(weights > 0, second.weights / weights, 0.5)[:, None]
    offset = second.means - first.means
    means = first.means + share * offset
    if kind == "tied":
        between = (weights[:, None] * share * (1 - share) * offset).T @ offset
        within = first.weights.sum() * first.covariances + second.weights.sum() * second.covariances
        return Parameters(weights, means, (within + between) / weights.sum())
    square = offset.square()
    if kind == "spherical":
        share, square = share[:, 0], square.mean(1)
    covariances = (1 - share) * first.covariances + share * second.covariances + (1 - share) * share * square
    return Parameters(weights, means, covariances)


def weight_of_past(seen: float | None, memory: float | None) -> float:
    """Number of points that the current mixture counts as: `seen` (None: unknown), at most `memory`.

    Raises `InvalidArgumentError` for an invalid memory, or memory=None if `seen` is unknown.
    """
    if memory is None:
        if seen is None:
            raise InvalidArgumentError(
                "memory=None, but the number of points that this mixture stands for is unknown; pass memory, "
                "the number of points that it counts as."
            )
        return seen
    check_number("memory", memory)
    return float(memory) if seen is None else min(seen, float(memory))
