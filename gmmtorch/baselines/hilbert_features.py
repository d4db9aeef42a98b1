"""Features of a position that Hilbert maps are linear in: random Fourier, Nyström, and kernels on a lattice.

Each set of features makes a `Design` of points: φ(x) for each, ready to be multiplied from either side.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from gmmtorch.baselines.bgk_map import kernel_offsets, sparse_kernel
from gmmtorch.baselines.samples import centroids
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.files import require
from gmmtorch.occupancy.voxels.cell_table import CellTable

RBF_CUTOFF = 1e-3
"""Kernels on a lattice are taken as zero below this, as the authors of Hilbert maps do."""

_VALUES_AT_ONCE = 1 << 22
_NYSTROEM_REACH = 5.0  # lengths from every centre beyond which nothing is known

Kernel = Callable[[Tensor, float], Tensor]


def rbf_kernel(distance: Tensor, length: float) -> Tensor:
    """exp(−d²/2ℓ²) of distances (m), any shape."""
    return (-0.5 * (distance / length).square()).exp()


def cut_rbf_kernel(distance: Tensor, length: float) -> Tensor:
    """exp(−d²/2ℓ²), zero from where it falls below `RBF_CUTOFF`: 3.7 ℓ."""
    value = rbf_kernel(distance, length)
    return torch.where(value > RBF_CUTOFF, value, 0.0)


KERNELS: dict[str, tuple[Kernel, float]] = {
    "sparse": (sparse_kernel, 1.0),
    "rbf": (cut_rbf_kernel, math.sqrt(-2 * math.log(RBF_CUTOFF))),
}
"""Kernels of compact support by name, and their support in lengths."""


class Design(ABC):
    """Features Φ (M, F) of M points."""

    @abstractmethod
    def dot(self, weights: Tensor) -> Tensor:
        """Φ w (M,)."""

    @abstractmethod
    def pull(self, residuals: Tensor) -> Tensor:
        """Φᵀ r (F,)."""

    @abstractmethod
    def rows(self, index: Tensor) -> Design:
        """Features of some of the points."""

    @abstractmethod
    def known(self) -> Tensor:
        """Whether each point (M,) is where features speak of."""


class Features(ABC):
    """A finite set of features of positions (M, D) in the world frame."""

    @property
    @abstractmethod
    def count(self) -> int:
        """How many there are, F."""

    @property
    def points_at_once(self) -> int:
        """Points to make a design of at most, where there are many, so that memory stays bounded."""
        return 1 << 16

    @abstractmethod
    def design(self, points: Tensor) -> Design:
        """Features of finite points (M, D), float64."""

    @abstractmethod
    def tensors(self) -> dict[str, Tensor]:
        """What a file needs to make them again."""


# -- dense ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _DenseDesign(Design):
    """Features K mix⁻ᵀ, with all rows of K computed a portion at a time, once if they are one portion.

    points: (M, D); values: K of points; mix: (F, F), lower triangular, the unit matrix if None;
    near: whether features speak of points, of all if None.
    """

    points: Tensor
    count: int
    values: Callable[[Tensor], Tensor]
    mix: Tensor | None = None
    near: Callable[[Tensor], Tensor] | None = None

    @cached_property
    def _first(self) -> Tensor:
        return self.values(self._portions()[0])

    def _portions(self) -> tuple[Tensor, ...]:
        return self.points.split(max(1, _VALUES_AT_ONCE // max(1, self.count)))

    def _each(self) -> Iterator[Tensor]:
        yield self._first
        for portion in self._portions()[1:]:
            yield self.values(portion)

    def dot(self, weights: Tensor) -> Tensor:
        if self.mix is not None:
            weights = torch.linalg.solve_triangular(self.mix.mT, weights[:, None], upper=True)[:, 0]
        # Row by row: a matrix product would round a point's answer by how many are asked about with it.
        return torch.cat([(values * weights).sum(1) for values in self._each()])

    def pull(self, residuals: Tensor) -> Tensor:
        total, start = residuals.new_zeros(self.count), 0
        for values in self._each():
            total += residuals[start : start + len(values)] @ values
            start += len(values)
        if self.mix is not None:
            total = torch.linalg.solve_triangular(self.mix, total[:, None], upper=False)[:, 0]
        return total

    def rows(self, index: Tensor) -> Design:
        return _DenseDesign(self.points[index], self.count, self.values, self.mix, self.near)

    def known(self) -> Tensor:
        if self.near is None:
            return torch.ones(len(self.points), dtype=torch.bool, device=self.points.device)
        return torch.cat([self.near(portion) for portion in self._portions()])


class FourierFeatures(Features):
    """A constant, and √(2/F)·[cos ωᵀx, sin ωᵀx] with ω ~ N(0, I/ℓ²), of which φ(x)ᵀφ(y) ≈ exp(−‖x−y‖²/2ℓ²).

    Rahimi & Recht 2007. They speak of everywhere.

    Args:
        frequencies: ω (F/2, D), 1/m.
        anchor: where x is measured from (D,), m; so that phases keep their digits far from the origin.
    """

    def __init__(self, frequencies: Tensor, anchor: Tensor) -> None:
        self.frequencies = frequencies.float()  # as they are stored
        self.anchor = anchor.double()

    @classmethod
    def drawn(
        cls, n_features: int, length: float, anchor: Tensor, generator: torch.Generator
    ) -> FourierFeatures:
        """`n_features` of a kernel of this length (m)."""
        frequencies = torch.randn(max(1, n_features // 2), anchor.shape[0], generator=generator)
        return cls(frequencies.to(anchor.device) / length, anchor)

    @property
    def count(self) -> int:
        return 2 * self.frequencies.shape[0] + 1

    def design(self, points: Tensor) -> Design:
        return _DenseDesign(points - self.anchor, self.count, self._values)

    def _values(self, points: Tensor) -> Tensor:
        phase = (points[:, None] * self.frequencies.double()).sum(2).float()
        scale = self.frequencies.shape[0] ** -0.5
        one = torch.ones(len(points), 1, device=points.device)
        return torch.cat([one, phase.cos() * scale, phase.sin() * scale], 1).double()

    def tensors(self) -> dict[str, Tensor]:
        return {"frequencies": self.frequencies, "anchor": self.anchor}

    @classmethod
    def read(cls, tensors: Mapping[str, Tensor], dim: int, path: str | Path) -> FourierFeatures:
        """Features of a file. Raises `DataError` if it is damaged."""
        anchor = require(tensors, "anchor", (dim,), torch.float64, path)
        return cls(require(tensors, "frequencies", (None, dim), torch.float32, path), anchor)


class NystroemFeatures(Features):
    """L⁻¹ k(x), k of the centres and L Lᵀ = K their kernel matrix: φ(x)ᵀφ(y) = k(x)ᵀ K⁻¹ k(y).

    Williams & Seeger 2001. On the span of the centres the kernel is exact; five lengths from all of
    them nothing is known.

    Args:
        centers: (F, D), m, relative to the anchor.
        anchor: (D,), m.
        length: ℓ of exp(−d²/2ℓ²) (m).
    """

    def __init__(self, centers: Tensor, anchor: Tensor, length: float) -> None:
        self.centers = centers.float()  # as they are stored
        self.anchor = anchor.double()
        self.length = length
        kernel = self._values(self.centers.double())
        # Close centres make K nearly singular; the ridge bounds the weights that cancel.
        ridge = 1e-6 * torch.eye(self.count, dtype=torch.float64, device=kernel.device)
        self._factor = torch.linalg.cholesky(kernel + ridge)

    @classmethod
    def of_data(
        cls, points: Tensor, n_features: int, length: float, anchor: Tensor, generator: torch.Generator
    ) -> NystroemFeatures:
        """Centres drawn from the points (N, D), of which one cube of half the length counts once."""
        candidates = centroids(points - anchor, 0.5 * length)
        chosen = torch.randperm(candidates.shape[0], generator=generator)[:n_features].sort().values
        return cls(candidates[chosen.to(points.device)], anchor, length)

    @property
    def count(self) -> int:
        return self.centers.shape[0]

    def design(self, points: Tensor) -> Design:
        return _DenseDesign(points - self.anchor, self.count, self._values, self._factor, self._near)

    def _values(self, points: Tensor) -> Tensor:
        return rbf_kernel(self._distance(points), self.length)

    def _distance(self, points: Tensor) -> Tensor:
        # Exact differences: products of large coordinates would lose small distances.
        exact = "donot_use_mm_for_euclid_dist"
        return torch.cdist(points, self.centers.double(), compute_mode=exact)

    def _near(self, points: Tensor) -> Tensor:
        return (self._distance(points) <= _NYSTROEM_REACH * self.length).any(1)

    def tensors(self) -> dict[str, Tensor]:
        return {"centers": self.centers, "anchor": self.anchor}

    @classmethod
    def read(
        cls, tensors: Mapping[str, Tensor], dim: int, length: float, path: str | Path
    ) -> NystroemFeatures:
        """Features of a file. Raises `DataError` if it is damaged."""
        anchor = require(tensors, "anchor", (dim,), torch.float64, path)
        return cls(require(tensors, "centers", (None, dim), torch.float32, path), anchor, length)


# -- on a lattice -----------------------------------------------------------------------------------


class LatticeDesign(Design):
    """Kernel values of each point at the nodes around its cell, computed when they are asked for.

    within: (M, D) place of the point in its cell, in cells; cell: (M,) which distinct cell that is;
    nodes: (C, O) feature at each of the `offsets` from that cell, −1 where there is none.
    """

    def __init__(self, features: LatticeFeatures, within: Tensor, cell: Tensor, nodes: Tensor) -> None:
        self._features, self._within, self._cell, self._nodes = features, within, cell, nodes
        self.count = features.count

    @cached_property
    def nodes(self) -> Tensor:
        """Feature (M, O) of each value; 0 where there is none."""
        return self._nodes[self._cell].clamp_min(0)

    @cached_property
    def values(self) -> Tensor:
        """φ (M, O), float64; zero where there is no feature, or it is out of reach."""
        kernel = self._features.kernel_at(self._within)
        return torch.where(self._nodes[self._cell] >= 0, kernel, 0.0)

    def dot(self, weights: Tensor) -> Tensor:
        return _gathered(self.values, self.nodes, weights)

    def pull(self, residuals: Tensor) -> Tensor:
        return self._spread(self.values * residuals[:, None])

    def dot_squared(self, weights: Tensor) -> Tensor:
        """Φ² w (M,), squared elementwise."""
        return _gathered(self.values.square(), self.nodes, weights)

    def pull_squared(self, residuals: Tensor) -> Tensor:
        """(Φ²)ᵀ r (F,), squared elementwise."""
        return self._spread(self.values.square() * residuals[:, None])

    def _spread(self, terms: Tensor) -> Tensor:
        return terms.new_zeros(self.count).index_add_(0, self.nodes.view(-1), terms.view(-1))

    def rows(self, index: Tensor) -> LatticeDesign:
        return LatticeDesign(self._features, self._within[index], self._cell[index], self._nodes)

    def known(self) -> Tensor:
        return (self.values != 0).any(1)

    def dense(self) -> Tensor:
        """Φ (M, F)."""
        matrix = self.values.new_zeros(self.values.shape[0], self.count)
        return matrix.scatter_add_(1, self.nodes, self.values)


def _gathered(values: Tensor, nodes: Tensor, weights: Tensor) -> Tensor:
    return (values * weights[nodes]).sum(1) if weights.numel() else values.sum(1)


class LatticeFeatures(Features):
    """k(‖x − h‖) at nodes h, the centres of cells of a lattice that hold data; of compact support.

    Memory follows the data, not the box around it. Points beyond every node's support have no features.

    Args:
        kernel: "sparse" (Melkumyan & Ramos 2009) or "rbf", cut where it is below 10⁻³.
        length: of the kernel (m).
        spacing: of the lattice (m).
        width: numbers kept for each node in `table.values`.
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
    def points_at_once(self) -> int:
        return max(1, _VALUES_AT_ONCE // self.offsets.shape[0])

    def open(self, points: Tensor) -> None:
        """See that the cells of these points (M, D) have a node."""
        self.table.open(torch.unique(self.table.cells(points), dim=0))

    def design(self, points: Tensor) -> LatticeDesign:
        own = (points / self.table.resolution).floor()
        cells, cell = _distinct(own)
        nodes, present = self.table.find_cells((cells[:, None] + self.offsets).flatten(0, 1))
        nodes = torch.where(present, nodes, -1).view(len(cells), len(self.offsets))
        return LatticeDesign(self, points / self.table.resolution - own, cell, nodes)

    def kernel_at(self, within: Tensor) -> Tensor:
        """Kernel (M, O) between places within a cell (M, D) and the node at each offset from that cell."""
        distance = ((self.offsets + 0.5) - within[:, None]).norm(dim=2) * self.table.resolution
        return self._kernel(distance, self.length)

    def tensors(self) -> dict[str, Tensor]:
        return self.table.packed()


def _distinct(cells: Tensor) -> tuple[Tensor, Tensor]:
    """Distinct rows (C, D), int64, of finite cells (M, D), and which each is (M,)."""
    # Beyond 2^52 a float has no cell of its own; nothing is that far from the data.
    rows, inverse = torch.unique(cells.clamp(-(2.0**52), 2.0**52), dim=0, return_inverse=True)
    return rows.long(), inverse


def check_lattice(kernel: str, length: float, spacing: float, dim: int) -> None:
    """Raises unless every point of a cell is within the reach of the node in its middle."""
    if KERNELS[kernel][1] * length <= 0.5 * spacing * math.sqrt(dim):
        raise InvalidArgumentError(
            f"spacing={spacing} m leaves gaps between kernels of length {length:.3g} m; take at most "
            f"{2 * KERNELS[kernel][1] * length / math.sqrt(dim):.3g} m."
        )
