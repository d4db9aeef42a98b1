"""Stepwise EM: a mixture that learns from one batch of points after another.

Running statistics S ← (1 − η) S + η s, s those of the batch a point, and parameters from S by the
M-step (Cappé & Moulines, 2009; Liang & Klein, 2009). Weights, means and covariances say what S
does, so a mixture needs no statistics beside it: it is merged, component by component, with what
one EM step makes of the batch. Nothing cancels, wherever the points are, and covariances stay
definite.
"""

from __future__ import annotations

import math
import numbers

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.reduction.moments import merge_pairs


def step_size(batch: float, seen: float, kappa: float) -> float:
    """η = (n / (m + n))^κ, of a batch of weight n after points of weight m.

    For batches of one size it is (t + 1)^−κ, t = 0, 1, …: Liang & Klein's (t + 2)^−κ after a first
    batch that is taken whole. With κ = 1 every point counts the same, whatever the batches.
    """
    return float((batch / (seen + batch)) ** kappa)


def blend(previous: Parameters, update: Parameters, step: float) -> Parameters:
    """The M-step on (1 − η) S + η s, η = `step`, of the parameters that S and s have, in one frame.

    `update` is an EM step from `previous`. The variance that regularisation added to both is in
    the result once.
    """
    return merge_pairs(
        previous._replace(weights=(1 - step) * previous.weights),
        update._replace(weights=step * update.weights),
    )


def weight_of_past(seen: float | None, memory: float | None) -> float:
    """For how many points what was learned counts: `memory` at most; `seen` is None if not known.

    Raises:
        InvalidArgumentError: a memory that cannot be, or none where nothing else is known.
    """
    if memory is None:
        if seen is None:
            raise InvalidArgumentError(
                "memory=None, but how many points this mixture stands for is not known; give memory, the "
                "number of points it is to count for."
            )
        return seen
    most = check_points("memory", memory)
    return most if seen is None else min(seen, most)


def check_points(name: str, value: object) -> float:
    """`value` as a number of points, whole or not; else `InvalidArgumentError`."""
    if not isinstance(value, numbers.Real) or not 0 <= float(value) < math.inf:
        raise InvalidArgumentError(f"{name}={value!r} must be a finite number of points of at least 0.")
    return float(value)


def check_kappa(kappa: object) -> float:
    """κ of `step_size`, if steps of that size converge: 0.5 < κ ≤ 1; else `InvalidArgumentError`."""
    if not isinstance(kappa, numbers.Real) or not 0.5 < float(kappa) <= 1:
        raise InvalidArgumentError(f"kappa={kappa!r} must be above 0.5 and at most 1.")
    return float(kappa)
