"""Novelty of beams: by how many bits each beam lowers the entropy of a map (thesis 4.1.2).

Association adds the points that a map explains to the counts of components (thesis 4.1.3).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import cell_entropy, explained_points, is_fused, reduction_along_rays, traverse
from gmmtorch.linalg import dense_ranks
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.rules import NoveltyRule
from gmmtorch.occupancy import (
    Box,
    RollingWindow,
    bernoulli_entropy,
    flat_index,
    intersection,
    occupancy_probability,
    point_evidence,
    rays_in_box,
    to_lattice,
    whitening,
)
from gmmtorch.scan import Scan

_CHUNK_BEAMS = 1 << 14
_QUANTILES = {2: 5.991464547107979, 3: 7.814727903251179}  # 95 % of χ² with this many degrees of freedom


def entropy_reduction(components: Components, scan: Scan, rule: NoveltyRule) -> tuple[Tensor, Tensor]:
    """Entropy reduction (N,) of each beam in bits, and whether it crosses an unobserved cell, (N,) bool.

    Beams are in the order of `Scan.ends`. The reduction is Σ h(p) − h(p′) over the cells that the beam
    crosses or ends in: p is the cell's occupancy by the map, p′ the occupancy after this beam's miss or hit.
    It is negative for a beam that contradicts the map. A no-return beam ends in no cell. The sensor is at the
    centre of a cell, so the result does not depend on the world's origin.
    """
    ends, is_hit = scan.ends()
    ends, origin = ends.double(), scan.origin.double()
    bits = torch.zeros(ends.shape[0], dtype=torch.float64, device=ends.device)
    unobserved = torch.zeros_like(bits, dtype=torch.bool)
    for begin in range(0, ends.shape[0], _CHUNK_BEAMS):
        part = slice(begin, begin + _CHUNK_BEAMS)
        _add_beams(components, origin, ends[part], is_hit[part], rule, bits[part], unobserved[part])
    return bits, unobserved


def _add_beams(
    components: Components,
    origin: Tensor,
    ends: Tensor,
    is_hit: Tensor,
    rule: NoveltyRule,
    bits: Tensor,
    unobserved: Tensor,
) -> None:
    """Writes the results of beams (N,) to `bits` and `unobserved`, in place."""
    stops = (ends - origin) / rule.resolution + 0.5
    starts = torch.full_like(stops, 0.5)
    cells = stops.floor()
    low, high = cells.amin(0).clamp_max(0), cells.amax(0).clamp_min(0)
    shape = tuple((high - low + 1).long().tolist())
    if math.prod(shape) >= 2**62:
        raise InvalidArgumentError(
            f"resolution={rule.resolution} m is too fine for beams that span {shape} cells; take more."
        )
    strides = torch.tensor([math.prod(shape[axis + 1 :]) for axis in range(len(shape))], device=low.device)
    passed = list(traverse(starts, stops, shape, low=low))
    hit = is_hit.nonzero().squeeze(1)
    last = ((cells[hit] - low).long() * strides).sum(1)
    voxel = torch.cat([*(v for v, _ in passed), last])
    ray = torch.cat([*(r for _, r in passed), hit])
    ended = torch.zeros_like(ray, dtype=torch.bool)
    ended[ray.shape[0] - hit.shape[0] :] = True
    number, n_cells = dense_ranks(voxel)
    flat = torch.zeros(n_cells, dtype=torch.int64, device=voxel.device).scatter_(0, number, voxel)
    index = torch.stack(
        [flat // stride % size for stride, size in zip(strides.tolist(), shape, strict=True)], 1
    )
    centers = origin + (index + low) * rule.resolution
    hits, misses = point_evidence(components.cones(), centers, rule.resolution, rule.cutoff)
    before = bernoulli_entropy(occupancy_probability(hits, misses, rule.prior))
    by_miss = before - bernoulli_entropy(occupancy_probability(hits, misses + 1, rule.prior))
    by_hit = before - bernoulli_entropy(occupancy_probability(hits + 1, misses, rule.prior))
    bits.index_add_(0, ray, torch.where(ended, by_hit[number], by_miss[number]))
    unobserved[ray[(hits + misses < rule.observed)[number]]] = True


def novel_beams(components: Components, scan: Scan, rule: NoveltyRule) -> Tensor:
    """Which beams (N,) of a scan are novel, in the order of `Scan.ends`.

    A beam is novel if its entropy reduction reaches the threshold, or if it crosses an unobserved cell.
    """
    if len(components) == 0:
        return torch.ones(scan.n_beams, dtype=torch.bool, device=scan.points.device)
    bits, unobserved = entropy_reduction(components, scan, rule)
    return unobserved | (bits >= rule.threshold)


def beam_novelty(
    window: RollingWindow,
    origin: Tensor,
    ends: Tensor,
    is_hit: Tensor,
    rule: NoveltyRule,
    short: float = 0.0,
    within: Box | None = None,
) -> tuple[Tensor, Tensor]:
    """Bits (N,) float64 by which each beam reduces the entropy of a window of cells, and whether the beam is
    unobserved.

    The reduction is Σ h(p) − h(p′) over the cells that a beam passes through, and the cell that a hit ends
    in: p is the occupancy of the cell, p′ the occupancy after this beam's miss or hit. Cells outside the
    window do not count. It is negative for a beam that contradicts the map.

    The flag (N,) bool is True if a beam passes through a cell with fewer than `rule.observed` rays, or if a
    hit ends in a cell with fewer hits than that: a thin object in a cell that most rays pass is new to a
    map that calls the cell free (thesis 4.1.2).

    Args:
        origin: (3,), world metres. ends: (N, 3), world metres. is_hit: (N,) bool, False for no-return beams.
        rule: its `prior` and `observed` are used.
        short: metres before the end of a beam that do not count as free space, because a map can leave them
            out near surfaces.
        within: cells that count, if the map stores no evidence of others; all if not given.
    """
    if not 0 <= short < math.inf:
        raise InvalidArgumentError(f"short={short} must be finite metres, at least zero.")
    stops = to_lattice(ends, window.resolution, "ends")
    starts = to_lattice(origin, window.resolution, "origin").expand_as(stops)
    bits = torch.zeros(len(stops), dtype=torch.float64, device=stops.device)
    way = stops - starts
    length = way.norm(dim=1, keepdim=True).clamp_min(torch.finfo(way.dtype).tiny)
    until = stops - way * (short / window.resolution / length).clamp_max(1) if short else None
    box = window.box if within is None else intersection(window.box, within)
    rays = None if box is None else rays_in_box(starts, stops, box, until)
    if rays is None:
        return bits, torch.zeros_like(bits, dtype=torch.bool)
    # A beam reduces the entropy by at most one bit for each cell that it crosses. So one sum can hold both
    # the bits and the unobserved cells: each of these adds a mark, more than twice the largest sum of bits.
    mark = 2.0 * (sum(window.shape) + 3)
    hits, misses = window.evidence(rays.window)
    along = reduction_along_rays(
        rays.starts,
        rays.stops,
        rays.low,
        hits,
        misses,
        prior=rule.prior,
        observed=rule.observed,
        mark=mark,
        margin=0 if rays.block is rays.window else 1,
    )
    bits = along if rays.ray is None else bits.index_copy_(0, rays.ray, along)
    flat, inside = flat_index(stops.floor().long() - rays.window.low, rays.window.shape)
    ended = (is_hit & inside).nonzero().squeeze(1)
    flat = flat[ended]
    hits, misses = hits.view(-1)[flat].double(), misses.view(-1)[flat].double()
    before, after = (cell_entropy(hits + hit, misses, rule.prior) for hit in (0, 1))
    bits[ended] += before - after + mark * (hits + misses < rule.observed)
    bits[ended] += mark * ((hits < rule.observed) & (hits + misses >= rule.observed))
    n_unobserved = (bits / mark).round()
    return bits - n_unobserved * mark, n_unobserved > 0


_LEAST_DISTANCE = 1e-6  # squared Mahalanobis: the thesis's shares are undefined at a mean
_PAIRS_AT_ONCE = 1 << 20
_POINTS_AT_ONCE = 512  # neighbouring points that few components can explain


def count_explained(
    components: Components,
    points: Tensor,
    origin: Tensor,
    distance: float,
    explained: float | None = None,
    max_range: bool = False,
    weight: float = 1.0,
    frees: Tensor | None = None,
) -> tuple[Components, Tensor]:
    """Adds points (N, D), observed from `origin` (D,), to the counts of the components that explain them.

    A component explains a point if d = (z − μ)ᵀ Σ⁻¹ (z − μ) < `explained`, and if one of its origins is
    within `distance` (m) of the sensor: then it also explains the free space before the point. The components
    share the point in proportion to 1/d, N_k += Σ_n w_nk; each share goes to the origin nearest to the
    sensor. Means and covariances do not change. Returns the components with the new counts, and which points
    (N,) bool are counted.

    Args:
        explained: squared Mahalanobis distance; None: the 95 % quantile of χ² with D degrees of freedom.
        max_range: the points are ends of no-return beams, which only `max_range` components explain.
        weight: number of measured points for which each point stands.
        frees: (N,) bool, points whose beams contribute free space. Only these need an origin within
            `distance`, as in the thesis. None: all points need it.
    """
    n, k = points.shape[0], len(components)
    found = torch.zeros(n, dtype=torch.bool, device=points.device)
    near, nearest = _nearest_viewpoints(components, origin, distance)
    is_candidate = components.max_range == max_range
    rows = (is_candidate & near if frees is None else is_candidate).nonzero().squeeze(1)
    if n == 0 or len(rows) == 0:
        return components, found
    limit = explained_within(components.dim, explained)
    inverse, _ = whitening(components.covariances[rows])
    means = components.means[rows].double()
    if is_fused(points, means):
        gained, found = explained_points(points, means, inverse, limit, _LEAST_DISTANCE, near[rows], frees)
    else:
        gained, found = _shared_out(components.selected(rows), points, inverse, limit, near[rows], frees)
    gain = components.support.new_zeros(k).index_copy_(0, rows, gained * weight)
    counts = components.seen_count.index_add(0, nearest[rows], gain[rows])
    return replace(components, support=components.support + gain, seen_count=counts), found


def _shared_out(
    components: Components, points: Tensor, inverse: Tensor, limit: float, near: Tensor, frees: Tensor | None
) -> tuple[Tensor, Tensor]:
    """`explained_points` in tensor operations; inverse (K, D, D)."""
    means = components.means.double()
    gained = means.new_zeros(len(components))
    found = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    reach = None if frees is None else box_around(components, limit)
    for part, some in portions(points, len(components), reach):
        offset = points[part, None].double() - means[some]
        squared = torch.einsum("kij,nkj->nki", inverse[some], offset).square().sum(-1)
        explains = squared < limit
        if frees is not None:
            explains &= near[some] | ~frees[part, None]
        share = torch.where(explains, squared.clamp_min(_LEAST_DISTANCE).reciprocal(), 0.0)
        total = share.sum(1)
        found[part] = total > 0
        gained[some] += (share / total.clamp_min(torch.finfo(total.dtype).tiny)[:, None]).sum(0)
    return gained, found


def explained_within(dim: int, explained: float | None) -> float:
    """The squared Mahalanobis distance within which components explain points; see `count_explained`."""
    return _QUANTILES[dim] if explained is None else explained


def box_around(components: Components, squared: float) -> tuple[Tensor, Tensor]:
    """Lowest and highest corners (K, D) of boxes around the points within a squared Mahalanobis distance."""
    half = (components.covariances.diagonal(dim1=1, dim2=2).double() * (squared * (1 + 1e-9))).sqrt()
    return components.means.double() - half, components.means.double() + half


def summed(components: Components) -> Components:
    """Each id once, in order, with the sum of the counts of all rows with this id.

    Every component must have one viewpoint.
    """
    robot, sequence = components.ids.unbind(1)
    row, n_ids = dense_ranks(robot * (int(sequence.max()) + 1 if len(robot) else 1) + sequence)
    order = torch.arange(len(components), device=row.device)
    first = torch.full_like(order[:n_ids], len(components)).scatter_reduce_(0, row, order, "amin")
    support = components.support.new_zeros(n_ids).index_add_(0, row, components.support)
    kept = components.selected(first)
    return replace(kept, support=support, seen_count=support[kept.seen_by])


def portions(points: Tensor, k: int, boxes: tuple[Tensor, Tensor] | None) -> Iterator[tuple[Tensor, Tensor]]:
    """Portions of points (N, D), as indices, and the indices of the components that may explain them.

    boxes: lowest and highest corners (K, D) of what the components explain. Portions are then neighbouring
        points, with the few of the K components whose boxes meet them. None: all components.
    """
    n, device = len(points), points.device
    if boxes is None:
        for part in torch.arange(n, device=device).split(max(1, _PAIRS_AT_ONCE // k)):
            yield part, torch.arange(k, device=device)
        return
    low, high = boxes
    order = torch.arange(n, device=device)
    for axis in range(points.shape[1]):  # the last axis, in rising order within cells of a metre
        order = order[points[order, axis].floor().argsort(stable=True)]
    for part in order.split(min(_POINTS_AT_ONCE, max(1, _PAIRS_AT_ONCE // k))):
        first, last = points[part].double().aminmax(dim=0)
        yield part, ((low <= last) & (high >= first)).all(1).nonzero().squeeze(1)


def _nearest_viewpoints(components: Components, origin: Tensor, distance: float) -> tuple[Tensor, Tensor]:
    """Which components (K,) have an origin within `distance` of a position; their nearest viewpoints (K,)."""
    k, n_viewpoints = len(components), components.seen_by.shape[0]
    apart = (components.origins[components.seen_from].double() - origin.double()).norm(dim=1)
    least = apart.new_full((k,), torch.inf).scatter_reduce_(0, components.seen_by, apart, "amin")
    best = (apart == least[components.seen_by]).nonzero().squeeze(1)
    nearest = best.new_full((k,), n_viewpoints).scatter_reduce_(0, components.seen_by[best], best, "amin")
    return least <= distance, nearest
