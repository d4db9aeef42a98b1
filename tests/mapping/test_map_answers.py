"""Occupancy of a GaussianMap by every method: probabilities, grids, gradients, invariances."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache, partial

import pytest
import torch
from mapping.map_cases import (
    FINE,
    assert_close_components,
    assert_same_components,
    built,
    drive,
    given_parts,
    open_drive,
    rooms,
)
from occupancy.protocol_contract import RESOLUTION, SENSOR, WALL, dims, lattice, points, shifted, wall_scan

from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.mapping import METHODS, GaussianMap, Query, QueryOptions, map_state, quantized
from gmmtorch.mapping import query as map_query
from gmmtorch.mapping.query import count_many, cutoff_of
from gmmtorch.occupancy import CUTOFF, Calibration, Cones, VoxelGrid, cone_index
from gmmtorch.occupancy.forms import point as point_form

methods = pytest.mark.parametrize("method", METHODS)


@cache
def fine_map(dim: int, codec: str = "float") -> GaussianMap:
    return built(open_drive(2, dim), FINE, codec=codec)


@dims
@methods
def test_occupancy_is_a_probability_and_one_half_far_away(dim, method):
    made = fine_map(dim, "quantized")
    theta = made.occupancy(lattice(dim), method=method)
    assert 0 <= float(theta.min()) < 0.3
    assert 0.6 < float(theta.max()) <= 1
    away = torch.cat([lattice(dim)[::40] + 100, lattice(dim)[::40] - 1e7, torch.full((2, dim), math.inf)])
    assert (made.occupancy(away, method=method) == 0.5).all()
    sensor = torch.tensor(SENSOR[:dim], dtype=torch.float64)
    at = torch.stack([sensor, drive(2, dim)[1].origin, sensor + 1e-9])
    assert float(made.occupancy(at, method=method).max()) < 0.5
    assert float(made.occupancy(points([WALL], dim), method=method)) > 0.5


@dims
@methods
@pytest.mark.parametrize("resolution", [1e-3, 10.0])
def test_occupancy_is_a_probability_at_1_mm_and_10_m_resolution(dim, method, resolution):
    if method == "monte_carlo" and resolution < 0.01:
        return  # takes memory by the cell: see the test of its limit
    query = torch.cat([points([0.3125, 1.0, 2.0, 3.0, WALL, 3.0715, 4.0], dim), lattice(dim)[::60]])
    theta = fine_map(dim).occupancy(query, resolution, method)
    assert 0 <= float(theta.min()) <= float(theta.max()) <= 1


@dims
@methods
def test_occupancy_is_the_same_far_from_the_world_origin(dim, method):
    parts = given_parts(dim)
    shift = torch.tensor([524_288.0, -262_144.0, 1024.0], dtype=torch.float64)[:dim]
    far = {**parts, "means": parts["means"] + shift, "origins": parts["origins"] + shift}
    query = lattice(dim)[::3] + 2.0**-9
    near, there = (
        GaussianMap.from_components(**given, method=method, n_samples=1 << 14) for given in (parts, far)
    )
    expected = near.occupancy(query, 0.125)
    theta = there.occupancy(query + shift, 0.125)
    if method == "monte_carlo":  # a ray that crosses a corner may go the other way round it
        assert float((theta - expected).abs().mean()) < 1e-4
    else:
        torch.testing.assert_close(theta, expected, rtol=0, atol=1e-5)


@dims
@methods
def test_grid_evidence_equals_the_occupancy_at_cell_centres(dim, method):
    made = built(drive(2, dim), method=method)
    grid = VoxelGrid.covering([-1.0] * dim, [3.5] * dim, 0.25)
    evidence = made.evidence(grid)
    assert float(evidence.hits.min()) >= 0
    assert float(evidence.misses.min()) >= 0
    theta = evidence.probability().flatten()
    # The flux of a grid and that of single boxes are integrated separately, each within its tolerance.
    tolerance = 0.01 if method == "flux" else 1e-6
    torch.testing.assert_close(made.occupancy(grid.centers(), 0.25), theta, rtol=1e-6, atol=tolerance)
    assert len(theta.unique()) > 10


@dims
def test_a_map_of_given_components_has_the_calibration_of_its_ranges(dim):
    means, origins = points([1.0, 4.0, 9.0], dim), points([0.0, 0.0, 1.0], dim)
    given = {
        "means": means,
        "covariances": 0.01 * torch.eye(dim, dtype=torch.float64).expand(3, dim, dim),
        "support": [30.0, 10.0, 50.0],
        "origins": origins,
        "max_range": [False, False, True],  # beams without a return do not count
    }
    known = Calibration.prior((30 * 1.0 + 10 * 4.0) / 40)
    found = GaussianMap.from_components(**given).occupancy(lattice(dim), 0.25)
    expected = GaussianMap.from_components(**given, calibration=known).occupancy(lattice(dim), 0.25)
    assert torch.equal(found, expected)
    counts = GaussianMap.from_components(**given, prior=1.0).occupancy(lattice(dim), 0.25)
    assert not torch.equal(found, counts)
    free = {**given, "max_range": [True] * 3}
    assert bool((GaussianMap.from_components(**free).occupancy(means) < 0.5).all())


@dims
def test_all_methods_approximate_monte_carlo_occupancy(dim):
    made = built(drive(2, dim), n_samples=1 << 17, prior=1.0)
    exact = made.occupancy(lattice(dim), method="monte_carlo")
    for method, tolerance in (("flux", 0.01), ("cone", 0.1), ("point", 0.1)):
        theta = made.occupancy(lattice(dim), method=method)
        assert float((theta - exact).abs().mean()) < tolerance, method


@dims
@pytest.mark.parametrize("learning", [None, FINE])
def test_gradients_in_the_queries_equal_finite_differences(dim, learning, generator):
    made = built(drive(2, dim), learning)
    on_wall = points([WALL], dim) + 0.05 * torch.randn(20, dim, generator=generator, dtype=torch.float64)
    query = torch.cat([lattice(dim)[::17], on_wall]).requires_grad_()
    made.occupancy(query, 0.125, "point").sum().backward()
    assert query.grad is not None
    step = 1e-6
    for axis in range(dim):
        shift = step * torch.eye(dim, dtype=torch.float64)[axis]
        above, below = (made.occupancy(query.detach() + sign * shift, 0.125, "point") for sign in (1, -1))
        torch.testing.assert_close(query.grad[:, axis], (above - below) / (2 * step), rtol=1e-4, atol=1e-6)
    assert float(query.grad.abs().max()) > 1


def test_occupancy_uses_the_prior_of_the_map():
    weak, strong = (built([wall_scan(2)], prior=prior) for prior in (0.1, 10.0))
    query = points([3.0625], 2)
    assert 0.5 < float(strong.occupancy(query)) < float(weak.occupancy(query))


@methods
def test_occupancy_uses_the_resolution_and_method_of_the_map_by_default(method):
    made = built([wall_scan(2)], resolution=0.25, method=method)
    assert torch.equal(made.occupancy(lattice(2)), made.occupancy(lattice(2), 0.25, method))
    assert not torch.equal(made.occupancy(lattice(2)), made.occupancy(lattice(2), 0.125))
    other = METHODS[METHODS.index(method) - 1]
    assert not torch.equal(made.occupancy(lattice(2)), made.occupancy(lattice(2), method=other))


def test_n_samples_changes_occupancy_only_by_noise():
    few, many = (built(drive(2), n_samples=n, method="monte_carlo") for n in (3_000, 100_000))
    difference = (few.occupancy(lattice(2)) - many.occupancy(lattice(2))).abs()
    assert 0 < float(difference.mean()) < 0.01


# -- bad input -------------------------------------------------------------------------------------


@pytest.mark.parametrize("resolution", [0, -1.0, math.nan, math.inf])
def test_invalid_resolutions_are_refused(resolution):
    with pytest.raises(InvalidArgumentError, match="resolution"):
        built([wall_scan(2)]).occupancy(lattice(2), resolution)


def test_an_unknown_method_is_refused_by_name():
    for made in (built([wall_scan(2)]), GaussianMap(resolution=RESOLUTION)):
        with pytest.raises(InvalidArgumentError, match="method='magic'"):
            made.occupancy(lattice(2), method="magic")
        with pytest.raises(InvalidArgumentError, match="method='magic'"):
            made.evidence(VoxelGrid((0, 0), 1.0, (2, 2)), method="magic")


def test_a_grid_of_another_dimension_is_refused():
    with pytest.raises(InvalidArgumentError, match="dimensional"):
        built([wall_scan(2)]).evidence(VoxelGrid((0, 0, 0), 1.0, (2, 2, 2)))


def test_evidence_beyond_the_memory_limit_is_refused():
    with pytest.raises(MemoryLimitError, match="resolution"):
        built([wall_scan(2)], memory_limit=1 << 16).occupancy(lattice(2), 0.005, "monte_carlo")


def test_lists_are_read_in_double_precision():
    # A list that became float32 on the way would be off by 2 cm there.
    matrix = shifted(2, (524_288.3, -262_144.7))
    made = built([wall_scan(2).transformed(matrix)], FINE)
    query = points([3.0], 2) + matrix[:2, 2]
    assert made.occupancy(query.tolist()).tolist() == made.occupancy(query).tolist()
    given = {name: value.tolist() for name, value in given_parts().items()}
    assert torch.equal(GaussianMap.from_components(**given).origins, given_parts()["origins"])


def test_the_default_cutoff_follows_the_support_of_the_components():
    def cutoff(*counts: float) -> float:
        return cutoff_of(*count_many(torch.tensor(counts, dtype=torch.float64)))

    assert cutoff(1000.0, 60.0, 50.0) == 3
    assert cutoff(1000.0, 40.0, 3.0) == CUTOFF
    assert cutoff(0.0, 0.0, 70.0) == 3
    assert cutoff() == CUTOFF
    components = built(open_drive(2, 2), FINE).components()
    counts = torch.full_like(components.seen_count, 1000.0)
    many = replace(components, seen_count=counts)
    assert [Query([many], QueryOptions(cutoff=given)).cutoff for given in (4.0, None)] == [4, 3]


# -- a map that is asked while it grows ------------------------------------------------------------------


corridor = partial(rooms, apart=4.0)


@dims
@pytest.mark.parametrize(
    ("method", "codec", "block"),
    [("point", "quantized", 8192), ("flux", "float", 8192)]
    + [(method, "quantized", 25) for method in ("point", "flux", "cone")],
)
def test_a_map_asked_after_each_scan_answers_like_a_new_one(dim, method, codec, block, monkeypatch):
    for module in (point_form, cone_index):
        monkeypatch.setattr(module, "_FEW_PAIRS", 0)
    monkeypatch.setattr(map_query, "_BLOCK", block)
    grown = GaussianMap(replace(FINE, window=3), codec=codec, method=method)
    grid = VoxelGrid.covering([-1.0] * dim, [10.0] + [2.0] * (dim - 1), 0.5)
    for number, scan in enumerate(corridor(8, dim)):
        grown.insert(scan)
        query = torch.cat([lattice(dim)[::7], lattice(dim)[::11] + scan.origin])
        theta = grown.occupancy(query)
        new = grown.snapshot()
        torch.testing.assert_close(theta, new.occupancy(query), rtol=1e-9, atol=1e-9)
        if number % 4 == 3:
            found, expected = grown.evidence(grid), new.evidence(grid)
            for name in ("hits", "misses"):
                torch.testing.assert_close(
                    getattr(found, name), getattr(expected, name), rtol=1e-9, atol=1e-9
                )
    expected = quantized(grown.unrounded()) if codec == "quantized" else grown.unrounded()
    assert_same_components(grown.components(), expected)


@dims
@pytest.mark.parametrize("few_pairs", [0, 1 << 19])
def test_blocks_answer_as_one_form_of_all_cones_however_the_components_change(
    dim, few_pairs, monkeypatch, generator
):
    for module in (point_form, cone_index):
        monkeypatch.setattr(module, "_FEW_PAIRS", few_pairs)
    monkeypatch.setattr(map_query, "_BLOCK", 20)
    every = built(corridor(9, dim), FINE).components()
    asked = torch.cat([lattice(dim), lattice(dim) + torch.tensor([4.0, 0, 0][:dim])])
    asked = torch.cat([asked, torch.full_like(asked[:1], torch.inf), 1e7 + asked[:1]])
    options = QueryOptions(cutoff=4.0)
    answers = Query([every.selected(torch.arange(10))], options)
    for step in range(12):
        kept = torch.rand(len(every), generator=generator) < (step / 8 if step < 8 else 0.9)
        changed = every.selected(kept.nonzero().squeeze(1))
        if step % 3 == 1 and len(changed):
            changed.seen_count[: 1 + len(changed) // 3] *= 2  # `selected` copies
        recent = [every.selected(torch.arange(step, step + 2))] if step % 2 else []
        answers = Query([changed], options, recent, answers)
        cones = Cones(*map(torch.cat, zip(*(c.cones() for c in (changed, *recent)), strict=True)))
        expected = point_form.PointForm(cones, 0.1, 4.0)(asked)
        found = answers.evidence_at(asked, 0.1, "point")
        for one, other in zip(found, expected, strict=True):
            assert torch.equal(one, other)


@dims
def test_a_large_unfinished_window_answers_from_its_parts_until_it_is_learned(dim, monkeypatch):
    monkeypatch.setattr(map_state, "_PART", 1)
    grown = GaussianMap(replace(FINE, window=4))
    asked = torch.cat([scan.points[::5] for scan in corridor(7, dim)]) + 0.02
    for scan in corridor(7, dim):
        grown.insert(scan)
    theta = grown.occupancy(asked)
    assert len(grown._parts) == 3
    whole = built(corridor(4, dim), replace(FINE, window=4), codec="quantized").components().cones()
    parts = [c.cones() for c in grown._parts.values()]
    cones = Cones(*map(torch.cat, zip(whole, *parts, strict=True)))
    query = Query([grown.components()], grown.query_options)
    evidence = point_form.PointForm(cones, grown.resolution, query.cutoff)(asked)
    expected = grown.query_options.calibration.probability(*evidence, grown.resolution, dim)
    torch.testing.assert_close(theta, expected, rtol=1e-12, atol=1e-12)
    learned = grown.occupancy(asked)  # `components` has learned the window
    assert not torch.equal(learned, theta)
    torch.testing.assert_close(learned, grown.snapshot().occupancy(asked), rtol=1e-9, atol=1e-9)
    restored = GaussianMap(replace(FINE, window=4))
    restored.load_state_dict(grown.state_dict())
    assert torch.equal(restored.occupancy(asked), theta)


@dims
def test_a_map_that_is_asked_between_scans_learns_when_they_are_inserted(dim, monkeypatch):
    monkeypatch.setattr(map_state, "_PART", 1)
    asked, other = GaussianMap(replace(FINE, window=4)), GaussianMap(replace(FINE, window=4))
    points = lattice(dim)
    for number, scan in enumerate(corridor(11, dim)):
        asked.insert(scan)
        other.insert(scan)
        assert asked._is_stale == (number in (0, 7))  # nobody asked between the scan before and this one
        if number != 6:
            asked.occupancy(points)
    found, expected = asked.occupancy(points), other.occupancy(points)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


@dims
@pytest.mark.parametrize("block", [8192, 25])
def test_components_that_are_replaced_give_no_evidence(dim, block, monkeypatch):
    for module in (point_form, cone_index):
        monkeypatch.setattr(module, "_FEW_PAIRS", 0)
    monkeypatch.setattr(map_query, "_BLOCK", block)
    made = built(corridor(6, dim), FINE, codec="quantized")
    query = torch.cat([lattice(dim), lattice(dim) + torch.tensor([4.0, 0, 0][:dim])])
    before = made.occupancy(query)
    n = made.n_components
    made.revise(lambda components: components.selected(torch.arange(n // 10, n)))
    after = made.occupancy(query)
    assert not torch.equal(after, before)
    torch.testing.assert_close(after, made.snapshot().occupancy(query), rtol=1e-9, atol=1e-9)
    made.revise(lambda components: replace(components, max_range=components.max_range | True))
    assert float(made.evidence(VoxelGrid.covering([0.0] * dim, [4.0] * dim, 0.5)).hits.max()) == 0
    made.revise(lambda components: components.selected(torch.arange(0)))
    assert (made.occupancy(query) == 0.5).all()
    made.insert(corridor(1, dim)[0])
    torch.testing.assert_close(made.occupancy(query), made.snapshot().occupancy(query), rtol=1e-9, atol=1e-9)


@dims
@pytest.mark.parametrize("codec", ["quantized", "float"])
def test_a_map_in_blocks_is_the_same_map_to_the_bit(dim, codec, monkeypatch):
    rule = replace(FINE, window=3, mean_origins=None)
    scans = corridor(14, dim)
    whole = built(scans, rule, codec=codec)
    monkeypatch.setattr(map_query, "_BLOCK", 20)
    grown = built(scans, rule, codec=codec)
    assert len(grown._blocks) > 2
    assert grown.n_pending == 2
    for name in ("means", "covariances", "support", "max_range", "ids"):
        assert torch.equal(getattr(grown.components(), name), getattr(whole.components(), name)), name
    assert_close_components(grown.components(), whole.components())  # counts of one block are scaled again
    assert grown.query_options == whole.query_options  # the same predictions
    asked = torch.cat([scan.points[::9] for scan in scans]) + 0.02
    if codec == "quantized":
        assert torch.equal(grown.occupancy(asked), whole.occupancy(asked))
    grown.finish()
    assert grown.n_components == len(grown.unrounded()) == whole.n_components > grown.n_final


@pytest.mark.parametrize("codec", ["quantized", "float"])
def test_a_map_in_blocks_continues_bit_by_bit_from_its_state_and_its_file(codec, monkeypatch, tmp_path):
    monkeypatch.setattr(map_query, "_BLOCK", 20)
    rule = replace(FINE, window=3)
    scans = corridor(20, 2)
    first = built(scans[:13], rule, codec=codec)
    restored = GaussianMap(rule, codec=codec)
    restored.load_state_dict(first.state_dict())
    assert [len(block.components) for block in restored._blocks] == [len(b.components) for b in first._blocks]
    assert len(first._blocks) > 2
    first.save(tmp_path / "map.safetensors")  # an unfinished window ends there
    first.revise(lambda components: components)
    loaded = GaussianMap.load(tmp_path / "map.safetensors")
    for scan in scans[13:]:
        for made in (first, restored, loaded):
            made.insert(scan)
    other = built(scans, rule, codec=codec)
    assert_same_components(restored.components(), other.components())
    if codec == "float":
        assert_same_components(loaded.components(), first.components())


def test_a_scan_changes_and_reads_the_last_block_only(monkeypatch):
    monkeypatch.setattr(map_query, "_BLOCK", 20)
    grown = GaussianMap(replace(FINE, window=3))
    for scan in corridor(12, 2):
        grown.insert(scan)
        grown.occupancy(scan.points[:9])
    before = [(block, block.components) for block in grown._blocks[:-1]]
    answered = grown._answers()._blocks[: len(before)]
    assert len(before) > 1
    for scan in corridor(15, 2)[12:]:
        grown.insert(scan)
        grown.occupancy(scan.points[:9])
    assert grown.n_pending == 0
    for (block, components), now in zip(before, grown._blocks, strict=False):
        assert now is block
        assert now.components is components
    for block, now in zip(answered, grown._answers()._blocks, strict=False):
        assert now is block
