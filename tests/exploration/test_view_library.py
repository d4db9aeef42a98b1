"""The view library: what is told of it, and a list of the best views kept apart."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from exploration.voxel_worlds import surroundings_from
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.exploration.information.view_library import ViewLibrary
from gmmtorch.exploration.mission.checkpoint import load_checkpoint, save_checkpoint
from gmmtorch.sharing.messages.message_registry import ViewsMessage, decode
from gmmtorch.sharing.replica.intervals import Intervals


def poses_of(*rows: tuple[float, ...]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, 4)


def same(one: ViewLibrary, other: ViewLibrary) -> bool:
    mine, theirs = one.candidates(), other.candidates()
    equal = mine.ids == theirs.ids and all(map(torch.equal, mine[1:], theirs[1:]))
    assert (one.digest() == other.digest()) == equal  # where the same are dead
    return equal


def message_of(
    views: list[tuple[int, int, float, float, float]], removed: list[tuple[int, int]]
) -> ViewsMessage:
    """Views (robot, number, x, value, stamp) and tombstones (robot, number)."""
    return ViewsMessage(
        torch.tensor([view[:2] for view in views], dtype=torch.int64).reshape(-1, 2),
        poses_of(*((x, 0.0, 0.0, 0.0) for _, _, x, _, _ in views)),
        torch.tensor([value for *_, value, _ in views], dtype=torch.float64),
        torch.tensor([stamp for *_, stamp in views], dtype=torch.float64),
        Intervals.of(np.array([robot << 52 | number for robot, number in removed], np.int64)),
    )


def said(library: ViewLibrary) -> list[ViewsMessage]:
    """What has changed there since it last spoke."""
    return [decode(datagram) for datagram in library.datagrams()]


def tell(library: ViewLibrary, other: ViewLibrary) -> None:
    for message in said(library):
        assert other.receive(message)


def test_the_later_value_counts_and_what_is_removed_stays_so():
    library = ViewLibrary(0)
    library.receive(message_of([(1, 0, 0.0, 5.0, 2.0), (1, 1, 4.0, 6.0, 2.0)], []))
    library.receive(message_of([(1, 0, 0.0, 1.0, 3.0), (1, 1, 4.0, 9.0, 1.0)], []))
    assert library.candidates().values.tolist() == [1.0, 6.0]
    library.receive(message_of([], [(1, 0)]))
    library.receive(message_of([(1, 0, 0.0, 9.0, 99.0)], []))
    assert library.candidates().ids == [(1, 1)]


@given(seed=st.integers(0, 100))
def test_views_are_kept_apart_and_the_best_come_first(seed):
    generator = torch.Generator().manual_seed(seed)
    poses = torch.rand(60, 4, generator=generator, dtype=torch.float64) * torch.tensor([6.0, 6.0, 1.0, 7.0])
    values = torch.rand(60, generator=generator) * 10
    library = ViewLibrary(0)
    library.add(poses, values, 1.0, least=2.0, most=60)
    kept = library.candidates()
    assert len(kept.ids) > 3
    assert float(kept.values.min()) >= 1.99

    def near(one: torch.Tensor, other: torch.Tensor) -> bool:
        turn = (float(one[3] - other[3]) + math.pi) % (2 * math.pi) - math.pi
        return float((one[:3] - other[:3]).norm()) < 1.48 and abs(turn) < math.radians(43)

    for i, one in enumerate(kept.poses):
        assert not any(near(one, other) for other in kept.poses[i + 1 :])
    for pose, value in zip(poses, values.tolist(), strict=True):
        if value > 2.01:  # kept, or next to one that is worth more

            def beside(one: torch.Tensor, other: torch.Tensor) -> bool:
                turn = (float(one[3] - other[3]) + math.pi) % (2 * math.pi) - math.pi
                return float((one[:3] - other[:3]).norm()) < 1.52 and abs(turn) < math.radians(47)

            rows = [row for row, other in enumerate(kept.poses) if beside(pose, other)]
            assert any(float(kept.values[row]) >= value * 0.998 for row in rows)


def test_the_own_views_are_bounded_and_the_least_valuable_go():
    library = ViewLibrary(0, size=4)
    library.receive(message_of([(1, n, 100.0 + 5 * n, 0.5, 0.0) for n in range(4)], []))
    for n in range(10):
        library.add(poses_of((5.0 * n, 0, 0, 0)), torch.tensor([float(n + 1)]), float(n), 0.0)
    own = [
        value
        for key, value in zip(library.candidates().ids, library.candidates().values, strict=True)
        if not key[0]
    ]
    assert sorted(float(value) for value in own) == [7.0, 8.0, 9.0, 10.0]
    assert len(library) == 8
    other = ViewLibrary(2)
    everything = message_of([(1, n, 100.0 + 5 * n, 0.5, 0.0) for n in range(4)], [])
    other.receive(everything)
    tell(library, other)
    assert same(library, other)


def test_values_are_renewed_where_the_window_shows_them_and_worthless_views_go():
    library = ViewLibrary(0)
    poses = poses_of((1.0, 1.0, 1.0, 0.0), (3.0, 1.0, 1.0, 0.0), (9.0, 1.0, 1.0, 0.0))
    a, b, c = library.add(poses, torch.tensor([3.0, 2.0, 1.0]), 0.0, 0.0)
    passable = torch.ones(20, 10, 10, dtype=torch.bool)
    here = surroundings_from(passable)
    assert library.covered(here, 5.0, most=9) == []  # known well enough
    assert library.covered(here, 20.0, most=9) == [a, b]
    assert library.covered(here, 20.0, most=1) == [a]
    library.revalue([a], torch.tensor([1.0]), 20.0, least=0.5)
    assert library.covered(here, 21.0, most=1) == [b]  # the one that waits the longest
    library.revalue([b], torch.tensor([0.1]), 21.0, least=0.5)
    assert library.candidates().ids == [a, c]
    assert library.candidates().values.tolist() == [1.0, 1.0]
    passable[5, 5, 5] = False
    assert library.covered(here, 40.0, most=9) == []  # nobody can be there


def test_views_of_a_clock_that_is_far_ahead_are_as_old_as_the_hearing_of_them():
    """A robot that was started again hears of teammates that have flown for long."""
    library, here = ViewLibrary(0), surroundings_from(torch.ones(20, 10, 10, dtype=torch.bool))
    said_late = message_of([(1, 0, 1.0, 5.0, 500.0), (1, 1, 3.0, 5.0, 2.0)], [])
    library.receive(said_late, 3.0)
    assert library.covered(here, 11.9, most=9) == []
    assert library.covered(here, 12.0, most=9) == [(1, 1)]  # by its stamp, as where clocks are one
    assert library.covered(here, 13.0, most=9) == [(1, 1), (1, 0)]
    library.receive(said_late, 13.0)  # again: nobody has looked again
    assert library.covered(here, 13.0, most=9) == [(1, 1), (1, 0)]
    library.receive(message_of([(1, 0, 1.0, 6.0, 510.0)], []), 13.0)
    assert library.covered(here, 22.9, most=9) == [(1, 1)]
    assert library.covered(here, 23.0, most=9) == [(1, 1), (1, 0)]
    library.receive(message_of([], [(1, 0)]), 23.0)
    assert library.covered(here, 900.0, most=9) == [(1, 1)]


def test_visited_views_go():
    library = ViewLibrary(0)
    poses = poses_of((0, 0, 0, 0.1), (0, 0, 0, math.pi), (0.5, 0, 3.0, 0))
    library.add(poses, torch.tensor([1.0, 2.0, 3.0]), 0.0, 0.0)
    library.visit(poses_of((0.3, 0.2, 0, 2 * math.pi)), 1.0)
    assert sorted(library.candidates().values.tolist()) == [2.0, 3.0]


def test_the_best_view_is_worth_the_way():
    library = ViewLibrary(0)
    assert library.best(torch.zeros(0)) is None
    library.add(poses_of((0, 0, 0, 0), (5, 0, 0, 0), (9, 0, 0, 0)), torch.tensor([4.0, 3.0, 9.0]), 0.0, 0.0)
    metres = torch.tensor([1.0, 7.0, 8.0])[library.candidates().values.argsort().argsort()]
    values = library.candidates().values.tolist()
    score = [v / (1 + m) for v, m in zip(values, metres.tolist(), strict=True)]
    assert library.best(metres) == score.index(max(score))
    assert library.best(torch.full((3,), math.inf)) is None
    assert library.best(metres, least=8.0) == values.index(9.0)


def test_changes_tell_others_all_that_happened_here():
    library, other = ViewLibrary(0), ViewLibrary(1)
    theirs = other.add(poses_of((50, 0, 0, 0), (60, 0, 0, 0)), torch.tensor([7.0, 7.5]), 0.5, 0.0)
    tell(other, library)
    library.add(poses_of((0, 0, 0, 0), (5, 0, 0, 0)), torch.tensor([1.0, 2.0]), 1.0, 0.0)
    version, (first,) = library.version, said(library)
    assert first.ids.tolist() == [[0, 0], [0, 1]]
    assert said(library) == []
    library.revalue([(0, 0)], torch.tensor([4.0]), 2.0, 0.0)
    library.remove([theirs[0]], 3.0)
    assert library.version > version
    (second,) = said(library)
    assert second.ids.tolist() == [[0, 0]]
    assert second.removed == Intervals.span(1 << 52, (1 << 52) + 1)
    for message in (second, first):
        other.receive(message)
    assert same(library, other)
    library.revalue([(0, 1)], library.candidates().values[1:2] * 1.01, 9.0, 0.0)
    assert said(library) == []  # so small a change is not told


def test_what_was_lost_is_told_again():
    one, other = ViewLibrary(0), ViewLibrary(1)
    one.add(poses_of((0, 0, 0, 0), (5, 0, 0, 0)), torch.tensor([1.0, 2.0]), 1.0, 0.0)
    one.remove([(0, 0)], 2.0)
    assert one.datagrams()  # nobody hears it
    for _ in range(5):
        for sender, receiver in ((one, other), (other, one)):
            for datagram in [*sender.announcements(), *sender.datagrams()]:
                assert receiver.receive(decode(datagram))
    assert other.candidates().ids == [(0, 1)]
    assert same(one, other)


def test_replicas_hold_the_same_bits_after_a_message():
    library, other = ViewLibrary(0), ViewLibrary(1)
    generator = torch.Generator().manual_seed(0)
    poses = torch.randn(20, 4, generator=generator, dtype=torch.float64) * 20
    library.add(poses, torch.rand(20, generator=generator) * 1e3, 12.34567, 0.0, most=20)
    library.remove(library.candidates().ids[:3], 13.00049)
    tell(library, other)
    assert same(library, other)


def test_restored_it_goes_on_as_before(tmp_path):
    library = ViewLibrary(0)
    library.add(poses_of((0, 0, 0, 0), (5, 0, 0, 0)), torch.tensor([1.0, 2.0]), 1.0, 0.0)
    said(library)
    library.revalue([(0, 0)], torch.tensor([1.05]), 30.0, 0.0)
    library.remove([(0, 1)], 2.0)
    other = ViewLibrary(0)
    save_checkpoint(tmp_path / "library", library.state())
    other.restore(load_checkpoint(tmp_path / "library"))
    here = surroundings_from(torch.ones(10, 10, 10, dtype=torch.bool), (-5, -5, -5))
    assert same(library, other)
    assert other.covered(here, 35.0, 9) == library.covered(here, 35.0, 9) == []
    for one in (library, other):
        assert [message.removed for message in said(one)] == [Intervals.span(1, 2)]
        one.add(poses_of((9, 0, 0, 0)), torch.tensor([3.0]), 4.0, 0.0)
    assert same(library, other)
    assert other.candidates().ids == [(0, 0), (0, 2)]


def test_bad_input_is_named():
    with pytest.raises(InvalidArgumentError, match="spacing"):
        ViewLibrary(0, spacing=-1.0)
    with pytest.raises(InvalidArgumentError, match="robot"):
        ViewLibrary(-1)
    with pytest.raises(InvalidArgumentError, match="size"):
        ViewLibrary(0, size=0)
    with pytest.raises(DataError, match="robot 1"):
        ViewLibrary(0).restore(ViewLibrary(1).state())
