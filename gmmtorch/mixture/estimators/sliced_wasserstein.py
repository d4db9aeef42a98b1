"""Mixtures fitted by the sliced Wasserstein distance (Kolouri, Rohde & Hoffmann, 2018; thesis 2.1.5).

SW² of a cloud and a mixture is the mean, over directions, of W₂² between their projections on a line.
Directions are drawn once, and the points are sorted along each once. Adam then descends on batches of
directions; one iteration is a pass over all directions.

Along a direction θ the points have coordinates θᵀx, and a mixture is Σ_k w_k N(m_k, s_k²), m = θᵀμ
and s² = θᵀΣθ. The coordinates are summarised by J values u_1 ≤ … ≤ u_J at levels 0 = t_0 < … <
t_J = 1. The optimal map for W₂ sends the mixture's mass between its quantiles a_{j−1} and a_j to u_j.
With a convex potential Ψ, of slope u_j there, and its conjugate Ψ*,

    W₂² = E_mixture[x² − 2Ψ(x)] + E_data[u² − 2Ψ*(u)].

Because Ψ is piecewise linear, E_k[Ψ] is a sum of E_k[(x − a_j)₊], which is closed in Φ and φ. Any
ordered cuts a_j give a lower bound, and the quantiles give the largest, so an error in the quantiles has
a second-order effect. The derivatives by w, m and s are those at fixed Ψ: exact integrals over each
component, however narrow.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from gmmtorch.linalg import safe_cholesky
from gmmtorch.mixture.em.exact import SOFTMAX_DTYPES, Parameters
from gmmtorch.mixture.em.initialization import initialize
from gmmtorch.mixture.em.loop import OnIteration
from gmmtorch.mixture.estimator import ABOVE_ZERO, COUNT, Cloud, MixtureEstimator
from gmmtorch.mixture.validation import RandomState, as_generator

_BATCH = 16  # directions of one step of Adam
_STEPS = 8  # fewest steps of a pass; if there are few directions, a pass visits them repeatedly
_HALVINGS = 6  # halvings of the learning rate before the descent ends
_THINNEST = 1e-6  # least variance at the start and least deviation, for a cloud of spread 1
_MOMENTS = (0.9, 0.99)  # of Adam; short memory, because a pass has few steps
LEVELS = 256
"""J: number of values that summarise a cloud along a direction."""
_BLOCK_ELEMENTS = 1 << 21  # entries of one chunk of (directions, points) or (directions, J, K)
_NODES = (-2.0, -1.2, -0.6, 0.0, 0.6, 1.2, 2.0)  # points of each component, in standard deviations
_NEWTON_STEPS = 2


@dataclass(eq=False, repr=False)
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

    n_components: int = 1
    _: KW_ONLY
    n_projections: int = 256
    learning_rate: float = 0.1
    tol: float = 1e-3
    reg_covar: float = 1e-6
    max_iter: int = 200
    init_params: str = "kmeans"
    random_state: RandomState = None
    dtype: str = "float64"

    def _learn(self, cloud: Cloud, on_iteration: OnIteration | None) -> None:
        points, weight, center = cloud
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
    given = (value.detach().to(dtype) for value in (weights, along, deviations))
    cost, by_weight, by_mean, by_deviation = (value.double() for value in transport(slices, *given))
    shape.zero_grad()
    torch.autograd.backward([weights, along, deviations], [by_weight.mean(0), by_mean / n, by_deviation / n])
    return float(cost.mean())


class Slices(NamedTuple):
    """A cloud along P directions, summarised at J levels.

    directions: unit vectors (P, D). values: u (P, J), each the mean of the coordinates between two
    levels. levels: t_1 … t_{J−1} (J − 1,). power: E[u²] (P,).
    """

    directions: Tensor
    values: Tensor
    levels: Tensor
    power: Tensor

    def rows(self, index: Tensor | slice) -> Slices:
        """The slices of some directions."""
        return Slices(self.directions[index], self.values[index], self.levels, self.power[index])


def random_directions(n: int, dim: int, generator: torch.Generator) -> Tensor:
    """Unit vectors (n, D), uniform on the sphere. In 1D there is only one direction, up to its sign."""
    if dim == 1:
        return torch.ones(1, 1, dtype=torch.float64)
    normal = torch.randn(n, dim, generator=generator, dtype=torch.float64)
    return normal / normal.norm(dim=1, keepdim=True)


def slice_cloud(points: Tensor, weight: Tensor, directions: Tensor) -> Slices:
    """Points (N, D) with weights (N,) along directions (P, D).

    Levels are denser near 0 and 1, where coordinates spread more: t_j = (1 − cos(πj/J)) / 2.
    """
    step = torch.arange(LEVELS + 1, dtype=points.dtype, device=points.device)
    levels = 0.5 * (1 - torch.cos(math.pi / LEVELS * step))
    values = []
    for part in directions.split(max(1, _BLOCK_ELEMENTS // points.shape[0])):
        coordinates, order = (part @ points.T).sort(1)
        mass = weight[order]
        # Integral of the quantile function from 0 to t: linear between the points' own levels.
        reached = nn.functional.pad(mass.cumsum(1), (1, 0))
        integral = nn.functional.pad((mass * coordinates).cumsum(1), (1, 0))
        total = reached[:, -1:].clone()
        at_levels = interpolate(levels * total, reached, integral)
        values.append(at_levels.diff(dim=1) / (levels.diff() * total))
    gathered = torch.cat(values)
    return Slices(directions, gathered, levels[1:-1], (levels.diff() * gathered.square()).sum(1))


def interpolate(x: Tensor, knots: Tensor, heights: Tensor) -> Tensor:
    """Piecewise linear functions, one per row, at x (P, M), through increasing knots (P, R) and heights
    (P, R)."""
    index = torch.searchsorted(knots, x.contiguous(), right=True).clamp(1, knots.shape[1] - 1)
    x0, x1 = knots.gather(1, index - 1), knots.gather(1, index)
    y0, y1 = heights.gather(1, index - 1), heights.gather(1, index)
    share = ((x - x0) / (x1 - x0).clamp_min(torch.finfo(x.dtype).tiny)).clamp(0, 1)
    return y0 + share * (y1 - y0)


def mixture_quantiles(levels: Tensor, weights: Tensor, means: Tensor, deviations: Tensor) -> Tensor:
    """Approximate quantiles (P, M) at levels (M,) of 1-D mixtures: means, deviations (P, K), weights (K,).

    Newton's method within brackets on Φ⁻¹(F(a)) = Φ⁻¹(t), which is linear for one component. The start is
    a mixture of a few points in each component.
    """
    n = means.shape[0]
    nodes = means.new_tensor(_NODES)
    first = (means[:, :, None] + deviations[:, :, None] * nodes).flatten(1).sort(1)
    mass = (weights[:, None] / len(_NODES)).expand(-1, len(_NODES)).flatten()[first.indices]
    wanted = levels.expand(n, -1).contiguous()
    scores = torch.special.ndtri(wanted)
    cuts = interpolate(wanted, mass.cumsum(1) - 0.5 * mass, first.values)
    low = (means - 9 * deviations).amin(1, True).expand_as(cuts)
    high = (means + 9 * deviations).amax(1, True).expand_as(cuts)
    least = torch.finfo(means.dtype).eps
    for _ in range(_NEWTON_STEPS):
        z = (cuts[:, :, None] - means[:, None]) / deviations[:, None]
        below = torch.special.ndtr(z) @ weights
        density = (normal_density(z) @ (weights / deviations)[:, :, None]).squeeze(2)
        # The neighbouring cuts bound a quantile, and so does its own last position.
        index = torch.searchsorted(below, wanted)
        knots = torch.cat([low[:, :1], cuts, high[:, -1:]], 1)
        low = torch.maximum(low, knots.gather(1, index))
        high = torch.minimum(high, knots.gather(1, index + 1))
        score = torch.special.ndtri(below.clamp(least, 1 - least))
        newton = cuts + (scores - score) * normal_density(score) / density.clamp_min(1e-30)
        inside = (low <= newton) & (newton <= high)
        cuts = torch.where(inside, newton, 0.5 * (low + high)).cummax(1).values
    return cuts


def normal_density(z: Tensor) -> Tensor:
    return torch.exp(-0.5 * z.square()) / math.sqrt(2 * math.pi)


def transport(
    slices: Slices, weights: Tensor, means: Tensor, deviations: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Transport from 1-D mixtures, means and deviations (P, K), weights (K,), to the slices of a cloud.

    Returns W₂² (P,) along each direction, and its derivatives by w, m and s, each (P, K). Computed in the
    dtype of the mixtures, in chunks of directions.
    """
    rows = max(1, _BLOCK_ELEMENTS // (LEVELS * weights.shape[0]))
    if means.shape[0] > rows:
        chunks = (slice(begin, begin + rows) for begin in range(0, means.shape[0], rows))
        parts = [transport(slices.rows(part), weights, means[part], deviations[part]) for part in chunks]
        cost, by_weight, by_mean, by_deviation = (torch.cat(values) for values in zip(*parts, strict=True))
        return cost, by_weight, by_mean, by_deviation
    slices = Slices(*(value.to(means.dtype) for value in slices))
    cuts = mixture_quantiles(slices.levels, weights, means, deviations)
    z = (cuts[:, :, None] - means[:, None]) / deviations[:, None]
    above, density = torch.special.ndtr(-z), normal_density(z)
    rise = slices.values.diff(dim=1)
    first = slices.values[:, :1]

    def summed(over_cuts: Tensor) -> Tensor:
        return (rise[:, None] @ over_cuts).squeeze(1)

    mapped = first + summed(above)  # E_k of the target of x
    stretched = summed(density)  # E_k[z · target of x]
    potential = first * means + deviations * summed(density - z * above)
    by_weight = means.square() + deviations.square() - 2 * potential
    conjugate = (rise * cuts * (1 - slices.levels)).sum(1)
    cost = by_weight @ weights + slices.power - 2 * conjugate
    return cost, by_weight, 2 * weights * (means - mapped), 2 * weights * (deviations - stretched)
