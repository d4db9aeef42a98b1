"""Cones for tests of evidence, and the evidence of a box by counted rays."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gmmtorch.kernels import pair_evidence
from gmmtorch.linalg import safe_cholesky
from gmmtorch.occupancy import Cones, PointEvidence, PointForm


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


def joined(*parts: Cones) -> Cones:
    return Cones(*(torch.cat(fields) for fields in zip(*parts, strict=True)))


def moved(cones: Cones, *shift: float) -> Cones:
    """The cones elsewhere; the shift is zero along axes that it does not state."""
    step = torch.tensor([*shift, 0.0, 0.0][: cones.dim], dtype=torch.float64)
    return cones._replace(means=cones.means + step, origins=cones.origins + step)


def every_pair(form: PointForm, points: Tensor) -> PointEvidence:
    """Every cone at every point, without any list or test of nearness."""
    point, cone = torch.cartesian_prod(torch.arange(len(points)), torch.arange(len(form.rows))).unbind(1)
    shares = pair_evidence(points.T[:, None], point, *form._table, cone, form.resolution, form.cutoff)
    return PointEvidence(*(share.view(len(points), -1).sum(1) for share in shares))


def draw_ends(cones: Cones, n: int) -> Tensor:
    """Ends (n, D) of the rays of one cone: scrambled Sobol points."""
    engine = torch.quasirandom.SobolEngine(cones.dim, scramble=True, seed=1)
    z = torch.special.ndtri(engine.draw(n, dtype=torch.float64).clamp(0, 1 - 2.0**-30) + 2.0**-31)
    return cones.means[0] + z @ safe_cholesky(cones.covariances[0]).T


def count_rays(cones: Cones, low: Tensor, high: Tensor, n: int = 1 << 17) -> tuple[float, float]:
    """hits, misses of a box per ray of one cone, by testing each of `n` segments against it."""
    ends = draw_ends(cones, n)
    a, b = ((corner - cones.origins[0]) / (ends - cones.origins[0]) for corner in (low, high))
    enter, leave = torch.minimum(a, b).amax(1).clamp_min(0), torch.maximum(a, b).amin(1)
    hits = ((ends > low) & (ends < high)).all(1)
    return float(hits.double().mean()), float(((enter < leave) & (leave < 1)).double().mean())


def one_cone(
    mean: Sequence[float],
    covariance: Sequence,
    origin: Sequence[float] | None = None,
    count: float = 1.0,
    max_range: bool = False,
) -> Cones:
    """One cone, seen from the world's origin if not stated; `covariance` can be variances along the axes."""
    spread = torch.as_tensor(covariance, dtype=torch.float64)
    spread = torch.diag(spread) if spread.ndim == 1 else spread
    at = torch.as_tensor(mean, dtype=torch.float64)
    seen_from = torch.zeros_like(at) if origin is None else torch.as_tensor(origin, dtype=torch.float64)
    counts = torch.tensor([count], dtype=torch.float64)
    return Cones(at[None], spread[None], seen_from[None], counts, torch.tensor([max_range]))


def random_cones(dim: int, n: int, seed: int, room: bool = False) -> Cones:
    """n cones: means and sensors some metres apart, deviations from 2 mm to 0.6 m, some at maximum range.

    `room`: as of a room of 6 m, with deviations from 1 to 10 cm.
    """
    generator = torch.Generator().manual_seed(seed)
    axes = torch.linalg.qr(normal(generator, n, dim, dim))[0]
    share = uniform(generator, n, dim)
    deviations = 0.01 * 10**share if room else 0.002 * 300**share
    return Cones(
        means=6 * uniform(generator, n, dim),
        covariances=(axes * deviations[:, None] ** 2) @ axes.transpose(1, 2),
        origins=(2 + 2 * uniform(generator, n, dim)) if room else 6 * uniform(generator, n, dim),
        counts=1 + 500 * uniform(generator, n),
        max_range=uniform(generator, n) < 0.2,
    )


def tiled(cones: Cones, copies: int, step: float) -> Cones:
    """Copies side by side along the first axis, `step` (m) apart."""
    shift = torch.zeros(copies, 1, cones.dim, dtype=torch.float64)
    shift[:, 0, 0] = step * torch.arange(copies)
    return Cones(
        (cones.means + shift).flatten(0, 1),
        cones.covariances.repeat(copies, 1, 1),
        (cones.origins + shift).flatten(0, 1),
        cones.counts.repeat(copies),
        cones.max_range.repeat(copies),
    )
