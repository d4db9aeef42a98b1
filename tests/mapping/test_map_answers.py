"""Occupancy of a GaussianMap by every method: probabilities, grids, gradients, invariances."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from mapping.map_cases import FINE, built, drive, given_parts, open_drive
from occupancy.protocol_contract import RESOLUTION, SENSOR, WALL, dims, lattice, points, shifted, wall_scan

from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.mapping.codec.quantization import quantized
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.query import Query, cutoff_by_support
from gmmtorch.mapping.query_options import METHODS, QueryOptions
from gmmtorch.occupancy import cone_index
from gmmtorch.occupancy.calibrator import Calibration
from gmmtorch.occupancy.cones import CUTOFF, Cones
from gmmtorch.occupancy.forms import point as point_form
from gmmtorch.occupancy.grid import VoxelGrid
from gmmtorch.scan import Scan

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
def test_gradients_in_the_queries_equal_finite_differences(dim, learning):
    made = built(drive(2, dim), learning)
    generator = torch.Generator().manual_seed(0)
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
    def cones(*counts: float) -> Cones:
        k = len(counts)
        eye = torch.eye(2, dtype=torch.float64).repeat(k, 1, 1)
        place = torch.zeros(k, 2, dtype=torch.float64)
        weight = torch.tensor(counts, dtype=torch.float64)
        return Cones(place, eye, place + 5, weight, torch.zeros(k, dtype=torch.bool))

    assert cutoff_by_support(cones(1000.0, 60.0, 50.0)) == 3
    assert cutoff_by_support(cones(1000.0, 40.0, 3.0)) == CUTOFF
    assert cutoff_by_support(cones(0.0, 0.0, 70.0)) == 3
    assert cutoff_by_support(cones()) == CUTOFF
    fixed = Query(cones(1000.0), QueryOptions(cutoff=4.0))
    assert (fixed.cutoff, Query(cones(1000.0), QueryOptions(cutoff=None)).cutoff) == (4, 3)


# -- a map that is asked while it grows ------------------------------------------------------------------


def corridor(n: int, dim: int) -> list[Scan]:
    """Scans of walls every 4 m, each from another place."""
    shift = torch.tensor([4.0, 0, 0][:dim], dtype=torch.float64)
    near = open_drive(3, dim)
    return [
        Scan(
            s.points + number // 3 * shift, s.origin + number // 3 * shift, s.no_return + number // 3 * shift
        )
        for number in range(n)
        for s in [near[number % 3]]
    ]


@dims
@pytest.mark.parametrize("method", ["point", "flux", "cone"])
@pytest.mark.parametrize("codec", ["quantized", "float"])
def test_a_map_asked_after_each_scan_answers_like_a_new_one(dim, method, codec, monkeypatch):
    for module in (point_form, cone_index):
        monkeypatch.setattr(module, "_FEW_PAIRS", 0)
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
    for name, values in grown.components().tensors().items():
        assert torch.equal(values, getattr(expected, name)), name


@dims
def test_components_that_are_replaced_give_no_evidence(dim, monkeypatch):
    for module in (point_form, cone_index):
        monkeypatch.setattr(module, "_FEW_PAIRS", 0)
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
