"""Cone form: approximate evidence of boxes in closed form, thesis (3.3) in 2D and (3.4)-(3.7) in 3D."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike
from gmmtorch.occupancy.cones import CUTOFF, Cones, WhitenedCones, cross, dot, length, outside_cone
from gmmtorch.occupancy.culling import Pairs, candidate_pairs, in_chunks
from gmmtorch.occupancy.forms.cone.projection import Planes, share_beyond_3d
from gmmtorch.occupancy.forms.cone.silhouette import facing, image, meets_disc, outline
from gmmtorch.occupancy.forms.flux.box_flux import checked_boxes
from gmmtorch.occupancy.forms.flux.box_mass import box_mass

CHUNK_PAIRS = 1 << 13
"""Pairs of a box and a cone evaluated in one pass; each takes about 10 kB."""

_QUARTER = 0.5 * math.pi


def cone_evidence(
    cones: Cones,
    low: ArrayLike,
    high: ArrayLike,
    pairs: Iterable[Pairs] | None = None,
    exact: bool = False,
    cutoff: float = CUTOFF,
) -> tuple[Tensor, Tensor]:
    """Hits (M,) and misses (M,) of boxes [low, high], (M, D) each, world metres.

    Hits are the mass of the components in the box (3.8). The number of rays that go through the silhouette
    of the box and end beyond its nearest point comes from (3.3) in 2D, and from the projection on the
    component's plane (3.4)-(3.7) in 3D. Misses are this number minus the hits, at least zero. Both
    approximations assume components far from the sensor, and in 3D thin components; `box_flux` has no such
    error.

    Args:
        cones: the components and their sensor origins.
        pairs: chunks of (box, cone) indices, (P,) each, of all pairs that can meet, each pair once. All
            boxes are tested with all cones if not given.
        exact: in 3D, compute the polygon's probability by Owen's T instead of the thesis's approximate error
            function. No effect in 2D.
        cutoff: Mahalanobis distance beyond which a component gives no evidence.

    Raises:
        InvalidArgumentError: corners of another shape, not finite, or not low < high.
    """
    cones = cones.checked()
    low, high = checked_boxes(low, high, cones)
    white, counts = WhitenedCones.of(cones), cones.counts.double()
    planes = Planes.of(cones) if cones.dim == 3 else None
    hits, misses = (low.new_zeros(len(low)) for _ in range(2))
    if pairs is None:
        pairs = candidate_pairs(cones, low, high, cutoff)
    for box, cone in in_chunks(pairs, CHUNK_PAIRS):
        part, bottom, top = white.take(cone), low[box].T, high[box].T
        kept = _reached(part, bottom, top, cutoff).nonzero().squeeze(1)
        box, cone, part, bottom, top = box[kept], cone[kept], part.take(kept), bottom[:, kept], top[:, kept]
        mass = box_mass(part, bottom, top, cutoff).clamp_max(1)  # quadrature can exceed 1 by 1e-4
        bottom, top = bottom - part.origin, top - part.origin
        if planes is None:
            inside = ((bottom < 0) & (top > 0)).all(0)
            mean = part.apply(part.mean - part.origin)
            beyond = share_beyond_2d(_corners_2d(part, bottom, top), mean, inside, cutoff)
        else:
            beyond = share_beyond_3d(planes.take(cone), bottom, top, exact, cutoff)
        misses = misses.index_add(0, box, (beyond - mass).clamp_min(0) * counts[cone])
        hits = hits.index_add(0, box, torch.where(cones.max_range[cone], 0.0, mass * counts[cone]))
    return hits, misses


def _corners_2d(white: WhitenedCones, low: Tensor, high: Tensor) -> Tensor:
    """Whitened corners (4, 2, P) of cells [low, high], (2, P) each, in cyclic order."""
    (x1, y1), (x2, y2) = low, high
    corners = ((x1, y1), (x2, y1), (x2, y2), (x1, y2))
    return torch.stack([white.apply(torch.stack(corner)) for corner in corners])


def _reached(white: WhitenedCones, low: Tensor, high: Tensor, cutoff: float) -> Tensor:
    """Whether each box (P,) can have evidence: whether its outline meets the cone's cross-section."""
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
    return near & (inside | (distance <= cutoff) | meets_disc(*image(turned), tangent))


def share_beyond_2d(corners: Tensor, mean: Tensor, inside: Tensor, cutoff: float) -> Tensor:
    """Share E (P,) of a component's rays that go through a cell's angles and end beyond its nearest point
    (3.3).

    Rays that end in the cell are included. In the whitened frame, seen from the sensor origin, the mean is at
    distance p, the cell starts at distance r' and lies between the angles θ₁ < θ₂ from the mean, limited to
    ±90°:

        E = ¼ (1 − erf((r' − p)/√2)) (erf(p sin θ₂/√2) − erf(p sin θ₁/√2))

    (3.3) replaces circles around the sensor origin by straight lines, so it is accurate at long range: the
    error of E is up to 0.13 at p = 2, 0.05 at p = 5 and 0.005 at p = 50.

    Args:
        corners: W(q − s) of the cells' corners in cyclic order, (4, 2, P).
        mean: W(μ − s), (2, P).
        inside: cells (P,) that contain the sensor origin: all rays leave them.
        cutoff: E is 0 farther than this (Mahalanobis) beside the mean direction or beyond the mean.
    """
    distance = length(mean)
    # Angles relative to the middle of the cell do not wrap around, because the cell is convex.
    middle = corners.mean(0)
    direction = _angle(mean, middle)
    spread = _angle(middle, corners)
    first = (direction + spread.amin(0)).clamp(-_QUARTER, _QUARTER)
    last = (direction + spread.amax(0)).clamp(-_QUARTER, _QUARTER)
    first, last = torch.where(inside, -_QUARTER, first), torch.where(inside, _QUARTER, last)
    nearest = torch.where(inside, 0.0, _distance_to(corners))
    sideways = _erf((distance * last.sin()).clamp(-cutoff, cutoff)) - _erf(
        (distance * first.sin()).clamp(-cutoff, cutoff)
    )
    beyond = torch.special.erfc((nearest - distance) / math.sqrt(2))
    behind = nearest - distance > cutoff
    return torch.where(behind, 0.0, 0.25 * beyond * sideways)


def _erf(deviations: Tensor) -> Tensor:
    return torch.erf(deviations / math.sqrt(2))


def _angle(a: Tensor, b: Tensor) -> Tensor:
    """Angle from a to b in (−π, π]: (…, 2, P) → (…, P)."""
    return torch.atan2(cross(a, b)[..., 0, :], dot(a, b))


def _distance_to(corners: Tensor) -> Tensor:
    """Distance (P,) from the sensor origin to a parallelogram that does not contain it."""
    edges = corners.roll(-1, 0) - corners
    share = -dot(corners, edges) / dot(edges, edges).clamp_min(1e-300)
    return length(corners + share.clamp(0, 1)[:, None] * edges).amin(0)
