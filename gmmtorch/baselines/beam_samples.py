"""Labelled points of beams, which regressors learn from: ends are hits, points on the way are free."""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.baselines.thinned_samples import centroids, check_length
from gmmtorch.errors import MemoryLimitError
from gmmtorch.scan import Scan

_MAX_SAMPLES = 1 << 27


def beam_samples(
    scan: Scan,
    spacing: float,
    *,
    gap: float = 0.0,
    thin: float | None = None,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor]:
    """Points (S, D), float64, of the beams of a scan, and which of them (S,) are hits; hits come first.

    The part of each beam that is free (all of it, but for the last `gap` of one that returned) is cut
    into equal pieces no longer than `spacing`, and has one free point in each: uniform in its piece, as
    Ramos & Ott 2016 and Senanayake & Ramos 2017 draw them along a beam, or in its middle without a
    generator. A beam without return gives free points only. A beam of no length gives none.

    Args:
        scan: world frame.
        spacing: of the free points of one beam (m); infinite for one a beam.
        gap: distance (m) before a hit that has no free points.
        thin: if given, ends in one cube of this side (m) are first taken together, as their mean.
        generator: on the CPU.

    Raises `InvalidArgumentError` for lengths that are none, `MemoryLimitError` for too many points.
    """
    spacing = spacing if spacing == float("inf") else check_length("spacing", spacing)
    gap = gap if gap == 0 else check_length("gap", gap)
    origin, hits, empty = scan.origin.double(), scan.points.double(), scan.no_return.double()
    if thin is not None:
        thin = check_length("thin", thin)
        hits, empty = centroids(hits, thin), centroids(empty, thin)
    ways = torch.cat([hits, empty]) - origin
    length = ways.norm(dim=1)
    free_length = length.clone()
    free_length[: hits.shape[0]] -= gap
    pieces = torch.where(free_length > 0, (free_length / spacing).ceil().clamp_min(1), 0)
    if float(pieces.sum()) > _MAX_SAMPLES:
        raise MemoryLimitError(
            f"spacing={spacing} m makes {int(pieces.sum()):,} free points of one scan, above the limit of "
            f"{_MAX_SAMPLES:,}; take a wider one."
        )
    pieces = pieces.long()
    beam = torch.repeat_interleave(pieces)
    piece = torch.arange(beam.shape[0], device=beam.device) - (pieces.cumsum(0) - pieces)[beam]
    within = torch.full((beam.shape[0],), 0.5, dtype=torch.float64)
    if generator is not None:
        within = torch.rand(beam.shape[0], generator=generator, dtype=torch.float64)
    share = (piece + within.to(beam.device)) / pieces[beam] * (free_length / length)[beam]
    free = origin + ways[beam] * share[:, None]
    is_hit = torch.zeros(hits.shape[0] + free.shape[0], dtype=torch.bool, device=free.device)
    is_hit[: hits.shape[0]] = True
    return torch.cat([hits, free]), is_hit
