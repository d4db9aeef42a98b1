"""Hilbert map and Bayesian Hilbert map: occupancy as logistic regression on features of the position."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, get_args

import torch
from torch import Tensor

from gmmtorch.errors import DataError, MemoryLimitError, check_choice, check_number, check_whole
from gmmtorch.experiments.baselines.hilbert_features import (
    DenseDesign,
    DenseFeatures,
    LatticeDesign,
    LatticeFeatures,
    check_lattice,
    fourier_features,
    nystroem_centers,
    nystroem_features,
)
from gmmtorch.experiments.baselines.samples import beam_samples
from gmmtorch.files import require
from gmmtorch.occupancy import TensorFileMap, check_length, optional_length
from gmmtorch.scan import Scan

_CONJUGATE_STEPS = 10  # each step lowers the error, and each round starts from the last round's mean

Design = DenseDesign | LatticeDesign
Covariance = Literal["diagonal", "mean_field", "full"]


def logistic_regression(
    design: Design,
    is_hit: Tensor,
    weights: Tensor,
    *,
    alpha: float,
    l1_ratio: float,
    epochs: int,
    batch_size: int,
    learning_rate: float,
    generator: torch.Generator,
) -> Tensor:
    """Weights w (F,), float64, that minimize a loss by stochastic gradients from initial `weights` w₀.

        Σ ln(1 + exp(−y wᵀφ)) + α (ρ‖w − w₀‖₁ + ½(1 − ρ)‖w − w₀‖²),   y = ±1, ρ = l1_ratio

    Ramos & Ott 2016, (6), with an elastic net. The penalty applies to the change from the initial weights, so
    that an earlier map is not forgotten.

    Each batch makes one composite step of AdaGrad (Duchi, Hazan & Singer 2011). Every weight has its own
    step size, which features with few points need. Soft thresholds apply the L1 term exactly. The loss is
    divided by the number of points, so that step sizes do not depend on it.
    """
    n = is_hit.shape[0]
    labels = is_hit.double()
    change, squares = torch.zeros_like(weights), torch.zeros_like(weights)
    l1, l2 = alpha * l1_ratio / n, alpha * (1 - l1_ratio) / n
    for _ in range(epochs):
        order = torch.randperm(n, generator=generator).to(is_hit.device)
        for batch in order.split(batch_size):
            rows = design.rows(batch)
            residual = torch.sigmoid(rows.dot(weights + change)) - labels[batch]
            gradient = rows.transpose_dot(residual) / batch.shape[0] + l2 * change
            squares += gradient.square()
            step = learning_rate / squares.sqrt().clamp_min(1e-12)
            change = change - step * gradient
            change = change.sign() * (change.abs() - step * l1).clamp_min(0)
    return weights + change


@dataclass(frozen=True)
class Posterior:
    """Normal distribution of F weights: mean (F,), float64; precision (F,) if diagonal, else (F, F)."""

    mean: Tensor
    precision: Tensor

    @property
    def is_full(self) -> bool:
        return self.precision.ndim == 2

    @cached_property
    def factor(self) -> Tensor:
        """Lower Cholesky factor (F, F) of a full precision."""
        return torch.linalg.cholesky(self.precision)

    @classmethod
    def from_factor(cls, mean: Tensor, factor: Tensor) -> Posterior:
        """The posterior of a full precision with a known Cholesky factor (F, F)."""
        made = cls(mean, factor @ factor.mT)
        made.__dict__["factor"] = factor  # the cached property
        return made


def jaakkola_lambda(xi: Tensor) -> Tensor:
    """λ(ξ) = tanh(ξ/2)/4ξ for ξ ≥ 0, ⅛ at zero: the curvature of Jaakkola & Jordan's bound at ξ."""
    return torch.where(xi > 1e-4, (0.5 * xi).tanh() / (4 * xi).clamp_min(1e-300), 0.125)


