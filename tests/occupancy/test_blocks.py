"""BlockEvidence: the dense grid's numbers, stored only where rays went."""

from __future__ import annotations

import math
import re

import pytest
import torch
from exact_dda import voxels_crossed, voxels_left
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.occupancy.evidence import Evidence
from gmmtorch.occupancy.grid import BYTES_PER_CELL, VoxelGrid
from gmmtorch.occupancy.voxels.blocks import BlockEvidence

RESOLUTION = 0.125


def random_rays(n: int, dim: int, seed: int = 0, size: float = 6.0) -> tuple[Tensor, Tensor]:
    """Rays of coordinates that lie on no plane of the lattice."""
    generator = torch.Generator().manual_seed(seed)
    rays = torch.round((torch.rand(2, n, dim, generator=generator, dtype=torch.float64) - 0.5) * size * 4096)
    rays = (2 * rays + 1) / 8192
    return rays[0], rays[1]


def counted(origins: Tensor, ends: Tensor, resolution: float = RESOLUTION, **options) -> BlockEvidence:
    blocks = BlockEvidence(resolution, origins.shape[1])
    blocks.add_rays(origins, ends, **options)
    return blocks


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("seed", [0, 1])
def test_blocks_hold_what_a_dense_grid_holds(dim, seed):
    origins, ends = random_rays(300, dim, seed)
    weights = torch.rand(300, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    is_hit = torch.arange(300) % 3 > 0
    blocks = counted(origins, ends, weights=weights, is_hit=is_hit)
    grid = VoxelGrid.covering([-4.0] * dim, [4.0] * dim, RESOLUTION)
    dense = Evidence.empty(grid)
    dense.add_rays(origins, ends, weights, is_hit)
    found = blocks.dense(grid)
    torch.testing.assert_close(found.hits, dense.hits, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(found.misses, dense.misses, rtol=1e-12, atol=1e-12)
    assert float(blocks.hits.sum()) == pytest.approx(float(weights[is_hit].sum()))
    assert float(blocks.misses.sum()) == pytest.approx(float(dense.misses.sum()))


@given(
    seed=st.integers(0, 10**6),
    dim=st.sampled_from([2, 3]),
    resolution=st.sampled_from([0.125, 0.1, 0.37, 2.0]),
    shift=st.integers(-40, 40),
)
def test_blocks_hold_what_a_dense_grid_holds_anywhere(seed, dim, resolution, shift):
    origins, ends = (x + shift for x in random_rays(20, dim, seed, size=4.0))
    grid = VoxelGrid.covering([shift - 3.0] * dim, [shift + 3.0] * dim, resolution)
    dense = Evidence.empty(grid)
    dense.add_rays(origins, ends)
    found = counted(origins, ends, resolution).dense(grid)
    assert torch.equal(found.hits, dense.hits)
    assert torch.equal(found.misses, dense.misses)


@pytest.mark.parametrize("dim", [2, 3])
def test_many_small_portions_are_one_large_one(dim):
    origins, ends = random_rays(200, dim)
    whole, parts = counted(origins, ends), BlockEvidence(RESOLUTION, dim)
    for i in range(200):
        parts.add_rays(origins[i : i + 1], ends[i : i + 1], chunk_visits=3)
    grid = VoxelGrid.covering([-4.0] * dim, [4.0] * dim, RESOLUTION)
    assert torch.equal(whole.dense(grid).hits, parts.dense(grid).hits)
    assert torch.equal(whole.dense(grid).misses, parts.dense(grid).misses)
    assert parts.keys.numel() == parts.keys.unique().numel() == parts.n_blocks
    assert whole.n_blocks == parts.n_blocks


def test_in_key_order_the_blocks_are_those_of_the_keys():
    origins, ends = random_rays(100, 2)
    parts = BlockEvidence(RESOLUTION, 2)
    for i in range(100):
        parts.add_rays(origins[i : i + 1], ends[i : i + 1])
    hits, misses = parts.in_key_order()
    corners = (parts.unpack(parts.keys) + parts.anchor) * parts.block_side
    local = torch.cartesian_prod(*[torch.arange(parts.block_side)] * 2)
    for block in range(parts.n_blocks):
        centers = (corners[block] + local + 0.5) * RESOLUTION
        found_hits, found_misses = parts.evidence_at(centers.double())
        assert torch.equal(found_hits, hits[block])
        assert torch.equal(found_misses, misses[block])


@pytest.mark.parametrize("dim", [2, 3])
def test_packing_blocks_is_undone_and_keeps_their_order(dim):
    blocks = BlockEvidence(RESOLUTION, dim)
    generator = torch.Generator().manual_seed(0)
    index = torch.randint(-1_000_000, 1_000_000, (500, dim), generator=generator)
    keys = blocks.pack(index)
    assert torch.equal(blocks.unpack(keys), index)
    assert index[keys.argsort()].tolist() == sorted(index.tolist())


# -- ties: exact on the lattice, and never far from the ray --------------------------------------------


@given(
    st.sampled_from([2, 3]).flatmap(
        lambda d: st.lists(
            st.lists(st.integers(-320, 320).map(lambda i: i / 64), min_size=2 * d, max_size=2 * d),
            min_size=1,
            max_size=5,
        )
    )
)
def test_rays_on_planes_and_corners_count_as_the_exact_walk(rows):
    rays = torch.tensor(rows, dtype=torch.float64)
    dim = rays.shape[1] // 2
    blocks = counted(rays[:, :dim], rays[:, dim:])
    expected: dict[tuple[int, ...], int] = {}
    for row in (rays / RESOLUTION).tolist():
        for voxel in voxels_left(row[:dim], row[dim:]):
            expected[voxel] = expected.get(voxel, 0) + 1
    assert float(blocks.misses.sum()) == sum(expected.values())
    if expected:
        centers = (torch.tensor(list(expected), dtype=torch.float64) + 0.5) * RESOLUTION
        assert blocks.evidence_at(centers)[1].tolist() == list(expected.values())


def farthest_miss(blocks: BlockEvidence, start: Tensor, end: Tensor) -> float:
    """Distance (cells) from the segment to the centre of the farthest cell that holds misses."""
    _, misses = blocks.in_key_order()
    local = torch.cartesian_prod(*[torch.arange(blocks.block_side)] * blocks.dim)
    corners = (blocks.unpack(blocks.keys) + blocks._anchored()) * blocks.block_side
    centers = (corners[:, None] + local + 0.5)[misses > 0]
    a, b = start / blocks.resolution, end / blocks.resolution
    along = ((centers - a) @ (b - a) / (b - a).square().sum()).clamp(0, 1)
    return float((centers - a - along[:, None] * (b - a)).norm(dim=1).max())


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("resolution", [0.1, 0.05, 0.3, 0.07])
def test_misses_follow_the_ray_where_rounding_decides_on_ties(dim, resolution):
    # Diagonals, and other rays through the corners of blocks, in coordinates that are no binary fractions.
    worst, missed = 0.0, 0
    for i in range(1, 60, 2):
        start = torch.full((dim,), 0.01 * i, dtype=torch.float64)
        step = torch.tensor([1.0, [1.0, 2.0, 0.5, -1.0][i // 2 % 4], 1.0][:dim], dtype=torch.float64)
        end = start + (3.0 + 0.1 * i) * step
        blocks = counted(start[None], end[None], resolution)
        worst = max(worst, farthest_miss(blocks, start, end))
        crossed = voxels_crossed((start / resolution).tolist(), (end / resolution).tolist(), 1e-6)
        centers = (torch.tensor(list(crossed), dtype=torch.float64) + 0.5) * resolution
        missed += int((blocks.evidence_at(centers)[1] == 0).sum())
    assert worst < math.sqrt(dim)
    assert missed == 0


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("n_blocks", [1, 2, 3, 5])
def test_a_ray_just_below_a_plane_stays_beside_it(dim, n_blocks):
    # −1e-17 is below the plane, but becomes the plane itself once the window's corner is taken off.
    blocks = BlockEvidence(0.1, dim)
    side = blocks.block_side * 0.1
    low = 0.03 - side * (n_blocks - 0.5)
    start, end = torch.full((2, dim), -1e-17, dtype=torch.float64)
    start[0] = low
    corner = torch.full((dim,), low, dtype=torch.float64)
    blocks.add_rays(torch.stack([start, corner]), torch.stack([end, corner + 0.01]))
    assert abs(float(blocks.misses.sum()) - abs(low) / 0.1) <= dim
    assert farthest_miss(blocks, start, end) < math.sqrt(dim)


# -- memory --------------------------------------------------------------------------------------------


def test_a_stray_far_return_costs_its_own_ray():
    origins, ends = random_rays(300, 3, size=4.0)
    near = counted(origins, ends)
    stray = torch.tensor([[0.3, 0.3, 0.3]]).double(), torch.tensor([[60.3, 50.7, 5.1]]).double()
    both = counted(torch.cat([origins, stray[0]]), torch.cat([ends, stray[1]]))
    walked = (
        sum(abs(math.floor(b) - math.floor(a)) for a, b in zip(stray[0][0], stray[1][0], strict=True)) + 4
    )
    assert both.n_blocks - near.n_blocks <= walked  # blocks have a side of 1 m
    box = 60 * 50 * 5 * both.cells_per_block
    assert both.n_blocks * both.cells_per_block < box / 50


def test_what_rays_touch_beyond_the_limit_is_refused_with_a_resolution_that_fits():
    origins, ends = random_rays(400, 3, size=20.0)
    limit = 1 << 21
    blocks = BlockEvidence(0.05, 3, memory_limit=limit)
    with pytest.raises(MemoryLimitError, match=f"{limit:,}") as caught:
        blocks.add_rays(origins, ends)
    suggestion = float(re.search(r"a resolution of ([0-9.e+-]+) m", str(caught.value))[1])
    coarser = BlockEvidence(suggestion, 3, memory_limit=limit)
    coarser.add_rays(origins, ends)
    assert coarser.n_blocks * coarser.cells_per_block * BYTES_PER_CELL <= limit


def test_rays_that_span_too_much_are_refused_with_a_resolution_whose_table_fits():
    origins = torch.tensor([[0.0, 0.0], [0.1, 0.1]], dtype=torch.float64)
    ends = torch.tensor([[30_000.0, 0.3], [0.2, 50_000.0]], dtype=torch.float64)
    limit = 1 << 22
    with pytest.raises(MemoryLimitError, match=f"{limit:,}") as caught:
        BlockEvidence(0.1, 2, memory_limit=limit).add_rays(origins, ends)
    suggestion = float(re.search(r"resolution of ([0-9.e+-]+) m or more", str(caught.value), re.DOTALL)[1])
    try:
        BlockEvidence(suggestion, 2, memory_limit=limit).add_rays(origins, ends)
    except MemoryLimitError as error:  # the table fits now; the cells themselves are another matter
        assert "table" not in str(error)  # noqa: PT017


def test_a_refusal_leaves_what_was_counted_before():
    origins, ends = random_rays(100, 2, size=3.0)
    blocks = BlockEvidence(RESOLUTION, 2, memory_limit=1 << 20)
    blocks.add_rays(origins, ends)
    before = blocks.lookup(ends)
    with pytest.raises(MemoryLimitError):
        blocks.add_rays(origins * 2000, ends * 2000)
    assert torch.equal(blocks.lookup(ends), before)


@pytest.mark.parametrize("resolution", [0, -1, float("nan"), float("inf")])
def test_a_resolution_that_is_none_is_refused(resolution):
    with pytest.raises(InvalidArgumentError, match="resolution"):
        BlockEvidence(resolution, 3)


# -- far from the origin -------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("offset", [500_000.0, -500_000.0, 4_000_000.0])
def test_utm_coordinates_count_as_those_near_the_origin(dim, offset):
    origins, ends = random_rays(100, dim)
    near, far = (
        counted(origins, ends),
        counted(origins + offset, ends + offset),
    )  # multiples of a block's side
    assert near.n_blocks == far.n_blocks
    assert torch.equal(near.in_key_order()[0], far.in_key_order()[0])
    assert torch.equal(near.in_key_order()[1], far.in_key_order()[1])
    assert torch.equal(near.lookup(ends), far.lookup(ends + offset))
    low, high = far.bounds()
    assert bool(((low <= ends + offset) & (ends + offset < high)).all())


@pytest.mark.parametrize("offset", [500_000.0, 4_000_000.0])
def test_utm_coordinates_work_at_resolutions_that_are_no_binary_fraction(offset):
    start, end = (
        torch.tensor([[offset + 0.53, offset + 0.47]]).double(),
        torch.tensor([[offset + 2.03, offset + 0.47]]).double(),
    )
    blocks = counted(start, end, 0.1)
    assert float(blocks.lookup(end)) > 0.5
    between = start + (end - start) * torch.linspace(0, 0.9, 10, dtype=torch.float64)[:, None]
    assert float(blocks.lookup(between).max()) < 0.5
    assert float(blocks.misses.sum()) == 15


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e12, -1e12, 1e300])
@pytest.mark.parametrize("dim", [2, 3])
def test_questions_from_nowhere_are_unknown(value, dim):
    blocks = counted(*random_rays(50, dim))
    points = torch.zeros(dim, dim, dtype=torch.float64)
    points.fill_diagonal_(value)
    assert blocks.lookup(points).tolist() == [0.5] * dim


def test_before_any_ray_everything_is_unknown():
    blocks = BlockEvidence(RESOLUTION, 3)
    assert blocks.lookup(torch.zeros(4, 3)).tolist() == [0.5] * 4
    blocks.add_rays(torch.empty(0, 3), torch.empty(0, 3))
    assert blocks.n_blocks == 0


def test_a_scan_too_far_from_the_first_is_refused_clearly():
    blocks = counted(torch.zeros(1, 3).double(), torch.ones(1, 3).double(), 0.01)
    far = torch.full((1, 3), 1e6, dtype=torch.float64)
    with pytest.raises(InvalidArgumentError, match="resolution"):
        blocks.add_rays(far, far + 1)
