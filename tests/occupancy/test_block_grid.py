"""Evidence in blocks of a bounded lattice, against a dictionary."""

from __future__ import annotations

import pytest
import torch

from gmmtorch.errors import DataError, InvalidArgumentError, MemoryLimitError
from gmmtorch.occupancy.voxels.block_grid import BlockGrid
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.cell_evidence import CellEvidence

LOW, HIGH = [-21, 3, -5], [30, 47, 12]  # sides that are no multiples of a block's


def box(low=LOW, high=HIGH) -> Box:
    return Box(torch.tensor(low), torch.tensor(high))


def random_evidence(n: int, seed: int, spread: int = 3) -> CellEvidence:
    """Distinct cells in and around the box."""
    generator = torch.Generator().manual_seed(seed)
    shape = [h - a + 2 * spread for a, h in zip(LOW, HIGH, strict=True)]
    flat = torch.randperm(shape[0] * shape[1] * shape[2], generator=generator)[:n]
    cells = torch.stack(torch.unravel_index(flat, shape), 1) + torch.tensor(LOW) - spread
    both = torch.randint(0, 50, (2, n), generator=generator).float()
    return CellEvidence(cells, both[0], both[1])


def is_inside(cell) -> bool:
    return all(a <= x < b for a, x, b in zip(LOW, cell, HIGH, strict=True))


class Reference:
    def __init__(self) -> None:
        self.hits: dict[tuple[int, ...], float] = {}
        self.misses: dict[tuple[int, ...], float] = {}

    def add(self, evidence: CellEvidence) -> tuple[list[float], list[float]]:
        before: tuple[list[float], list[float]] = ([], [])
        for cell, hit, miss in zip(*(part.tolist() for part in evidence), strict=True):
            for counts, more, old in ((self.hits, hit, before[0]), (self.misses, miss, before[1])):
                old.append(counts.get(tuple(cell), 0.0))
                if is_inside(cell):
                    counts[tuple(cell)] = old[-1] + more
        return before


def filled(n_times: int = 4, n: int = 2000) -> tuple[BlockGrid, Reference]:
    grid, reference = BlockGrid(0.2, box()), Reference()
    for seed in range(n_times):
        evidence = random_evidence(n, seed)
        grid.add(evidence)
        reference.add(evidence)
    return grid, reference


def test_what_was_there_before_and_what_is_there_now():
    grid, reference = BlockGrid(0.2, box()), Reference()
    for seed in range(5):
        evidence = random_evidence(1500, seed)
        hits, misses = grid.add(evidence)
        assert (hits.tolist(), misses.tolist()) == reference.add(evidence)
        assert grid.inside(evidence.cells).tolist() == [is_inside(cell) for cell in evidence.cells.tolist()]
    asked = random_evidence(4000, 99).cells
    hits, misses = grid.at(asked)
    assert hits.tolist() == [reference.hits.get(tuple(cell), 0.0) for cell in asked.tolist()]
    assert misses.tolist() == [reference.misses.get(tuple(cell), 0.0) for cell in asked.tolist()]


@pytest.mark.parametrize(
    ("low", "high"),
    [
        (LOW, HIGH),
        ([-30, -3, -9], [40, 60, 20]),  # all around
        ([-20, 4, -4], [-19, 5, -3]),  # one cell
        ([-14, 10, 1], [9, 21, 7]),
        ([25, 40, 5], [50, 70, 30]),  # over a corner
        ([100, 0, 0], [104, 5, 3]),  # beyond
        ([0, 10, 0], [0, 12, 4]),  # none
    ],
)
def test_dense_blocks(low, high):
    grid, reference = filled()
    hits, misses = grid.dense(box(low, high))
    shape = tuple(b - a for a, b in zip(low, high, strict=True))
    assert hits.shape == misses.shape == shape
    for dense, counts in ((hits, reference.hits), (misses, reference.misses)):
        expected = torch.zeros(shape)
        for cell, count in counts.items():
            if all(a <= x < b for a, x, b in zip(low, cell, high, strict=True)):
                expected[tuple(x - a for a, x in zip(low, cell, strict=True))] = count
        assert torch.equal(dense, expected)


