"""E-step of truncated EM, and the choice of its candidates; the twins are in `mixture.em.grouping`.

Both fused kernels run on the CPU and work on groups of rows. The first one makes the natural parameters of a
group's candidates about its center, walks the group's rows once, and moves the sums to the components' means:
nothing is stored for a pair of a row and a candidate. It computes in float64 from rows of either type. With
float64 rows, statistics differ from the twin's by at most 10⁻¹² of their largest entry.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import CPU_LANES, FusedKernel

DIMENSIONS = (1, 2, 3)


class GroupedRows(NamedTuple):
    """features (S, F) about the group's center, weight (S,): of S slots, float32 or float64. begin (G + 1,):
    first slot of each group, multiples of eight. centers: (G, D).
    """

    features: Tensor
    weight: Tensor
    begin: Tensor
    centers: Tensor


def _kernels(name: str) -> dict[tuple[int, torch.dtype], FusedKernel]:
    kinds = {torch.float32: "float", torch.float64: "double"}
    calls = {(dim, dtype): f"{name}<{dim}, {kind}>" for dim in DIMENSIONS for dtype, kind in kinds.items()}
    return {key: FusedKernel("mixtures/truncated_e_step.h", call) for key, call in calls.items()}


_EXPECTATIONS, _CHOICES = _kernels("truncated"), _kernels("candidates")


def is_truncated_e_step_fused(rows: GroupedRows, *others: Tensor) -> bool:
    """Whether the fused kernels compute with these groups."""
    fits = rows.features.device.type == "cpu" and rows.centers.shape[1] in DIMENSIONS
    return fits and is_fused(*rows, *others)


def fused_expectation(
    rows: GroupedRows, candidates: Tensor, own: Tensor, means: Tensor, want_likeliest: bool
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Statistics (K, F) about the components' means, Σ p log Σ exp (a scalar), and the most likely candidate
    (S,) of each slot, if requested.

    Args:
        candidates: (G, m). own: (K, F), natural parameters of the components about their own means.
        means: (K, D).
    """
    n_groups, m = candidates.shape
    k, width = own.shape
    n_parts, padded = _n_parts(n_groups), m + -m % 4
    scratch = own.new_empty(n_parts, padded * (width + 2), CPU_LANES)
    natural = own.new_empty(n_parts, padded, width)
    statistics, value = own.new_zeros(n_parts, k, width), own.new_empty(n_parts)
    likeliest = torch.empty(len(rows.weight), dtype=torch.int64) if want_likeliest else None
    sizes = n_groups, k, m, padded, n_parts
    given = candidates.contiguous(), own.contiguous(), means.contiguous()
    kernel = _EXPECTATIONS[rows.centers.shape[1], rows.features.dtype]
    kernel(n_parts, *rows, *sizes, *given, scratch, natural, statistics, value, likeliest, device=own.device)
    return statistics.sum(0), value.sum(), likeliest


def fused_candidates(
    rows: GroupedRows, slots: Tensor, natural: Tensor, bounds: Tensor, n_candidates: int
) -> Tensor:
    """The most likely `n_candidates` components (G, m) for the sampled slots (G, n) of each of the G groups.

    Component g is a candidate of group g. The order is arbitrary.

    Args:
        natural: (G, F), of the components. bounds (D + 2, G): their means; the logarithm of weight times
            density at the mean; and √(1/2v), v at least the largest variance.
    """
    k, width = natural.shape
    n_parts, padded = _n_parts(k), k + -k % CPU_LANES
    table = natural.new_zeros(padded, width)
    table[:k], table[k:, 0] = natural, -1e300
    padded_bounds = natural.new_zeros(bounds.shape[0], padded)
    padded_bounds[:, :k], padded_bounds[-2, k:] = bounds, -1e300
    scratch = natural.new_empty(n_parts, 3, padded, CPU_LANES)
    scores = natural.new_empty(n_parts, n_candidates)
    candidates = torch.empty(k, n_candidates, dtype=torch.int64)
    sizes = k, k, n_candidates, padded, n_parts
    kernel = _CHOICES[rows.centers.shape[1], rows.features.dtype]
    given = slots.contiguous(), slots.shape[1], table, padded_bounds
    kernel(n_parts, *rows, *sizes, *given, scratch, scores, candidates, device=natural.device)
    return candidates


def _n_parts(n_groups: int) -> int:
    return max(1, min(torch.get_num_threads(), n_groups))
