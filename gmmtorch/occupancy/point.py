"""Evidence at single points, as of a cube around each: closed forms, no grid, no sampling."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.occupancy.cones import CUTOFF, Cones, whitening
from gmmtorch.occupancy.radial import flux_density


class PointEvidence(NamedTuple):
    """hits (M,), misses (M,): expected rays that end in, and that pass through, the cube at each point."""

    hits: Tensor
    misses: Tensor


def point_evidence(
    cones: Cones, points: Tensor, resolution: float, cutoff: float = CUTOFF, chunk_pairs: int = 1 << 20
) -> PointEvidence:
    """Evidence of the cube of side h = `resolution` (m) centred at each point (M, D).

    hits = h^D Σ N_k N(x | μ_k, Σ_k + h²/12 I), misses = h^{D−1} Σ N_k F_k(x), F the rays that pass
    through a unit area facing them (`radial.flux_density`); nothing beyond `cutoff` deviations.
    """
    dim = cones.dim
    eye = torch.eye(dim, dtype=torch.float64, device=points.device)
    smoothed = cones.covariances.double() + resolution**2 / 12 * eye
    inverse, log_norm = whitening(smoothed)
    hits, misses = [], []
    for part in points.double().split(max(1, chunk_pairs // max(1, len(cones.counts)))):
        offset = part[:, None] - cones.means.double()
        ray = part[:, None] - cones.origins.double()
        white = torch.einsum("cij,mcj->mci", inverse, offset)
        white_ray = torch.einsum("cij,mcj->mci", inverse, ray)
        distance = ray.norm(dim=-1).clamp_min(1e-9)
        length = white_ray.norm(dim=-1, keepdim=True)
        white_ray = torch.where(length > 1e-12, white_ray, 1e-12)
        squared = (white * white).sum(-1)
        density = torch.exp(-0.5 * squared - log_norm) * (squared < cutoff**2)
        flux = flux_density(white_ray, white, log_norm) * distance
        along = (white * white_ray).sum(-1) / white_ray.norm(dim=-1)
        seen = (squared - along * along < cutoff**2) & (along < cutoff)
        surface = cones.counts * ~cones.max_range
        hits.append(density @ surface * resolution**dim)
        through = (flux * seen * resolution ** (dim - 1)).clamp_max(1.0)
        misses.append(through @ cones.counts)
    return PointEvidence(torch.cat(hits), torch.cat(misses))