def test_all_cells_come_back_once():
    grid, reference = filled()
    evidence = grid.cells()
    cells = [tuple(cell) for cell in evidence.cells.tolist()]
    assert len(set(cells)) == len(cells)
    seen = {cell for cell in reference.hits if reference.hits[cell] + reference.misses[cell] > 0}
    assert set(cells) == seen
    assert evidence.hits.tolist() == [reference.hits[cell] for cell in cells]
    assert evidence.misses.tolist() == [reference.misses[cell] for cell in cells]


def test_blocks_are_stored_where_cells_are():
    grid = BlockGrid(0.2, box())
    assert grid.n_blocks == 0
    empty = grid.nbytes
    assert empty == 4 * 7 * 6 * 3
    evidence = random_evidence(60, 3)
    grid.add(evidence)
    inside = evidence.cells[grid.inside(evidence.cells)]
    blocks = {tuple(block) for block in ((inside - torch.tensor(LOW)) // 8).tolist()}
    assert grid.n_blocks == len(blocks)
    assert grid.nbytes == empty + len(blocks) * (512 * 8 + 8)
    assert len(grid.cells().cells) <= len(inside)


def test_nothing_outside_is_kept():
    grid = BlockGrid(0.2, box())
    outside = torch.tensor(
        [[-22, 5, 0], [30, 5, 0], [0, 2, 0], [0, 47, 0], [0, 5, -6], [0, 5, 12], [2**40, 5, 0]]
    )
    ones = torch.ones(len(outside))
    hits, misses = grid.add(CellEvidence(outside, ones, ones))
    assert hits.tolist() == misses.tolist() == [0.0] * len(outside)
    assert grid.n_blocks == 0
    grid.add(
        CellEvidence(torch.tensor([LOW, [0, 5, 12]]), ones[:2], ones[:2])
    )  # the block at the table's start
    hits, misses = grid.add(CellEvidence(outside, ones, ones))
    assert hits.sum() == misses.sum() == 0
    assert [part.sum() for part in grid.at(outside)] == [0, 0]
    assert grid.add(CellEvidence.empty())[0].shape == (0,)
    assert len(grid.cells().cells) == 1


def test_a_restored_grid_goes_on_alike():
    grid, _ = filled(3)
    twin = BlockGrid(0.2, box())
    twin.add(random_evidence(500, 77))  # what was there is gone
    twin.restore(grid.state())
    more = random_evidence(3000, 8)
    for one, other in zip(grid.add(more), twin.add(more), strict=True):
        assert torch.equal(one, other)
    for one, other in zip(grid.cells(), twin.cells(), strict=True):
        assert torch.equal(one, other)
    assert (grid.n_blocks, grid.nbytes) == (twin.n_blocks, twin.nbytes)
    kept = grid.state()
    before = kept["hits"].clone()
    grid.add(more)
    assert torch.equal(kept["hits"], before)  # a state is a copy


def test_states_of_other_grids_are_refused():
    state = filled(1)[0].state()
    with pytest.raises(DataError, match="made alike"):
        BlockGrid(0.1, box()).restore(state)
    with pytest.raises(DataError, match="made alike"):
        BlockGrid(0.2, box([0, 0, 0], [9, 9, 9])).restore(state)
    with pytest.raises(DataError, match="damaged"):
        BlockGrid(0.2, box()).restore({**state, "blocks": state["blocks"] + 10_000})


def test_boxes_and_resolutions_that_cannot_be():
    with pytest.raises(InvalidArgumentError, match="has no cells"):
        BlockGrid(0.2, box([0, 0, 0], [5, 0, 5]))
    with pytest.raises(InvalidArgumentError, match="resolution=-1"):
        BlockGrid(-1, box())
    with pytest.raises(MemoryLimitError, match="take coarser cells"):
        BlockGrid(0.001, box([0, 0, 0], [50_000, 40_000, 8_000]))
