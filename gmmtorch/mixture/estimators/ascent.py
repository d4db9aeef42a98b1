"""Maximisation of a smooth function on a manifold, by L-BFGS or conjugate gradients along geodesics.

The manifold's points must have a frame in which parallel transport along a geodesic is the identity.
Tangent vectors are then plain tensors that may be added wherever they were computed, and a step needs
only `Point.move` (Nocedal & Wright, 2006, chapters 3, 5 and 7). Library optimisers assume a vector
space, so they do not apply.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Protocol, TypeVar

from torch import Tensor

from gmmtorch.errors import NumericalError

_ARMIJO = 1e-4  # share of the predicted gain that a step must reach
_TRIALS = 30  # lengths tried along one direction


class Point(Protocol):
    """A point of the manifold, with the function value and the map along geodesics."""

    @property
    def value(self) -> float: ...

    @property
    def gradient(self) -> Tensor: ...

    @property
    def inverse_hessian(self) -> Tensor:
        """First guess of the inverse Hessian: diagonal and positive, so that it times the gradient is an
        ascent.
        """

    def bounded(self, direction: Tensor) -> Tensor:
        """The direction, shortened where it exceeds the longest allowed step."""

    def move(self: P, tangent: Tensor) -> P:
        """The point that the exponential map gives for a tangent vector."""


P = TypeVar("P", bound=Point)


class LBFGS:
    """L-BFGS: the inverse Hessian implied by the last `memory` steps and gradient changes."""

    slope_left = 0.9  # largest remaining share of the slope (the curvature condition)

    def __init__(self, memory: int) -> None:
        self._pairs: deque[tuple[Tensor, Tensor, float]] = deque(maxlen=memory)

    def direction(self, point: Point) -> Tensor:
        """Inverse Hessian times gradient, by the two-loop recursion."""
        vector = point.gradient
        shares = []
        for step, fall, product in reversed(self._pairs):
            shares.append(_dot(step, vector) / product)
            vector = vector - shares[-1] * fall
        vector = point.inverse_hessian * vector
        for (step, fall, product), share in zip(self._pairs, reversed(shares), strict=True):
            vector = vector + (share - _dot(fall, vector) / product) * step
        return vector

    def update(self, before: Point, direction: Tensor, length: float, after: Point) -> None:
        step, fall = length * direction, before.gradient - after.gradient
        product = _dot(step, fall)
        if product > 1e-12 * math.sqrt(_dot(step, step) * _dot(fall, fall)):
            self._pairs.append((step, fall, product))

    def reset(self) -> bool:
        """Reset to the first guess. False if there was nothing to reset."""
        had_memory = len(self._pairs) > 0
        self._pairs.clear()
        return had_memory


class ConjugateGradients:
    """Preconditioned conjugate gradients by Polak & Ribière, with β ≥ 0."""

    slope_left = 0.1

    def __init__(self, memory: int = 1) -> None:
        self._last: tuple[Point, Tensor] | None = None

    def direction(self, point: Point) -> Tensor:
        uphill = point.inverse_hessian * point.gradient
        if self._last is None:
            return uphill
        before, direction = self._last
        size = _dot(before.gradient, before.inverse_hessian * before.gradient)
        beta = _dot(point.gradient - before.gradient, uphill) / size
        return uphill + max(0.0, beta) * direction

    def update(self, before: Point, direction: Tensor, length: float, after: Point) -> None:
        self._last = before, direction

    def reset(self) -> bool:
        had_memory, self._last = self._last is not None, None
        return had_memory


SOLVERS: dict[str, Callable[[int], LBFGS | ConjugateGradients]] = {
    "lbfgs": LBFGS,
    "cg": ConjugateGradients,
}
"""Solvers by name; the argument is the number of steps to store."""


def ascend(
    point: P,
    solver: LBFGS | ConjugateGradients,
    *,
    tol: float,
    max_iter: int,
    on_iteration: Callable[[int, float], None] | None = None,
) -> tuple[P, list[float], bool]:
    """Climb from a point. Returns the final point, the value after each iteration, and whether it converged.

    Converged: an iteration gained less than `tol`, and a step by the first guess of the Hessian would also
    gain less, to second order; or no higher point was found, to rounding. Values never decrease.
    """
    values: list[float] = []
    for iteration in range(max_iter):
        found = _climb(point, solver)
        gain = found.value - point.value
        point = found
        values.append(point.value)
        if on_iteration is not None:
            on_iteration(iteration + 1, point.value)
        predicted = 0.5 * _dot(point.gradient, point.inverse_hessian * point.gradient)
        if gain == 0 or max(gain, predicted) < tol:
            return point, values, True
    return point, values, False


def _climb(point: P, solver: LBFGS | ConjugateGradients) -> P:
    """A higher point, or the same point if there is none.

    Resets the solver if its direction does not ascend.
    """
    while True:
        direction = point.bounded(solver.direction(point))
        length, found = search(point, direction, solver.slope_left)
        if length > 0:
            solver.update(point, direction, length, found)
            return found
        if not solver.reset():
            return point


def search(point: P, direction: Tensor, slope_left: float) -> tuple[float, P]:
    """Step length along a direction, and the point there; 0 and `point` if the direction does not ascend.

    Steps that gain too little are halved, and steps that leave too steep a slope are doubled, until the
    weak Wolfe conditions hold (Nocedal & Wright, 3.6).
    """
    slope = _dot(point.gradient, direction)
    best: tuple[float, P] = (0.0, point)
    if not slope > 1e-16 * abs(point.value):
        return best
    low, high, length = 0.0, math.inf, 1.0
    for _ in range(_TRIALS):
        try:
            found = point.move(length * direction)
        except NumericalError:  # the point cannot be computed
            found = None
        if found is None or not found.value >= point.value + _ARMIJO * length * slope:
            high = length
        else:
            best, low = (length, found), length
            if _dot(found.gradient, direction) <= slope_left * slope:
                break
        length = (low + high) / 2 if high < math.inf else 2 * low
    return best


def _dot(a: Tensor, b: Tensor) -> float:
    return float((a * b).sum())
