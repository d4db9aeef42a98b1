"""Components rounded to the codec's lattice and restored; the twins are in `mapping.codec.lattice`.

A fused kernel computes one component in one item, with the operations of the twin in the same order, each
of them rounded: its results equal the twin's to the bit. Replicas compare bits.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import templated

_ROUNDINGS = templated("mixtures/lattice.h", "lattice_rounding", (2, 3), rounds_each=True)
_RESTORINGS = templated("mixtures/lattice.h", "lattice_restoring", (2, 3), rounds_each=True)


class LatticeConstants(NamedTuple):
    """The lattice, by the names of `mapping.codec.lattice`.

    orders (O, D): axis orders. roots: 2^(i / per_octave). bounds: mantissas in [½, 1) at which the steps of a
    deviation change, in rising order.
    """

    orders: Tensor
    roots: Tensor
    bounds: Tensor
    per_octave: int
    precision: int
    least_deviation: int
    largest_deviation: int
    largest_ratio: int
    steepest: float
    farthest: float
    largest_variance: float


def lattice_rounding(
    means: Tensor, covariances: Tensor, constants: LatticeConstants
) -> tuple[Tensor, Tensor, Tensor, Tensor] | None:
    """Axis order (K,), deviation (K, D), shear (K, D(D−1)/2) and mean (K, D) of the nearest lattice points.

    Returns None if a component is, or would be, out of bounds.

    Args:
        means (K, D), covariances (K, D, D): float64.
    """
    n, dim = means.shape
    axis_order = torch.empty(n, dtype=torch.int64, device=means.device)
    deviation, steps = axis_order.new_empty(n, dim), axis_order.new_empty(n, dim)
    shear = axis_order.new_empty(n, dim * (dim - 1) // 2)
    beyond = torch.zeros(1, dtype=torch.bool, device=means.device)
    made = axis_order, deviation, shear, steps
    _ROUNDINGS[dim](n, len(constants.orders), *constants, means, covariances, *made, beyond)
    return None if bool(beyond) else made


def lattice_restoring(
    axis_order: Tensor, deviation: Tensor, shear: Tensor, mean: Tensor, constants: LatticeConstants
) -> tuple[Tensor, Tensor]:
    """Means (K, D) and covariances (K, D, D), float64,, of lattice points."""
    n, dim = mean.shape
    means = torch.empty(n, dim, dtype=torch.float64, device=mean.device)
    covariances = means.new_empty(n, dim, dim)
    places = axis_order, deviation, shear, mean
    _RESTORINGS[dim](n, len(constants.orders), *constants, *places, means, covariances)
    return means, covariances
