"""Features of a position on a lattice: kernels of compact support at the cells that contain data."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.baselines.bgk_map import kernel_offsets, sparse_kernel
from gmmtorch.experiments.baselines.hilbert.hilbert_features import CHUNK_VALUES, rbf_kernel
from gmmtorch.occupancy import CellTable

RBF_CUTOFF = 1e-3
"""Kernels on a lattice are zero below this value, as in the code of the authors of Hilbert maps."""

Kernel = Callable[[Tensor, float], Tensor]


def cut_rbf_kernel(distance: Tensor, length: float) -> Tensor:
    """exp(−d²/2ℓ²), set to zero below `RBF_CUTOFF`, which is beyond 3.7 ℓ."""
    value = rbf_kernel(distance, length)
    return torch.where(value > RBF_CUTOFF, value, 0.0)


KERNELS: dict[str, tuple[Kernel, float]] = {
    "sparse": (sparse_kernel, 1.0),
    "rbf": (cut_rbf_kernel, math.sqrt(-2 * math.log(RBF_CUTOFF))),
}
"""Name of each kernel of compact support: the kernel, and its support in lengths."""


class LatticeDesign:
    """Features Φ (M, F): kernel values of M points at the nodes around their cells, computed when first used.

    The methods are those of `DenseDesign`, and products with the elementwise square of Φ.

    Args:
        features: the lattice.
        within: (M, D) position of each point in its cell, in cells.
        cell: (M,) index of the cell among the C distinct cells.
        nodes: (C, O) feature at each of the lattice's `offsets` from the cell; −1 for none.
    """

    def __init__(self, features: LatticeFeatures, within: Tensor, cell: Tensor, nodes: Tensor) -> None:
        self._features, self._within, self._cell, self._nodes = features, within, cell, nodes
        self.count = features.count

    @cached_property
    def nodes(self) -> Tensor:
        """Feature (M, O) of each value; 0 for none."""
        return self._nodes[self._cell].clamp_min(0)

    @cached_property
    def values(self) -> Tensor:
        """φ (M, O), float64; zero for no feature, or one out of reach."""
        kernel = self._features.kernel_at(self._within)
        return torch.where(self._nodes[self._cell] >= 0, kernel, 0.0)

    def dot(self, weights: Tensor) -> Tensor:
        return _weighted_sum(self.values, self.nodes, weights)

    def transpose_dot(self, residuals: Tensor) -> Tensor:
        return self._sum_by_feature(self.values * residuals[:, None])

    def dot_squared(self, weights: Tensor) -> Tensor:
        """(Φ∘Φ) w (M,), with the elementwise square of Φ."""
        return _weighted_sum(self.values.square(), self.nodes, weights)

    def transpose_dot_squared(self, residuals: Tensor) -> Tensor:
        """(Φ∘Φ)ᵀ r (F,), with the elementwise square of Φ."""
        return self._sum_by_feature(self.values.square() * residuals[:, None])

    def _sum_by_feature(self, terms: Tensor) -> Tensor:
        return terms.new_zeros(self.count).index_add_(0, self.nodes.view(-1), terms.view(-1))

    def rows(self, index: Tensor) -> LatticeDesign:
        return LatticeDesign(self._features, self._within[index], self._cell[index], self._nodes)

    def in_reach(self) -> Tensor:
        return (self.values != 0).any(1)

    def dense(self) -> Tensor:
        """Φ (M, F)."""
        matrix = self.values.new_zeros(self.values.shape[0], self.count)
        return matrix.scatter_add_(1, self.nodes, self.values)


def _weighted_sum(values: Tensor, nodes: Tensor, weights: Tensor) -> Tensor:
    return (values * weights[nodes]).sum(1) if weights.numel() else values.sum(1)


class LatticeFeatures:
    """Kernels k(‖x − h‖) of compact support, with nodes h at the centres of lattice cells that contain data.

    Memory grows with the number of such cells, not with the box around them. Points beyond the support of all
    nodes are out of reach.

    Args:
        kernel: "sparse" (Melkumyan & Ramos 2009) or "rbf", cut at 10⁻³.
        length: of the kernel (m).
        spacing: of the lattice (m).
        dim: 2 or 3.
        width: numbers per node in `table.values`.
        device: of the tensors.
    """

    def __init__(
        self, kernel: str, length: float, spacing: float, dim: int, width: int, device: torch.device
    ) -> None:
        self._kernel, support = KERNELS[kernel]
        self.length = length
        self.table = CellTable(spacing, dim, width, device)
        self.offsets = kernel_offsets(support * length, spacing, dim).to(device)

    @property
    def count(self) -> int:
        return self.table.keys.shape[0]

    @property
    def max_points(self) -> int:
        return max(1, CHUNK_VALUES // self.offsets.shape[0])

    def add_nodes(self, points: Tensor) -> None:
        """Adds a node to each cell of the points (M, D) that has none."""
        self.table.open(torch.unique(self.table.cells(points), dim=0))

    def design(self, points: Tensor) -> LatticeDesign:
        own = (points / self.table.resolution).floor()
        cells, cell = _distinct(own)
        nodes, present = self.table.find_cells((cells[:, None] + self.offsets).flatten(0, 1))
        nodes = torch.where(present, nodes, -1).view(len(cells), len(self.offsets))
        return LatticeDesign(self, points / self.table.resolution - own, cell, nodes)

    def kernel_at(self, within: Tensor) -> Tensor:
        """Kernel (M, O) between positions (M, D) within a cell, in cells, and the nodes at all offsets."""
        distance = ((self.offsets + 0.5) - within[:, None]).norm(dim=2) * self.table.resolution
        return self._kernel(distance, self.length)

    def tensors(self) -> dict[str, Tensor]:
        return self.table.packed()


def _distinct(cells: Tensor) -> tuple[Tensor, Tensor]:
    """Distinct rows (C, D), int64, of finite cells (M, D), and the index (M,) of each cell among them."""
    # Beyond 2^52 the cells of a float are not exact; no data is that far away.
    rows, inverse = torch.unique(cells.clamp(-(2.0**52), 2.0**52), dim=0, return_inverse=True)
    return rows.long(), inverse


def check_lattice(kernel: str, length: float, spacing: float, dim: int) -> None:
    """Raises `InvalidArgumentError` unless the node at a cell's centre reaches every point of the cell."""
    if KERNELS[kernel][1] * length <= 0.5 * spacing * math.sqrt(dim):
        raise InvalidArgumentError(
            f"spacing={spacing} m leaves gaps between kernels of length {length:.3g} m; use at most "
            f"{2 * KERNELS[kernel][1] * length / math.sqrt(dim):.3g} m."
        )
