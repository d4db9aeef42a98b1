"""Ascent of a smooth function by L-BFGS or conjugate gradients, along geodesics.

For manifolds whose points carry a frame in which parallel transport along a geodesic is the
identity: tangent vectors are plain tensors that may be added up wherever they were found, and all
that a step needs of the manifold is `Point.move` (Nocedal & Wright, 2006, chapters 3, 5 and 7).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Protocol, TypeVar

from torch import Tensor

from gmmtorch.errors import NumericalError

_ARMIJO = 1e-4  # share of the promised rise that a step must deliver
_TRIALS = 30  # lengths tried along one direction


class Point(Protocol):
    """A place on the manifold, the function there, and the way from there."""

    @property
    def value(self) -> float: ...

    @property
    def gradient(self) -> Tensor: ...

    @property
    def inverse_hessian(self) -> Tensor:
        """First guess of it, diagonal and above zero: it times the gradient leads uphill."""

    def bounded(self, direction: Tensor) -> Tensor:
        """A direction no part of which goes further than a step may."""

    def move(self: P, tangent: Tensor) -> P:
        """Where the exponential map takes a tangent vector."""


P = TypeVar("P", bound=Point)


class LimitedMemory:
    """L-BFGS: the inverse Hessian that the last `memory` steps and changes of gradient tell of."""

    slope_left = 0.9  # share of the slope that a step may leave (the curvature condition)

    def __init__(self, memory: int) -> None:
        self._pairs: deque[tuple[Tensor, Tensor, float]] = deque(maxlen=memory)

    def direction(self, point: Point) -> Tensor:
        """Inverse Hessian times gradient, in two loops over the pairs."""
        vector = point.gradient
        shares = []
        for step, fall, product in reversed(self._pairs):
            shares.append(_dot(step, vector) / product)
            vector = vector - shares[-1] * fall
        vector = point.inverse_hessian * vector
        for (step, fall, product), share in zip(self._pairs, reversed(shares), strict=True):
            vector = vector + (share - _dot(fall, vector) / product) * step
        return vector

    def learn(self, before: Point, direction: Tensor, length: float, after: Point) -> None:
        step, fall = length * direction, before.gradient - after.gradient
        product = _dot(step, fall)
        if product > 1e-12 * math.sqrt(_dot(step, step) * _dot(fall, fall)):
            self._pairs.append((step, fall, product))

    def forget(self) -> bool:
        """Go back to the first guess; False where nothing more was known."""
        known = len(self._pairs) > 0
        self._pairs.clear()
        return known


class ConjugateGradients:
    """Preconditioned conjugate gradients after Polak & Ribière, with β no less than 0."""

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

    def learn(self, before: Point, direction: Tensor, length: float, after: Point) -> None:
        self._last = before, direction

    def forget(self) -> bool:
        known, self._last = self._last is not None, None
        return known


SOLVERS: dict[str, Callable[[int], LimitedMemory | ConjugateGradients]] = {
    "lbfgs": LimitedMemory,
    "cg": ConjugateGradients,
}
"""Which way to go, by name; each is made with the number of steps it may remember."""


def ascend(
    point: P,
    solver: LimitedMemory | ConjugateGradients,
    *,
    tol: float,
    max_iter: int,
    on_iteration: Callable[[int, float], None] | None = None,
) -> tuple[P, list[float], bool]:
    """Climb from a point: where that led, the value after each iteration, and whether it converged.

    Converged: an iteration gained less than `tol`, and a step by the first guess of the Hessian
    would gain less, too, to second order; or nothing near is higher, to rounding. No value is
    below the one before.
    """
    values: list[float] = []
    for iteration in range(max_iter):
        found = _climb(point, solver)
        gain = found.value - point.value
        point = found
        values.append(point.value)
        if on_iteration is not None:
            on_iteration(iteration + 1, point.value)
        if gain == 0 or max(gain, _promise(point)) < tol:
            return point, values, True
    return point, values, False


def _climb(point: P, solver: LimitedMemory | ConjugateGradients) -> P:
    """A higher point; the same one if there is none. What does not lead up is forgotten."""
    while True:
        direction = point.bounded(solver.direction(point))
        length, found = search(point, direction, solver.slope_left)
        if length > 0:
            solver.learn(point, direction, length, found)
            return found
        if not solver.forget():
            return point


def search(point: P, direction: Tensor, slope_left: float) -> tuple[float, P]:
    """How far to go along a direction, and the point there; 0 and `point` if it leads nowhere up.

    Steps that rise too little are halved, those that leave the slope too steep doubled, until the
    (weak) Wolfe conditions hold (Nocedal & Wright, 3.6).
    """
    slope = _dot(point.gradient, direction)
    best: tuple[float, P] = (0.0, point)
    if not slope > 1e-16 * abs(point.value):
        return best
    low, high, length = 0.0, math.inf, 1.0
    for _ in range(_TRIALS):
        found = _moved(point, length * direction)
        if found is None or not found.value >= point.value + _ARMIJO * length * slope:
            high = length
        else:
            best, low = (length, found), length
            if _dot(found.gradient, direction) <= slope_left * slope:
                break
        length = (low + high) / 2 if high < math.inf else 2 * low
    return best


def _moved(point: P, tangent: Tensor) -> P | None:
    """Where a tangent vector leads; None if nothing can be computed there."""
    try:
        return point.move(tangent)
    except NumericalError:
        return None


def _promise(point: Point) -> float:
    return 0.5 * _dot(point.gradient, point.inverse_hessian * point.gradient)


def _dot(a: Tensor, b: Tensor) -> float:
    return float((a * b).sum())