def moments(design: LatticeDesign, posterior: Posterior) -> tuple[Tensor, Tensor]:
    """Mean and variance (M,) of wᵀφ(x)."""
    mean = design.dot(posterior.mean)
    if not posterior.is_full:
        return mean, design.dot_squared(1 / posterior.precision)
    solved = torch.linalg.solve_triangular(posterior.factor, design.dense().mT, upper=False)
    return mean, solved.square().sum(0)


def moderated(mean: Tensor, variance: Tensor) -> Tensor:
    """σ(m/√(1 + πv/8)) ≈ E[σ(a)] for a ~ N(m, v): MacKay 1992."""
    return torch.sigmoid(mean / (1 + math.pi / 8 * variance).sqrt())


def variational_step(
    design: LatticeDesign,
    is_hit: Tensor,
    prior: Posterior,
    xi: Tensor,
    covariance: Covariance,
    start: Tensor | None = None,
) -> Posterior:
    """The posterior for given ξ (M,) from the prior and the labelled points.

    precision = prior's + 2 Σ λ(ξ) φφᵀ; the mean m solves precision · m = prior's · m₀ + Σ (y − ½) φ.
    "full" computes exactly that. "mean_field" is the best normal distribution with independent weights: the
    same mean, and the diagonal of that precision. "diagonal" is the authors' fast form: it also ignores the
    off-diagonal entries in the equation of the mean, as if features did not overlap.

    `start` (F,) is an initial guess of the mean; default the prior's mean.
    """
    curvature = 2 * jaakkola_lambda(xi)
    pull = design.transpose_dot(is_hit.double() - 0.5)
    if prior.is_full:
        phi = design.dense()
        precision = prior.precision + phi.mT @ (phi * curvature[:, None])
        right = prior.precision @ prior.mean + pull
        mean = torch.cholesky_solve(right[:, None], torch.linalg.cholesky(precision))[:, 0]
        return Posterior(mean, precision)
    precision = prior.precision + design.transpose_dot_squared(curvature)
    right = prior.precision * prior.mean + pull
    if covariance == "diagonal":
        return Posterior(right / precision, precision)

    def times(x: Tensor) -> Tensor:
        return prior.precision * x + design.transpose_dot(curvature * design.dot(x))

    start = prior.mean if start is None else start
    return Posterior(_conjugate_gradients(times, right, start, precision), precision)


def _conjugate_gradients(
    times: Callable[[Tensor], Tensor], right: Tensor, start: Tensor, diagonal: Tensor
) -> Tensor:
    """x of A x = right for positive definite A, by conjugate gradients preconditioned with A's diagonal."""
    x = start
    residual = right - times(x)
    preconditioned = residual / diagonal
    direction, power = preconditioned, residual @ preconditioned
    goal = 1e-10 * float(right @ (right / diagonal))
    for _ in range(_CONJUGATE_STEPS):
        if float(power) <= goal:
            break
        image = times(direction)
        step = power / (direction @ image)
        x, residual = x + step * direction, residual - step * image
        preconditioned = residual / diagonal
        power, previous = residual @ preconditioned, power
        direction = preconditioned + power / previous * direction
    return x


def fit_posterior(
    design: LatticeDesign, is_hit: Tensor, prior: Posterior, covariance: Covariance, n_iter: int
) -> Posterior:
    """The posterior after `n_iter` rounds from ξ = 1; each updates the weights, then ξ."""
    xi = torch.ones(is_hit.shape[0], dtype=torch.float64, device=is_hit.device)
    posterior = prior
    for _ in range(n_iter):
        posterior = variational_step(design, is_hit, prior, xi, covariance, posterior.mean)
        mean, variance = moments(design, posterior)
        xi = (mean.square() + variance).sqrt()
    return posterior


Features = DenseFeatures | LatticeFeatures
FeatureKind = Literal["sparse", "nystroem", "fourier"]
_LENGTHS: dict[str, float] = {"sparse": 0.3, "nystroem": 0.5, "fourier": 0.5}


