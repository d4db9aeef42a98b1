"""HilbertMap: occupancy as logistic regression on features of the position."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from gmmtorch.baselines.baseline_map import BaselineMap
from gmmtorch.baselines.hilbert_features import (
    Design,
    Features,
    FourierFeatures,
    LatticeFeatures,
    NystroemFeatures,
    check_lattice,
)
from gmmtorch.baselines.samples import beam_samples, check_length
from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.files import pack_tensors, require
from gmmtorch.scan import Scan

_FILE_KIND, _FILE_VERSION = "gmmtorch.hilbert_map", 1

FeatureKind = Literal["sparse", "nystroem", "fourier"]
_LENGTHS: dict[str, float] = {"sparse": 0.3, "nystroem": 0.5, "fourier": 0.5}


def check_between(name: str, value: float, low: float, high: float = math.inf) -> float:
    """A finite number in [low, high] as a float; else `InvalidArgumentError`."""
    if not isinstance(value, int | float) or not (math.isfinite(value) and low <= value <= high):
        span = f"of at least {low}" if high == math.inf else f"from {low} to {high}"
        raise InvalidArgumentError(f"{name}={value!r} must be a finite number {span}.")
    return float(value)


def penalised_loss(
    design: Design, is_hit: Tensor, weights: Tensor, alpha: float = 0.0, l1_ratio: float = 0.0
) -> Tensor:
    """Σ ln(1 + exp(−y wᵀφ)) + α (ρ‖w‖₁ + ½(1 − ρ)‖w‖²), y = ±1: Ramos & Ott 2016, (6) with an elastic net."""
    sign = torch.where(is_hit, -1.0, 1.0).double()
    loss = torch.nn.functional.softplus(sign * design.dot(weights)).sum()
    return loss + alpha * (l1_ratio * weights.abs().sum() + 0.5 * (1 - l1_ratio) * weights.square().sum())


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
    """Weights (F,), float64, that make `penalised_loss` small, by stochastic gradients from `weights`.

    The penalty is on how far they go from there: what an earlier map had learned is not to be forgotten.

    Each batch takes one composite step of AdaGrad (Duchi, Hazan & Singer 2011): every weight has a step
    of its own, which features that few points have need, and the L1 term is met exactly, by soft
    thresholds. All of it is divided by the number of points, so that steps do not depend on it.
    """
    n = is_hit.shape[0]
    labels = is_hit.double()
    change, squares = torch.zeros_like(weights), torch.zeros_like(weights)
    l1, l2 = alpha * l1_ratio / n, alpha * (1 - l1_ratio) / n
    for _ in range(epochs):
        order = torch.randperm(n, generator=generator).to(is_hit.device)
        for batch in order.split(batch_size):
            part = design.rows(batch)
            residual = torch.sigmoid(part.dot(weights + change)) - labels[batch]
            gradient = part.pull(residual) / batch.shape[0] + l2 * change
            squares += gradient.square()
            step = learning_rate / squares.sqrt().clamp_min(1e-12)
            change = change - step * gradient
            change = change.sign() * (change.abs() - step * l1).clamp_min(0)
    return weights + change


class HilbertMap(BaselineMap):
    """A linear classifier of ends against points on the way, in a space of features of the position.

    Ramos & Ott 2016, "Hilbert maps: scalable continuous occupancy mapping with stochastic gradient
    descent": θ(x) = σ(wᵀφ(x)), with w learned by stochastic gradients on the elastic-net penalised
    negative log-likelihood. φ are `sparse` kernels on a lattice, `nystroem` features of the RBF
    kernel, or its random `fourier` features. The first two speak only of what is near data and have
    no constant term, so that elsewhere θ is exactly ½ (the paper fits an intercept); Fourier
    features have one and speak of everywhere.

    Points are kept until `finish`, or the first question, learns from all of them together; when more
    are inserted then, learning starts again. A loaded map has no points of its past: it goes on from
    its weights, and is penalised for leaving them, with features that are fixed, but for the lattice's,
    which grows.

    Args:
        features: sparse, nystroem or fourier.
        length: of the kernel (m): its support (sparse), or deviation (nystroem, fourier); 0.3 and 0.5 if
            not given, which suit rooms seen to 0.1 m, as the other defaults do.
        spacing: of the lattice of sparse features (m); half the length if not given.
        n_features: of nystroem and fourier, at most.
        alpha: weight of the penalty, against the loss's sum over all points.
        l1_ratio: share of the L1 term in it.
        free_spacing: of the free points along a beam (m).
        gap: before a hit, without free points (m).
        thin: side of the cubes in which a scan's ends count once (m); None: all count.
        epochs: passes over the points.
        batch_size: points of one step.
        learning_rate: of AdaGrad.
        random_state: seed of the features, the free points and the order of the points.
    """

    any_resolution = True

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
        if features not in get_args(FeatureKind):
            raise InvalidArgumentError(
                f"features={features!r} is not one of {', '.join(get_args(FeatureKind))}."
            )
        self.features = features
        self.length = check_length("length", _LENGTHS[features] if length is None else length)
        self.spacing = check_length("spacing", 0.5 * self.length if spacing is None else spacing)
        self.n_features = check_whole("n_features", n_features, 1)
        self.alpha = check_between("alpha", alpha, 0)
        self.l1_ratio = check_between("l1_ratio", l1_ratio, 0, 1)
        self.free_spacing = check_length("free_spacing", free_spacing)
        self.gap = check_between("gap", gap, 0)
        self.thin = None if thin is None else check_length("thin", thin)
        self.epochs = check_whole("epochs", epochs, 1)
        self.batch_size = check_whole("batch_size", batch_size, 1)
        self.learning_rate = check_length("learning_rate", learning_rate)
        self.random_state = check_whole("random_state", random_state, 0)
        self._drawing = torch.Generator().manual_seed(self.random_state)
        self._points: list[Tensor] = []
        self._is_hit: list[Tensor] = []
        self._anchor = torch.empty(0, dtype=torch.float64)
        self._before: tuple[Features, Tensor] | None = None  # what a loaded map goes on from
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
            scan, self.free_spacing, gap=self.gap, thin=self.thin, generator=self._drawing
        )
        if not points.shape[0]:
            return
        if not self._points:
            self._anchor = scan.origin.double().clone()
        self._points.append(points)
        self._is_hit.append(is_hit)
        self._learned = None

    def finish(self) -> None:
        """Learn now from the points that wait, rather than at the first question."""
        if self.dim is not None:
            self.model()

    def model(self) -> tuple[Features, Tensor] | None:
        """Features and their weights (F,), float32; None where there was nothing to learn from."""
        if self._learned is None and self._points:
            self._learned = self._trained(torch.cat(self._points), torch.cat(self._is_hit))
        return self._learned or self._before

    def _trained(self, points: Tensor, is_hit: Tensor) -> tuple[Features, Tensor]:
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
        """Features for the points, and the weights that learning starts from."""
        if self.features == "sparse":
            lattice = self._lattice(points.shape[1], points.device)
            if self._before is not None:
                earlier, weights = self._before
                assert isinstance(earlier, LatticeFeatures)
                lattice.table.anchor, lattice.table.keys = earlier.table.anchor, earlier.table.keys
                lattice.table.values = weights[:, None]
            lattice.open(points)
            return lattice, lattice.table.values[:, 0]
        if self._before is not None:
            return self._before
        made: Features
        if self.features == "nystroem":
            made = NystroemFeatures.of_data(points, self.n_features, self.length, self._anchor, generator)
        else:
            made = FourierFeatures.drawn(self.n_features, self.length, self._anchor, generator)
        return made, torch.zeros(made.count, device=points.device)

    def _lattice(self, dim: int, device: torch.device) -> LatticeFeatures:
        return LatticeFeatures("sparse", self.length, self.spacing, dim, 1, device)

    def _answer(self, query: Tensor) -> Tensor:
        model = self.model()
        theta = query.new_full((query.shape[0],), 0.5)
        if model is not None:
            features, weights = model
            finite = torch.isfinite(query).all(1).nonzero().squeeze(1)
            for index in finite.split(features.points_at_once):
                design = features.design(query[index])
                theta[index] = torch.where(design.known(), torch.sigmoid(design.dot(weights.double())), 0.5)
        return theta

    # -- keeping ----------------------------------------------------------------------------------

    _OPTIONS = (
        "features",
        "length",
        "spacing",
        "n_features",
        "alpha",
        "l1_ratio",
        "free_spacing",
        "gap",
        "thin",
        "epochs",
        "batch_size",
        "learning_rate",
        "random_state",
    )

    def _serialized(self) -> bytes:
        """The features, and their weights as float32; not the points they were learned from."""
        facts: dict[str, Any] = {name: getattr(self, name) for name in self._OPTIONS}
        model, tensors = self.model(), {}
        if model is not None:
            tensors = {**model[0].tensors(), "weights": model[1]}
        return pack_tensors(tensors, _FILE_KIND, _FILE_VERSION, dim=self.dim, **facts)

    @classmethod
    def load(cls, path: str | Path) -> HilbertMap:
        """Read a map that `save` wrote. Raises `DataError` if it is not one."""
        made, tensors = cls._opened(path, _FILE_KIND, _FILE_VERSION)
        if tensors:
            features = made._read_features(tensors, path)
            made._before = features, require(tensors, "weights", (features.count,), torch.float32, path)
        return made

    def _read_features(self, tensors: dict[str, Tensor], path: str | Path) -> Features:
        assert self.dim is not None
        if self.features == "nystroem":
            return NystroemFeatures.read(tensors, self.dim, self.length, path)
        if self.features == "fourier":
            return FourierFeatures.read(tensors, self.dim, path)
        lattice = self._lattice(self.dim, torch.device("cpu"))
        lattice.table.fill(tensors, path)
        return lattice
