"""Novelty of beams against a cell-by-cell walk in exact arithmetic."""

from __future__ import annotations

import math

import pytest
import torch
from mapping.map_cases import absorbed
from mapping.random_components import normal_components
from occupancy.exact_dda import voxels_left
from occupancy.protocol_contract import dims, empty_scan, wall_scan
from occupancy.test_rolling_window import at, cells_of, new_window, random_evidence

from gmmtorch import Components, IncrementalRule, NoveltyRule, Scan
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.learning.novelty import beam_novelty, entropy_reduction, novel_beams
from gmmtorch.occupancy import Box, CellEvidence, RollingWindow, cast_evidence, point_evidence

RULE = NoveltyRule(resolution=0.125, threshold=0.5)
LEARNING = IncrementalRule(noise=0.01, length=0.5, cell=0.05)


def binary_entropy(hits: float, misses: float, prior: float) -> float:
    p = (hits + prior) / (hits + misses + 2 * prior) if hits + misses + 2 * prior > 0 else 0.5
    return -sum(q * math.log2(q) for q in (p, 1 - p) if q > 0)


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
            after = binary_entropy(h + 1, m, rule.prior) if ended else binary_entropy(h, m + 1, rule.prior)
            total += binary_entropy(h, m, rule.prior) - after
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
def test_every_beam_is_novel_to_an_empty_map(dim):
    assert bool(novel_beams(Components.empty(dim), wall_scan(dim), RULE).all())
    assert novel_beams(Components.empty(dim), empty_scan(dim), RULE).shape == (0,)
    known = absorbed(Components.empty(dim), [wall_scan(dim)], LEARNING)
    assert novel_beams(known, empty_scan(dim), RULE).shape == (0,)


def test_novelty_is_the_same_far_from_the_world_origin():
    shift = torch.tensor([512_000.0, -256_000.0, 1024.0], dtype=torch.float64)
    scans = [wall_scan(3, seed) for seed in range(2)]
    moved = [Scan(scan.points + shift, scan.origin + shift) for scan in scans]
    near = absorbed(Components.empty(3), scans[:1], LEARNING)
    far = absorbed(Components.empty(3), moved[:1], LEARNING)
    here, _ = entropy_reduction(near, scans[1], RULE)
    there, _ = entropy_reduction(far, moved[1], RULE)
    torch.testing.assert_close(here, there, rtol=1e-4, atol=1e-4)


# -- beam_novelty against a cell-by-cell walk of each beam -----------------------------------------------


INSIDE, OUTSIDE = (0.125, -0.25, 0.0625), (9.0, 1.0, 1.0)  # sensor origins, seen from the window around zero
CENTER = torch.tensor([0.13, -0.21, 0.07], dtype=torch.float64)


def window_with(*evidence: CellEvidence) -> RollingWindow:
    window = new_window()
    window.center_on(at(0, 0, 0))
    for part in evidence:
        window.add(part)
    return window


def random_beams(n: int, seed: int, spread: float):
    generator = torch.Generator().manual_seed(seed)
    ends = spread * torch.randn(n, 3, generator=generator, dtype=torch.float64)
    return ends, torch.rand(n, generator=generator) < 0.6


def novelty_by_a_walk(window: RollingWindow, origin, ends, is_hit, rule, short: float = 0.0):
    """Like `beam_novelty`, one beam and one cell at a time."""
    counts, low = window.evidence(), window.box.low.tolist()
    bits, unobserved = [], []
    for end, hit in zip(ends, is_hit.tolist(), strict=True):
        length = float((end - origin).norm())
        until = origin + (end - origin) / length * max(0.0, length - short) if short else end
        start, stop = (origin / window.resolution).tolist(), (until / window.resolution).tolist()
        crossed = [(cell, 0, 1) for cell in voxels_left(start, stop)]
        if hit:
            crossed.append((tuple((end / window.resolution).floor().long().tolist()), 1, 0))
        total, new = 0.0, False
        for cell, more_hits, more_misses in crossed:
            local = tuple(x - a for x, a in zip(cell, low, strict=True))
            if all(0 <= x < n for x, n in zip(local, window.shape, strict=True)):
                h, m = (float(part[local]) for part in counts)
                after = binary_entropy(h + more_hits, m + more_misses, rule.prior)
                total += binary_entropy(h, m, rule.prior) - after
                new = new or (h if more_hits else h + m) < rule.observed
        bits.append(total)
        unobserved.append(new)
    return torch.tensor(bits, dtype=torch.float64), unobserved


