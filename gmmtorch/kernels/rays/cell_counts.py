"""Counts of cells: those of a dense block as a list, and the addition of a list to a sparse store."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel

_RUN = 256  # cells of an item on a CPU

_BLOCK_BITS = 3
"""Cells are listed by blocks of 8³ cells, as sparse stores keep them: neighbours stay together in memory."""

_LIST = FusedKernel(
    "list_counted_cells",
    "int64 nx, int64 ny, int64 nz, int64 blocks_y, int64 blocks_z, const double* hits, const double* misses,"
    " const int64* low, int64* n_before, int64* cells, float* listed_hits, float* listed_misses",
    f"""
    constexpr int64_t BITS = {_BLOCK_BITS};
    const int64_t block[3] = {{item / (blocks_y * blocks_z), item / blocks_z % blocks_y, item % blocks_z}};
    const int64_t size[3] = {{nx, ny, nz}};
    int64_t first[3], stop[3], n = cells ? n_before[item] : 0;
    for (int a = 0; a < 3; ++a) {{
        const int64_t begin = (((low[a] >> BITS) + block[a]) << BITS) - low[a];
        first[a] = GMM_MAX(begin, 0);
        stop[a] = GMM_MIN(begin + (1 << BITS), size[a]);
    }}
    for (int64_t x = first[0]; x < stop[0]; ++x)
        for (int64_t y = first[1]; y < stop[1]; ++y) {{
            const double *h = hits + (x * ny + y) * nz, *m = misses + (x * ny + y) * nz;
            for (int64_t z = first[2]; z < stop[2]; ++z) {{
                if (!(h[z] > 0.0 || m[z] > 0.0)) continue;
                if (cells) {{
                    cells[3 * n] = x + low[0];
                    cells[3 * n + 1] = y + low[1];
                    cells[3 * n + 2] = z + low[2];
                    listed_hits[n] = (float)h[z];
                    listed_misses[n] = (float)m[z];
                }}
                ++n;
            }}
        }}
    if (!cells) n_before[item] = n;
    """,
)


def list_counted_cells(low: Tensor, hits: Tensor, misses: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The C cells with hits or misses of a dense array (nx, ny, nz), by blocks; row-major in each.

    Args:
        low: (3,) int64, the lowest cell. hits, misses: float64.

    Returns cells (C, 3) int64, hits (C,) and misses (C,), float32.
    """
    device = hits.device
    n_blocks = [(n - 1 >> _BLOCK_BITS) + 2 for n in hits.shape]  # one more, because `low` may cut a block
    if not (is_fused(low, hits, misses) and hits.dtype == misses.dtype == torch.float64):
        cells = ((hits > 0) | (misses > 0)).nonzero()
        x, y, z = ((cells + low >> _BLOCK_BITS) - (low >> _BLOCK_BITS)).unbind(1)
        cells = cells[((x * n_blocks[1] + y) * n_blocks[2] + z).argsort(stable=True)]
        some = [counts[cells.unbind(1)].float() for counts in (hits, misses)]
        return cells + low, some[0], some[1]
    given = *hits.shape, *n_blocks[1:], hits.contiguous(), misses.contiguous(), low.contiguous()
    n_items = math.prod(n_blocks)
    in_block = torch.empty(n_items, dtype=torch.int64, device=device)
    _LIST(n_items, *given, in_block, None, None, None, device=device)
    until = torch.cumsum(in_block, 0)
    n = int(until[-1])
    cells = torch.empty(n, 3, dtype=torch.int64, device=device)
    listed = torch.empty(2, n, device=device)
    _LIST(n_items, *given, until - in_block, cells, listed[0], listed[1], device=device)
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
