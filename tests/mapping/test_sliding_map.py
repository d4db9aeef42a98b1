"""The window around a robot, against maps made from scratch and beams walked cell by cell."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from occupancy.exact_dda import voxels_left

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mapping.learning.rules import NoveltyRule
from gmmtorch.mapping.sliding_map import SlidingVoxelMap
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.cell_evidence import CellEvidence, sum_evidence
from gmmtorch.occupancy.voxels.ray_casting import cast_evidence

SHAPE = (12, 16, 10)
EVERYTHING = Box(torch.tensor([-4096] * 3), torch.tensor([4096] * 3))


def at(*cell: float, resolution: float = 0.25) -> torch.Tensor:
    """The middle of a cell, metres."""
    return (torch.tensor(cell, dtype=torch.float64) + 0.5) * resolution


def new_map(step: int = 3, shape=SHAPE) -> SlidingVoxelMap:
    return SlidingVoxelMap(0.25, shape, step)


def cells_of(box: Box) -> set[tuple[int, ...]]:
    return set(
        itertools.product(*(range(a, b) for a, b in zip(box.low.tolist(), box.high.tolist(), strict=True)))
    )


def random_evidence(n: int, seed: int, reach: int = 12, at=(0, 0, 0)) -> CellEvidence:
    generator = torch.Generator().manual_seed(seed)
    flat = torch.randperm((2 * reach) ** 3, generator=generator)[:n]
    cells = torch.stack(torch.unravel_index(flat, (2 * reach,) * 3), 1) - reach + torch.tensor(at)
    both = torch.randint(0, 9, (2, n), generator=generator).float()
    return CellEvidence(cells, both[0], both[1])


def in_window(evidence: CellEvidence, window: Box) -> tuple[torch.Tensor, torch.Tensor]:
    """Dense hits and misses of the window, by a loop."""
    hits, misses = torch.zeros(2, *window.shape)
    low = window.low.tolist()
    for cell, h, m in zip(*(part.tolist() for part in evidence), strict=True):
        local = tuple(x - a for x, a in zip(cell, low, strict=True))
        if all(0 <= x < n for x, n in zip(local, window.shape, strict=True)):
            hits[local] += h
            misses[local] += m
    return hits, misses


# -- where the window is --------------------------------------------------------------------------


def test_first_the_whole_window_is_new():
    for cell in itertools.product((-1000, -7, 0, 5, 2501), repeat=3):
        sliding = new_map()
        (box,) = sliding.center_on(at(*cell))
        assert torch.equal(box.low, sliding.low)
        assert box.shape == sliding.box.shape == sliding.shape == SHAPE
        assert bool((sliding.low % 3 == 0).all())
        off = torch.tensor(cell) - sliding.low - torch.tensor(SHAPE) // 2
        assert int(off.abs().max()) <= 2


@settings(deadline=None, max_examples=30)
@given(
    moves=st.lists(
        st.tuples(*[st.one_of(st.integers(-4, 4), st.integers(-20, 20))] * 3), min_size=1, max_size=8
    ),
    step=st.integers(1, 2),
)
def test_the_window_follows(moves, step):
    shape = (6, 8, 5)
    half, cell = torch.tensor(shape) // 2, torch.zeros(3, dtype=torch.int64)
    sliding = new_map(step, shape)
    sliding.center_on(at(*cell.tolist()))
    for move in moves:
        old, old_low = cells_of(sliding.box), sliding.low
        fresh = (sliding.evidence()[0] == 0).float()
        sliding.add_dense(sliding.box, fresh, 3 * fresh)  # now 1 and 3 everywhere
        cell = cell + torch.tensor(move)
        far = (cell - old_low - half).abs() >= step
        pieces = [cells_of(box) for box in sliding.center_on(at(*cell.tolist()))]
        # Moved by whole steps, along the axes where the robot was far off: it is near the middle now.
        assert ((sliding.low - old_low) != 0).tolist() == far.tolist()
        assert bool(((sliding.low - old_low) % step == 0).all())
        assert bool(((cell - sliding.low - half).abs() < step).all())
        # What it uncovers: disjoint boxes, exactly what is new; that is empty, and all else is kept.
        now = cells_of(sliding.box)
        assert sum(map(len, pieces)) == len(set().union(*pieces))
        assert set().union(*pieces) == now - old
        hits, misses = sliding.evidence()
        for known in now:
            local = tuple(x - a for x, a in zip(known, sliding.low.tolist(), strict=True))
            assert (float(hits[local]), float(misses[local])) == ((1, 3) if known in old else (0, 0))


def test_no_move_before_a_whole_step():
    sliding = new_map(step=4)
    sliding.center_on(at(0, 0, 0))
    start = sliding.low.clone()
    middle = start + torch.tensor(SHAPE) // 2
    assert sliding.center_on(at(*(middle + torch.tensor([3, -3, 3])).tolist())) == []
    assert torch.equal(sliding.low, start)
    (box,) = sliding.center_on(at(*(middle + torch.tensor([0, -5, 3])).tolist()))
    assert (sliding.low - start).tolist() == [0, -4, 0]
    assert (box.low - start).tolist() == [0, -4, 0]
    assert box.shape == (12, 4, 10)


# -- evidence -------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", [(0, 0, 0), (5, -3, 2), (-4, 7, -6), (1000, 1001, -999)])
def test_evidence_in_the_order_of_the_lattice(cell):
    sliding = new_map()
    sliding.center_on(at(*cell))
    first, second = (random_evidence(3000, seed, at=cell) for seed in (0, 1))
    sliding.add(first)
    sliding.add(second)
    found = sliding.evidence()
    for one, other, both in zip(
        in_window(first, sliding.box), in_window(second, sliding.box), found, strict=True
    ):
        assert torch.equal(one + other, both)
        assert both.dtype == torch.float32
    copy = found[0].clone()
    sliding.add(first)
    assert torch.equal(copy, found[0])  # what was read does not change


@pytest.mark.parametrize("shift", [(0, 0, 0), (5, -9, 4), (-11, 15, -9), (12, 0, 0), (40, 0, 0)])
def test_dense_blocks_are_added_where_they_are(shift):
    sliding = new_map()
    sliding.center_on(at(3, 4, 5))
    low = sliding.low + torch.tensor(shift)
    box = Box(low, low + torch.tensor([9, 21, 6]))
    generator = torch.Generator().manual_seed(0)
    hits, misses = torch.rand(2, *box.shape, generator=generator)
    sliding.add_dense(box, hits, misses)
    sliding.add_dense(box, hits, misses)
    cells = torch.tensor(sorted(cells_of(box)))
    evidence = CellEvidence(cells, 2 * hits.flatten(), 2 * misses.flatten())
    for one, other in zip(in_window(evidence, sliding.box), sliding.evidence(), strict=True):
        assert torch.equal(one, other)


@settings(deadline=None, max_examples=12)
@given(seed=st.integers(0, 10**6), far=st.booleans())
def test_a_wandering_window_equals_one_made_from_scratch(seed, far):
    """Rays are trimmed to what each move uncovers, so that nothing is counted twice (thesis Fig 4.2)."""
    generator = torch.Generator().manual_seed(seed)
    sliding, rays = new_map(), []
    robot = at(0, 0, 0)
    for _ in range(9):
        step = torch.randn(3, generator=generator, dtype=torch.float64)
        robot = robot + step * (4.0 if far else 0.6)
        for box in sliding.center_on(robot):
            for ray, weight in rays:
                sliding.add(cast_evidence(*ray, 0.25, box, weight))
        ends = robot + 2.0 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
        if not far:
            ends = (ends * 8).round() / 8  # many on planes of the lattice
        is_hit = torch.rand(40, generator=generator) < 0.8
        ray = (robot, ends, is_hit)
        weight = 0.1 + torch.rand(40, generator=generator, dtype=torch.float64)
        rays.append((ray, weight))
        sliding.add(cast_evidence(*ray, 0.25, sliding.box, weight))
        if len(rays) % 3:
            continue
        scratch = new_map()
        scratch.center_on(at(*(sliding.low + torch.tensor(SHAPE) // 2).tolist()))
        assert torch.equal(scratch.low, sliding.low)
        scratch.add(sum_evidence(cast_evidence(*ray, 0.25, EVERYTHING, weight) for ray, weight in rays))
        for one, other in zip(sliding.evidence(), scratch.evidence(), strict=True):
            torch.testing.assert_close(one, other, rtol=1e-5, atol=0)


# -- a part of it ---------------------------------------------------------------------------------


@given(
    x=st.floats(-30, 30), y=st.floats(-30, 30), z=st.floats(-9, 9), step=st.sampled_from([1, 2, 4]),
    seed=st.integers(0, 99),
)  # fmt: skip
def test_a_box_around_a_place_is_a_part_of_the_window(x, y, z, step, seed):
    sliding = new_map()
    sliding.center_on(at(x, y, z))
    sliding.add(random_evidence(4000, seed))
    shape = (12, 9, 7)
    box = sliding.around(at(x, y, z), shape, step)
    assert box.shape == shape
    assert bool((box.low >= sliding.low).all() & (box.high <= sliding.box.high).all())
    assert bool(((box.low - sliding.low) % step == 0).all())
    cell = (at(x, y, z) / 0.25).floor()
    off = (box.low + box.high) / 2 - cell - 0.5
    fits = (box.low > sliding.low) & (box.high + step <= sliding.box.high)  # not held back by the window
    assert bool((off.abs() <= (step + 1) / 2)[fits].all())
    inside = tuple(
        slice(a, b)
        for a, b in zip((box.low - sliding.low).tolist(), (box.high - sliding.low).tolist(), strict=True)
    )
    for part, whole in zip(sliding.evidence(box), sliding.evidence(), strict=True):
        assert torch.equal(part, whole[inside])


def test_no_box_reaches_out_of_the_window():
    sliding = new_map()
    sliding.center_on(at(0, 0, 0))
    box = sliding.box
    with pytest.raises(InvalidArgumentError, match="reaches out of the window"):
        sliding.evidence(Box(box.low, box.high + 1))
    with pytest.raises(InvalidArgumentError, match="reaches out of the window"):
        sliding.evidence(Box(box.low - 1, box.high))
    with pytest.raises(InvalidArgumentError, match="is more than the window's"):
        sliding.around(at(0, 0, 0), (12, 99, 7))


# -- novelty --------------------------------------------------------------------------------------


def entropy(hits: float, misses: float, prior: float) -> float:
    p = (hits + prior) / (hits + misses + 2 * prior) if hits + misses + 2 * prior > 0 else 0.5
    return -sum(q * math.log2(q) for q in (p, 1 - p) if q > 0)


def novelty_by_a_walk(sliding: SlidingVoxelMap, origin, ends, is_hit, rule):
    """As `beam_novelty`, one beam and one cell at a time."""
    counts, low = sliding.evidence(), sliding.low.tolist()
    bits, unobserved = [], []
    for end, hit in zip(ends, is_hit.tolist(), strict=True):
        start, stop = origin / sliding.resolution, end / sliding.resolution
        crossed = [(cell, 0, 1) for cell in voxels_left(start.tolist(), stop.tolist())]
        if hit:
            crossed.append((tuple(stop.floor().long().tolist()), 1, 0))
        total, new = 0.0, False
        for cell, more_hits, more_misses in crossed:
            local = tuple(x - a for x, a in zip(cell, low, strict=True))
            if all(0 <= x < n for x, n in zip(local, sliding.shape, strict=True)):
                h, m = (float(part[local]) for part in counts)
                after = entropy(h + more_hits, m + more_misses, rule.prior)
                total += entropy(h, m, rule.prior) - after
                new = new or (h if more_hits else h + m) < rule.observed
        bits.append(total)
        unobserved.append(new)
    return torch.tensor(bits, dtype=torch.float64), unobserved


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("origin", "spread"),
    [((0.125, -0.25, 0.0625), 0.5), ((0.125, -0.25, 0.0625), 4.0), ((9.0, 1.0, 1.0), 5.0)],
)
def test_novelty_is_that_of_a_walk(seed, origin, spread):
    # Beams within the window, beams that leave it, and a sensor outside.
    sliding = new_map()
    sliding.center_on(at(0, 0, 0))
    sliding.add(random_evidence(13_700, seed))  # of 24 cubed
    generator = torch.Generator().manual_seed(seed)
    place = torch.tensor(origin, dtype=torch.float64)
    ends = spread * torch.randn(60, 3, generator=generator, dtype=torch.float64)
    ends[:10] = (ends[:10] * 8).round() / 8
    is_hit = torch.rand(60, generator=generator) < 0.6
    for rule in (NoveltyRule(), NoveltyRule(observed=3.0, prior=0.25)):
        bits, unobserved = sliding.beam_novelty(place, ends, is_hit, rule)
        expected, new = novelty_by_a_walk(sliding, place, ends, is_hit, rule)
        torch.testing.assert_close(bits, expected, rtol=1e-9, atol=1e-9)
        assert unobserved.tolist() == new
        assert 0 < sum(new) < 60


def test_what_is_known_is_no_news():
    sliding = new_map()
    sliding.center_on(at(0, 0, 0))
    ends = torch.tensor([[1.1, 0.1, 0.2], [0.3, -1.4, 0.1]], dtype=torch.float64)
    is_hit = torch.tensor([True, False])
    beams = (at(0, 0, 0), ends, is_hit)
    rule = NoveltyRule()
    bits, unobserved = sliding.beam_novelty(*beams, rule)
    assert bool((bits > 0.3).all())
    assert unobserved.tolist() == [True, True]
    for _ in range(60):
        sliding.add(cast_evidence(*beams, 0.25, sliding.box))
    bits, unobserved = sliding.beam_novelty(*beams, rule)
    assert bool((bits.abs() < 0.05).all())
    assert unobserved.tolist() == [False, False]


def test_a_surface_in_a_cell_called_free_is_news_until_the_map_has_hits_there():
    sliding = new_map()
    sliding.center_on(at(0, 0, 0))
    past = torch.tensor([[1.6, 0.1, 0.1]], dtype=torch.float64)
    for _ in range(500):
        sliding.add(cast_evidence(at(0, 0.1, 0.1), past, torch.tensor([True]), 0.25, sliding.box))
    rail = torch.tensor([[1.1, 0.1, 0.1]], dtype=torch.float64)
    for is_hit, expected in ((True, True), (False, False)):
        beam = (at(0, 0.1, 0.1), rail, torch.tensor([is_hit]))
        assert sliding.beam_novelty(*beam, NoveltyRule())[1].tolist() == [expected]
    beam = (at(0, 0.1, 0.1), rail, torch.tensor([True]))
    sliding.add(cast_evidence(*beam, 0.25, sliding.box))
    assert sliding.beam_novelty(*beam, NoveltyRule())[1].tolist() == [False]


def test_no_beam_and_beams_elsewhere_tell_nothing():
    sliding = new_map()
    sliding.center_on(at(0, 0, 0))
    far = torch.full((3, 3), 50.0, dtype=torch.float64)
    is_hit = torch.ones(3, dtype=torch.bool)
    bits, unobserved = sliding.beam_novelty(far[0], far + 1, is_hit, NoveltyRule())
    assert bits.tolist() == [0.0] * 3
    assert not bool(unobserved.any())
    assert sliding.beam_novelty(far[0], far[:0], is_hit[:0], NoveltyRule())[0].shape == (0,)


# -- checkpoints and errors -----------------------------------------------------------------------


def test_a_restored_map_goes_on_alike():
    sliding = new_map()
    sliding.center_on(at(0, 0, 0))
    sliding.add(random_evidence(4000, 0))
    sliding.center_on(at(4, 0, -5))
    state = sliding.state()
    twin = new_map()
    twin.restore(state)
    for each in (sliding, twin):
        each.center_on(at(9, 3, 1))
        each.add(random_evidence(4000, 2))
    assert torch.equal(sliding.low, twin.low)
    for one, other in zip(sliding.evidence(), twin.evidence(), strict=True):
        assert torch.equal(one, other)
    twin.restore(state)  # the state was not touched
    again = new_map()
    again.restore(state)
    assert torch.equal(twin.evidence()[0], again.evidence()[0])


def test_a_map_without_a_place():
    sliding = new_map()
    fresh = new_map()
    fresh.restore(sliding.state())
    for each in (sliding, fresh):
        with pytest.raises(InvalidArgumentError, match="call center_on"):
            each.add(random_evidence(5, 0))
        with pytest.raises(InvalidArgumentError, match="call center_on"):
            each.evidence()
    assert fresh.center_on(at(0, 0, 0))[0].shape == SHAPE


def test_what_cannot_be():
    for arguments, message in (
        ((0.0,), "resolution=0"),
        ((0.2, (4, 4)), "3 sides"),
        ((0.2, (16, 16, 0)), "shape=0"),
        ((0.2, (16, 16, 10), 6), "step=6"),
        ((0.2, (16, 16, 10), 0), "step=0"),
    ):
        with pytest.raises(InvalidArgumentError, match=message):
            SlidingVoxelMap(*arguments)
    sliding = new_map()
    with pytest.raises(InvalidArgumentError, match="position must be finite"):
        sliding.center_on(torch.tensor([0.0, float("nan"), 0.0]))
    sliding.center_on(at(0, 0, 0))
    end, is_hit = torch.full((1, 3), float("inf")), torch.tensor([True])
    with pytest.raises(InvalidArgumentError, match="ends must be finite"):
        sliding.beam_novelty(at(0, 0, 0), end, is_hit, NoveltyRule())
    with pytest.raises(InvalidArgumentError, match="must both be of box"):
        sliding.add_dense(sliding.box, torch.zeros(2, 2, 2), torch.zeros(2, 2, 2))
    with pytest.raises(DataError, match="made alike"):
        SlidingVoxelMap(0.5, SHAPE, 3).restore(sliding.state())


# -- beams that stop short ------------------------------------------------------------------------


def novelty_stopping_short(sliding: SlidingVoxelMap, origin, ends, is_hit, rule, short: float):
    """Misses of beams cut off before their ends, and hits of those that only end."""
    far = (ends - origin).norm(dim=1, keepdim=True)
    until = origin + (ends - origin) / far * (far - short).clamp_min(0)
    passed, new = novelty_by_a_walk(sliding, origin, until, torch.zeros_like(is_hit), rule)
    for beam, hit in enumerate(is_hit.tolist()):
        if hit:  # a beam of no length ends in its cell, and passes through none
            alone = (ends[beam], ends[[beam]], is_hit[[beam]], rule)
            bits, unobserved = novelty_by_a_walk(sliding, *alone)
            passed[beam] += bits[0]
            new[beam] = new[beam] or unobserved[0]
    return passed, new


@pytest.mark.parametrize("short", [0.0, 0.2, 0.5, 2.0, 1e6])
@pytest.mark.parametrize(
    ("origin", "spread"),
    [((0.13, -0.21, 0.07), 0.5), ((0.13, -0.21, 0.07), 4.0), ((9.0, 1.0, 1.0), 5.0)],
)
def test_beams_are_not_asked_about_their_last_stretch(short, origin, spread):
    sliding = new_map()
    sliding.center_on(at(0, 0, 0))
    sliding.add(random_evidence(13_700, 5))
    generator = torch.Generator().manual_seed(7)
    place = torch.tensor(origin, dtype=torch.float64)
    ends = spread * torch.randn(60, 3, generator=generator, dtype=torch.float64)
    is_hit = torch.rand(60, generator=generator) < 0.6
    rule = NoveltyRule(observed=3.0, prior=0.25)
    bits, unobserved = sliding.beam_novelty(place, ends, is_hit, rule, short=short)
    expected, new = novelty_stopping_short(sliding, place, ends, is_hit, rule, short)
    torch.testing.assert_close(bits, expected, rtol=1e-9, atol=1e-9)
    assert unobserved.tolist() == new
    if origin[0] < 1:  # it makes a difference, where beams end within the window
        whole, _ = sliding.beam_novelty(place, ends, is_hit, rule)
        assert torch.equal(bits, whole) == (short == 0)


def test_a_beam_that_ends_at_the_sensor_may_stop_short():
    sliding = new_map()
    sliding.center_on(at(0, 0, 0))
    end = at(0, 0, 0)[None]
    for hit in (False, True):
        bits, unobserved = sliding.beam_novelty(end[0], end, torch.tensor([hit]), NoveltyRule(), short=0.3)
        assert unobserved.tolist() == [hit]
        assert math.isfinite(float(bits[0]))


@pytest.mark.parametrize("short", [-0.1, math.nan, math.inf])
def test_no_stretch_is_negative_or_endless(short):
    sliding = new_map()
    sliding.center_on(at(0, 0, 0))
    with pytest.raises(InvalidArgumentError, match="short="):
        sliding.beam_novelty(at(0, 0, 0), torch.ones(1, 3), torch.tensor([True]), NoveltyRule(), short=short)


@pytest.mark.parametrize("corner", [(-3, -5, -2), (0, -40, -4), (-90, -90, -90), (30, 0, 0)])
def test_cells_that_a_map_does_not_take_in_do_not_count(corner):
    sliding, seen = new_map(), new_map()
    for each in (sliding, seen):
        each.center_on(at(0, 0, 0))
    low = torch.tensor(corner)
    within = Box(low, low + torch.tensor([6, 60, 95]))
    evidence = random_evidence(13_700, 5)
    sliding.add(evidence)
    # Cells of which all is known, to the last bit, tell nothing: so do those that do not count.
    seen.add(evidence)
    everywhere = torch.tensor(sorted(cells_of(seen.box)))
    outside = ((everywhere < within.low) | (everywhere >= within.high)).any(1)
    many = torch.full((int(outside.sum()),), 1e9)
    seen.add(CellEvidence(everywhere[outside], many, 0 * many))
    generator = torch.Generator().manual_seed(3)
    ends = torch.randn(80, 3, generator=generator, dtype=torch.float64)
    is_hit = torch.rand(80, generator=generator) < 0.6
    place = torch.tensor([0.13, -0.21, 0.07], dtype=torch.float64)
    bits, unobserved = sliding.beam_novelty(place, ends, is_hit, NoveltyRule(observed=3.0), within=within)
    expected, new = novelty_by_a_walk(seen, place, ends, is_hit, NoveltyRule(observed=3.0))
    torch.testing.assert_close(bits, expected, rtol=0, atol=1e-5)
    assert unobserved.tolist() == new
