"""Cones for tests of evidence."""

import torch

from gmmtorch.occupancy.cones import Cones


def random_cones(dim: int, n: int, seed: int, room: bool = False) -> Cones:
    """n cones: means and sensors some metres apart, deviations from 2 mm to 0.6 m, some at maximum range.

    `room`: as of a room of 6 m, with deviations from 1 to 10 cm.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    axes = torch.linalg.qr(torch.randn(n, dim, dim, generator=generator, dtype=torch.float64))[0]
    deviations = 0.01 * 10 ** uniform(n, dim) if room else 0.002 * 300 ** uniform(n, dim)
    return Cones(
        means=6 * uniform(n, dim),
        covariances=(axes * deviations[:, None] ** 2) @ axes.transpose(1, 2),
        origins=(2 + 2 * uniform(n, dim)) if room else 6 * uniform(n, dim),
        counts=1 + 500 * uniform(n),
        max_range=uniform(n) < 0.2,
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
