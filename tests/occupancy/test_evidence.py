"""Evidence: counts of rays, and the occupancy that follows from them."""

from __future__ import annotations

import math
import re
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from occupancy.exact_dda import voxels_left
from scipy.optimize import brentq
from scipy.stats import bernoulli
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.occupancy.evidence import (
    CellClass,
    Evidence,
    Thresholds,
    bernoulli_entropy,
    classify,
    occupancy_probability,
)
from gmmtorch.occupancy.grid import BYTES_PER_CELL, VoxelGrid, rasterize

GRIDS = {2: VoxelGrid((-1.0, 0.5), 0.25, (9, 8)), 3: VoxelGrid((-1.0, 0.5, 0.0), 0.25, (6, 7, 5))}
counts = st.floats(0, 1e6)


def random_rays(grid: VoxelGrid, n: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Rays with dyadic coordinates, some of which start or end outside the grid."""
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor(grid.shape, dtype=torch.float64) * grid.resolution
    unit = torch.rand(2, n, grid.dim, generator=generator, dtype=torch.float64) * 1.4 - 0.2
    rays = torch.tensor(grid.origin, dtype=torch.float64) + torch.round(unit * size * 1024) / 1024
    return rays[0], rays[1]


def brute_force(grid: VoxelGrid, origins: Tensor, ends: Tensor, weights: list[float], is_hit: list[bool]):
    hits, misses = np.zeros(grid.shape), np.zeros(grid.shape)
    for start, stop, weight, hit in zip(origins, ends, weights, is_hit, strict=True):
        a, b = (((x - torch.tensor(grid.origin).double()) / grid.resolution).tolist() for x in (start, stop))
        for voxel in voxels_left(a, b, grid.shape):
            misses[voxel] += weight
        last = tuple(math.floor(x) for x in b)
        if hit and all(0 <= i < n for i, n in zip(last, grid.shape, strict=True)):
            hits[last] += weight
    return hits, misses


# -- probability ---------------------------------------------------------------------------------------


@given(hits=counts, misses=counts, prior=st.floats(1e-3, 100))
def test_occupancy_probability_equals_equation_3_9(hits, misses, prior):
    pair = torch.tensor([[hits], [misses]], dtype=torch.float64)
    theta = float(occupancy_probability(pair[0], pair[1], prior))
    assert theta == pytest.approx((hits + prior) / (hits + misses + 2 * prior), rel=1e-12)
    assert 0 <= theta <= 1


@pytest.mark.parametrize("prior", [0, 1e-300, 0.1, 1 / 3, 1, 7.7])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_occupancy_is_exactly_half_without_evidence_and_the_share_of_hits_without_a_prior(prior, dtype):
    zero = torch.zeros(3, dtype=dtype)
    assert occupancy_probability(zero, zero, prior).tolist() == [0.5] * 3
    theta = occupancy_probability(torch.tensor([3.0, 0.0, 2.0]), torch.tensor([1.0, 5.0, 0.0]), 0)
    assert theta.tolist() == [0.75, 0.0, 1.0]


@pytest.mark.parametrize(
    ("name", "make", "values"),
    [
        ("prior", lambda x: occupancy_probability(torch.ones(1), torch.ones(1), x), (-1, math.nan, math.inf)),
        ("variance_threshold", lambda x: classify(torch.tensor([0.5]), x), (0, -0.1, 0.26, math.nan)),
        ("free_thresh=", lambda x: Thresholds(*x), ((0.7, 0.6), (-0.1, 0.5), (0.1, 1.1), (math.nan, 0.5))),
    ],
)
def test_invalid_priors_and_thresholds_are_refused(name, make, values):
    for value in values:
        with pytest.raises(InvalidArgumentError, match=name):
            make(value)


@pytest.mark.parametrize("theta", [0.0, 1e-12, 0.1, 0.5, 0.77, 1.0])
def test_entropy_equals_scipys_bernoulli(theta):
    value = torch.tensor([theta], dtype=torch.float64)
    expected = float(bernoulli(theta).entropy()) / math.log(2) if 0 < theta < 1 else 0.0
    assert float(bernoulli_entropy(value)) == pytest.approx(expected, abs=1e-12)


def test_methods_of_evidence_equal_the_functions(generator):
    grid = GRIDS[2]
    evidence = Evidence(grid, *(5 * torch.rand(2, *grid.shape, generator=generator, dtype=torch.float64)))
    theta = (evidence.hits + 2) / (evidence.hits + evidence.misses + 4)
    torch.testing.assert_close(evidence.probability(2), theta)
    torch.testing.assert_close(evidence.variance(2), theta * (1 - theta))
    torch.testing.assert_close(evidence.entropy(2), bernoulli_entropy(theta))
    assert evidence.classify(0.2, 2).tolist() == classify(theta, 0.2).tolist()


# -- the dead band -------------------------------------------------------------------------------------


@pytest.mark.parametrize("threshold", [1e-6, 0.01, 0.06, 0.2, 0.2499])
def test_the_dead_band_ends_where_the_variance_is_the_threshold(threshold):
    low = brentq(lambda t: t * (1 - t) - threshold, 0, 0.5, xtol=1e-14)
    high = brentq(lambda t: t * (1 - t) - threshold, 0.5, 1, xtol=1e-14)
    theta = torch.tensor([low - 1e-9, low + 1e-9, 0.5, high - 1e-9, high + 1e-9], dtype=torch.float64)
    unknown = CellClass.UNKNOWN
    expected = [CellClass.FREE, unknown, unknown, unknown, CellClass.OCCUPIED]
    assert classify(theta, threshold).tolist() == expected


def test_without_a_dead_band_only_a_half_is_unknown():
    theta = torch.tensor([0.0, 0.4999, 0.5, 0.5001, 1.0])
    assert classify(theta, 0.25).tolist() == [0, 0, -1, 1, 1]
    assert classify(theta, 0.25).dtype == torch.int8


# -- counting ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_rays_count_as_in_a_cell_by_cell_walk(dim):
    grid = GRIDS[dim]
    origins, ends = random_rays(grid, 300)
    generator = torch.Generator().manual_seed(1)
    weights = torch.rand(300, generator=generator, dtype=torch.float64)
    is_hit = torch.rand(300, generator=generator) > 0.3
    evidence = Evidence.empty(grid)
    evidence.add_rays(origins, ends, weights, is_hit)
    hits, misses = brute_force(grid, origins, ends, weights.tolist(), is_hit.tolist())
    np.testing.assert_allclose(evidence.hits.numpy(), hits, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(evidence.misses.numpy(), misses, rtol=1e-12, atol=1e-12)
    assert hits.sum() > 0 < misses.sum()


def test_lookup_reads_the_cell_and_is_half_outside():
    grid = GRIDS[2]
    evidence = Evidence.empty(grid)
    evidence.add_rays(*random_rays(grid, 200))
    assert torch.equal(evidence.lookup(grid.centers()), evidence.probability().flatten())
    nan, inf = float("nan"), float("inf")
    far = torch.tensor([[100.0, 0.0], [-1.01, 1.0], [nan, 1.0], [inf, 1.0]], dtype=torch.float64)
    assert evidence.lookup(far).tolist() == [0.5] * 4


def test_thresholds_classify_free_unknown_and_occupied():
    theta = torch.tensor([0.0, 0.196, 0.5, 0.65, 0.651, 1.0], dtype=torch.float64)
    assert Thresholds().classify(theta).tolist() == [0, -1, -1, -1, 1, 1]


# -- VoxelGrid: indices, centres, covering a box, and bad input ------------------------------------------


PLACES = [VoxelGrid((-1.0, 2.0), 0.25, (4, 6)), VoxelGrid((0.1, -7.3, 500_000.0), 0.1, (3, 4, 5))]


@pytest.mark.parametrize("grid", PLACES)
def test_cell_centres_have_their_own_flat_index(grid):
    cell, inside = grid.flat_index(grid.centers())
    assert bool(inside.all())
    assert cell.tolist() == list(range(grid.n_cells))
    index = torch.cartesian_prod(*(torch.arange(n) for n in grid.shape))  # row-major
    points = torch.tensor(grid.origin, dtype=torch.float64) + (index + 0.5) * grid.resolution
    torch.testing.assert_close(grid.centers(), points)


def test_cells_are_half_open():
    grid = VoxelGrid((0.0, 0.0), 0.5, (2, 3))
    points = torch.tensor(
        [[0, 0], [0.5, 0], [0, 0.5], [0.999, 1.499], [1.0, 0], [0, 1.5], [-1e-9, 0]]
    ).double()
    cell, inside = grid.flat_index(points)
    assert cell.tolist() == [0, 3, 1, 5, 0, 0, 0]
    assert inside.tolist() == [True] * 4 + [False] * 3


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e300])
def test_points_that_are_not_finite_are_outside(value):
    cell, inside = PLACES[0].flat_index(torch.tensor([[value, 2.1], [-0.9, value]], dtype=torch.float64))
    assert not inside.any()
    assert cell.tolist() == [0, 0]


box = st.tuples(st.integers(-2000, 2000), st.integers(0, 300)).map(lambda t: (t[0] / 16, (t[0] + t[1]) / 16))


@given(st.lists(box, min_size=2, max_size=3), st.sampled_from([0.125, 0.25, 0.5, 1.0]))
def test_covering_is_the_smallest_aligned_grid(sides, resolution):
    low, high = [a for a, _ in sides], [b for _, b in sides]
    grid = VoxelGrid.covering(low, high, resolution)
    for origin, n, a, b in zip(grid.origin, grid.shape, low, high, strict=True):
        assert Fraction(origin) % Fraction(resolution) == 0
        assert origin <= a < origin + resolution
        assert origin + (n - 1) * resolution <= b < origin + n * resolution
    assert bool(grid.flat_index(torch.tensor([low, high], dtype=torch.float64))[1].all())


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ([0, 0], [300, 500]),
        ([0, 0, 0], [80, 70, 90]),
        ([0, 0, 0], [2000, 2000, 0.01]),
        ([0, 0, 0], [90000, 0, 0]),
    ],
    ids=["square", "cube", "thin slab", "line"],
)
def test_a_grid_too_large_names_its_bytes_and_a_resolution_that_fits(low, high):
    limit = 1 << 20
    resolution = 0.05
    cells = math.prod(math.floor(b / resolution) + 1 for b in high)
    with pytest.raises(MemoryLimitError, match=re.escape(f"{cells * BYTES_PER_CELL:,} bytes")) as caught:
        VoxelGrid.covering(low, high, resolution, memory_limit=limit)
    assert f"{limit:,}" in str(caught.value)
    suggestion = float(re.search(r"a resolution of ([0-9.e+-]+) m", str(caught.value))[1])
    assert VoxelGrid.covering(low, high, suggestion, memory_limit=limit).n_cells * BYTES_PER_CELL <= limit


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize("resolution", [0, -0.1, NAN, INF])
def test_invalid_resolutions_are_refused(resolution):
    for make in (lambda h: VoxelGrid((0.0, 0.0), h, (2, 2)), lambda h: VoxelGrid.covering([0, 0], [1, 1], h)):
        with pytest.raises(InvalidArgumentError, match="resolution"):
            make(resolution)


def test_invalid_shapes_origins_and_boxes_are_refused():
    shapes = [((0.0, 0.0), (0, 3)), ((0.0, 0.0), (-1, 3)), ((0.0,), (3,)), ((0.0,) * 4, (2,) * 4)]
    shapes += [((0.0, 0.0), (2, 2, 2)), ((NAN, 0.0), (2, 2)), ((0.0, INF), (2, 2))]
    for origin, shape in shapes:
        with pytest.raises(InvalidArgumentError, match=r"origin|shape"):
            VoxelGrid(origin, 0.1, shape)
    for low, high in (([0, 0], [-1, 1]), ([0, NAN], [1, 1]), ([0, 0], [1, INF])):
        with pytest.raises(InvalidArgumentError, match=r"low|high"):
            VoxelGrid.covering(low, high, 0.1)


@pytest.mark.parametrize("shape", [(500, 300), (70, 40, 50)])
def test_rasterize_evaluates_each_cell_centre_and_reports_progress(shape):
    grid = VoxelGrid((0.3,) * len(shape), 0.1, shape)
    progress: list[int] = []
    found = rasterize(lambda x: (x * 0.1).sum(1), grid, lambda stage, done, total: progress.append(done))
    torch.testing.assert_close(found.flatten(), (grid.centers() * 0.1).sum(1), rtol=0, atol=0)
    assert progress == sorted(progress)
    assert progress[-1] == grid.n_cells
