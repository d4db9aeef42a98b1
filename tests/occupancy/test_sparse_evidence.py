"""SparseEvidence against dense grids, exact ray walks and dictionaries of cells."""

from __future__ import annotations

import math
import re

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from occupancy.exact_dda import voxels_crossed, voxels_left
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.occupancy import Box, CellEvidence, Evidence, SparseEvidence, VoxelGrid
from gmmtorch.occupancy.grid import BYTES_PER_CELL

RESOLUTION = 0.125
Cell = tuple[int, ...]


def random_rays(n: int, dim: int, seed: int = 0, size: float = 6.0) -> tuple[Tensor, Tensor]:
    """Rays whose coordinates lie on no plane of the lattice."""
    generator = torch.Generator().manual_seed(seed)
    rays = torch.round((torch.rand(2, n, dim, generator=generator, dtype=torch.float64) - 0.5) * size * 4096)
    rays = (2 * rays + 1) / 8192
    return rays[0], rays[1]


def counted(origins: Tensor, ends: Tensor, resolution: float = RESOLUTION, **options) -> SparseEvidence:
    store = SparseEvidence(resolution, origins.shape[1])
    store.add_rays(origins, ends, **options)
    return store


def counts_of(store: SparseEvidence) -> dict[Cell, tuple[float, float]]:
    cells, hits, misses = (part.tolist() for part in store.cells())
    found = {tuple(c): (h, m) for c, h, m in zip(cells, hits, misses, strict=True)}
    assert len(found) == len(cells)
    return found


def dense_counts(origins: Tensor, ends: Tensor, resolution: float, reach: float, **options):
    """The counts of a dense grid around the rays."""
    low = torch.minimum(origins.amin(0), ends.amin(0)) - reach
    high = torch.maximum(origins.amax(0), ends.amax(0)) + reach
    grid = VoxelGrid.covering(low, high, resolution)
    dense = Evidence.empty(grid)
    dense.add_rays(origins, ends, **options)
    known = ((dense.hits > 0) | (dense.misses > 0)).nonzero()
    first = [round(x / resolution) for x in grid.origin]
    return {
        tuple(i + a for i, a in zip(cell, first, strict=True)): (
            float(dense.hits[tuple(cell)]),
            float(dense.misses[tuple(cell)]),
        )
        for cell in known.tolist()
    }


# -- rays ---------------------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 10**6),
    dim=st.sampled_from([2, 3]),
    resolution=st.sampled_from([0.125, 0.1, 0.37, 2.0]),
    shift=st.integers(-40, 40),
    weighted=st.booleans(),
)
def test_rays_count_as_in_a_dense_grid(seed, dim, resolution, shift, weighted):
    origins, ends = (x + shift for x in random_rays(15, dim, seed, size=2.0))
    weights = 1 + torch.arange(15).double() % 7 / 8  # whose sums are exact
    options = {"weights": weights, "is_hit": torch.arange(15) % 3 > 0} if weighted else {}
    found = counts_of(counted(origins, ends, resolution, **options))
    assert found == dense_counts(origins, ends, resolution, 0.0, **options)


@pytest.mark.parametrize("dim", [2, 3])
def test_portions_and_chunks_of_rays_do_not_change_the_counts(dim):
    origins, ends = random_rays(60, dim)
    whole, parts = counted(origins, ends), SparseEvidence(RESOLUTION, dim)
    for i in range(60):
        parts.add_rays(origins[i : i + 1], ends[i : i + 1])
    assert counts_of(parts) == counts_of(whole)
    assert parts.keys.tolist() == sorted(set(parts.keys.tolist()))
    assert parts.n_blocks == whole.n_blocks


