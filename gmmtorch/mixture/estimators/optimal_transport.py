"""Optimal transport along lines, from one-dimensional mixtures to the coordinates of a cloud.

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
from typing import NamedTuple

import torch
from torch import Tensor, nn

LEVELS = 256
"""J: number of values that summarise a cloud along a direction."""

_BLOCK_ELEMENTS = 1 << 21  # entries of one chunk of (directions, points) or (directions, J, K)
_NODES = (-2.0, -1.2, -0.6, 0.0, 0.6, 1.2, 2.0)  # points of each component, in standard deviations
_NEWTON_STEPS = 2


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

    def to(self, dtype: torch.dtype) -> Slices:
        return Slices(*(value.to(dtype) for value in self))


class Transport(NamedTuple):
    """W₂² (P,) along each direction, and its derivatives by w, m and s, each (P, K)."""

    cost: Tensor
    by_weight: Tensor
    by_mean: Tensor
    by_deviation: Tensor


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
    (P, R).
    """
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


def transport(slices: Slices, weights: Tensor, means: Tensor, deviations: Tensor) -> Transport:
    """Transport from 1-D mixtures, means and deviations (P, K), weights (K,), to the slices of a cloud.

    Computed in the dtype of the mixtures, in chunks of directions.
    """
    rows = max(1, _BLOCK_ELEMENTS // (LEVELS * weights.shape[0]))
    parts = [
        _transport(slices.rows(slice(begin, begin + rows)).to(means.dtype), weights, m, s)
        for begin, m, s in zip(
            range(0, means.shape[0], rows), means.split(rows), deviations.split(rows), strict=True
        )
    ]
    return Transport(*(torch.cat(values) for values in zip(*parts, strict=True)))


def _transport(slices: Slices, weights: Tensor, means: Tensor, deviations: Tensor) -> Transport:
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
    return Transport(
        by_weight @ weights + slices.power - 2 * conjugate,
        by_weight,
        2 * weights * (means - mapped),
        2 * weights * (deviations - stretched),
    )
