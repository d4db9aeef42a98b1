"""Components rounded to the codec's lattice and restored; the twins are in `mapping.codec.lattice`.

A fused kernel computes one component in one item, with the operations of the twin in the same order, each
of them rounded: its results equal the twin's to the bit. Replicas compare bits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
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
        means (K, D), covariances (K, D, D): float64, on the CPU.
    """
    n, dim = means.shape
    widths = 1, dim, dim * (dim - 1) // 2, dim
    parts = torch.empty(n * sum(widths), dtype=torch.int64).split([n * width for width in widths])
    axis_order, deviation, shear, steps = (part.view(n, w) for part, w in zip(parts, widths, strict=True))
    beyond, made = np.zeros(1, bool), (axis_order.view(n), deviation, shear, steps)
    _ROUNDINGS[dim](n, len(constants.orders), *constants, means, covariances, *made, beyond)
    return None if beyond[0] else made


def lattice_restoring(
    axis_order: Tensor, deviation: Tensor, shear: Tensor, mean: Tensor, constants: LatticeConstants
) -> tuple[Tensor, Tensor]:
    """Means (K, D) and covariances (K, D, D), float64, of lattice points; infinite for axis orders that do
    not exist."""
    n, dim = mean.shape
    means = torch.empty(n, dim, dtype=torch.float64, device=mean.device)
    covariances = means.new_empty(n, dim, dim)
    places = axis_order, deviation, shear, mean
    _RESTORINGS[dim](n, len(constants.orders), *constants, *places, means, covariances)
    return means, covariances
