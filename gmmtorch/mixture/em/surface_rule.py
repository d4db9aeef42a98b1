"""How many components a cloud asks for: as many as it has surfaces, seen with the sensor's noise.

The cloud is cut into pieces (see `partition`) until each is as thin as the noise explains, or its
halves would have too few points. A wall is one piece, however large, a curved surface takes more the
less noise there is to hide its curvature, edges and clutter as many as their points can support.
Nothing is random, and nothing but the noise has a unit: points and noise in millimetres give the same
pieces. Points that lie on no surfaces, or noise in another unit than the points', mean one component
if the noise explains all of them, and else as many as there are points enough for.

Where a piece ends thus depends on what can be measured, which a number K given in advance does not,
nor the kernel width of a mean-shift count; and it costs one pass of cuts, not a fit for every K that
a criterion such as BIC compares. What each of these chooses is measured in BENCHMARKS.md.
"""

from __future__ import annotations

import math

from torch import Tensor

from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.em.initialization import pieces_by
from gmmtorch.mixture.em.partition import FlatnessRule

_FLAT = 2.0
"""Deviations of the noise that the thinnest direction of a flat piece has, at most."""

_APART = 100.0
"""Deviations of the noise (1 m of 1 cm) from which on stray points are pieces, however few they are."""

_MOST_CELLS = 1 << 17  # that are cut in place of more than twice as many points


def least_support(dim: int) -> int:
    """The fewest points of a component: 6 in 2D, 20 in 3D, and twice its parameters beyond."""
    return 6 if dim <= 2 else 2 + dim * (dim + 3)


def surface_rule(noise: float, dim: int, min_points: float | None = None) -> FlatnessRule:
    """When a piece of a cloud (N, dim) is cut that was measured with this noise, in the points' unit.

    `min_points`: the fewest points a piece may have; None: `least_support`.
    """
    least = least_support(dim) if min_points is None else min_points
    return FlatnessRule(
        thickness=_FLAT * noise,
        length=math.inf,
        min_weight=least,
        min_weight_thick=least,
        apart=_APART * noise,
    )


def surface_pieces(
    points: Tensor, weight: Tensor, noise: float, reg_covar: float, features: Tensor | None = None
) -> tuple[Parameters, Tensor]:
    """As many components as the cloud asks for, and the one that each point (N, D) belongs to, (N,).

    Args:
        points: (N, D), centred, float64; or the means of cells, whose mean `features` (N, F) are given.
        weight: (N,) how many points each row stands for; these are what a component needs enough of.
        noise: standard deviation of the sensor, in the points' unit.
        reg_covar: added to each variance, in its square.

    There are at most as many components as `least_support` goes into the weight, strays aside.
    """
    rule = surface_rule(noise, points.shape[1])
    return pieces_by(rule, points, weight, reg_covar, _MOST_CELLS, noise, features)
