"""Monte Carlo form: rays sampled from Gaussian components, to be cast through a grid (thesis 3.2.3)."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_choice
from gmmtorch.linalg import safe_cholesky
from gmmtorch.occupancy.cones import Cones

Sampling = Literal["sobol", "stratified", "plain"]
SAMPLINGS: tuple[str, ...] = get_args(Sampling)


class RayBundle(NamedTuple):
    """Sampled rays: origins (R, D), ends (R, D), weights (R,), is_hit (R,)."""

    origins: Tensor
    ends: Tensor
    weights: Tensor
    is_hit: Tensor


def allocate_samples(counts: Tensor, n_samples: int) -> Tensor:
    """Number of samples (C,) of each cone: proportional to its count, at least 1 if the count is above 0."""
    share = counts.double() * (n_samples / counts.double().sum().clamp_min(1e-300))
    return torch.where(counts > 0, share.round().clamp_min(1), 0.0).long()


def sample_rays(
    cones: Cones, n_samples: int, generator: torch.Generator | None = None, sampling: Sampling = "sobol"
) -> RayBundle:
    """Rays from the sensor origins to points sampled from the components.

    A ray of a cone with count N and n samples has the weight N/n, so that the expected evidence does not
    depend on the number of samples.

    Args:
        cones: the components and their sensor origins.
        n_samples: approximate total number of rays; it is rounded for each cone, to at least one.
        generator: seeded source of randomness, on the CPU; seed 0 if not given.
        sampling: `stratified` and `sobol` give each cone samples in proportion to its count, `plain` draws
            the cone of each sample at random. `sobol` maps scrambled Sobol points through the normal
            quantile function, the others draw independent normals.

    Raises:
        InvalidArgumentError: fewer than one sample, or an unknown kind of sampling.
    """
    check_choice("sampling", sampling, SAMPLINGS)
    if n_samples < 1:
        raise InvalidArgumentError(f"n_samples={n_samples} must be at least 1.")
    cones = cones.checked()
    device, dim = cones.means.device, cones.dim
    generator = generator or torch.Generator().manual_seed(0)
    if not bool((cones.counts > 0).any()):
        cone, weights = torch.empty(0, dtype=torch.int64, device=device), cones.counts.double()[:0]
    elif sampling == "plain":
        total = cones.counts.double().sum()
        cone = torch.multinomial(cones.counts.double().cpu(), n_samples, True, generator=generator).to(device)
        weights = (total / n_samples).expand(n_samples)
    else:
        per_cone = allocate_samples(cones.counts, n_samples)
        cone = torch.repeat_interleave(per_cone)
        weights = (cones.counts.double() / per_cone.clamp_min(1))[cone]
    normals = _standard_normals(cone.shape[0], dim, generator, sampling).to(device)
    factors = safe_cholesky(cones.covariances.double())
    ends = cones.means.double()[cone] + (factors[cone] @ normals[:, :, None]).squeeze(-1)
    return RayBundle(cones.origins.double()[cone], ends, weights, ~cones.max_range[cone])


def _standard_normals(n: int, dim: int, generator: torch.Generator | None, sampling: str) -> Tensor:
    """(n, dim) standard normal draws, float64, on the CPU."""
    if sampling != "sobol":
        return torch.randn(n, dim, dtype=torch.float64, generator=generator)
    seed = int(torch.randint(2**31 - 1, (), generator=generator))
    engine = torch.quasirandom.SobolEngine(dim, scramble=True, seed=seed)
    uniform = engine.draw(n, dtype=torch.float64) if n else torch.empty(0, dim, dtype=torch.float64)
    # The engine has 30 bits: move its points to the middle of their intervals, so that none is 0 or 1.
    return torch.special.ndtri(uniform.clamp(0, 1 - 2.0**-30) + 2.0**-31)
