"""RollingWindow: its motion, the removed cells, and its evidence against a new window."""

from __future__ import annotations

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy import Box, CellEvidence, RollingWindow, cast_evidence, sum_evidence

SHAPE = (12, 16, 10)
EVERYTHING = Box(torch.tensor([-4096] * 3), torch.tensor([4096] * 3))


def at(*cell: float, resolution: float = 0.25) -> torch.Tensor:
    """The centre of a cell, in metres in the world frame."""
    return (torch.tensor(cell, dtype=torch.float64) + 0.5) * resolution


def new_window(step: int = 3, shape=SHAPE) -> RollingWindow:
    return RollingWindow(0.25, shape, step)


def cells_of(box: Box) -> set[tuple[int, ...]]:
    return set(
        itertools.product(*(range(a, b) for a, b in zip(box.low.tolist(), box.high.tolist(), strict=True)))
    )


def random_evidence(n: int, seed: int, reach: int = 12) -> CellEvidence:
    generator = torch.Generator().manual_seed(seed)
    flat = torch.randperm((2 * reach) ** 3, generator=generator)[:n]
    cells = torch.stack(torch.unravel_index(flat, (2 * reach,) * 3), 1) - reach
    counts = torch.randint(0, 9, (2, n), generator=generator).float()
    return CellEvidence(cells, counts[0], counts[1])


# -- position -----------------------------------------------------------------------------------------


def test_the_first_window_is_all_new_and_centred_on_the_robot():
    for cell in itertools.product((-1000, -7, 0, 2501), repeat=3):
        window = new_window()
        (box,) = window.center_on(at(*cell))
        assert torch.equal(box.low, window.box.low)
        assert box.shape == window.box.shape == window.shape == SHAPE
        assert bool((box.low % 3 == 0).all())
        off = torch.tensor(cell) - box.low - torch.tensor(SHAPE) // 2
        assert int(off.abs().max()) <= 2


@settings(deadline=None, max_examples=25)
@given(
    moves=st.lists(
        st.tuples(*[st.one_of(st.integers(-4, 4), st.integers(-20, 20))] * 3), min_size=1, max_size=5
    ),
    step=st.integers(1, 2),
)
def test_the_window_follows_the_robot_and_keeps_the_evidence_of_kept_cells(moves, step):
    shape = (6, 8, 5)
    half, cell = torch.tensor(shape) // 2, torch.zeros(3, dtype=torch.int64)
    window = new_window(step, shape)
    window.center_on(at(*cell.tolist()))
    for move in moves:
        old = window.box
        unknown = (window.evidence()[0] == 0).float()
        window.add(CellEvidence.from_dense(old.low, unknown, 3 * unknown))  # now 1 and 3 everywhere
        cell = cell + torch.tensor(move)
        far = (cell - old.low - half).abs() >= step
        pieces = [cells_of(box) for box in window.center_on(at(*cell.tolist()))]
        # It moves by whole steps, along the axes on which the robot was far from the middle.
        moved = window.box.low - old.low
        assert (moved != 0).tolist() == far.tolist()
        assert bool((moved % step == 0).all())
        assert bool(((cell - window.box.low - half).abs() < step).all())
        # The uncovered boxes are disjoint, contain exactly the new cells, and have no evidence.
        now = cells_of(window.box)
        assert sum(map(len, pieces)) == len(set().union(*pieces))
        assert set().union(*pieces) == now - cells_of(old)
        kept = torch.tensor([c in cells_of(old) for c in sorted(now)]).view(shape)
        hits, misses = window.evidence()
        assert torch.equal(hits, kept.float())
        assert torch.equal(misses, 3 * kept.float())


