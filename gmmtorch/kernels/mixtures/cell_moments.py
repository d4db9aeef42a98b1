"""Points summed into cells: count, mean and second moment of each; the twin is in `mixture.em.cells`.

The fused kernel runs on the CPU and passes over the points once: the cell, its number in a hash table, and
the sums. Points of one cell often follow each other, and then the table is not asked. Cells and their numbers
equal the twin's; sums differ by rounding.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel

KEY_BITS = 20
"""Bits of one cell coordinate in a key."""

_BODY = """
    // One item for all points: cells are numbered in the order of their first points. A free place holds -1.
    int64_t n_found = 0, last = -1, number = 0;
    for (int64_t i = 0; i < n_points; ++i) {
        const double* x = points + i * DIM;
        int64_t key = 0;
        for (int a = 0; a < DIM; ++a)
            key = (key << KEY_BITS) | (int64_t)((x[a] - low[a]) / side * factor);
        if (key != last) {
            uint64_t hash = (uint64_t)key * 0x9E3779B97F4A7C15ull;
            int64_t at = (int64_t)((hash ^ (hash >> 32)) & (uint64_t)(n_places - 1));
            while (places[at] >= 0 && keys[places[at]] != key) at = (at + 1) & (n_places - 1);
            if (places[at] < 0) {
                if (n_found == max_cells) {
                    *n_cells = max_cells + 1;
                    return;
                }
                places[at] = n_found;
                keys[n_found++] = key;
            }
            last = key;
            number = places[at];
        }
        member[i] = number;
        const double p = weight ? weight[i] : 1.0;
        double* sum = sums + number * WIDTH;
        sum[0] += p;
        int f = 1 + DIM;
        for (int a = 0; a < DIM; ++a) {
            sum[1 + a] += p * x[a];
            for (int b = a; b < DIM; ++b, ++f) sum[f] += p * (x[a] * x[b]);
        }
    }
    *n_cells = n_found;
"""
_KERNELS = {
    dim: FusedKernel(
        f"cell_moments_{dim}d",
        "const double* points, const double* weight, int64 n_points, const double* low, double side,"
        " double factor, int64 max_cells, int64 n_places, int64* places, int64* keys, int64* member,"
        " double* sums, int64* n_cells",
        _BODY.replace("WIDTH", str(1 + dim + dim * (dim + 1) // 2))
        .replace("KEY_BITS", str(KEY_BITS))
        .replace("DIM", str(dim)),
        shares=True,
    )
    for dim in (1, 2, 3)
}


def cell_moments(
    points: Tensor, weight: Tensor, low: Tensor, side: float, factor: float, max_cells: int
) -> tuple[Tensor, Tensor] | None:
    """The sums (C, F) of quadratic features over the cells of points (N, D), and the cell (N,) of each point.

    Cells are in the order of their keys. None if there are more than `max_cells`. The cell of a point x is
    ⌊(x − low)/side · factor⌋.

    Args:
        points, weight: (N, D) and (N,), float64, on the CPU. low: (D,).
    """
    n, dim = points.shape
    width = 1 + dim + dim * (dim + 1) // 2
    most = min(n, max_cells)
    n_places = 1 << (2 * most).bit_length()
    places = torch.full((n_places,), -1, dtype=torch.int64)
    keys, member = torch.empty(most, dtype=torch.int64), torch.empty(n, dtype=torch.int64)
    sums, n_cells = points.new_zeros(most, width), torch.zeros(1, dtype=torch.int64)
    given = points.contiguous(), weight.contiguous(), n, low.contiguous(), side, factor, max_cells, n_places
    _KERNELS[dim](1, *given, places, keys, member, sums, n_cells, device=points.device)
    found = int(n_cells)
    if found > max_cells:
        return None
    order = keys[:found].argsort()
    rank = torch.empty_like(order)
    rank[order] = torch.arange(found)
    return sums[order], rank[member]
