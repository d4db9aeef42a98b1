"""The thesis's closed forms of evidence, of boxes of any size and place: (3.3) in 2D, (3.4-3.7) in 3D."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from gmmtorch.occupancy.cones import CUTOFF, Cones
from gmmtorch.occupancy.forms.cone import cone_2d, projection
from gmmtorch.occupancy.forms.cone.box_mass import box_mass
from gmmtorch.occupancy.forms.cone.mahalanobis import length, outside_cone
from gmmtorch.occupancy.forms.cone.projection import Planes
from gmmtorch.occupancy.forms.cone.silhouette import facing, image, meets_disc, outline
from gmmtorch.occupancy.forms.flux.box_flux import check_boxes
from gmmtorch.occupancy.index.culling import Pairs, Whitened, candidate_pairs, in_chunks

CHUNK_PAIRS = 1 << 13
"""Pairs of a box and a cone worked on at once: some 10 kB each."""


def cone_evidence(
    cones: Cones,
    low: Tensor,
    high: Tensor,
    pairs: Iterable[Pairs] | None = None,
    exact: bool = False,
    cutoff: float = CUTOFF,
) -> tuple[Tensor, Tensor]:
    """hits (M,), misses (M,) of boxes [low, high] (m, world), (M, D) each, as the thesis has them.

    Hits are the components' mass in the box (3.8). The rays that reach the box's nearest point within
    the angles that it is seen under come from (3.3) in 2D and from the projection on the component's
    plane (3.4-3.7) in 3D; less those that end in the box they are the misses, never below zero. Both are
    approximations for components that are far away, and in 3D thin; `flux.box_flux` has no such error.

    Args:
        cones: the components and whence they were seen.
        pairs: chunks of (box, cone) indices, (P,) each, no pair twice: those that can meet. Every box is
            tried with every cone if not given.
        exact: in 3D, the polygon's probability by Owen's T instead of the thesis's approximation. In 2D
            (3.3) needs no such approximation, and this changes nothing.
        cutoff: deviations beyond which a component ends: evidence outside is exactly 0.

    Raises:
        InvalidArgumentError: corners of another shape, not finite, or not low < high.
    """
    check_boxes(low, high, cones.dim)
    low, high = low.double(), high.double()
    white, counts = Whitened.of(cones), cones.counts.double()
    planes = Planes.of(cones) if cones.dim == 3 else None
    hits, misses = (low.new_zeros(len(low)) for _ in range(2))
    if pairs is None:
        pairs = candidate_pairs(cones, low, high, cutoff)
    for box, cone in in_chunks(pairs, CHUNK_PAIRS):
        part, bottom, top = white.take(cone), low[box].T, high[box].T
        kept = _reached(part, bottom, top, cutoff).nonzero().squeeze(1)
        box, cone, part, bottom, top = box[kept], cone[kept], part.take(kept), bottom[:, kept], top[:, kept]
        mass = box_mass(part, bottom, top, cutoff).clamp_max(1)  # which quadrature can exceed by 1e-4
        bottom, top = bottom - part.origin, top - part.origin
        if planes is None:
            inside = ((bottom < 0) & (top > 0)).all(0)
            mean = part.apply(part.mean - part.origin)
            beyond = cone_2d.share_beyond(_corners_2d(part, bottom, top), mean, inside, cutoff)
        else:
            beyond = projection.share_beyond(planes.take(cone), bottom, top, exact, cutoff)
        misses = misses.index_add(0, box, (beyond - mass).clamp_min(0) * counts[cone])
        hits = hits.index_add(0, box, torch.where(cones.max_range[cone], 0.0, mass * counts[cone]))
    return hits, misses


def _corners_2d(white: Whitened, low: Tensor, high: Tensor) -> Tensor:
    """Whitened corners (4, 2, P) of cells (2, P), in cyclic order."""
    (x1, y1), (x2, y2) = low, high
    corners = ((x1, y1), (x2, y1), (x2, y2), (x1, y2))
    return torch.stack([white.apply(torch.stack(corner)) for corner in corners])


def _reached(white: Whitened, low: Tensor, high: Tensor, cutoff: float) -> Tensor:
    """Boxes (P,) in which their cones can have evidence: those whose outline the cone's section meets."""
    center, side = 0.5 * (low + high), high - low
    ray, offset = white.apply(center - white.origin), white.apply(center - white.mean)
    near = ~outside_cone(ray, offset, white.matrix.transpose(0, 1) * side[:, None], cutoff)
    if len(low) == 2:
        return near
    mean = ray - offset
    distance = length(mean)
    corners, inside = outline(low - white.origin, high - white.origin)
    frame = facing(mean / distance.clamp_min(1e-300))
    turned = (frame[None] * torch.stack([white.apply(c) for c in corners])[:, None]).sum(2)
    tangent = cutoff / (distance**2 - cutoff**2).clamp_min(1e-300).sqrt()
    return near & (inside | (distance <= cutoff) | meets_disc(image(turned), tangent))
