"""CellEvidence: hits and misses of a list of cells, as one frame or message adds them to a map."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import list_counted_cells, row_major_strides


class CellEvidence(NamedTuple):
    """Hits and misses of C distinct cells of the world's lattice.

    cells (C, 3) int64: cell c is the cube [c, c + 1) times the resolution, world frame. hits (C,) and
    misses (C,), float32: rays that end in the cell, and rays that pass through it.
    """

    cells: Tensor
    hits: Tensor
    misses: Tensor

    @classmethod
    def empty(cls, device: torch.device | str | None = None) -> CellEvidence:
        """Evidence of no cell, in 3D."""
        zero = torch.zeros(0, device=device)
        return cls(torch.zeros(0, 3, dtype=torch.int64, device=device), zero, zero)

    @classmethod
    def from_dense(cls, low: Tensor, hits: Tensor, misses: Tensor) -> CellEvidence:
        """The cells with any evidence of a dense array (nx, ny, nz) whose lowest cell is `low` (3,)."""
        return cls(*list_counted_cells(low, hits, misses))


def sum_evidence(parts: Iterable[CellEvidence]) -> CellEvidence:
    """The sum of several evidences; each cell occurs once.

    Raises `InvalidArgumentError` if the cells span too large a box for 64-bit indices.
    """
    given = list(parts)
    parts = [part for part in given if len(part.cells)] or given[:1]
    if not parts:
        return CellEvidence.empty()
    if len(parts) == 1:
        return parts[0]
    cells = torch.cat([part.cells for part in parts])
    low = cells.amin(0)
    shape = tuple((cells.amax(0) - low + 1).tolist())
    if math.prod(shape) >= 2**62:
        raise InvalidArgumentError(f"Evidence that spans {shape} cells cannot be summed; use coarser cells.")
    strides = torch.tensor(row_major_strides(shape), device=cells.device)
    key, row = torch.unique(((cells - low) * strides).sum(1), return_inverse=True)
    sums = [
        torch.zeros(len(key), device=cells.device).index_add_(0, row, torch.cat([part[i] for part in parts]))
        for i in (1, 2)
    ]
    size = torch.tensor(shape, device=cells.device)
    return CellEvidence(key[:, None] // strides % size + low, *sums)
