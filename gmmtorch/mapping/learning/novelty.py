"""Novelty of beams: how much of what a map does not know each of them would tell (thesis 4.1.2)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.linalg import dense_ranks
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.rules import NoveltyRule
from gmmtorch.occupancy.evidence import bernoulli_entropy, occupancy_probability
from gmmtorch.occupancy.forms.point import point_evidence
from gmmtorch.occupancy.voxels.ray_traversal import traverse
from gmmtorch.scan import Scan

_CHUNK_BEAMS = 1 << 14


def entropy_reduction(components: Components, scan: Scan, rule: NoveltyRule) -> tuple[Tensor, Tensor]:
    """Bits (N,) that each beam of a scan would take off the entropy, and whether it crosses a cell that
    was not observed, (N,) bool; beams in the order of `Scan.ends`.

    Σ h(p) − h(p′) over the cells that a beam passes through or ends in: p is the occupancy of the cell
    by the map, p′ that with this beam's miss or hit added. The cells are those of a lattice that has
    the sensor in the middle of one, so that nothing depends on where the world's origin lies. A
    reduction may be negative: of a beam that contradicts the map. A beam without return ends in no cell.
    """
    ends, is_hit = scan.ends()
    ends, origin = ends.double(), scan.origin.double()
    bits = torch.zeros(ends.shape[0], dtype=torch.float64, device=ends.device)
    unobserved = torch.zeros_like(bits, dtype=torch.bool)
    for begin in range(0, ends.shape[0], _CHUNK_BEAMS):
        part = slice(begin, begin + _CHUNK_BEAMS)
        _of_beams(components, origin, ends[part], is_hit[part], rule, bits[part], unobserved[part])
    return bits, unobserved


def _of_beams(
    components: Components,
    origin: Tensor,
    ends: Tensor,
    is_hit: Tensor,
    rule: NoveltyRule,
    bits: Tensor,
    unobserved: Tensor,
) -> None:
    """Adds what beams (N,) tell to `bits` and `unobserved`."""
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
    missed = before - bernoulli_entropy(occupancy_probability(hits, misses + 1, rule.prior))
    struck = before - bernoulli_entropy(occupancy_probability(hits + 1, misses, rule.prior))
    bits.index_add_(0, ray, torch.where(ended, struck[number], missed[number]))
    unobserved[ray[(hits + misses < rule.observed)[number]]] = True


def novel_beams(components: Components, scan: Scan, rule: NoveltyRule) -> Tensor:
    """Which beams (N,) of a scan, in the order of `Scan.ends`, tell a map something new.

    Those that lower the entropy by at least the threshold, and those through any unobserved cell.
    """
    if len(components) == 0:
        return torch.ones(scan.n_beams, dtype=torch.bool, device=scan.points.device)
    bits, unobserved = entropy_reduction(components, scan, rule)
    return unobserved | (bits >= rule.threshold)
