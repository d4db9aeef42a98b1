"""Silhouettes: the outline of a box seen from a point, and its perspective image on a plane."""

from __future__ import annotations

import functools
import itertools

import torch
from torch import Tensor

_TOUCHING = 1e-6  # relative to a side: distance at which a viewpoint on a face is placed from it
_GRAZING = 1e-9  # directions with a smaller cosine to the normal count as parallel to the plane


def outline(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Corners (6, 3, P) of each box's outline in cyclic order, and whether the viewpoint is in the box (P,).

    One, two or three faces of a box are visible. The outline has four or six corners; the last one is
    repeated.

    Args:
        low, high: (3, P) corners of the boxes relative to the viewpoint. A viewpoint on a face is outside.
    """
    touching = _TOUCHING * (high - low)
    low = torch.where(low >= 0, torch.maximum(low, touching), low)
    high = torch.where(high <= 0, torch.minimum(high, -touching), high)
    side = (low <= 0).long() + (high < 0).long()  # viewpoint below, within or above the box: 0, 1, 2
    code = 9 * side[0] + 3 * side[1] + side[2]
    vertex = _outlines(low.device)[code].T  # (6, P)
    corners = torch.stack(
        [torch.where(vertex >> axis & 1 == 1, high[axis], low[axis]) for axis in range(3)], 1
    )
    return corners, code == 13


def image(corners: Tensor) -> tuple[Tensor, Tensor]:
    """Perspective image of convex outlines on the plane at depth 1, clipped to positive depth.

    Returns the starts and the ends (n + 1, 2, P) of its edges. An edge can have zero length.

    Args:
        corners: (n, 3, P) of the outlines relative to the viewpoint; the last coordinate is the depth.
    """
    rays = corners / corners.norm(dim=1, keepdim=True).clamp_min(1e-300)
    following = rays.roll(-1, 0)
    depth, next_depth = rays[:, 2], following[:, 2]
    seen, next_seen = depth > _GRAZING, next_depth > _GRAZING
    change = torch.where(seen == next_seen, 1.0, next_depth - depth)
    crossing = rays + ((_GRAZING - depth) / change)[:, None] * (following - rays)
    starts = torch.where(seen[:, None], rays, crossing)
    ends = torch.where(next_seen[:, None], following, crossing)
    shown = (seen | next_seen)[:, None]
    # Clipping leaves a gap at the horizon: close it by an edge between the two clipped ends.
    leaving, returning = ((a & ~b)[:, None] for a, b in ((seen, next_seen), (next_seen, seen)))
    gap_start, gap_end = ((crossing * which).sum(0)[None] for which in (leaving, returning))
    cut = leaving.any(0)[None]
    points = []
    for parts, gap in ((starts, gap_start), (ends, gap_end)):
        flat = parts[:, :2] / parts[:, 2:].clamp_min(_GRAZING)
        gap = gap[:, :2] / gap[:, 2:].clamp_min(_GRAZING)
        points.append(torch.cat([torch.where(shown, flat, 0.0), torch.where(cut, gap, 0.0)]))
    return points[0], points[1]


def meets_disc(starts: Tensor, ends: Tensor, radius: Tensor) -> Tensor:
    """Whether each polygon (P,), with edges (E, 2, P), meets the disc of `radius` (P,) around the origin."""
    step = ends - starts
    share = -(starts * step).sum(1) / (step * step).sum(1).clamp_min(1e-300)
    nearest = (starts + share.clamp(0, 1)[:, None] * step).norm(dim=1)
    drawn = (step != 0).any(1)
    turned = torch.atan2(starts[:, 0] * ends[:, 1] - starts[:, 1] * ends[:, 0], (starts * ends).sum(1))
    around = torch.where(drawn, turned, 0.0).sum(0).abs() > 3  # the sum is 2π around the origin, else 0
    return around | (drawn & (nearest < radius)).any(0)


def facing(direction: Tensor) -> Tensor:
    """Rotations (3, 3, P) whose third row is a unit direction (3, P) (Duff et al. 2017)."""
    x, y, z = direction
    sign = torch.where(z >= 0, 1.0, -1.0).to(z)
    a = -1 / (sign + z)
    b = x * y * a
    rows = (1 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y, x, y, z)
    return torch.stack(rows).unflatten(0, (3, 3))


@functools.cache
def _outlines(device: torch.device) -> Tensor:
    """Vertices (27, 6) of the outline of a box seen from each of the 27 regions around it.

    Bit b of a vertex states whether it is at the high end of axis b. The vertices run counter-clockwise on
    a plane behind the box whose axes are right-handed with the viewing direction.
    """
    table = torch.zeros(27, 6, dtype=torch.int64)
    for code, sides in enumerate(itertools.product(range(3), repeat=3)):
        edges: set[tuple[int, int]] = set()
        for axis, side in enumerate(sides):
            if side == 1:
                continue
            b, c = (axis + 1) % 3, (axis + 2) % 3
            around = [0, 1 << b, (1 << b) + (1 << c), 1 << c]  # as seen along the axis
            if side == 2:
                around = [v + (1 << axis) for v in reversed(around)]
            edges |= set(itertools.pairwise([*around, around[0]]))
        # The set contains an edge between two visible faces in both directions; the outline does not.
        table[code] = _chain({start: end for start, end in edges if (end, start) not in edges})
    return table.to(device)


def _chain(following: dict[int, int]) -> Tensor:
    """Vertices (6,) in cyclic order, given the successor of each; the last is repeated."""
    chain = [min(following, default=0)]
    while following and len(chain) < len(following):
        chain.append(following[chain[-1]])
    return torch.tensor(chain + [chain[-1]] * (6 - len(chain)))