class HilbertMap(TensorFileMap):
    """A linear classifier of beam ends against free points, in a space of features of the position.

    Ramos & Ott 2016, "Hilbert maps: scalable continuous occupancy mapping with stochastic gradient
    descent": θ(x) = σ(wᵀφ(x)), with w learned by stochastic gradients on the negative log-likelihood with
    an elastic-net penalty. The features φ are `sparse` kernels on a lattice, `nystroem` features of the
    RBF kernel, or its random `fourier` features. Sparse and Nyström features are zero far from data and
    have no constant term, so θ is exactly ½ there (the paper fits an intercept). Fourier features have a
    constant term and extrapolate everywhere.

    Points are stored until `finish` or the first query, which learns from all of them together. Learning
    restarts if more points are inserted later. A loaded map has no stored points: learning starts from its
    weights, and changes of them are penalised. Its features are fixed, except that the lattice grows.

    Args:
        features: sparse, nystroem or fourier.
        length: of the kernel (m): support (sparse) or standard deviation (nystroem, fourier). Defaults 0.3
            and 0.5, which suit rooms mapped at 0.1 m, as the other defaults do.
        spacing: of the lattice of sparse features (m); default half the length.
        n_features: largest number of nystroem or fourier features.
        alpha: weight of the penalty, relative to the sum of the loss over all points.
        l1_ratio: share of the L1 term in the penalty.
        free_spacing: spacing of the free points of a beam (m).
        gap: distance before a hit without free points (m).
        thin: side of the cubes in which a scan's beam ends are merged (m); None: no merging.
        epochs: passes over the points.
        batch_size: points per step.
        learning_rate: of AdaGrad.
        random_state: seed of the features, the free points and the order of the points.
    """

    any_resolution = True
    file_kind = "gmmtorch.hilbert_map"

    def __init__(
        self,
        features: FeatureKind = "sparse",
        *,
        length: float | None = None,
        spacing: float | None = None,
        n_features: int = 2000,
        alpha: float = 0.1,
        l1_ratio: float = 0.15,
        free_spacing: float = 1.0,
        gap: float = 0.0,
        thin: float | None = None,
        epochs: int = 3,
        batch_size: int = 1024,
        learning_rate: float = 0.5,
        random_state: int = 0,
    ) -> None:
        check_choice("features", features, get_args(FeatureKind))
        self.features = features
        self.length = check_length("length", _LENGTHS[features] if length is None else length)
        self.spacing = check_length("spacing", 0.5 * self.length if spacing is None else spacing)
        self.n_features = check_whole("n_features", n_features, 1)
        self.alpha = check_number("alpha", alpha)
        self.l1_ratio = check_number("l1_ratio", l1_ratio, 1)
        self.free_spacing = check_length("free_spacing", free_spacing)
        self.gap = check_number("gap", gap)
        self.thin = optional_length("thin", thin)
        self.epochs = check_whole("epochs", epochs, 1)
        self.batch_size = check_whole("batch_size", batch_size, 1)
        self.learning_rate = check_number("learning_rate", learning_rate, above=True)
        self.random_state = check_whole("random_state", random_state, 0)
        self._generator = torch.Generator().manual_seed(self.random_state)
        self._points: list[Tensor] = []
        self._is_hit: list[Tensor] = []
        self._anchor = torch.empty(0, dtype=torch.float64)
        self._initial: tuple[Features, Tensor] | None = None  # the model of a loaded map
        self._learned: tuple[Features, Tensor] | None = None

    @property
    def device(self) -> torch.device:
        return self._anchor.device

    def _start(self, dim: int, device: torch.device) -> None:
        if self.features == "sparse":
            check_lattice("sparse", self.length, self.spacing, dim)
        self._anchor = torch.zeros(dim, dtype=torch.float64, device=device)

    def _learn(self, scan: Scan) -> None:
        points, is_hit = beam_samples(
            scan, self.free_spacing, gap=self.gap, thin=self.thin, generator=self._generator
        )
        if not points.shape[0]:
            return
        if not self._points:
            self._anchor = scan.origin.double().clone()
        self._points.append(points)
        self._is_hit.append(is_hit)
        self._learned = None

    def finish(self) -> None:
        """Learns from the stored points, which is otherwise deferred to the first query."""
        if self.dim is not None:
            self.model()

    def model(self) -> tuple[Features, Tensor] | None:
        """Features and their weights (F,), float32; None if no points were inserted."""
        if self._learned is None and self._points:
            self._learned = self._train(torch.cat(self._points), torch.cat(self._is_hit))
        return self._learned or self._initial

    def _train(self, points: Tensor, is_hit: Tensor) -> tuple[Features, Tensor]:
        generator = torch.Generator().manual_seed(self.random_state)
        features, start = self._features_of(points, generator)
        weights = logistic_regression(
            features.design(points),
            is_hit,
            start.double(),
            alpha=self.alpha,
            l1_ratio=self.l1_ratio,
            epochs=self.epochs,
            batch_size=self.batch_size,
            learning_rate=self.learning_rate,
            generator=generator,
        )
        return features, weights.float()

    def _features_of(self, points: Tensor, generator: torch.Generator) -> tuple[Features, Tensor]:
        """Features for the points, and the initial weights."""
        if self.features == "sparse":
            lattice = self._lattice(points.shape[1], points.device)
            if self._initial is not None:
                earlier, weights = self._initial
                assert isinstance(earlier, LatticeFeatures)
                lattice.table.anchor, lattice.table.keys = earlier.table.anchor, earlier.table.keys
                lattice.table.values = weights[:, None]
            lattice.add_nodes(points)
            return lattice, lattice.table.values[:, 0]
        if self._initial is not None:
            return self._initial
        if self.features == "nystroem":
            centers = nystroem_centers(points - self._anchor, self.n_features, self.length, generator)
            made = nystroem_features(centers, self._anchor, self.length)
        else:
            frequencies = torch.randn(max(1, self.n_features // 2), points.shape[1], generator=generator)
            made = fourier_features(frequencies.to(points.device) / self.length, self._anchor)
        return made, torch.zeros(made.count, device=points.device)

    def _lattice(self, dim: int, device: torch.device) -> LatticeFeatures:
        return LatticeFeatures("sparse", self.length, self.spacing, dim, 1, device)

    def _answer(self, query: Tensor) -> Tensor:
        model = self.model()
        theta = query.new_full((query.shape[0],), 0.5)
        if model is not None:
            features, weights = model
            finite = torch.isfinite(query).all(1).nonzero().squeeze(1)
            for index in finite.split(features.max_points):
                design = features.design(query[index])
                probability = torch.sigmoid(design.dot(weights.double()))
                theta[index] = torch.where(design.in_reach(), probability, 0.5)
        return theta

    def _tensors(self) -> dict[str, Tensor]:
        """The features and their weights as float32, without the points."""
        model = self.model()
        return {} if model is None else {**model[0].tensors, "weights": model[1]}

    def _restore(self, tensors: dict[str, Tensor], path: str | Path) -> None:
        if tensors:
            features = self._read_features(tensors, path)
            self._initial = features, require(tensors, "weights", (features.count,), torch.float32, path)

    def _read_features(self, tensors: dict[str, Tensor], path: str | Path) -> Features:
        assert self.dim is not None
        if self.features == "sparse":
            lattice = self._lattice(self.dim, torch.device("cpu"))
            lattice.table.fill(tensors, path)
            return lattice
        anchor = require(tensors, "anchor", (self.dim,), torch.float64, path)
        if self.features == "nystroem":
            centers = require(tensors, "centers", (None, self.dim), torch.float32, path)
            return nystroem_features(centers, anchor, self.length)
        return fourier_features(
            require(tensors, "frequencies", (None, self.dim), torch.float32, path), anchor
        )


_MAX_FULL = 4096  # most hinges with a full covariance


class BayesianHilbertMap(TensorFileMap):
    """A normal distribution over the weights of RBF kernels that are hinged at the nodes of a lattice.

    Senanayake & Ramos 2017, "Bayesian Hilbert maps for dynamic continuous occupancy mapping". The
    posterior of each scan, by Jaakkola and Jordan's bound, is the prior of the next scan; a large scan is
    learned in parts. No points are stored. Queries take the variance of the weights into account.
    Differences from the paper: nodes are hinged only where data is, not throughout a box; kernels are cut
    at 10⁻³; there is no constant term, so θ is exactly ½ beyond the reach of all hinges.

    Args:
        gamma: of the kernel exp(−γ d²) (1/m²). The defaults suit rooms mapped at 0.1 m.
        spacing: of the hinges (m).
        covariance: of the weights: diagonal, mean_field or full, see `variational_step`. "diagonal" needs
            kernels that hardly overlap (γ·spacing² ≥ 4, say). "full" suits few hinges: its memory is
            quadratic in their number, and its time per scan cubic.
        prior_variance: of each weight; the authors' code uses 10⁴.
        n_iter: rounds per scan.
        free_spacing: spacing of the free points of a beam (m).
        gap: distance before a hit without free points (m).
        thin: side of the cubes in which a scan's beam ends are merged (m); None: no merging.
        random_state: seed of the free points.
    """

    any_resolution = True
    file_kind = "gmmtorch.bayesian_hilbert_map"

    def __init__(
        self,
        gamma: float = 30.0,
        *,
        spacing: float = 0.2,
        covariance: Covariance = "mean_field",
        prior_variance: float = 10.0,
        n_iter: int = 3,
        free_spacing: float = 1.0,
        gap: float = 0.0,
        thin: float | None = None,
        random_state: int = 0,
    ) -> None:
        check_choice("covariance", covariance, get_args(Covariance))
        self.gamma = check_number("gamma", gamma, least=1e-12)
        self.spacing = check_length("spacing", spacing)
        self.covariance = covariance
        self.prior_variance = check_number("prior_variance", prior_variance, least=1e-12)
        self.n_iter = check_whole("n_iter", n_iter, 1)
        self.free_spacing = check_length("free_spacing", free_spacing)
        self.gap = check_number("gap", gap)
        self.thin = optional_length("thin", thin)
        self.random_state = check_whole("random_state", random_state, 0)
        self._generator = torch.Generator().manual_seed(self.random_state)
        # Values of a hinge: mean, and precision that the data adds to the prior's; float32, as in files.
        self._hinges = self._lattice(2, torch.device("cpu"))
        self._factor = torch.empty(0, 0)  # "full": lower Cholesky factor of the precision (F, F)

    def _lattice(self, dim: int, device: torch.device) -> LatticeFeatures:
        return LatticeFeatures("rbf", (2 * self.gamma) ** -0.5, self.spacing, dim, 2, device)

    @property
    def device(self) -> torch.device:
        return self._hinges.table.keys.device

    @property
    def posterior(self) -> Posterior:
        """Distribution of the weights of the hinges, in the order of `hinges`."""
        mean, added = self._hinges.table.values.double().unbind(1)
        if self.covariance != "full":
            return Posterior(mean, added + 1 / self.prior_variance)
        return Posterior.from_factor(mean, self._factor.double())

    @property
    def hinges(self) -> Tensor:
        """Centres of the kernels (F, D), world metres."""
        return self._hinges.table.centers()

    def _start(self, dim: int, device: torch.device) -> None:
        check_lattice("rbf", (2 * self.gamma) ** -0.5, self.spacing, dim)
        self._hinges = self._lattice(dim, device)
        self._factor = torch.empty(0, 0, device=device)

    def _learn(self, scan: Scan) -> None:
        points, is_hit = beam_samples(
            scan, self.free_spacing, gap=self.gap, thin=self.thin, generator=self._generator
        )
        if not points.shape[0]:
            return
        self._add_hinges(points)
        n_parts = math.ceil(points.shape[0] / self._max_points)
        posterior = self.posterior
        for part in range(n_parts):  # every n-th point, so that each part covers the whole scan
            design = self._hinges.design(points[part::n_parts])
            posterior = fit_posterior(design, is_hit[part::n_parts], posterior, self.covariance, self.n_iter)
        self._store(posterior)

    @property
    def _max_points(self) -> int:
        """Largest number of points per design."""
        return self._hinges.max_points if self.covariance != "full" else 1 << 12

    def _store(self, posterior: Posterior) -> None:
        table = self._hinges.table
        if self.covariance == "full":
            added = torch.zeros_like(posterior.mean)
            self._factor = posterior.factor.float().contiguous()  # rounded as in files
        else:
            added = posterior.precision - 1 / self.prior_variance
        table.values = torch.stack([posterior.mean, added], 1).float()

    def _add_hinges(self, points: Tensor) -> None:
        """Adds the missing hinges of the points' cells, with the prior."""
        table = self._hinges.table
        before = table.keys
        self._hinges.add_nodes(points)
        if self.covariance != "full":
            return
        n = self._hinges.count
        if n > _MAX_FULL:
            raise MemoryLimitError(
                f"spacing={self.spacing} m makes {n:,} hinges, above the {_MAX_FULL:,} of covariance='full'; "
                "use a wider spacing, or covariance='mean_field'."
            )
        # New weights are independent of the others. They can be inserted anywhere in the order.
        precision = torch.eye(n, dtype=torch.float64, device=table.keys.device) / self.prior_variance
        old, factor = torch.searchsorted(table.keys, before), self._factor.double()
        precision[old[:, None], old] = factor @ factor.mT
        self._factor = torch.linalg.cholesky(precision).float()

    def _answer(self, query: Tensor) -> Tensor:
        theta = query.new_full((query.shape[0],), 0.5)
        if not self._hinges.count:
            return theta
        posterior = self.posterior
        finite = torch.isfinite(query).all(1).nonzero().squeeze(1)
        for index in finite.split(self._max_points):
            theta[index] = moderated(*moments(self._hinges.design(query[index]), posterior))
        return theta

    def _tensors(self) -> dict[str, Tensor]:
        """Hinges, means, and precisions or the lower triangle of their Cholesky factor, as float32."""
        mean, added = self._hinges.table.values.unbind(1)
        tensors = {**self._hinges.tensors, "means": mean}
        if self.covariance == "full":
            rows, cols = torch.tril_indices(len(mean), len(mean))
            tensors["factor"] = self._factor[rows, cols]
        else:
            tensors["precisions"] = added
        return tensors

    def _restore(self, tensors: dict[str, Tensor], path: str | Path) -> None:
        table = self._hinges.table
        table.fill(tensors, path)
        n = table.keys.shape[0]
        table.values[:, 0] = require(tensors, "means", (n,), torch.float32, path)
        if self.covariance != "full":
            table.values[:, 1] = require(tensors, "precisions", (n,), torch.float32, path)
            if bool((table.values[:, 1] < 0).any()):
                raise DataError(f"{path}: precisions contains negative numbers; the file is damaged.")
        elif n:
            if n > _MAX_FULL:
                raise DataError(f"{path} has {n:,} hinges, above the {_MAX_FULL:,} of covariance='full'.")
            stored = require(tensors, "factor", (n * (n + 1) // 2,), torch.float32, path)
            rows, cols = torch.tril_indices(n, n)
            self._factor = torch.zeros(n, n)
            self._factor[rows, cols] = stored
            if bool((self._factor.diagonal() <= 0).any()):
                raise DataError(f"{path}: factor is not that of a precision; the file is damaged.")
