"""Novelty of beams: by how many bits each beam lowers the entropy of a map (thesis 4.1.2)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import cell_entropy, reduction_along_rays, traverse
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
)
from gmmtorch.scan import Scan

_CHUNK_BEAMS = 1 << 14


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
    passed = [(visit.voxel, visit.ray) for visit in traverse(starts, stops, shape, low=low)]
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