# -- evidence -----------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=5)
@given(seed=st.integers(0, 10**6), far=st.booleans())
def test_a_moved_window_equals_a_new_window(seed, far):
    """Rays are trimmed to the uncovered cells, so that nothing is counted twice (thesis Fig 4.2)."""
    generator = torch.Generator().manual_seed(seed)
    window, rays = new_window(), []
    robot = at(0, 0, 0)
    for _ in range(6):
        step = torch.randn(3, generator=generator, dtype=torch.float64)
        robot = robot + step * (4.0 if far else 0.6)
        for box in window.center_on(robot):
            for ray, weight in rays:
                window.add(cast_evidence(*ray, 0.25, box, weight))
        ends = robot + 2.0 * torch.randn(30, 3, generator=generator, dtype=torch.float64)
        if not far:
            ends = (ends * 8).round() / 8  # many on planes of the lattice
        ray = (robot, ends, torch.rand(30, generator=generator) < 0.8)
        weight = 0.1 + torch.rand(30, generator=generator, dtype=torch.float64)
        rays.append((ray, weight))
        window.add(cast_evidence(*ray, 0.25, window.box, weight))
    scratch = new_window()
    scratch.center_on(at(*(window.box.low + torch.tensor(SHAPE) // 2).tolist()))
    assert torch.equal(scratch.box.low, window.box.low)
    scratch.add(sum_evidence(cast_evidence(*ray, 0.25, EVERYTHING, weight) for ray, weight in rays))
    for one, other in zip(window.evidence(), scratch.evidence(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=0)


@given(
    x=st.floats(-30, 30), y=st.floats(-30, 30), z=st.floats(-9, 9), step=st.sampled_from([1, 2, 4]),
    seed=st.integers(0, 99),
)  # fmt: skip
def test_a_box_around_a_point_is_part_of_the_window(x, y, z, step, seed):
    window = new_window()
    window.center_on(at(x, y, z))
    window.add(random_evidence(4000, seed))
    shape = (12, 9, 7)
    box, whole = window.around(at(x, y, z), shape, step), window.box
    assert box.shape == shape
    assert bool((box.low >= whole.low).all() & (box.high <= whole.high).all())
    assert bool(((box.low - whole.low) % step == 0).all())
    cell = (at(x, y, z) / 0.25).floor()
    off = (box.low + box.high) / 2 - cell - 0.5
    fits = (box.low > whole.low) & (box.high + step <= whole.high)  # the window does not limit it
    assert bool((off.abs() <= (step + 1) / 2)[fits].all())
    first, last = (box.low - whole.low).tolist(), (box.high - whole.low).tolist()
    part = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
    for found, everything in zip(window.evidence(box), window.evidence(), strict=True):
        assert found.dtype == torch.float32
        assert torch.equal(found, everything[part])


# -- errors -------------------------------------------------------------------------------------------


def test_an_unplaced_window_and_boxes_outside_it_are_refused():
    window = new_window()
    with pytest.raises(InvalidArgumentError, match="call center_on"):
        window.add(random_evidence(5, 0))
    with pytest.raises(InvalidArgumentError, match="call center_on"):
        window.evidence()
    with pytest.raises(InvalidArgumentError, match="position must be finite"):
        window.center_on(torch.tensor([0.0, float("nan"), 0.0]))
    window.center_on(at(0, 0, 0))
    box = window.box
    for wrong in (Box(box.low, box.high + 1), Box(box.low - 1, box.high)):
        with pytest.raises(InvalidArgumentError, match="is not within the window"):
            window.evidence(wrong)
    with pytest.raises(InvalidArgumentError, match="is more than the window's"):
        window.around(at(0, 0, 0), (12, 99, 7))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0,), "resolution=0"),
        ((0.2, (4, 4)), "3 sides"),
        ((0.2, (16, 16, 0)), "shape=0"),
        ((0.2, (16, 16, 10), 6), "step=6"),
        ((0.2, (16, 16, 10), 0), "step=0"),
    ],
)
def test_invalid_shapes_and_steps_are_refused(arguments, message):
    with pytest.raises(InvalidArgumentError, match=message):
        RollingWindow(*arguments)
