"""Novelty of beams against a cell-by-cell walk in exact arithmetic."""

from __future__ import annotations

import math

import pytest
import torch
from mapping.map_cases import absorbed
from mapping.random_components import normal_components
from occupancy.exact_dda import voxels_left
from occupancy.protocol_contract import dims, empty_scan, open_scan, wall_scan

from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.novelty import entropy_reduction, novel_beams
from gmmtorch.mapping.learning.rules import IncrementalRule, NoveltyRule
from gmmtorch.occupancy.forms.point import point_evidence
from gmmtorch.scan import Scan

RULE = NoveltyRule(resolution=0.125, threshold=0.5)
LEARNING = IncrementalRule(noise=0.01, length=0.5, cell=0.05)


def entropy(hits: float, misses: float, prior: float) -> float:
    p = (hits + prior) / (hits + misses + 2 * prior)
    return -p * math.log2(p) - (1 - p) * math.log2(1 - p)


def bits_by_a_walk(components: Components, scan: Scan, rule: NoveltyRule) -> tuple[list[float], list[bool]]:
    """Like `entropy_reduction`, one beam and one cell at a time."""
    bits, unobserved = [], []
    ends, is_hit = scan.ends()
    for end, hit in zip(ends, is_hit.tolist(), strict=True):
        stop = (end - scan.origin) / rule.resolution + 0.5
        cells = [(cell, False) for cell in voxels_left([0.5] * scan.dim, stop.tolist())]
        if hit:
            cells.append((tuple(stop.floor().long().tolist()), True))
        total, new = 0.0, False
        for cell, ended in cells:
            center = scan.origin + torch.tensor(cell, dtype=torch.float64) * rule.resolution
            found = point_evidence(components.cones(), center[None], rule.resolution, rule.cutoff)
            h, m = float(found.hits), float(found.misses)
            after = entropy(h + 1, m, rule.prior) if ended else entropy(h, m + 1, rule.prior)
            total += entropy(h, m, rule.prior) - after
            new = new or h + m < rule.observed
        bits.append(total)
        unobserved.append(new)
    return bits, unobserved


@pytest.mark.parametrize(("dim", "seed"), [(2, 0), (3, 1)])
def test_entropy_reduction_equals_an_exact_walk(dim, seed):
    components = normal_components(6, dim, seed, empty=0.3)
    generator = torch.Generator().manual_seed(seed)
    ends = 1.2 * torch.randn(6, dim, generator=generator, dtype=torch.float64)
    scan = Scan(ends[:4], torch.tensor([0.1, -0.2, 0.3][:dim], dtype=torch.float64), ends[4:])
    bits, unobserved = entropy_reduction(components, scan, RULE)
    expected, new = bits_by_a_walk(components, scan, RULE)
    torch.testing.assert_close(bits, torch.tensor(expected, dtype=torch.float64), rtol=1e-9, atol=1e-9)
    assert unobserved.tolist() == new


@dims
def test_beams_through_learned_space_are_not_novel(dim):
    scans = [wall_scan(dim, seed) for seed in range(3)]
    learned = absorbed(Components.empty(dim), scans, LEARNING)
    again = wall_scan(dim, 9)
    assert float(novel_beams(learned, again, RULE).double().mean()) < 0.25
    elsewhere = again.transformed(_turn(dim))
    assert bool(novel_beams(learned, elsewhere, RULE).all())


def _turn(dim: int) -> torch.Tensor:
    """Half a turn about the vertical through the world's origin: the wall is now behind."""
    matrix = torch.eye(dim + 1, dtype=torch.float64)
    matrix[0, 0] = matrix[1, 1] = -1
    return matrix


@dims
def test_every_beam_is_novel_to_an_empty_map(dim):
    assert bool(novel_beams(Components.empty(dim), wall_scan(dim), RULE).all())
    assert novel_beams(Components.empty(dim), empty_scan(dim), RULE).shape == (0,)
    known = absorbed(Components.empty(dim), [wall_scan(dim)], LEARNING)
    assert novel_beams(known, empty_scan(dim), RULE).shape == (0,)


def test_one_unobserved_cell_makes_a_beam_novel():
    known = absorbed(Components.empty(2), [wall_scan(2, seed) for seed in range(3)], LEARNING)
    inside = wall_scan(2, 5).select(torch.arange(241) == 120)
    never = NoveltyRule(resolution=0.125, threshold=1e6)
    assert novel_beams(known, inside, never).tolist() == [False]
    through = Scan(inside.points + torch.tensor([0.5, 0.0], dtype=torch.float64), inside.origin)
    assert novel_beams(known, through, never).tolist() == [True]
    unasked = NoveltyRule(resolution=0.125, threshold=1e6, observed=0.0)
    assert novel_beams(known, through, unasked).tolist() == [False]


@dims
def test_no_return_beams_reduce_the_entropy_of_free_space(dim):
    open_ = open_scan(dim)
    learned = absorbed(Components.empty(dim), [open_, open_, open_], LEARNING)
    assert bool(learned.max_range.all())
    bits, _ = entropy_reduction(learned, open_, RULE)
    assert bool((bits > 0).all())
    assert float(novel_beams(learned, open_, RULE).double().mean()) < 0.25


def test_novelty_is_the_same_far_from_the_world_origin():
    shift = torch.tensor([512_000.0, -256_000.0, 1024.0], dtype=torch.float64)
    scans = [wall_scan(3, seed) for seed in range(2)]
    moved = [Scan(scan.points + shift, scan.origin + shift) for scan in scans]
    near = absorbed(Components.empty(3), scans[:1], LEARNING)
    far = absorbed(Components.empty(3), moved[:1], LEARNING)
    here, _ = entropy_reduction(near, scans[1], RULE)
    there, _ = entropy_reduction(far, moved[1], RULE)
    torch.testing.assert_close(here, there, rtol=1e-4, atol=1e-4)
