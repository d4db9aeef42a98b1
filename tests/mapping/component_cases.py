"""Random components, and plain loops as references."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.mapping.components import Components


def random_components(
    k: int, dim: int, seed: int, n_origins: int = 5, spread: float = 3.0, empty: float = 0.0
) -> Components:
    """k components, some with several of `n_origins` origins; a share `empty` is flagged max_range."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    factors = 0.3 * normal(k, dim, dim)
    seen = torch.rand(k, n_origins, generator=generator) < 0.5
    seen[torch.arange(k), torch.randint(n_origins, (k,), generator=generator)] = True
    by, viewpoint = seen.nonzero(as_tuple=True)
    count = 1 + 50 * torch.rand(len(by), generator=generator, dtype=torch.float64)
    return Components(
        means=spread * normal(k, dim),
        covariances=factors @ factors.transpose(1, 2) + 1e-4 * torch.eye(dim, dtype=torch.float64),
        support=torch.zeros(k, dtype=torch.float64).index_add_(0, by, count),
        max_range=torch.rand(k, generator=generator) < empty,
        ids=torch.stack([torch.full((k,), 3), torch.arange(k)], 1),
        origins=2 * normal(n_origins, dim),
        seen_by=by,
        seen_from=viewpoint,
        seen_count=count,
    ).checked()


def total_moments(components: Components, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Support, mean and covariance of all components of some rows together, by a loop."""
    dim = components.dim
    weight = torch.zeros((), dtype=torch.float64)
    first, second = torch.zeros(dim, dtype=torch.float64), torch.zeros(dim, dim, dtype=torch.float64)
    for k in rows.nonzero().squeeze(1).tolist():
        w, m, c = components.support[k], components.means[k], components.covariances[k]
        weight, first, second = weight + w, first + w * m, second + w * (c + torch.outer(m, m))
    mean = first / weight.clamp_min(1e-300)
    return weight, mean, second / weight.clamp_min(1e-300) - torch.outer(mean, mean)


def counts_add_up(components: Components) -> bool:
    total = torch.zeros(len(components), dtype=torch.float64)
    total.index_add_(0, components.seen_by, components.seen_count)
    return torch.allclose(total, components.support, rtol=1e-9)
