"""Which rays may meet which triangles: bundles of rays of similar direction against cones around triangles.

Operations are kept small on purpose, and gather with `index_select`. Beyond some 32 thousand elements
(with `x[index]` sooner) torch shares an operation among threads, and on a busy machine these wait for each
other at every one of many small operations, far longer than they work.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

_CHUNK_CONES = 1 << 15
"""Pairs of bundle and triangle held at once."""

_CHUNK_HITS = 1 << 13
"""Pairs of ray and triangle handed out at once, give or take a bundle."""

_CELLS = 8
"""Bundles along the side of the cube onto which directions are projected: each about 14° wide."""


class Cones(NamedTuple):
    """Cones from the origin: unit axes (3, C), cosine and sine (C,) of their half-angles.

    `is_open` (C,) marks what looks wider than a half-space: around it there is no cone, and it may lie
    anywhere.
    """

    axis: Tensor
    cos: Tensor
    sin: Tensor
    is_open: Tensor


class Bundles(NamedTuple):
    """Rays in bundles: `rays` (N,) sorted by bundle, of which bundle g has `sizes[g]` from `starts[g]` on.

    `cones` encloses each bundle; None if the rays start apart, so that there is none.
    """

    rays: Tensor
    starts: Tensor
    sizes: Tensor
    cones: Cones | None


def bundled(directions: Tensor) -> Bundles:
    """Rays from one origin (N, 3) in bundles, by the cell of a cube's surface through which they pass."""
    unit = normalize(directions, dim=1)
    face = unit.abs().argmax(1)
    cell = ((unit / unit.abs().amax(1, keepdim=True) + 1) * (_CELLS / 2)).floor().long()
    cell = cell.nan_to_num().clamp(0, _CELLS)
    key = ((cell[:, 0] * (_CELLS + 1) + cell[:, 1]) * (_CELLS + 1) + cell[:, 2]) * 3 + face
    _, bundle, sizes = torch.unique(key, return_inverse=True, return_counts=True)
    axis = unit.new_zeros(sizes.shape[0], 3).index_add_(0, bundle, unit)
    width = unit.new_zeros(sizes.shape[0]).scatter_reduce_(0, bundle, _angle(unit, axis[bundle]), "amax")
    return Bundles(bundle.argsort(stable=True), sizes.cumsum(0) - sizes, sizes, _cones(axis, width))


def apart(n: int) -> Bundles:
    """Every ray for itself."""
    rays = torch.arange(n)
    return Bundles(rays, rays, torch.ones_like(rays), None)


def candidates(bundles: Bundles, triangles: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Pairs of ray (P,) and triangle (P,) that may meet, in chunks; corners are relative to the origin."""
    n_bundles, n_triangles = bundles.sizes.shape[0], triangles.shape[0]
    step = max(1, _CHUNK_CONES // n_triangles)
    middle = triangles.mean(1)
    cones = _cones(middle, _angle(triangles, middle[:, None]).amax(1))
    for first in range(0, n_bundles, step):
        rows = slice(first, min(first + step, n_bundles))
        if bundles.cones is None:
            near = torch.ones(rows.stop - first, n_triangles, dtype=torch.bool)
        else:
            near = _overlap(bundles.cones, cones, rows)
        bundle, triangle = near.nonzero(as_tuple=True)
        bundle = bundle + first
        ends = bundles.sizes[bundle].cumsum(0)
        total = int(ends[-1]) if len(ends) else 0
        cuts = torch.arange(_CHUNK_HITS, max(total, _CHUNK_HITS), _CHUNK_HITS)
        for part in torch.arange(len(bundle)).tensor_split(torch.searchsorted(ends, cuts)):
            if len(part):
                yield _expanded(bundles, bundle[part], triangle[part])


def _expanded(bundles: Bundles, bundle: Tensor, triangle: Tensor) -> tuple[Tensor, Tensor]:
    """Every ray of each bundle (Q,) with that bundle's triangle (Q,)."""
    sizes = bundles.sizes.index_select(0, bundle)
    ends = sizes.cumsum(0)
    is_next = torch.zeros(int(ends[-1]), dtype=torch.long)
    is_next[ends[:-1]] = 1  # no bundle is empty, so this counts up; repeat_interleave would wake all threads
    pair = is_next.cumsum(0)
    shift = bundles.starts.index_select(0, bundle) - (ends - sizes)
    position = torch.arange(pair.shape[0]) + shift.index_select(0, pair)
    return bundles.rays.index_select(0, position), triangle.index_select(0, pair)


def _cones(axis: Tensor, width: Tensor) -> Cones:
    """Cones of axes (C, 3) of any length and half-angles (C,) in radians."""
    is_open = ~(width < 0.49 * torch.pi)
    return Cones(normalize(axis, dim=1).T.contiguous(), width.cos(), width.sin(), is_open)


def _overlap(bundles: Cones, cones: Cones, rows: slice) -> Tensor:
    """Which cones (C,) some bundles (rows) overlap: cos(angle of the axes) ≥ cos(sum of the half-angles)."""
    excess = bundles.sin[rows, None] * cones.sin - bundles.cos[rows, None] * cones.cos
    for own, other in zip(bundles.axis[:, rows], cones.axis, strict=True):
        excess = torch.addcmul(excess, own[:, None], other)
    return (excess > -1e-9) | cones.is_open | bundles.is_open[rows, None]


def _angle(u: Tensor, v: Tensor) -> Tensor:
    """Angles (…) between vectors (…, 3) in radians; a right angle where one of them is zero."""
    scale = (u.norm(dim=-1) * v.norm(dim=-1)).clamp_min(1e-300)
    return ((u * v).sum(-1) / scale).clamp(-1, 1).acos()
