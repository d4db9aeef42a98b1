"""Mixtures by the sliced Wasserstein distance (Kolouri, Rohde & Hoffmann, 2018; thesis 2.1.5).

SW² of a cloud and a mixture is the mean, over directions, of W₂² between what both are along a
line (`transport`). Directions are drawn once, and the points sorted along each once; then Adam
descends on a few of the directions at a time, and a pass over all of them is an iteration.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from typing import Any

import torch
from torch import nn

from gmmtorch.errors import check_whole
from gmmtorch.linalg import safe_cholesky
from gmmtorch.mixture.em.exact import SOFTMAX_DTYPES, Parameters
from gmmtorch.mixture.em.initialization import INITIALIZATIONS, start
from gmmtorch.mixture.estimator import MixtureEstimator
from gmmtorch.mixture.estimators.optimal_transport import Slices, random_directions, slice_cloud, transport
from gmmtorch.mixture.validation import (
    Array,
    RandomState,
    as_generator,
    check_choice,
    check_enough,
    check_number,
)

_BATCH = 16  # directions to a step of Adam
_STEPS = 8  # of a pass, at least: few directions are visited again, or it would say little
_HALVINGS = 6  # of the learning rate, before the descent is over
_THINNEST = 1e-6  # variance of the start's components, and deviation of any, where the cloud's is 1
_MOMENTS = (0.9, 0.99)  # Adam's: a pass is a few steps, so its memory is short


class SlicedWassersteinGaussianMixture(MixtureEstimator):
    """Gaussian mixture closest to the points in the sliced Wasserstein distance.

    Good against poor starts: on 20 000 points of a lidar scan, K=32 from random points, SW² is 0.011 m²
    and PSNR2 88.8 dB, where EM has 0.089 m² and 87.0 dB. Poor as a density, and slow: few lines see
    how thin a wall is, so from k-means EM has 94.3 dB to its 91.8, −4.0 nats held out to its −5.8, in
    0.2 s to its 4.

    Args:
        n_components: K, at most the number of points.
        n_projections: directions, drawn once; 256 are enough in 3D, and time grows with them.
        learning_rate: Adam's first, in units of a component's own size.
        tol: a pass that lowers the distance by a smaller share halves the learning rate; converged
            when that has happened seven times.
        reg_covar: added to each variance, in the square of the points' unit (m²).
        max_iter: passes over the directions at most.
        init_params: "kmeans" (scikit-learn's), "random_points" or "bounding_box".
        random_state: a seed, a `RandomState`, a `torch.Generator`, or None for a fresh one.
        dtype: of Φ and φ.

    `lower_bounds_` holds −SW² (m²) after each pass, as the mean over its steps: not a likelihood,
    which this fit may lower.
    """

    def __init__(
        self,
        n_components: int = 1,
        *,
        n_projections: int = 256,
        learning_rate: float = 0.1,
        tol: float = 1e-3,
        reg_covar: float = 1e-6,
        max_iter: int = 200,
        init_params: str = "kmeans",
        random_state: RandomState = None,
        dtype: str = "float64",
    ) -> None:
        nn.Module.__init__(self)
        self.n_components = n_components
        self.n_projections = n_projections
        self.learning_rate = learning_rate
        self.tol = tol
        self.reg_covar = reg_covar
        self.max_iter = max_iter
        self.init_params = init_params
        self.random_state = random_state
        self.dtype = dtype

    def fit(
        self,
        X: Array,
        y: Any = None,
        sample_weight: Array | None = None,
        on_iteration: Callable[[int, float], None] | None = None,
    ) -> SlicedWassersteinGaussianMixture:
        """Learn the mixture of points X (N, D).

        Args:
            X: points, finite.
            y: ignored, as in scikit-learn.
            sample_weight: (N,) how many points each row stands for: not negative, not all zero.
            on_iteration: called with the pass (from 1) and −SW² (m²).

        Raises:
            InvalidArgumentError (a ValueError): a bad argument, weight or point; K above the
                number of points of non-zero weight.
            NumericalError: a component collapsed, as happens with reg_covar = 0.
        """
        points, weight, center = self._prepare(X, sample_weight)
        generator = as_generator(self.random_state)
        epsilon, dim = float(self.reg_covar), points.shape[1]
        spread = float((weight[:, None] * points.square()).sum() / weight.sum()) / dim
        floor = min(epsilon, _THINNEST * spread) or epsilon  # of a single point there is but ε
        first = start(self.init_params, points, weight, self.n_components, floor, generator)
        # In units of the cloud's spread, so that a step means the same for any cloud.
        unit = math.sqrt(spread or epsilon) or 1.0
        directions = random_directions(self.n_projections, dim, generator).to(points.device)
        slices = slice_cloud(points / unit, weight, directions)
        shape = Shape(Parameters(first.weights, first.means / unit, first.covariances / unit**2))

        def on_pass(iteration: int, cost: float) -> None:
            if on_iteration is not None:
                on_iteration(iteration, -cost * unit**2)

        costs, converged = descend(
            shape,
            slices,
            generator,
            learning_rate=float(self.learning_rate),
            tol=float(self.tol),
            max_iter=self.max_iter,
            dtype=SOFTMAX_DTYPES[self.dtype],
            on_pass=on_pass,
        )
        with torch.no_grad():
            weights, means, covariances = shape()
        covariances = covariances * unit**2
        covariances.diagonal(dim1=-2, dim2=-1).add_(epsilon)
        safe_cholesky(covariances)
        found = Parameters(weights, means * unit, covariances)
        self._keep(found, center, [-cost * unit**2 for cost in costs], converged)
        self._warn_unless_converged("The descent")
        return self

    def check_parameters(self, n_points: int | None = None) -> None:
        """Raise `InvalidArgumentError` for a parameter that cannot be, or K above the number of points."""
        for name in ("n_components", "n_projections", "max_iter"):
            check_whole(name, getattr(self, name), 1)
        for name in ("tol", "reg_covar"):
            check_number(name, getattr(self, name))
        check_number("learning_rate", self.learning_rate, above=True)
        choices: dict[str, Collection[str]] = {"init_params": INITIALIZATIONS, "dtype": SOFTMAX_DTYPES}
        for name, known in choices.items():
            check_choice(name, getattr(self, name), known)
        as_generator(self.random_state)
        check_enough(self.n_components, n_points)


# -- the descent -----------------------------------------------------------------------------------


class Shape(nn.Module):
    """A mixture as numbers that may take any value, zero at the start but for the logits.

    Weights are a softmax. Means move by multiples of K^(−1/D), the size of a component's share of a
    cloud of spread 1. Covariances are L T Tᵀ Lᵀ, L of the start, T triangular with exp on its diagonal.
    """

    def __init__(self, first: Parameters) -> None:
        super().__init__()
        weights, means, covariances = first
        n_components, dim = means.shape
        self.means, self.reach = means, n_components ** (-1 / dim)
        self.factors = safe_cholesky(covariances)
        self.logits = nn.Parameter(weights.clamp_min(1e-12).log())
        self.shift = nn.Parameter(torch.zeros_like(means))
        self.stretch = nn.Parameter(torch.zeros_like(covariances))  # the upper triangle does not count

    def forward(self) -> Parameters:
        diagonal = torch.diag_embed(self.stretch.diagonal(dim1=-2, dim2=-1).exp())
        factors = self.factors @ (self.stretch.tril(-1) + diagonal)
        means = self.means + self.reach * self.shift
        return Parameters(torch.softmax(self.logits, 0), means, factors @ factors.mT)


def descend(
    shape: Shape,
    slices: Slices,
    generator: torch.Generator,
    *,
    learning_rate: float,
    tol: float,
    max_iter: int,
    dtype: torch.dtype = torch.float64,
    on_pass: Callable[[int, float], None] | None = None,
) -> tuple[list[float], bool]:
    """Adam on the mean W₂² along the slices: what it was in each pass, and whether it converged.

    Where a pass gains less than a share `tol` on the one before, the learning rate is halved.
    """
    adam = torch.optim.Adam(shape.parameters(), lr=learning_rate, betas=_MOMENTS)
    n = slices.directions.shape[0]
    rounds = math.ceil(_STEPS / math.ceil(n / _BATCH))
    costs: list[float] = []
    halvings, last = 0, math.inf
    for iteration in range(max_iter):
        cost = 0.0
        for _ in range(rounds):
            for chosen in torch.randperm(n, generator=generator).split(_BATCH):
                part = slices.rows(chosen.to(slices.values.device))
                cost += len(chosen) / (n * rounds) * differentiate(shape, part, dtype)
                adam.step()
        costs.append(cost)
        if on_pass is not None:
            on_pass(iteration + 1, cost)
        gained, last = cost < (1 - tol) * last, cost
        if gained:
            continue
        if halvings == _HALVINGS:
            return costs, True
        halvings += 1
        for group in adam.param_groups:
            group["lr"] /= 2
    return costs, False


def differentiate(shape: Shape, slices: Slices, dtype: torch.dtype = torch.float64) -> float:
    """Mean W₂² along the slices; its derivatives by the parameters of the shape go to their `grad`."""
    n = slices.directions.shape[0]
    with torch.enable_grad():
        weights, means, covariances = shape()
        along = slices.directions @ means.T
        deviations = torch.einsum("pi,kij,pj->pk", slices.directions, covariances, slices.directions)
        deviations = (deviations + _THINNEST**2).sqrt()  # nothing is divided by zero
    moved = transport(slices, *(value.detach().to(dtype) for value in (weights, along, deviations)))
    shape.zero_grad()
    torch.autograd.backward(
        [weights, along, deviations],
        [
            moved.by_weight.mean(0).double(),
            moved.by_mean.double() / n,
            moved.by_deviation.double() / n,
        ],
    )
    return float(moved.cost.double().mean())
