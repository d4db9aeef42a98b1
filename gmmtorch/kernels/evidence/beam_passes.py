"""Beams of one sensor that pass through components, and that end on them, for forgetting.

The fused kernel handles one component in one item, and keeps no list of pairs.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.chunks import chunk_elements, chunked
from gmmtorch.kernels.compiler import templated


class PassLimits(NamedTuple):
    """When a beam meets a component, and then passes through it or ends on it; distances in its deviations.

    through: the line of a beam that meets the component comes nearer to its mean than this.
    reach: the component ends at this distance. A beam that passes enters it after the sensor and leaves it
        at least `margin` metres before the beam's own end.
    grazing: a beam that passes has a deviation along it of at most this many times the smallest one.
    explained: squared distance of a return that is on the component.
    """

    through: float
    reach: float
    margin: float
    grazing: float
    explained: float


_KERNELS = templated("evidence/beam_passes.h", "beam_passes", (2, 3))


def beam_passes(
    whitening: Tensor, offsets: Tensor, deviations: Tensor, beams: Tensor, is_hit: Tensor, limits: PassLimits
) -> tuple[Tensor, Tensor]:
    """Number of beams (K,) that pass through each component, and number of returns (K,) on it, float64.

    Args:
        whitening: W (K, D, D) with WᵀW = Σ⁻¹. offsets: means less the sensor origin (K, D), metres.
        deviations: smallest and largest deviation of each component (K, 2), metres.
        beams: ends less the sensor origin (N, D), metres. is_hit: (N,) bool, False for no-return beams.
    """
    lengths = beams.norm(dim=1)
    directions = beams / lengths.clamp_min(torch.finfo(beams.dtype).tiny)[:, None]
    radii = deviations[:, 1] * max(limits.through, limits.explained**0.5) * (1 + 1e-9)
    given = whitening, offsets, radii, deviations[:, 0], directions, lengths, is_hit
    if not is_fused(*given):
        return _batched(whitening, offsets, deviations[:, 0], (directions, lengths, is_hit), limits)
    k, dim = offsets.shape
    passed, returned = (offsets.new_empty(k) for _ in range(2))
    numbers = limits._replace(through=limits.through**2)
    _KERNELS[dim](k, *given, len(beams), *numbers, passed, returned)
    return passed, returned


def _batched(
    whitening: Tensor,
    offsets: Tensor,
    thinnest: Tensor,
    beams: tuple[Tensor, Tensor, Tensor],
    limits: PassLimits,
) -> tuple[Tensor, Tensor]:
    """The twin."""
    directions, lengths, is_hit = beams

    def count(part: slice) -> Tensor:
        ray = torch.einsum("kij,nj->kni", whitening[part], directions)
        mean = torch.einsum("kij,kj->ki", whitening[part], offsets[part])[:, None]
        square = ray.square().sum(-1)
        nearest, spread = (ray * mean).sum(-1) / square, square.rsqrt()
        aside = (mean - nearest[..., None] * ray).square().sum(-1)
        meets = aside < limits.through**2
        returned = meets & is_hit & (aside + ((lengths - nearest) / spread).square() < limits.explained)
        passed = meets & (spread <= limits.grazing * thinnest[part, None])
        passed &= nearest > limits.reach * spread
        passed &= nearest + limits.reach * spread + limits.margin < lengths
        return torch.stack([passed.sum(1), returned.sum(1)]).double()

    size = max(1, chunk_elements(offsets.device) // max(1, len(lengths) * offsets.shape[1]))
    counts = [*chunked(len(offsets), size, count), offsets.new_zeros(2, 0)]
    passed, returned = torch.cat(counts, 1)
    return passed, returned
