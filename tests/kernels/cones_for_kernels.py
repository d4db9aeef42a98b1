"""Cones of ordinary and of extreme shapes."""

from __future__ import annotations

import torch

from gmmtorch.occupancy.cones import Cones


def cones_of(dim: int, kind: str, n: int = 60, thin: float = 1e-6) -> Cones:
    generator = torch.Generator().manual_seed(dim)
    means = 4 * torch.randn(n, dim, generator=generator, dtype=torch.float64)
    roots = 0.3 * torch.randn(n, dim, dim, generator=generator, dtype=torch.float64)
    covariances = roots @ roots.mT + 1e-6 * torch.eye(dim)
    origins = torch.randn(n, dim, generator=generator, dtype=torch.float64)
    if kind == "flat":  # `thin` metres thick, or a needle
        scale = torch.ones(n, dim, dtype=torch.float64)
        scale[::2, 0] = thin
        scale[::4, 1] = thin
        axes = torch.linalg.qr(roots)[0]
        covariances = axes @ torch.diag_embed(scale**2) @ axes.mT
        covariances = 0.5 * (covariances + covariances.mT)
    if kind == "around":  # the component holds its sensor origin; some origins are the mean
        origins = means + 0.1 * origins
        origins[::3] = means[::3]
    counts = torch.logspace(-2, 6, n, dtype=torch.float64)
    return Cones(means, covariances, origins, counts, torch.arange(n) % 5 == 0)
