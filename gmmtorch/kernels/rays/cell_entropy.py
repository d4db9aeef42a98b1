"""Entropy of cells: what additions of evidence remove from it, and what one beam would remove."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import check_prior
from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel
from gmmtorch.kernels.rays.ray_traversal import grid_arguments, row_major_strides, traverse
from gmmtorch.kernels.rays.ray_walk import PARAMETERS, walk

_CHUNK_VISITS = 1 << 16  # of the twin: fastest when cores share a cache
_RUN = 256  # cells whose sums an item adds up

_ENTROPY = """
    // Entropy in bits of a cell with h hits and m misses, its probability within [clamp, 1 - clamp].
    auto entropy = [&](auto h, auto m, auto prior, auto clamp) {
        typedef decltype(h) real;
        const real total = h + m + 2 * prior;
        real p = total > 0 ? (h + prior) / total : (real)0.5;
        p = GMM_MIN(GMM_MAX(p, clamp), 1 - clamp);
        const real q = 1 - p;
        const real bits = (p > 0 ? p * log(p) : 0) + (q > 0 ? q * log(q) : 0);
        return bits * (real)-1.4426950408889634;
    };
"""


class Removed(NamedTuple):
    """Bits removed from all cells and from the chosen ones; chosen cells without evidence before."""

    bits: float
    chosen_bits: float
    n_new: int


_REMOVED = FusedKernel(
    "entropy_removed",
    "int64 n_cells, int64 run, const float* hits, const float* misses, const float* more_hits,"
    " const float* more_misses, const bool* chosen, double prior, double clamp, double* sums",
    _ENTROPY
    + """
    const int64_t stop = GMM_MIN(n_cells, (item + 1) * run);
    const float lowest = (float)clamp, highest = 1.0f - lowest, each = (float)prior;
    // Most cells are unknown or certain: their entropies need no logarithm.
    const float of_unknown = entropy(0.0f, 0.0f, each, lowest);
    const float of_free = entropy(0.0f, 1e30f, each, lowest);
    const float of_occupied = entropy(1e30f, 0.0f, each, lowest);
    auto bits_of = [&](float h, float m) {
        if (h + m == 0.0f) return of_unknown;
        const float p = (h + each) / (h + m + 2 * each);
        return p <= lowest ? of_free : p >= highest ? of_occupied : entropy(h, m, each, lowest);
    };
    double all = 0.0, some = 0.0, n_new = 0.0;
    for (int64_t c = item * run; c < stop; ++c) {
        const float h = hits[c], m = misses[c];
        const float gone = bits_of(h, m) - bits_of(h + more_hits[c], m + more_misses[c]);
        all += gone;
        if (chosen[c]) {
            some += gone;
            if (h + m == 0.0f) n_new += 1.0;
        }
    }
    sums[3 * item] = all;
    sums[3 * item + 1] = some;
    sums[3 * item + 2] = n_new;
    """,
)


def entropy_removed(
    before: tuple[Tensor, Tensor], added: tuple[Tensor, Tensor], chosen: Tensor, prior: float, clamp: float
) -> Removed:
    """Sums, over cells, of the entropy that an addition of evidence removes.

    Args:
        before, added: hits (C,) and misses (C,), float32. chosen: (C,) bool.
        prior: N_p, rays. clamp: probabilities stay within [clamp, 1 − clamp].

    The fused kernel differs from its twin by at most 10⁻⁶ bits for each cell.
    """
    if is_fused(*before, *added, chosen) and before[0].dtype == torch.float32:
        n = len(chosen)
        sums = torch.empty(-(-n // _RUN), 3, dtype=torch.float64, device=chosen.device)
        values = [value.contiguous() for value in (*before, *added, chosen)]
        _REMOVED(len(sums), n, _RUN, *values, prior, clamp, sums, device=chosen.device)
        bits, chosen_bits, n_new = sums.sum(0).tolist()
        return Removed(bits, chosen_bits, int(n_new))
    (h, m), (more_h, more_m) = before, added

    def entropy(hits: Tensor, misses: Tensor) -> Tensor:
        return bernoulli_entropy(occupancy_probability(hits, misses, prior).clamp(clamp, 1 - clamp))

    gone = entropy(h, m) - entropy(h + more_h, m + more_m)
    return Removed(
        float(gone.sum(dtype=torch.float64)),
        float(gone[chosen].sum(dtype=torch.float64)),
        int((h + m == 0)[chosen].sum()),
    )


_ALONG = FusedKernel(
    "reduction_along_rays",
    PARAMETERS + ", const float* hits, const float* misses, double prior, double observed, double mark,"
    " double* table, double* sums",
    _ENTROPY
    + """
    double sum = 0.0;
    const double of_unknown = entropy(0.0, 0.0, prior, 0.0) - entropy(0.0, 1.0, prior, 0.0);
    """
    + walk(
        """
        double bits = table[voxel];
        if (bits != bits) {
            const double h = hits[voxel], m = misses[voxel];
            bits = of_unknown;
            if (h + m > 0.0) bits = entropy(h, m, prior, 0.0) - entropy(h, m + 1.0, prior, 0.0);
            if (h + m < observed) bits += mark;
            table[voxel] = bits;
        }
        sum += bits;
        """
    )
    + "sums[item] = sum;",
)


def reduction_along_rays(
    starts: Tensor,
    stops: Tensor,
    low: Tensor | None,
    hits: Tensor,
    misses: Tensor,
    *,
    prior: float,
    observed: float,
    mark: float,
    margin: int = 0,
) -> Tensor:
    """Bits (R,) float64 by which one more miss in each cell that a ray leaves would reduce its entropy.

    Args:
        starts, stops, low: see `traverse`; the grid is that of `hits`, and `margin` cells on each side.
        hits, misses: (nx, ny, nz) float32. The margin has no entropy.
        prior: N_p, rays. mark: is added for each cell with fewer than `observed` rays.

    The fused kernel computes only the cells that rays leave. Its sums differ from the twin's by rounding.
    """
    shape = tuple(n + 2 * margin for n in hits.shape)
    if is_fused(starts, stops, low, hits, misses) and hits.dtype == torch.float32:
        table = torch.nn.functional.pad(torch.full_like(hits, math.nan, dtype=torch.float64), (margin,) * 6)
        hits, misses = (torch.nn.functional.pad(counts, (margin,) * 6) for counts in (hits, misses))
        grid = grid_arguments(starts.double(), stops.double(), shape, row_major_strides(shape), low)
        sums = torch.empty(len(starts), dtype=torch.float64, device=starts.device)
        counts = hits.contiguous(), misses.contiguous()
        _ALONG(len(starts), *grid, *counts, prior, observed, mark, table, sums, device=starts.device)
        return sums
    h, m = hits.double(), misses.double()
    bits = cell_entropy(h, m, prior) - cell_entropy(h, m + 1, prior) + mark * (h + m < observed)
    table = torch.nn.functional.pad(bits, (margin,) * 6).view(-1)
    sums = torch.zeros(len(starts), dtype=torch.float64, device=starts.device)
    for visit in traverse(starts, stops, shape, _CHUNK_VISITS, low=low):
        sums.index_add_(0, visit.ray, table.index_select(0, visit.voxel))
    return sums


def cell_entropy(hits: Tensor, misses: Tensor, prior: float) -> Tensor:
    """Entropy in bits of cells with these hits and misses, any shape; 1 without evidence."""
    return bernoulli_entropy(occupancy_probability(hits, misses, prior))


def occupancy_probability(hits: ArrayLike, misses: ArrayLike, prior: float = 1.0) -> Tensor:
    """Occupancy θ = (H + N_p)/(H + M + 2N_p) of hits H and misses M, thesis (3.9); ½ without evidence.

    Raises `InvalidArgumentError` if the prior count N_p is negative or not finite.
    """
    check_prior(prior)
    hits, misses = as_tensor(hits, "hits"), as_tensor(misses, "misses")
    total = hits + misses + 2 * prior
    return torch.where(total > 0, (hits + prior) / total.clamp_min(torch.finfo(total.dtype).tiny), 0.5)


def bernoulli_entropy(probability: Tensor) -> Tensor:
    """−θ log₂ θ − (1 − θ) log₂(1 − θ) in bits: 1 for an unknown cell, 0 for a certain cell."""
    return -(
        torch.xlogy(probability, probability) + torch.xlogy(1 - probability, 1 - probability)
    ) / math.log(2)
