"""Cones for tests of the flux form, and the evidence of a box by counted rays."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.linalg import safe_cholesky
from gmmtorch.occupancy.cones import Cones


def uniform(generator: torch.Generator, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
    return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)


def normal(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def random_covariances(generator: torch.Generator, deviations: Tensor) -> Tensor:
    """Covariances (C, D, D) of standard deviations (C, D) along random axes."""
    axes = torch.linalg.qr(normal(generator, *deviations.shape, deviations.shape[1]))[0]
    covariance = axes @ torch.diag_embed(deviations**2) @ axes.mT
    return 0.5 * (covariance + covariance.mT)


def one_each(means: Tensor, covariances: Tensor, origins: Tensor) -> Cones:
    """Cones of a single ray each."""
    ones = torch.ones(len(means), dtype=torch.float64)
    return Cones(means, covariances, origins, ones, torch.zeros(len(means), dtype=torch.bool))


def only(cones: Cones, index: int) -> Cones:
    return Cones(*(part[index : index + 1] for part in cones))


def draw_ends(cones: Cones, n: int) -> Tensor:
    """Ends (n, D) of the rays of one cone: scrambled Sobol points."""
    engine = torch.quasirandom.SobolEngine(cones.dim, scramble=True, seed=1)
    z = torch.special.ndtri(engine.draw(n, dtype=torch.float64).clamp(0, 1 - 2.0**-30) + 2.0**-31)
    return cones.means[0] + z @ safe_cholesky(cones.covariances[0]).T


def count_rays(cones: Cones, low: Tensor, high: Tensor, n: int = 1 << 17) -> tuple[float, float]:
    """hits, misses of a box per ray of one cone, by testing each of `n` segments against it."""
    ends = draw_ends(cones, n)
    a, b = (
        (low - cones.origins[0]) / (ends - cones.origins[0]),
        (high - cones.origins[0]) / (ends - cones.origins[0]),
    )
    enter, leave = torch.minimum(a, b).amax(1).clamp_min(0), torch.maximum(a, b).amin(1)
    hits = ((ends > low) & (ends < high)).all(1)
    return float(hits.double().mean()), float(((enter < leave) & (leave < 1)).double().mean())
