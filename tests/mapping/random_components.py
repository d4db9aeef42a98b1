"""Random components of any shape, size and position, for tests of codecs and messages."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.mapping.components import Components


def rotations(k: int, dim: int, generator: torch.Generator) -> Tensor:
    """Uniform rotations (K, D, D)."""
    q, r = torch.linalg.qr(torch.randn(k, dim, dim, generator=generator, dtype=torch.float64))
    return q * r.diagonal(dim1=1, dim2=2).sign()[:, None, :]


def random_components(
    dim: int,
    k: int = 40,
    seed: int = 0,
    center: float = 0.0,
    extent: float = 20.0,
    deviations: tuple[float, float] = (5e-3, 1.0),
    counts: tuple[float, float] = (1.0, 1e4),
    n_origins: int = 7,
    max_sightings: int = 3,
    robot: int = 0,
) -> Components:
    """K randomly rotated components with log-uniform deviations and counts; some are flagged max_range."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    def log_uniform(limits: tuple[float, float], *shape: int) -> Tensor:
        low, high = torch.tensor(limits, dtype=torch.float64).log()
        return torch.exp(low + (high - low) * uniform(*shape))

    turn = rotations(k, dim, generator)
    variances = log_uniform(deviations, k, dim) ** 2
    covariances = turn @ torch.diag_embed(variances) @ turn.transpose(1, 2)
    support = log_uniform(counts, k)
    n_each = torch.randint(1, max_sightings + 1, (k,), generator=generator)
    seen_by = torch.repeat_interleave(n_each)
    shuffled = torch.rand(k, n_origins, generator=generator).argsort(1)
    seen_from = shuffled[torch.arange(n_origins) < n_each[:, None]]
    weight = 0.05 + uniform(len(seen_by))
    total = torch.zeros(k, dtype=torch.float64).index_add_(0, seen_by, weight)
    return Components(
        means=center + extent * (uniform(k, dim) - 0.5),
        covariances=(covariances + covariances.transpose(1, 2)) / 2,
        support=support,
        max_range=uniform(k) < 0.2,
        ids=torch.stack([torch.full((k,), robot), torch.arange(k)], 1),
        origins=center + extent * (uniform(n_origins, dim) - 0.5),
        seen_by=seen_by,
        seen_from=seen_from,
        seen_count=weight * (support / total)[seen_by],
    )
