"""Cells of dense blocks and of sparse stores: listed with their counts, found, and added to; and their
entropy: what additions of evidence remove from it, and what one beam would remove.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import check_prior
from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel
from gmmtorch.kernels.rays.ray_traversal import rays_argument, row_major_strides, traverse

_RUN = 256  # cells of an item on a CPU, and of one that sums up entropies
_INDEX_RUN = 1 << 10  # of one that searches again only where the block changes

_BLOCK_BITS = 3
"""Cells are listed by blocks of 8³ cells, as sparse stores keep them: neighbours stay together in memory."""

_SOURCE = "rays/cell_counts.h"
_LIST = FusedKernel(_SOURCE, "list_counted_cells")
_ADD = FusedKernel(_SOURCE, "add_counts")
_FLAGS = FusedKernel(_SOURCE, "flags_of_cells")
_INDEX = FusedKernel(_SOURCE, "cell_index")


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
    given = *hits.shape, *n_blocks[1:], _BLOCK_BITS, hits, misses, low
    n_items = math.prod(n_blocks)
    in_block = torch.empty(n_items, dtype=torch.int64, device=device)
    _LIST(n_items, *given, in_block, None, None, None)
    until = torch.cumsum(in_block, 0)
    n = int(until[-1])
    cells = torch.empty(n, 3, dtype=torch.int64, device=device)
    listed = torch.empty(2, n, device=device)
    _LIST(n_items, *given, until - in_block, cells, listed[0], listed[1])
    return cells, listed[0], listed[1]


def add_counts(counts: Tensor, index: Tensor, hits: Tensor, misses: Tensor) -> tuple[Tensor, Tensor]:
    """Adds hits (C,) and misses (C,) to counts (2, …) at distinct places; returns those before, (C,) each.

    Args:
        counts: contiguous, changed in place. index: (C,) int64, flat in counts[0]; nothing is added at 0.
    """
    n = len(index)
    if is_fused(counts, index, hits, misses) and counts.dtype == hits.dtype == misses.dtype == torch.float32:
        before = torch.empty(2, n, device=counts.device)
        run = _RUN if counts.device.type == "cpu" else 1
        _ADD(-(-n // run), n, run, index, hits, misses, counts[0].numel(), counts, before)
        return before[0], before[1]
    inside = index > 0
    olds = [part.view(-1).index_select(0, index) for part in counts]
    for part, old, added in zip(counts, olds, (hits, misses), strict=True):
        part.view(-1).index_copy_(0, index, old + torch.where(inside, added, 0.0).to(old.dtype))
    return olds[0], olds[1]


def flags_of_cells(cells: Tensor, low: Tensor, flags: Tensor) -> Tensor:
    """The flags (C,) bool of cells (C, 3) int64 in a block (nx, ny, nz), bool; False outside.

    Args:
        low: (3,) int64, the lowest cell of the block.
    """
    nx, ny, nz = flags.shape
    if is_fused(cells, low, flags):
        n, found = len(cells), torch.empty_like(cells[:, 0], dtype=torch.bool)
        run = _RUN if cells.device.type == "cpu" else 1
        _FLAGS(-(-n // run), n, run, cells, low, nx, ny, nz, flags, found)
        return found
    x, y, z = (cells - low).unbind(1)
    inside = (x >= 0) & (x < nx) & (y >= 0) & (y < ny) & (z >= 0) & (z < nz)
    return inside & flags.reshape(-1)[torch.where(inside, (x * ny + y) * nz + z, 0)]


class BlockKeys(NamedTuple):
    """The index of a sparse store.

    keys: (B,) int64, ascending. slots: (B,) int64, places of the blocks. bounds: (3, D) int64: lowest cell
    of the block that keys are relative to, then low and high of the cells that can be stored. local_bits: of
    a cell in its block along an axis. axis_bits: of a block in a key along an axis.
    """

    keys: Tensor
    slots: Tensor
    bounds: Tensor
    local_bits: int
    axis_bits: int


def cell_index(cells: Tensor, blocks: BlockKeys) -> Tensor:
    """Flat index (C,), int64, of cells (C, D) in the slots; −1 in blocks not stored, 0 out of bounds."""
    if is_fused(cells, blocks.keys, blocks.bounds):
        run = _INDEX_RUN if cells.device.type == "cpu" else 1
        index, (n, dim) = torch.empty_like(cells[:, 0]), cells.shape
        table = blocks.keys, blocks.slots, len(blocks.keys), blocks.bounds
        bits = blocks.local_bits, blocks.axis_bits
        _INDEX(-(-n // run), cells, n, dim, run, *table, *bits, index)
        return index
    bounds = list(zip(cells.unbind(1), *blocks.bounds.tolist(), strict=True))
    columns = [cell - origin for cell, origin, _, _ in bounds]
    inside = functools.reduce(
        torch.logical_and, [(cell >= low) & (cell < high) for cell, _, low, high in bounds]
    )
    half, in_block = 1 << (blocks.axis_bits - 1), (1 << blocks.local_bits) - 1
    key, place = (columns[0] >> blocks.local_bits) + half, columns[0] & in_block
    for column in columns[1:]:
        key = (key << blocks.axis_bits) | ((column >> blocks.local_bits) + half)
        place = (place << blocks.local_bits) | (column & in_block)
    if len(blocks.keys) == 0:
        return torch.where(inside, -1, 0)
    # Neighbouring cells often share a block: each run of equal keys is searched once.
    runs, run = torch.unique_consecutive(torch.where(inside, key, -1), return_inverse=True)
    rank = torch.searchsorted(blocks.keys, runs).clamp_max(len(blocks.keys) - 1)
    place_bits = blocks.local_bits * len(columns)
    first = torch.where(blocks.keys[rank] == runs, blocks.slots[rank] << place_bits, -1)[run]
    return torch.where(inside, torch.where(first < 0, -1, first + place), 0)


_REMOVED = FusedKernel("rays/cell_entropy.h", "entropy_removed")
_ALONG = FusedKernel("rays/cell_entropy.h", "reduction_along_rays")


def entropy_removed(
    before: tuple[Tensor, Tensor], added: tuple[Tensor, Tensor], chosen: Tensor, prior: float, clamp: float
) -> tuple[float, float, int]:
    """Bits of entropy that an addition of evidence removes from all cells and from the chosen ones; and how
    many of the chosen ones had no evidence.

    Args:
        before, added: hits (C,) and misses (C,), float32. chosen: (C,) bool.
        prior: N_p, rays. clamp: probabilities stay within [clamp, 1 − clamp].
    """
    if is_fused(*before, *added, chosen) and before[0].dtype == torch.float32:
        n = len(chosen)
        sums = torch.empty(-(-n // _RUN), 3, dtype=torch.float64, device=chosen.device)
        _REMOVED(len(sums), n, _RUN, *before, *added, chosen, prior, clamp, sums)
        bits, chosen_bits, n_new = sums.sum(0).tolist()
        return bits, chosen_bits, int(n_new)
    (h, m), (more_h, more_m) = before, added

    def entropy(hits: Tensor, misses: Tensor) -> Tensor:
        return bernoulli_entropy(occupancy_probability(hits, misses, prior).clamp(clamp, 1 - clamp))

    gone = entropy(h, m) - entropy(h + more_h, m + more_m)
    bits, chosen_bits = (float(part.sum(dtype=torch.float64)) for part in (gone, gone[chosen]))
    return bits, chosen_bits, int((h + m == 0)[chosen].sum())


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
        _ALONG(len(starts), *rays, hits, misses, prior, observed, mark, table, sums)
        return sums
    h, m = hits.double(), misses.double()
    bits = cell_entropy(h, m, prior) - cell_entropy(h, m + 1, prior) + mark * (h + m < observed)
    table = torch.nn.functional.pad(bits, (margin,) * 6).view(-1)
    sums = torch.zeros(len(starts), dtype=torch.float64, device=starts.device)
    for voxel, ray in traverse(starts, stops, shape, low=low):
        sums.index_add_(0, ray, table.index_select(0, voxel))
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
