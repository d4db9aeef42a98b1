"""Mixtures fitted by the sliced Wasserstein distance (Kolouri, Rohde & Hoffmann, 2018; thesis 2.1.5).

SW² of a cloud and a mixture is the mean, over directions, of W₂² between their projections on a line
(see `optimal_transport`). Directions are drawn once, and the points are sorted along each once. Adam
then descends on batches of directions; one iteration is a pass over all directions.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch import nn

from gmmtorch.linalg import safe_cholesky
from gmmtorch.mixture.em.exact import SOFTMAX_DTYPES, Parameters
from gmmtorch.mixture.em.initialization import initialize
from gmmtorch.mixture.estimator import ABOVE_ZERO, COUNT, MixtureEstimator
from gmmtorch.mixture.estimators.optimal_transport import Slices, random_directions, slice_cloud, transport
from gmmtorch.mixture.validation import Array, RandomState, as_generator

_BATCH = 16  # directions of one step of Adam
_STEPS = 8  # fewest steps of a pass; if there are few directions, a pass visits them repeatedly
_HALVINGS = 6  # halvings of the learning rate before the descent ends
_THINNEST = 1e-6  # least variance at the start and least deviation, for a cloud of spread 1
_MOMENTS = (0.9, 0.99)  # of Adam; short memory, because a pass has few steps


class SlicedWassersteinGaussianMixture(MixtureEstimator):
    """Gaussian mixture with the smallest sliced Wasserstein distance to the points.

    Robust against poor starts: on 20 000 points of a lidar scan, K=32 from random points, SW² is 0.011 m²
    and PSNR2 88.8 dB, while EM reaches 0.089 m² and 87.0 dB. Poor as a density, and slow, because few
    directions show how thin a wall is: from k-means EM reaches 94.3 dB against 91.8, −4.0 nats held out
    against −5.8, and takes 0.2 s against 4.

    Args:
        n_components: K, at most the number of points.
        n_projections: number of directions, drawn once. 256 are enough in 3D; time grows with them.
        learning_rate: initial learning rate of Adam, in units of a component's size.
        tol: a pass that decreases the distance by a smaller share halves the learning rate; converged
            after seven such passes.
        reg_covar: added to each variance, in the squared unit of the points (m²).
        max_iter: largest number of passes over the directions.
        init_params: as in `GaussianMixture`, without "auto".
        random_state: a seed, a `RandomState`, a `torch.Generator`, or None for a random seed.
        dtype: of Φ and φ.

    `lower_bounds_` contains −SW² (m²) of each pass, as the mean over its steps. It is not a likelihood,
    and this fit may decrease the likelihood.
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **MixtureEstimator._parameter_constraints,
        "n_projections": [COUNT],
        "learning_rate": [ABOVE_ZERO],
    }

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
        """Fit the mixture to points X (N, D). Arguments and errors: see `MixtureEstimator.fit`.

        `on_iteration` is called with the pass (from 1) and −SW² (m²).
        """
        points, weight, center = self._prepare(X, sample_weight)
        generator = as_generator(self.random_state)
        epsilon, dim = float(self.reg_covar), points.shape[1]
        spread = float((weight[:, None] * points.square()).sum() / weight.sum()) / dim
        floor = min(epsilon, _THINNEST * spread) or epsilon  # a single point has only ε
        first = initialize(self.init_params, points, weight, self.n_components, floor, generator)
        # In units of the cloud's spread, so that the learning rate suits any cloud.
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
        self._store_fit(found, center, [-cost * unit**2 for cost in costs], converged)
        self._warn_unless_converged()
        return self


# -- the descent -----------------------------------------------------------------------------------


class Shape(nn.Module):
    """A mixture as unconstrained parameters, zero at the start except the logits.

    Weights are a softmax. Means move by multiples of K^(−1/D), the size of a component in a cloud of
    spread 1. Covariances are L T Tᵀ Lᵀ, with L of the start and T triangular with exp on its diagonal.
    """

    def __init__(self, first: Parameters) -> None:
        super().__init__()
        weights, means, covariances = first
        n_components, dim = means.shape
        self.means, self.reach = means, n_components ** (-1 / dim)
        self.factors = safe_cholesky(covariances)
        self.logits = nn.Parameter(weights.clamp_min(1e-12).log())
        self.shift = nn.Parameter(torch.zeros_like(means))
        self.stretch = nn.Parameter(torch.zeros_like(covariances))  # the upper triangle is unused

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
    """Adam on the mean W₂² along the slices: its value in each pass, and whether it converged.

    The learning rate is halved after a pass that decreases the value by less than a share `tol`.
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
    """Mean W₂² along the slices.

    Its derivatives by the parameters of the shape are stored in their `grad`.
    """
    n = slices.directions.shape[0]
    with torch.enable_grad():
        weights, means, covariances = shape()
        along = slices.directions @ means.T
        deviations = torch.einsum("pi,kij,pj->pk", slices.directions, covariances, slices.directions)
        deviations = (deviations + _THINNEST**2).sqrt()  # avoids division by zero
    moved = transport(slices, *(value.detach().to(dtype) for value in (weights, along, deviations)))
    shape.zero_grad()
    torch.autograd.backward(
        [weights, along, deviations],
        [moved.by_weight.mean(0).double(), moved.by_mean.double() / n, moved.by_deviation.double() / n],
    )
    return float(moved.cost.double().mean())
