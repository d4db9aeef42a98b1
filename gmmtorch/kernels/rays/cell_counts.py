"""Counts of cells: those of a dense block as a list, and the addition of a list to a sparse store."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel

_RUN = 256  # cells of an item on a CPU

_LIST = FusedKernel(
    "list_counted_cells",
    "int64 ny, int64 nz, const double* hits, const double* misses, const int64* low, int64* n_before,"
    " int64* cells, float* listed_hits, float* listed_misses",
    """
    const double *h = hits + item * nz, *m = misses + item * nz;
    int64_t n = cells ? n_before[item] : 0;
    for (int64_t z = 0; z < nz; ++z) {
        if (!(h[z] > 0.0 || m[z] > 0.0)) continue;
        if (cells) {
            cells[3 * n] = item / ny + low[0];
            cells[3 * n + 1] = item % ny + low[1];
            cells[3 * n + 2] = z + low[2];
            listed_hits[n] = (float)h[z];
            listed_misses[n] = (float)m[z];
        }
        ++n;
    }
    if (!cells) n_before[item] = n;
    """,
)


def list_counted_cells(low: Tensor, hits: Tensor, misses: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The C cells with hits or misses of a dense block (nx, ny, nz), row-major.

    Args:
        low: (3,) int64, the lowest cell. hits, misses: float64.

    Returns cells (C, 3) int64, hits (C,) and misses (C,), float32.
    """
    nx, ny, nz = hits.shape
    device = hits.device
    if not (is_fused(low, hits, misses) and hits.dtype == misses.dtype == torch.float64):
        flat = ((hits > 0) | (misses > 0)).flatten().nonzero().squeeze(1)
        column = flat // nz
        cells = torch.stack([column // ny, column % ny, flat % nz], 1) + low
        some = [counts.flatten().index_select(0, flat).float() for counts in (hits, misses)]
        return cells, some[0], some[1]
    given = ny, nz, hits.contiguous(), misses.contiguous(), low.contiguous()
    in_column = torch.empty(nx * ny, dtype=torch.int64, device=device)
    _LIST(nx * ny, *given, in_column, None, None, None, device=device)
    until = torch.cumsum(in_column, 0)
    n = int(until[-1]) if len(until) else 0
    cells = torch.empty(n, 3, dtype=torch.int64, device=device)
    listed = torch.empty(2, n, device=device)
    _LIST(nx * ny, *given, until - in_column, cells, listed[0], listed[1], device=device)
    return cells, listed[0], listed[1]


_ADD = FusedKernel(
    "add_counts",
    "int64 n_cells, int64 run, const int64* index, const float* more_hits, const float* more_misses,"
    " int64 n_stored, float* counts, float* before",
    """
    const int64_t stop = GMM_MIN(n_cells, (item + 1) * run);
    for (int64_t c = item * run; c < stop; ++c) {
        float *hits = counts + index[c], *misses = hits + n_stored;
        before[c] = *hits;
        before[n_cells + c] = *misses;
        if (index[c] == 0) continue;
        *hits += more_hits[c];
        *misses += more_misses[c];
    }
    """,
)


def add_counts(counts: Tensor, index: Tensor, hits: Tensor, misses: Tensor) -> tuple[Tensor, Tensor]:
    """Adds hits (C,) and misses (C,) to counts (2, …) at distinct places; returns those before, (C,) each.

    Args:
        counts: contiguous, changed in place. index: (C,) int64, flat in counts[0]; nothing is added at 0.

    The fused kernel, for float32, and its twin give equal counts.
    """
    n = len(index)
    if is_fused(counts, index, hits, misses) and counts.dtype == hits.dtype == misses.dtype == torch.float32:
        before = torch.empty(2, n, device=counts.device)
        run = _RUN if counts.device.type == "cpu" else 1
        more = index.contiguous(), hits.contiguous(), misses.contiguous()
        _ADD(-(-n // run), n, run, *more, counts[0].numel(), counts, before, device=counts.device)
        return before[0], before[1]
    inside = index > 0
    olds = [part.view(-1).index_select(0, index) for part in counts]
    for part, old, added in zip(counts, olds, (hits, misses), strict=True):
        part.view(-1).index_copy_(0, index, old + torch.where(inside, added, 0.0).to(old.dtype))
    return olds[0], olds[1]


_FLAGS = FusedKernel(
    "flags_of_cells",
    "int64 n_cells, int64 run, const int64* cells, const int64* low, int64 nx, int64 ny, int64 nz,"
    " const bool* flags, bool* found",
    """
    const int64_t stop = GMM_MIN(n_cells, (item + 1) * run);
    for (int64_t c = item * run; c < stop; ++c) {
        const int64_t x = cells[3 * c] - low[0], y = cells[3 * c + 1] - low[1], z = cells[3 * c + 2] - low[2];
        const bool inside = x >= 0 && x < nx && y >= 0 && y < ny && z >= 0 && z < nz;
        found[c] = inside && flags[(x * ny + y) * nz + z];
    }
    """,
)


def flags_of_cells(cells: Tensor, low: Tensor, flags: Tensor) -> Tensor:
    """The flags (C,) bool of cells (C, 3) int64 in a block (nx, ny, nz), bool; False outside.

    Args:
        low: (3,) int64, the lowest cell of the block.
    """
    nx, ny, nz = flags.shape
    if is_fused(cells, low, flags):
        n, found = len(cells), torch.empty_like(cells[:, 0], dtype=torch.bool)
        run = _RUN if cells.device.type == "cpu" else 1
        given = cells.contiguous(), low.contiguous(), nx, ny, nz, flags.contiguous()
        _FLAGS(-(-n // run), n, run, *given, found, device=cells.device)
        return found
    x, y, z = (cells - low).unbind(1)
    inside = (x >= 0) & (x < nx) & (y >= 0) & (y < ny) & (z >= 0) & (z < nz)
    return inside & flags.reshape(-1)[torch.where(inside, (x * ny + y) * nz + z, 0)]