def check(
    window: RollingWindow, origin, ends, is_hit, rule, expected_from: RollingWindow | None = None, **options
):
    bits, unobserved = beam_novelty(window, origin, ends, is_hit, rule, **options)
    short = options.get("short", 0.0)
    expected, new = novelty_by_a_walk(expected_from or window, origin, ends, is_hit, rule, short)
    tolerance = 1e-9 if expected_from is None else 1e-5
    torch.testing.assert_close(bits, expected, rtol=tolerance, atol=tolerance)
    assert unobserved.tolist() == new
    return bits, new


@pytest.mark.parametrize(("origin", "spread"), [(INSIDE, 0.5), (INSIDE, 4.0), (OUTSIDE, 5.0)])
def test_beam_novelty_equals_a_cell_by_cell_walk(origin, spread):
    # Beams within the window, beams that leave it, and a sensor outside.
    window = window_with(random_evidence(13_700, 0))  # of 24³ cells
    place = torch.tensor(origin, dtype=torch.float64)
    ends, is_hit = random_beams(60, 0, spread)
    ends[:10] = (ends[:10] * 8).round() / 8  # on planes
    for rule in (NoveltyRule(), NoveltyRule(observed=3.0, prior=0.25)):
        _, new = check(window, place, ends, is_hit, rule)
        assert 0 < sum(new) < 60


@pytest.mark.parametrize("corner", [(-3, -5, -2), (0, -40, -4), (-90, -90, -90), (30, 0, 0)])
def test_cells_outside_the_given_box_have_no_novelty(corner):
    low = torch.tensor(corner)
    within = Box(low, low + torch.tensor([6, 60, 95]))
    evidence = random_evidence(13_700, 5)
    window, known = window_with(evidence), window_with(evidence)
    # In the other window these cells are certain, so that they cannot reduce its binary_entropy.
    everywhere = torch.tensor(sorted(cells_of(known.box)))
    outside = everywhere[((everywhere < within.low) | (everywhere >= within.high)).any(1)]
    many = torch.full((len(outside),), 1e9)
    known.add(CellEvidence(outside, many, 0 * many))
    ends, is_hit = random_beams(80, 3, 1.0)
    check(window, CENTER, ends, is_hit, NoveltyRule(observed=3.0), known, within=within)


def test_a_hit_in_a_free_cell_is_novel_until_the_map_has_hits_there():
    past = torch.tensor([[1.6, 0.1, 0.1]], dtype=torch.float64)
    evidence = cast_evidence(at(0, 0.1, 0.1), past, torch.tensor([True]), 0.25, window_with().box)
    window = window_with(CellEvidence(evidence.cells, 500 * evidence.hits, 500 * evidence.misses))
    rail = torch.tensor([[1.1, 0.1, 0.1]], dtype=torch.float64)
    for is_hit in (True, False):
        beam = (at(0, 0.1, 0.1), rail, torch.tensor([is_hit]))
        assert beam_novelty(window, *beam, NoveltyRule())[1].tolist() == [is_hit]
    beam = (at(0, 0.1, 0.1), rail, torch.tensor([True]))
    window.add(cast_evidence(*beam, 0.25, window.box))
    assert beam_novelty(window, *beam, NoveltyRule())[1].tolist() == [False]


def test_beams_outside_the_window_and_no_beams_have_no_novelty():
    window = window_with()
    far = torch.full((3, 3), 50.0, dtype=torch.float64)
    is_hit = torch.ones(3, dtype=torch.bool)
    bits, unobserved = beam_novelty(window, far[0], far + 1, is_hit, NoveltyRule())
    assert bits.tolist() == [0.0] * 3
    assert not bool(unobserved.any())
    assert beam_novelty(window, far[0], far[:0], is_hit[:0], NoveltyRule())[0].shape == (0,)


@pytest.mark.parametrize("hit", [False, True])
def test_a_beam_of_no_length_has_finite_novelty(hit):
    end = at(0, 0, 0)[None]
    bits, unobserved = beam_novelty(window_with(), end[0], end, torch.tensor([hit]), NoveltyRule(), short=0.3)
    assert unobserved.tolist() == [hit]
    assert math.isfinite(float(bits[0]))


def test_invalid_beams_are_refused():
    window, one = window_with(), torch.tensor([True])
    for short in (-0.1, math.nan, math.inf):
        with pytest.raises(InvalidArgumentError, match="short="):
            beam_novelty(window, at(0, 0, 0), torch.ones(1, 3), one, NoveltyRule(), short=short)
    with pytest.raises(InvalidArgumentError, match="ends must be finite"):
        beam_novelty(window, at(0, 0, 0), torch.full((1, 3), math.inf), one, NoveltyRule())
