"""Ray traversal against a plain DDA in exact rational arithmetic."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels.twins import Largest
from occupancy.exact_dda import voxels_crossed, voxels_left
from torch import Tensor

from gmmtorch.kernels import kernels, row_major_strides, traverse


@pytest.fixture(autouse=True, params=["fused", "torch"])
def _kernels(request):
    with kernels(request.param):
        yield


SHAPES = {2: (7, 9), 3: (6, 5, 7)}

Visited = list[tuple[int, tuple[int, ...]]]  # (ray, voxel), sorted


def visited(starts: Tensor, ends: Tensor, shape: tuple[int, ...], **options) -> Visited:
    strides = options.get("strides") or row_major_strides(shape)
    found = []
    for chunk in traverse(starts, ends, shape, **options):
        assert {part.dtype for part in chunk} == {torch.int64}
        for voxel, ray in zip(*(part.tolist() for part in chunk), strict=True):
            index = []
            for axis in sorted(range(len(shape)), key=lambda a: -strides[a]):
                index.append((axis, voxel // strides[axis]))
                voxel %= strides[axis]
            found.append((ray, tuple(i for _, i in sorted(index))))
    return sorted(found)


def expected(starts: Tensor, ends: Tensor, shape: tuple[int, ...]) -> Visited:
    rays = zip(starts.tolist(), ends.tolist(), strict=True)
    return sorted((r, v) for r, (a, b) in enumerate(rays) for v in voxels_left(a, b, shape))


def check(starts: Tensor, ends: Tensor, shape: tuple[int, ...]) -> None:
    assert visited(starts, ends, shape) == expected(starts, ends, shape)


def random_rays(
    n: int, shape: tuple[int, ...], margin: float, step: float, seed: int = 0
) -> tuple[Tensor, Tensor]:
    """Ends within the box grown by `margin` of its size, on multiples of `step`."""
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor(shape, dtype=torch.float64)

    def draw() -> Tensor:
        unit = torch.rand(n, len(shape), generator=generator, dtype=torch.float64) * (1 + 2 * margin) - margin
        return torch.round(unit * size / step) * step

    return draw(), draw()


# -- the oracle itself, by hand -----------------------------------------------------------------------


def test_the_reference_walk_equals_a_hand_computed_ray():
    assert voxels_left([0.5, 0.5], [2.5, 1.25]) == [(0, 0), (1, 0), (1, 1)]
    assert voxels_left([2.5, 1.25], [0.5, 0.5]) == [(2, 1), (1, 1), (1, 0)]
    assert voxels_left([0.5, 0.5], [2.5, 2.5]) == [(0, 0), (1, 0), (1, 1), (2, 1)]  # ties: lower axis first
    assert voxels_left([0.5, 0.5], [0.75, 0.75]) == []


# -- random and aligned -------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("step", [2.0**-16, 0.25, 0.5, 1.0])
@pytest.mark.parametrize("margin", [-0.02, 0.6])
def test_random_rays_and_those_on_lattice_points_equal_the_reference_walk(dim, step, margin):
    check(*random_rays(1500, SHAPES[dim], margin, step), SHAPES[dim])


SPANS = [(0.0, 4.0), (4.0, 0.0), (-3.5, 8.5), (8.0, -3.0), (1.25, 1.75), (3.0, 3.0), (0.5, 2.0), (3.5, 2.0)]
BESIDE = [[[-2.0, -1, 1], [-1, 7, 1]], [[6, 0.5, 1], [9, 4.5, 1]], [[-1, 4.5, 1], [4.5, 10, 1]]]
"""Rays that no cell of a grid of 5³ contains a part of."""


def test_rays_along_axes_and_diagonals_and_beside_the_grid_equal_the_reference_walk():
    """Some of no length, and some that end on planes or lie in them."""
    rays = [torch.tensor(pair).double() for pair in BESIDE]
    for axis, other, span in itertools.product(range(3), (0.0, 0.5, 2.0, 4.0, 5.0, -0.25), SPANS):
        rays.append(torch.full((2, 3), other).double())
        rays[-1][:, axis] = torch.tensor(span)
    for signs, offset in itertools.product(itertools.product((1, -1), repeat=3), (0.0, 0.25, 0.5)):
        step = torch.tensor(signs).double()
        start = torch.where(step > 0, offset, 5 - offset).double()
        rays.append(torch.stack([start, start + 4.75 * step]))
    check(*torch.stack(rays).unbind(1), (5, 5, 5))


def test_no_rays_visit_nothing():
    empty = torch.empty(0, 3, dtype=torch.float64)
    assert list(traverse(empty, empty, (4, 4, 4))) == []


coordinate = st.integers(-(2**11), 2**12).map(lambda i: i / 256)  # −8 … 16, so that ties are exact
nice = st.sampled_from([-2.0, 0.0, 0.5, 1.0, 2.0, 2.25, 3.0, 4.0, 5.0, 8.0]) | coordinate


@settings(max_examples=150)
@given(
    st.sampled_from([2, 3]).flatmap(
        lambda d: st.lists(st.lists(nice, min_size=2 * d, max_size=2 * d), min_size=1, max_size=6)
    )
)
def test_arbitrary_rays_equal_the_reference_walk(rows):
    rays = torch.tensor(rows, dtype=torch.float64)
    dim = rays.shape[1] // 2
    check(rays[:, :dim], rays[:, dim:], SHAPES[dim])


def test_float32_rays_are_converted_exactly():
    starts, ends = random_rays(200, (7, 9), 0.5, 2.0**-10)
    assert visited(starts.float(), ends.float(), (7, 9)) == expected(starts, ends, (7, 9))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("slope", [1.0, 2.0, 0.5, -1.0])
@pytest.mark.parametrize("resolution", [0.1, 0.3, 0.05])
def test_voxels_occur_once_and_none_is_missed_at_rounded_ties(dim, slope, resolution):
    # Rays through edges and corners all the way, in coordinates that are no binary fractions.
    starts = 0.01 * torch.arange(1, 60, 5, dtype=torch.float64)[:, None].repeat(1, dim) / resolution
    direction = torch.tensor([1.0, slope, 1.0][:dim], dtype=torch.float64)
    ends = (
        starts + (3.0 + 0.1 * torch.arange(1, 60, 5, dtype=torch.float64)[:, None]) / resolution * direction
    )
    shift = torch.tensor([0.0, 250.0 if slope < 0 else 0.0, 0.0][:dim], dtype=torch.float64)
    starts, ends = starts + shift, ends + shift
    found = visited(starts, ends, (500,) * dim)
    assert len(found) == len(set(found))
    rays = zip(starts.tolist(), ends.tolist(), strict=True)
    needed = {(r, voxel) for r, (a, b) in enumerate(rays) for voxel in voxels_crossed(a, b, 1e-6)}
    assert needed <= set(found)


# -- chunks, strides, work ----------------------------------------------------------------------------


@pytest.mark.parametrize("chunk", [1, 7, 100, 10**9])
@pytest.mark.parametrize("margin", [0.0, 1.0])
def test_visits_do_not_depend_on_the_chunk_size(chunk, margin):
    rays = random_rays(120, SHAPES[3], margin, 0.25)
    assert visited(*rays, SHAPES[3], chunk_visits=chunk) == visited(*rays, SHAPES[3])


def test_chunks_have_about_the_requested_size():
    starts, ends = random_rays(5000, (50, 50), 0.0, 2.0**-10)
    sizes = [voxel.numel() for voxel, _ in traverse(starts, ends, (50, 50), chunk_visits=1000)]
    assert len(sizes) > 50
    assert max(sizes) <= 1000 + 100  # one ray more, at most


@pytest.mark.parametrize("strides", [[1, 8], [64, 1], [16, 1]])
def test_flat_indices_use_the_given_strides(strides):
    rays = random_rays(300, (8, 8), 0.3, 0.25)
    assert visited(*rays, (8, 8), strides=strides) == expected(*rays, (8, 8))


def test_row_major_strides_are_those_of_a_tensor():
    for shape in ((4, 5), (3, 4, 5)):
        assert row_major_strides(shape) == list(torch.empty(shape).stride())


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (1.0, 1.0, 1.0), (-0.3, 0.9, 0.01), (1e-7, 1.0, 0.0)])
def test_a_ray_of_500_km_costs_no_more_than_the_grid(direction):
    shape = (40, 30, 20)
    length = 5e6 / math.hypot(*direction)  # cells of 10 cm
    middle = torch.tensor([[20.25, 15.25, 10.25]]).double()
    offset = torch.tensor([direction]).double() * length
    starts, ends = middle - offset, middle + offset
    with Largest() as work:
        n = sum(voxel.numel() for voxel, _ in traverse(starts, ends, shape))
    assert 0 < n <= sum(shape)
    assert work.entries < 4 * sum(shape)


def test_a_ray_of_500_km_visits_what_exact_arithmetic_says():
    starts = torch.tensor([[-(2.0**22) + 0.25, 1.5], [2.0**22, 2.0**21]], dtype=torch.float64)
    ends = torch.tensor([[2.0**22, 2.75], [-(2.0**22) + 8, -(2.0**21) + 8]], dtype=torch.float64)
    found = visited(starts, ends, (9, 9))
    # Only the middle of the oracle's walk is affordable: cut the rays at exact points around the grid.
    for ray, (a, b) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
        slope = (b[1] - a[1]) / (b[0] - a[0])
        inside = [v for r, v in found if r == ray]
        assert inside
        for i, j in inside:
            low, high = sorted(a[1] + slope * (x - a[0]) for x in (i, i + 1))
            assert low - 1e-6 < j + 1
            assert high + 1e-6 > j
        columns = {i for i, _ in inside}
        assert columns == set(range(min(columns), max(columns) + 1))


@pytest.mark.parametrize("bad", [math.inf, -math.inf, math.nan, -1e300])
def test_the_fused_walk_ends_for_rays_that_are_not_finite(bad):
    inside = torch.full((3, 3), 2.5, dtype=torch.float64)
    outside = inside.clone()
    outside[torch.arange(3), torch.arange(3)] = bad
    with kernels("fused"):
        assert visited(outside, inside, (5, 5, 5)) == []
        visited(inside, outside, (5, 5, 5))