@given(
    st.sampled_from([2, 3]).flatmap(
        lambda d: st.lists(
            st.lists(st.integers(-320, 320).map(lambda i: i / 64), min_size=2 * d, max_size=2 * d),
            min_size=1,
            max_size=5,
        )
    )
)
def test_rays_on_planes_and_corners_count_as_an_exact_walk(rows):
    rays = torch.tensor(rows, dtype=torch.float64)
    dim = rays.shape[1] // 2
    found = counts_of(counted(rays[:, :dim], rays[:, dim:]))
    expected: dict[Cell, int] = {}
    for row in (rays / RESOLUTION).tolist():
        for voxel in voxels_left(row[:dim], row[dim:]):
            expected[voxel] = expected.get(voxel, 0) + 1
    assert {cell: misses for cell, (_, misses) in found.items() if misses} == expected


def farthest_miss(store: SparseEvidence, start: Tensor, end: Tensor) -> float:
    """Distance (cells) from the segment to the centre of the farthest cell that has misses."""
    cells, _, misses = store.cells()
    centers = cells[misses > 0] + 0.5
    a, b = start / store.resolution, end / store.resolution
    along = ((centers - a) @ (b - a) / (b - a).square().sum()).clamp(0, 1)
    return float((centers - a - along[:, None] * (b - a)).norm(dim=1).max())


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("resolution", [0.1, 0.07])
def test_misses_follow_the_ray_where_rounding_decides_on_ties(dim, resolution):
    # Diagonals, and other rays through the corners of blocks, in coordinates that are no binary fractions.
    worst, missed = 0.0, 0
    for i in range(1, 60, 6):
        start = torch.full((dim,), 0.01 * i, dtype=torch.float64)
        step = torch.tensor([1.0, [1.0, 2.0, 0.5, -1.0][i // 6 % 4], 1.0][:dim], dtype=torch.float64)
        end = start + (2.0 + 0.1 * i) * step
        store = counted(start[None], end[None], resolution)
        worst = max(worst, farthest_miss(store, start, end))
        crossed = voxels_crossed((start / resolution).tolist(), (end / resolution).tolist(), 1e-6)
        missed += int((store.at_cells(torch.tensor(list(crossed)))[1] == 0).sum())
    assert worst < math.sqrt(dim)
    assert missed == 0


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("n_blocks", [1, 2, 5])
def test_a_ray_just_below_a_plane_stays_below_it(dim, n_blocks):
    # −1e-17 is below the plane, but rounds to the plane once the lowest corner of the rays is subtracted.
    store = SparseEvidence(0.1, dim)
    side = store.block_side * 0.1
    low = 0.03 - side * (n_blocks - 0.5)
    start, end = torch.full((2, dim), -1e-17, dtype=torch.float64)
    start[0] = low
    corner = torch.full((dim,), low, dtype=torch.float64)
    store.add_rays(torch.stack([start, corner]), torch.stack([end, corner + 0.01]))
    assert abs(float(store.cells().misses.sum()) - abs(low) / 0.1) <= dim
    assert farthest_miss(store, start, end) < math.sqrt(dim)


# -- memory -------------------------------------------------------------------------------------------


def test_blocks_are_stored_only_along_a_far_ray():
    start, end = torch.tensor([[0.3, 0.3, 0.3]]).double(), torch.tensor([[60.3, 50.7, 5.1]]).double()
    store = counted(start, end)
    crossed = sum(abs(math.floor(b) - math.floor(a)) for a, b in zip(start[0], end[0], strict=True)) + 4
    assert store.n_blocks <= crossed  # blocks have a side of 1 m


def test_rays_beyond_the_memory_limit_are_refused_with_a_resolution_that_fits():
    origins, ends = random_rays(200, 3, size=20.0)
    limit = 1 << 21
    store = SparseEvidence(0.05, 3, memory_limit=limit)
    with pytest.raises(MemoryLimitError, match=f"{limit:,}") as caught:
        store.add_rays(origins, ends)
    suggestion = float(re.search(r"a resolution of ([0-9.e+-]+) m", str(caught.value))[1])
    coarser = SparseEvidence(suggestion, 3, memory_limit=limit)
    coarser.add_rays(origins, ends)
    assert coarser.n_blocks * coarser.cells_per_block * BYTES_PER_CELL <= limit


def test_rays_that_span_too_large_a_table_are_refused_with_a_resolution_that_fits():
    origins = torch.tensor([[0.0, 0.0], [0.1, 0.1]], dtype=torch.float64)
    ends = torch.tensor([[30_000.0, 0.3], [0.2, 50_000.0]], dtype=torch.float64)
    limit = 1 << 22
    with pytest.raises(MemoryLimitError, match=f"{limit:,}") as caught:
        SparseEvidence(0.1, 2, memory_limit=limit).add_rays(origins, ends)
    suggestion = float(re.search(r"resolution of ([0-9.e+-]+) m or more", str(caught.value), re.DOTALL)[1])
    try:
        SparseEvidence(suggestion, 2, memory_limit=limit).add_rays(origins, ends)
    except MemoryLimitError as error:  # the table fits; the cells need not
        assert "table" not in str(error)  # noqa: PT017


def test_a_refused_insert_keeps_earlier_evidence():
    origins, ends = random_rays(100, 2, size=3.0)
    store = SparseEvidence(RESOLUTION, 2, memory_limit=1 << 20)
    store.add_rays(origins, ends)
    before = store.lookup(ends)
    with pytest.raises(MemoryLimitError):
        store.add_rays(origins * 2000, ends * 2000)
    assert torch.equal(store.lookup(ends), before)


def test_cells_beyond_the_memory_limit_are_refused():
    store = SparseEvidence(0.1, memory_limit=10 * 512 * BYTES_PER_CELL)
    cells, one = torch.arange(11)[:, None] * torch.tensor([8, 0, 0]), torch.ones(11)
    store.add(CellEvidence(cells[:10], one[:10], one[:10]))
    with pytest.raises(MemoryLimitError, match="use coarser cells"):
        store.add(CellEvidence(cells, one, one))
    assert store.nbytes == 10 * (512 * BYTES_PER_CELL + 16)


# -- far from the origin, and points without evidence -------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("offset", [500_000.0, -4_000_000.0])
def test_utm_coordinates_count_as_those_near_the_origin(dim, offset):
    origins, ends = random_rays(50, dim)
    near, far = counted(origins, ends), counted(origins + offset, ends + offset)
    shift = round(offset / RESOLUTION)
    assert {tuple(i + shift for i in cell): pair for cell, pair in counts_of(near).items()} == counts_of(far)
    assert torch.equal(near.lookup(ends), far.lookup(ends + offset))
    low, high = far.bounds()
    assert bool(((low <= ends + offset) & (ends + offset < high)).all())


@pytest.mark.parametrize("offset", [500_000.0, 4_000_000.0])
def test_utm_coordinates_work_at_resolutions_that_are_no_binary_fraction(offset):
    start = torch.tensor([[offset + 0.53, offset + 0.47]]).double()
    end = torch.tensor([[offset + 2.03, offset + 0.47]]).double()
    store = counted(start, end, 0.1)
    assert float(store.lookup(end)) > 0.5
    between = start + (end - start) * torch.linspace(0, 0.9, 10, dtype=torch.float64)[:, None]
    assert float(store.lookup(between).max()) < 0.5
    assert float(store.cells().misses.sum()) == 15


@pytest.mark.parametrize("dim", [2, 3])
def test_unreachable_points_are_unknown_and_an_empty_store_is_unknown_everywhere(dim):
    store = counted(*random_rays(50, dim))
    values = torch.tensor([math.nan, math.inf, -math.inf, 1e12, -1e12, 1e300], dtype=torch.float64)
    points = torch.zeros(len(values), dim, dtype=torch.float64)
    points[:, dim - 1] = values
    assert store.lookup(points).tolist() == [0.5] * len(values)
    empty = counted(torch.empty(0, dim), torch.empty(0, dim))
    assert empty.lookup(torch.zeros(4, dim)).tolist() == [0.5] * 4
    assert empty.n_blocks == len(empty.cells().cells) == 0


def test_rays_too_far_from_the_first_are_refused():
    store = counted(torch.zeros(1, 3).double(), torch.ones(1, 3).double(), 0.01)
    far = torch.full((1, 3), 1e6, dtype=torch.float64)
    with pytest.raises(InvalidArgumentError, match=r"resolution=0\.01 m cannot index"):
        store.add_rays(far, far + 1)


# -- cells in a box, against a dictionary -------------------------------------------------------------

LOW, HIGH = (-21, 3, -5), (30, 47, 12)  # sides that are no multiples of a block's


def box(low=LOW, high=HIGH) -> Box:
    return Box(torch.tensor(low), torch.tensor(high))


def is_in(cell: Cell, low=LOW, high=HIGH) -> bool:
    return all(a <= x < b for a, x, b in zip(low, cell, high, strict=True))


def random_evidence(n: int, seed: int, spread: int = 3) -> CellEvidence:
    """Distinct cells in and around the box."""
    generator = torch.Generator().manual_seed(seed)
    shape = [h - a + 2 * spread for a, h in zip(LOW, HIGH, strict=True)]
    flat = torch.randperm(math.prod(shape), generator=generator)[:n]
    cells = torch.stack(torch.unravel_index(flat, shape), 1) + torch.tensor(LOW) - spread
    counts = torch.randint(0, 50, (2, n), generator=generator).float()
    return CellEvidence(cells, counts[0], counts[1])


def filled(n_times: int = 4, n: int = 2000) -> tuple[SparseEvidence, dict[Cell, tuple[float, float]]]:
    """A bounded store, and its expected content as a dictionary."""
    store, reference = SparseEvidence(0.2, box=box(), dtype=torch.float32), {}
    for seed in range(n_times):
        evidence = random_evidence(n, seed)
        before: list[tuple[float, float]] = []
        for cell, hit, miss in zip(*(part.tolist() for part in evidence), strict=True):
            h, m = reference.get(tuple(cell), (0.0, 0.0))
            before.append((h, m))
            if is_in(cell):
                reference[tuple(cell)] = (h + hit, m + miss)
        assert torch.stack(store.add(evidence), 1).tolist() == [list(pair) for pair in before]
    return store, {cell: pair for cell, pair in reference.items() if sum(pair)}


def test_a_bounded_store_contains_the_sums_of_all_evidence_inside():
    store, reference = filled()
    assert counts_of(store) == reference
    cells = random_evidence(4000, 99).cells
    found = torch.stack(store.at_cells(cells), 1).tolist()
    assert found == [list(reference.get(tuple(cell), (0.0, 0.0))) for cell in cells.tolist()]
    blocks = {tuple(x >> 3 for x in cell) for cell in reference}
    assert store.n_blocks >= len(blocks)
    assert store.nbytes == store.n_blocks * (512 * 8 + 16)
    store.clear()
    assert store.nbytes == len(counts_of(store)) == 0


@pytest.mark.parametrize(
    ("low", "high"),
    [
        (LOW, HIGH),
        ((-30, -3, -9), (40, 60, 20)),  # all around
        ((-20, 4, -4), (-19, 5, -3)),  # one cell
        ((-24, 8, 0), (8, 24, 8)),  # whole blocks
        ((-14, 10, 1), (9, 21, 7)),
        ((25, 40, 5), (50, 70, 30)),  # over a corner
        ((10**9, 0, 0), (10**9 + 4, 5, 3)),  # beyond all keys
        ((0, 10, 0), (0, 12, 4)),  # no cells
    ],
)
def test_a_dense_box_has_the_counts_of_its_cells(low, high):
    store, reference = filled()
    found = store.dense(box(low, high))
    shape = tuple(b - a for a, b in zip(low, high, strict=True))
    expected = torch.zeros(2, *shape)
    for cell, pair in reference.items():
        if is_in(cell, low, high):
            expected[(slice(None), *(x - a for a, x in zip(low, cell, strict=True)))] = torch.tensor(pair)
    assert torch.equal(torch.stack(found), expected)


def test_evidence_outside_the_box_is_ignored():
    store = SparseEvidence(0.2, box=box(), dtype=torch.float32)
    outside = torch.tensor(
        [[-22, 5, 0], [30, 5, 0], [0, 2, 0], [0, 47, 0], [0, 5, -6], [0, 5, 12], [2**40, 5, 0]]
    )
    ones = torch.ones(len(outside))
    for _ in range(2):
        hits, misses = store.add(CellEvidence(outside, ones, ones))
        assert hits.sum() == misses.sum() == 0
        assert [part.sum() for part in store.at_cells(outside)] == [0, 0]
    assert store.n_blocks == 0
    assert store.add(CellEvidence.empty())[0].shape == (0,)


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ((-21, 3, -5), (30, 47, 12)),
        ((-13, 5, -1), (20, 30, 9)),
        ((-16, 8, 0), (16, 40, 8)),
        ((90, 0, 0), (99, 9, 9)),
    ],
)
def test_cropping_removes_the_evidence_outside_the_new_box(low, high):
    store, reference = filled()
    store.crop(box(low, high))
    assert counts_of(store) == {cell: pair for cell, pair in reference.items() if is_in(cell, low, high)}
    store.crop(box())  # removed evidence is not restored
    assert counts_of(store) == {cell: pair for cell, pair in reference.items() if is_in(cell, low, high)}
    evidence = random_evidence(500, 9)
    store.add(evidence)
    for cell, hit, miss in zip(*(part.tolist() for part in evidence), strict=True):
        if is_in(cell):
            h, m = reference.get(tuple(cell), (0.0, 0.0)) if is_in(cell, low, high) else (0.0, 0.0)
            assert torch.stack(store.at_cells(torch.tensor([cell]))).flatten().tolist() == [h + hit, m + miss]


def test_evidence_is_added_from_another_store():
    source, reference = filled(2)
    target = SparseEvidence(0.2, box=box((-40, -40, -40), (10, 40, 40)), dtype=torch.float32)
    target.add(CellEvidence(torch.tensor([[0, 10, 0]]), torch.tensor([3.0]), torch.tensor([0.0])))
    target.add_from(source, box((-3, 5, -2), (60, 30, 9)))
    expected = {c: p for c, p in reference.items() if is_in(c, (-3, 5, -2), (10, 30, 9))}
    h, m = expected.get((0, 10, 0), (0.0, 0.0))
    assert counts_of(target) == {**expected, (0, 10, 0): (h + 3, m)}
    target.add_from(source, box((50, 50, 50), (60, 60, 60)))  # outside the target
    with pytest.raises(InvalidArgumentError, match="they must be equal"):
        SparseEvidence(0.1).add_from(source, box())


def test_invalid_resolutions_and_boxes_are_refused():
    for resolution in (0, -1, math.nan, math.inf):
        with pytest.raises(InvalidArgumentError, match="resolution"):
            SparseEvidence(resolution, 3)
    with pytest.raises(InvalidArgumentError, match="has no cells"):
        SparseEvidence(0.2, box=box((0, 0, 0), (5, 0, 5)))
    with pytest.raises(MemoryLimitError, match="use coarser cells"):
        SparseEvidence(1e-6, box=box((0, 0, 0), (50_000_000, 8, 8)))
    with pytest.raises(InvalidArgumentError, match="without a box"):
        SparseEvidence(0.2, box=box()).add_rays(torch.zeros(1, 3), torch.ones(1, 3))
    with pytest.raises(InvalidArgumentError, match="No box is set"):
        _ = SparseEvidence(0.2).box
    far = CellEvidence(torch.tensor([[0, 0, 0], [2**40, 0, 0]]), torch.ones(2), torch.ones(2))
    with pytest.raises(InvalidArgumentError, match="cannot index"):
        SparseEvidence(0.2).add(far)
