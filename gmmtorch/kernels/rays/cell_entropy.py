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
from gmmtorch.kernels.rays.ray_traversal import rays_argument, row_major_strides, traverse

_CHUNK_VISITS = 1 << 16  # of the twin: fastest when cores share a cache
_RUN = 256  # cells whose sums an item adds up


class Removed(NamedTuple):
    """Bits removed from all cells and from the chosen ones; chosen cells without evidence before."""

    bits: float
    chosen_bits: float
    n_new: int


_REMOVED = FusedKernel("rays/cell_entropy.h", "entropy_removed")
_ALONG = FusedKernel("rays/cell_entropy.h", "reduction_along_rays")


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
        rays = rays_argument(starts.double(), stops.double(), shape, row_major_strides(shape), low)
        sums = torch.empty(len(starts), dtype=torch.float64, device=starts.device)
        counts = hits.contiguous(), misses.contiguous()
        _ALONG(len(starts), *rays, *counts, prior, observed, mark, table, sums, device=starts.device)
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
