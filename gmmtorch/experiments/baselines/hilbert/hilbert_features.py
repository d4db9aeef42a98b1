"""Features of a position for Hilbert maps: random Fourier features and Nyström features.

A set of features computes the design of points: the matrix Φ of φ(x) for each point x. Features on a lattice
are in `lattice_features`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from gmmtorch.experiments.baselines.samples import centroids
from gmmtorch.files import require

CHUNK_VALUES = 1 << 22
"""Values of features that are computed at a time."""

MAX_POINTS = 1 << 16
"""Largest number of points per dense design, which limits the memory used."""

_NYSTROEM_REACH = 5.0  # distance from the centres, in lengths, beyond which nothing is known


def rbf_kernel(distance: Tensor, length: float) -> Tensor:
    """exp(−d²/2ℓ²) of distances (m) of any shape."""
    return (-0.5 * (distance / length).square()).exp()


@dataclass(frozen=True)
class DenseDesign:
    """Features Φ = K mix⁻ᵀ (M, F) of M points. The rows of K are computed in chunks; the first is cached.

    points: (M, D). values: computes K of points. mix: (F, F), lower triangular; None: the unit matrix.
    near: tells whether points are in reach; None: all are.
    """

    points: Tensor
    count: int
    values: Callable[[Tensor], Tensor]
    mix: Tensor | None = None
    near: Callable[[Tensor], Tensor] | None = None

    @cached_property
    def _first(self) -> Tensor:
        return self.values(self._chunks()[0])

    def _chunks(self) -> tuple[Tensor, ...]:
        return self.points.split(max(1, CHUNK_VALUES // max(1, self.count)))

    def _values_by_chunk(self) -> Iterator[Tensor]:
        yield self._first
        for chunk in self._chunks()[1:]:
            yield self.values(chunk)

    def dot(self, weights: Tensor) -> Tensor:
        """Φ w (M,)."""
        if self.mix is not None:
            weights = torch.linalg.solve_triangular(self.mix.mT, weights[:, None], upper=True)[:, 0]
        # Row by row, because the rounding of a matrix product depends on the number of rows.
        return torch.cat([(values * weights).sum(1) for values in self._values_by_chunk()])

    def transpose_dot(self, residuals: Tensor) -> Tensor:
        """Φᵀ r (F,)."""
        total, start = residuals.new_zeros(self.count), 0
        for values in self._values_by_chunk():
            total += residuals[start : start + len(values)] @ values
            start += len(values)
        if self.mix is not None:
            total = torch.linalg.solve_triangular(self.mix, total[:, None], upper=False)[:, 0]
        return total

    def rows(self, index: Tensor) -> DenseDesign:
        """The design of a subset of the points."""
        return DenseDesign(self.points[index], self.count, self.values, self.mix, self.near)

    def in_reach(self) -> Tensor:
        """Whether each point (M,) is in the reach of the features."""
        if self.near is None:
            return torch.ones(len(self.points), dtype=torch.bool, device=self.points.device)
        return torch.cat([self.near(chunk) for chunk in self._chunks()])


class FourierFeatures:
    """Random Fourier features (Rahimi & Recht 2007): a constant, and √(2/F)·[cos ωᵀx, sin ωᵀx].

    With ω ~ N(0, I/ℓ²), φ(x)ᵀφ(y) ≈ exp(−‖x−y‖²/2ℓ²). Every point is in their reach.

    Args:
        frequencies: ω (F/2, D), 1/m.
        anchor: (D,), m, origin of x, so that phases far from the world origin stay exact.
    """

    max_points = MAX_POINTS

    def __init__(self, frequencies: Tensor, anchor: Tensor) -> None:
        self.frequencies = frequencies.float()  # rounded as in files
        self.anchor = anchor.double()

    @classmethod
    def drawn(
        cls, n_features: int, length: float, anchor: Tensor, generator: torch.Generator
    ) -> FourierFeatures:
        """Draws `n_features` features of a kernel with this length (m)."""
        frequencies = torch.randn(max(1, n_features // 2), anchor.shape[0], generator=generator)
        return cls(frequencies.to(anchor.device) / length, anchor)

    @property
    def count(self) -> int:
        """Number of features, F."""
        return 2 * self.frequencies.shape[0] + 1

    def design(self, points: Tensor) -> DenseDesign:
        """The design of finite points (M, D), float64, in the world frame."""
        return DenseDesign(points - self.anchor, self.count, self._values)

    def _values(self, points: Tensor) -> Tensor:
        phase = (points[:, None] * self.frequencies.double()).sum(2).float()
        scale = self.frequencies.shape[0] ** -0.5
        one = torch.ones(len(points), 1, device=points.device)
        return torch.cat([one, phase.cos() * scale, phase.sin() * scale], 1).double()

    def tensors(self) -> dict[str, Tensor]:
        """The tensors from which a file restores the features."""
        return {"frequencies": self.frequencies, "anchor": self.anchor}

    @classmethod
    def read(cls, tensors: Mapping[str, Tensor], dim: int, path: str | Path) -> FourierFeatures:
        """The features in a file. Raises `DataError` if they are damaged."""
        anchor = require(tensors, "anchor", (dim,), torch.float64, path)
        return cls(require(tensors, "frequencies", (None, dim), torch.float32, path), anchor)


class NystroemFeatures:
    """Nyström features L⁻¹ k(x), with k the kernel of the centres and L Lᵀ = K their kernel matrix.

    Williams & Seeger 2001. φ(x)ᵀφ(y) = k(x)ᵀ K⁻¹ k(y) is the exact kernel on the span of the centres.
    Points more than five lengths from all centres are out of reach.

    Args:
        centers: (F, D), m, relative to the anchor.
        anchor: (D,), m.
        length: ℓ of exp(−d²/2ℓ²) (m).
    """

    max_points = MAX_POINTS

    def __init__(self, centers: Tensor, anchor: Tensor, length: float) -> None:
        self.centers = centers.float()  # rounded as in files
        self.anchor = anchor.double()
        self.length = length
        kernel = self._values(self.centers.double())
        # Close centres make K nearly singular; the ridge limits the size of cancelling weights.
        ridge = 1e-6 * torch.eye(self.count, dtype=torch.float64, device=kernel.device)
        self._factor = torch.linalg.cholesky(kernel + ridge)

    @classmethod
    def of_data(
        cls, points: Tensor, n_features: int, length: float, anchor: Tensor, generator: torch.Generator
    ) -> NystroemFeatures:
        """Draws centres from the points (N, D) after merging those in one cube of half the length."""
        candidates = centroids(points - anchor, 0.5 * length)
        chosen = torch.randperm(candidates.shape[0], generator=generator)[:n_features].sort().values
        return cls(candidates[chosen.to(points.device)], anchor, length)

    @property
    def count(self) -> int:
        """Number of features, F."""
        return self.centers.shape[0]

    def design(self, points: Tensor) -> DenseDesign:
        """The design of finite points (M, D), float64, in the world frame."""
        return DenseDesign(points - self.anchor, self.count, self._values, self._factor, self._near)

    def _values(self, points: Tensor) -> Tensor:
        return rbf_kernel(self._distance(points), self.length)

    def _distance(self, points: Tensor) -> Tensor:
        # Exact differences, because products of large coordinates lose small distances.
        exact = "donot_use_mm_for_euclid_dist"
        return torch.cdist(points, self.centers.double(), compute_mode=exact)

    def _near(self, points: Tensor) -> Tensor:
        return (self._distance(points) <= _NYSTROEM_REACH * self.length).any(1)

    def tensors(self) -> dict[str, Tensor]:
        """The tensors from which a file restores the features."""
        return {"centers": self.centers, "anchor": self.anchor}

    @classmethod
    def read(
        cls, tensors: Mapping[str, Tensor], dim: int, length: float, path: str | Path
    ) -> NystroemFeatures:
        """The features in a file. Raises `DataError` if they are damaged."""
        anchor = require(tensors, "anchor", (dim,), torch.float64, path)
        return cls(require(tensors, "centers", (None, dim), torch.float32, path), anchor, length)
