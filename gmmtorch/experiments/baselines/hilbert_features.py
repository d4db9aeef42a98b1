"""Features of a position for Hilbert maps: random Fourier, Nyström, and kernels on a lattice."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.baselines.bgk_map import kernel_offsets, sparse_kernel
from gmmtorch.experiments.baselines.cell_table import CellTable
from gmmtorch.experiments.baselines.samples import centroids

CHUNK_VALUES = 1 << 22
"""Values of features that are computed at a time."""

_NYSTROEM_REACH = 5.0  # distance from the centres, in lengths, beyond which nothing is known


def rbf_kernel(distance: Tensor, length: float) -> Tensor:
    """exp(−d²/2ℓ²) of distances (m) of any shape."""
    return (-0.5 * (distance / length).square()).exp()


@dataclass(frozen=True)
class DenseFeatures:
    """Features mix⁻¹ k(x), made by `fourier_features` or `nystroem_features`.

    count: their number, F. anchor: (D,), m, origin of x, so that positions far from the world origin stay
    exact. values: computes k (M, F) of points. tensors: from which a file restores the features. mix: (F, F),
    lower triangular; None: the unit matrix. near: tells whether points are in reach; None: all are.
    """

    count: int
    anchor: Tensor
    values: Callable[[Tensor], Tensor]
    tensors: dict[str, Tensor]
    mix: Tensor | None = None
    near: Callable[[Tensor], Tensor] | None = None
    max_points = 1 << 16
    """Largest number of points per design, which limits the memory used."""

    def design(self, points: Tensor) -> DenseDesign:
        """The design of finite points (M, D), float64, in the world frame."""
        return DenseDesign(self, points - self.anchor)


class DenseDesign:
    """Φ (M, F) of M points (M, D) about the anchor. Values are computed in chunks; the first is cached."""

    def __init__(self, features: DenseFeatures, points: Tensor) -> None:
        self._features, self._points = features, points

    @cached_property
    def _first(self) -> Tensor:
        return self._features.values(self._chunks()[0])

    def _chunks(self) -> tuple[Tensor, ...]:
        return self._points.split(max(1, CHUNK_VALUES // max(1, self._features.count)))

    def _values_by_chunk(self) -> Iterator[Tensor]:
        yield self._first
        for chunk in self._chunks()[1:]:
            yield self._features.values(chunk)

    def dot(self, weights: Tensor) -> Tensor:
        """Φ w (M,)."""
        mix = self._features.mix
        if mix is not None:
            weights = torch.linalg.solve_triangular(mix.mT, weights[:, None], upper=True)[:, 0]
        # Row by row, because the rounding of a matrix product depends on the number of rows.
        return torch.cat([(values * weights).sum(1) for values in self._values_by_chunk()])

    def transpose_dot(self, residuals: Tensor) -> Tensor:
        """Φᵀ r (F,)."""
        total, start, mix = residuals.new_zeros(self._features.count), 0, self._features.mix
        for values in self._values_by_chunk():
            total += residuals[start : start + len(values)] @ values
            start += len(values)
        if mix is not None:
            total = torch.linalg.solve_triangular(mix, total[:, None], upper=False)[:, 0]
        return total

    def rows(self, index: Tensor) -> DenseDesign:
        """The design of a subset of the points."""
        return DenseDesign(self._features, self._points[index])

    def in_reach(self) -> Tensor:
        """Whether each point (M,) is in the reach of the features."""
        if self._features.near is None:
            return torch.ones(len(self._points), dtype=torch.bool, device=self._points.device)
        return torch.cat([self._features.near(chunk) for chunk in self._chunks()])


def fourier_features(frequencies: Tensor, anchor: Tensor) -> DenseFeatures:
    """Random Fourier features (Rahimi & Recht 2007): a constant, and √(2/F)·[cos ωᵀx, sin ωᵀx].

    With ω ~ N(0, I/ℓ²), φ(x)ᵀφ(y) ≈ exp(−‖x−y‖²/2ℓ²). Every point is in their reach. frequencies: ω (F/2, D),
    1/m.
    """
    frequencies, anchor = frequencies.float(), anchor.double()  # rounded as in files

    def values(points: Tensor) -> Tensor:
        phase = (points[:, None] * frequencies.double()).sum(2).float()
        scale = len(frequencies) ** -0.5
        one = torch.ones(len(points), 1, device=points.device)
        return torch.cat([one, phase.cos() * scale, phase.sin() * scale], 1).double()

    tensors = {"frequencies": frequencies, "anchor": anchor}
    return DenseFeatures(2 * len(frequencies) + 1, anchor, values, tensors)


def nystroem_features(centers: Tensor, anchor: Tensor, length: float) -> DenseFeatures:
    """Nyström features L⁻¹ k(x), with k the kernel of the centres and L Lᵀ = K their kernel matrix.

    Williams & Seeger 2001. φ(x)ᵀφ(y) = k(x)ᵀ K⁻¹ k(y) is the exact kernel on the span of the centres.
    Points more than five lengths from all centres are out of reach. centers: (F, D), m, relative to the
    anchor (D,). length: ℓ of exp(−d²/2ℓ²) (m).
    """
    centers, anchor = centers.float(), anchor.double()  # rounded as in files

    def distance(points: Tensor) -> Tensor:
        # Exact differences, because products of large coordinates lose small distances.
        return torch.cdist(points, centers.double(), compute_mode="donot_use_mm_for_euclid_dist")

    def values(points: Tensor) -> Tensor:
        return rbf_kernel(distance(points), length)

    def near(points: Tensor) -> Tensor:
        return (distance(points) <= _NYSTROEM_REACH * length).any(1)

    kernel = values(centers.double())
    # Close centres make K nearly singular; the ridge limits the size of cancelling weights.
    factor = torch.linalg.cholesky(kernel + 1e-6 * torch.eye(len(centers)).to(kernel))
    tensors = {"centers": centers, "anchor": anchor}
    return DenseFeatures(len(centers), anchor, values, tensors, factor, near)


def nystroem_centers(points: Tensor, n: int, length: float, generator: torch.Generator) -> Tensor:
    """At most n centres (F, D) of points (N, D), of which those in one cube of half the length are merged."""
    candidates = centroids(points, 0.5 * length)
    chosen = torch.randperm(candidates.shape[0], generator=generator)[:n].sort().values
    return candidates[chosen.to(points.device)]


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

    The methods are those of `DenseDesign`, and products with the elementwise square of Φ. within: (M, D)
    position of each point in its cell, in cells. cell: (M,) index of the cell among the C distinct cells.
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
    nodes are out of reach. The kernel is "sparse" (Melkumyan & Ramos 2009) or "rbf", cut at 10⁻³; its length
    and the spacing of the lattice are in metres. width: numbers per node in `table.values`.
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
        # Beyond 2^52 the cells of a float are not exact; no data is that far away.
        cells, cell = torch.unique(own.clamp(-(2.0**52), 2.0**52), dim=0, return_inverse=True)
        cells = cells.long()
        nodes, present = self.table.find_cells((cells[:, None] + self.offsets).flatten(0, 1))
        nodes = torch.where(present, nodes, -1).view(len(cells), len(self.offsets))
        return LatticeDesign(self, points / self.table.resolution - own, cell, nodes)

    def kernel_at(self, within: Tensor) -> Tensor:
        """Kernel (M, O) between positions (M, D) within a cell, in cells, and the nodes at all offsets."""
        distance = ((self.offsets + 0.5) - within[:, None]).norm(dim=2) * self.table.resolution
        return self._kernel(distance, self.length)

    @property
    def tensors(self) -> dict[str, Tensor]:
        return self.table.packed()


def check_lattice(kernel: str, length: float, spacing: float, dim: int) -> None:
    """Raises `InvalidArgumentError` unless the node at a cell's centre reaches every point of the cell."""
    if KERNELS[kernel][1] * length <= 0.5 * spacing * math.sqrt(dim):
        raise InvalidArgumentError(
            f"spacing={spacing} m leaves gaps between kernels of length {length:.3g} m; use at most "
            f"{2 * KERNELS[kernel][1] * length / math.sqrt(dim):.3g} m."
        )
