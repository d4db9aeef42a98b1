"""Flux of the rays of cones through the faces of a grid, and mass of Gaussians in its cells.

The twins are the loop of `flux_evidence`, and `box_mass` on all pairs of a cell and a component. The fused
kernels work on rows, rectangles of faces in one plane of the grid with one cone, and on boxes of cells around
a component. They drop panels outside the cone, cut panels on which the integrand varies much, and integrate
the others by Gauss-Legendre rules, by the rules of `occupancy.forms.quadrature`. Panels that
share a vector share the order of the rule, the highest that one of them needs. So results differ from the
twin within the tolerance.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel

_FLUX = FusedKernel("evidence/grid_flux.h", "face_flux", shares=True)
_MASS = FusedKernel("evidence/grid_flux.h", "cell_mass", shares=True)


def add_row_flux(
    misses: Tensor,
    cones: Tensor,
    counts: Tensor,
    rows: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    axis: int,
    grid: tuple[tuple[float, ...], float, tuple[int, ...]],
    cutoff: float,
    limits: tuple[float, ...],
    target: Tensor | None = None,
) -> None:
    """Add the flux through rows of faces perpendicular to `axis` to the cells that the rays leave.

    Args:
        misses: (cells,) float64, row-major; or (M,), of any cells, if `target` is given.
        cones: (C, 16) float64: whitening W (3 × 3), sensor origin, W(μ − s), and 1/√det 2πΣ; zeros for the
            third coordinate in the plane. See `whitened_rows`.
        counts: (C,) float64.
        rows: cone, plane, forward (R,) and first, number (R, D − 1) of `FaceRows` (`occupancy.cones`).
        grid: its origin (m), the side of its cells (m), and their number along each axis.
        limits: largest variation of a panel for Gauss-Legendre rules of 1, 2, 3 and 4 nodes.
        target: (R,) where in `misses` the flux of each row is added.
    """
    cone, plane, forward, first, number = rows
    origin, side, shape = grid
    dim = len(shape)
    if dim == 2:
        first = torch.cat([first, torch.zeros_like(first)], 1)
        number = torch.cat([number, torch.ones_like(number)], 1)
    axes = [axis, *(a for a in range(dim) if a != axis)]
    strides = [math.prod(shape[a + 1 :]) if target is None else 0 for a in axes]
    pad = [0] * (3 - dim)
    place = dim, *axes, *(-1 for _ in pad), *(origin[a] for a in axes), *pad, side, side ** (dim - 1)
    given = cones, counts, cone, plane, forward, first, number, target
    _FLUX(len(cone), *given, *place, *strides, *pad, cutoff, *limits, misses)


def add_cell_mass(
    hits: Tensor,
    cones: Tensor,
    counts: Tensor,
    boxes: tuple[Tensor, Tensor, Tensor],
    grid: tuple[tuple[float, ...], float, tuple[int, ...]],
    cutoff: float,
    limits: tuple[float, ...],
    target: Tensor | None = None,
) -> None:
    """Add the mass of components in boxes of cells, times their counts, to the hits of the cells.

    Args:
        hits: (cells,) float64, row-major; or (M,), of any cells, if `target` is given.
        cones, counts: as in `add_row_flux`.
        boxes: cone (R,), lowest cell and number of cells (R, D), see `occupancy.cones.ball_rows`.
        grid, limits, target: as in `add_row_flux`.
    """
    origin, side, shape = grid
    dim = len(shape)
    pad = [0] * (3 - dim)
    strides = [math.prod(shape[a + 1 :]) if target is None else 0 for a in range(dim)]
    place = dim, *origin, *pad, side, *strides, *pad
    _MASS(len(boxes[0]), cones, counts, *boxes, target, *place, cutoff, *limits, hits)


def whitened_rows(matrix: Tensor, origin: Tensor, toward: Tensor, log_norm: Tensor) -> Tensor:
    """The rows `cones` of `add_row_flux`: matrix (D, D, C), origin and toward (D, C), log_norm (C,)."""
    dim, n = origin.shape
    rows = origin.new_zeros(n, 16)
    rows[:, :9].unflatten(1, (3, 3))[:, :dim, :dim] = matrix.permute(2, 0, 1)
    rows[:, 9 : 9 + dim] = origin.T
    rows[:, 12 : 12 + dim] = toward.T
    rows[:, 15] = torch.exp(-log_norm)
    return rows
