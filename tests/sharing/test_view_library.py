"""ViewLibrary: its views, and what a team shares of them over networks that lose datagrams."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
import torch
from exploration.voxel_worlds import surroundings_from
from hypothesis import given, settings
from hypothesis import strategies as st

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.team.sharing import ViewLibrary, ViewsMessage, decode, view_library
from gmmtorch.team.sharing.replica.record_keys import Intervals, first_key, robot_of


def key(robot: int, number: int) -> int:
    return first_key(robot) + number


def poses_of(*rows: tuple[float, ...]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, 4)


def same(one: ViewLibrary, other: ViewLibrary) -> bool:
    mine, theirs = one.candidates(), other.candidates()
    equal = mine.keys == theirs.keys and all(map(torch.equal, mine[1:], theirs[1:]))
    if equal:
        assert one.digest() == other.digest()
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
        Intervals.of(np.array([key(*name) for name in removed], np.int64)),
    )


def sent(library: ViewLibrary, now: float = 50.0) -> list[ViewsMessage]:
    """The messages that are due at the time `now`."""
    return [decode(datagram) for datagram in library.datagrams(now)]


def exchange(
    libraries: list[ViewLibrary], now: float, loss: float = 0.0, rng: random.Random | None = None
) -> int:
    """All send what is due, and receive what is not lost; returns the bytes."""
    n_bytes = 0
    for sender in libraries:
        for datagram in sender.datagrams(now):
            n_bytes += len(datagram)
            for receiver in libraries:
                if receiver is not sender and (rng is None or rng.random() >= loss):
                    assert receiver.receive(decode(datagram), now)
    return n_bytes


def line(n: int, y: float = 0.0) -> torch.Tensor:
    """Poses (n, 4), five metres apart."""
    return poses_of(*((5.0 * k, y, 0.0, 0.0) for k in range(n)))


def test_the_later_value_counts():
    library = ViewLibrary(0)
    library.receive(message_of([(1, 0, 0.0, 5.0, 2.0), (1, 1, 4.0, 6.0, 2.0)], []), 2.0)
    library.receive(message_of([(1, 0, 0.0, 1.0, 3.0), (1, 1, 4.0, 9.0, 1.0)], []), 3.0)
    assert library.candidates().values.tolist() == [1.0, 6.0]


@settings(max_examples=8)
@given(seed=st.integers(0, 100))
def test_views_are_kept_apart_and_the_best_come_first(seed):
    generator = torch.Generator().manual_seed(seed)
    poses = torch.rand(60, 4, generator=generator, dtype=torch.float64) * torch.tensor([6.0, 6.0, 1.0, 7.0])
    values = torch.rand(60, generator=generator) * 10
    library = ViewLibrary(0)
    library.add(poses, values, 1.0, least=2.0, most=60)
    kept = library.candidates()
    assert len(kept.keys) > 3
    assert float(kept.values.min()) >= 2.0 * 0.93

    def near(one: torch.Tensor, other: torch.Tensor, metres: float, degrees: float) -> bool:
        turn = (float(one[3] - other[3]) + math.pi) % (2 * math.pi) - math.pi
        return float((one[:3] - other[:3]).norm()) < metres and abs(turn) < math.radians(degrees)

    for i, one in enumerate(kept.poses):
        assert not any(near(one, other, 1.48, 43) for other in kept.poses[i + 1 :])
    for pose, value in zip(poses, values.tolist(), strict=True):
        if value > 2.01:  # kept, or next to one that is worth more
            rows = [row for row, other in enumerate(kept.poses) if near(pose, other, 1.52, 47)]
            assert any(float(kept.values[row]) >= value * 0.93 for row in rows)


def test_own_views_are_bounded_and_the_best_are_kept(monkeypatch):
    monkeypatch.setattr(view_library, "MOST_OWN_VIEWS", 4)
    library = ViewLibrary(0)
    library.receive(message_of([(1, n, 100.0 + 5 * n, 0.5, 0.0) for n in range(4)], []), 0.0)
    for n in range(10):
        library.add(poses_of((5.0 * n, 0, 0, 0)), torch.tensor([float(n + 1)]), float(n), 0.0)
    keys, _, values = library.candidates()
    own = [value for each, value in zip(keys, values.tolist(), strict=True) if robot_of(each) == 0]
    assert sorted(own) == [7.0, 8.0, 9.0, 10.0]
    assert len(library) == 8


def test_views_in_the_window_are_valued_again_and_worthless_ones_removed():
    library = ViewLibrary(0)
    poses = poses_of((1.0, 1.0, 1.0, 0.0), (3.0, 1.0, 1.0, 0.0), (9.0, 1.0, 1.0, 0.0))
    a, b, c = library.add(poses, torch.tensor([3.0, 2.0, 1.0]), 0.0, 0.0)
    passable = torch.ones(20, 10, 10, dtype=torch.bool)
    here = surroundings_from(passable)
    assert library.covered(here.is_passable, 5.0, most=9) == []  # known well enough
    assert library.covered(here.is_passable, 20.0, most=9) == [a, b]
    assert library.covered(here.is_passable, 20.0, most=1) == [a]
    library.revalue([a], torch.tensor([1.0]), 20.0, least=0.5)
    assert library.covered(here.is_passable, 21.0, most=1) == [b]  # the one that waits the longest
    library.revalue([b], torch.tensor([0.1]), 21.0, least=0.5)
    assert library.candidates().keys == [a, c]
    assert library.candidates().values.tolist() == [1.0, 1.0]
    passable[5, 5, 5] = False
    assert library.covered(here.is_passable, 40.0, most=9) == []  # nobody can be there


def test_visited_views_are_removed():
    library = ViewLibrary(0)
    poses = poses_of((0, 0, 0, 0.1), (0, 0, 0, math.pi), (0.5, 0, 3.0, 0))
    library.add(poses, torch.tensor([1.0, 2.0, 3.0]), 0.0, 0.0)
    library.visit(poses_of((0.3, 0.2, 0, 2 * math.pi)), 1.0)
    assert sorted(library.candidates().values.tolist()) == [2.0, 3.0]


def test_the_best_view_weighs_value_against_distance():
    library = ViewLibrary(0)
    assert library.best(torch.zeros(0)) is None
    library.add(poses_of((0, 0, 0, 0), (5, 0, 0, 0), (9, 0, 0, 0)), torch.tensor([4.0, 3.0, 9.0]), 0.0, 0.0)
    metres = torch.tensor([1.0, 7.0, 8.0])[library.candidates().values.argsort().argsort()]
    values = library.candidates().values.tolist()
    score = [v / (1 + m) for v, m in zip(values, metres.tolist(), strict=True)]
    assert library.best(metres) == score.index(max(score))
    assert library.best(torch.full((3,), math.inf)) is None
    assert library.best(metres, least=8.0) == values.index(9.0)


# -- a team ------------------------------------------------------------------------------------------------


def test_only_large_changes_are_sent_and_once():
    library, other = ViewLibrary(0), ViewLibrary(1)
    theirs = other.add(line(2, 50.0), torch.tensor([7.0, 7.5]), 0.5, 0.0)
    exchange([library, other], 0.5)
    library.add(line(2), torch.tensor([1.0, 2.0]), 1.0, 0.0)
    (first,) = sent(library)
    assert first.ids.tolist() == [[0, 0], [0, 1]]
    assert sent(library) == []
    library.revalue([key(0, 0)], torch.tensor([4.0]), 2.0, 0.0)
    library.remove([theirs[0]], 3.0)
    (second,) = sent(library)
    assert second.ids.tolist() == [[0, 0]]
    assert second.removed == Intervals.span(key(1, 0), key(1, 1))
    for message in (second, first):
        other.receive(message, 3.0)
    assert same(library, other)
    library.revalue([key(0, 1)], library.candidates().values[1:2] * 1.01, 9.0, 0.0)
    assert sent(library) == []


@settings(max_examples=10)
@given(seed=st.integers(0, 1000))
def test_without_loss_all_libraries_are_equal_after_a_round(seed):
    rng = random.Random(seed)
    libraries = [ViewLibrary(robot) for robot in range(3)]
    for step in range(12):
        library, now = rng.choice(libraries), float(step)
        known = library.candidates().keys
        choice = rng.randrange(3)
        if choice == 0 or not known:
            library.add(line(3, rng.uniform(0, 99)), torch.rand(3) + 1, now, 0.0)
        elif choice == 1:
            library.revalue(known[:2], torch.tensor([rng.uniform(0, 9) for _ in known[:2]]), now, 0.5)
        else:
            library.remove(rng.sample(known, 1), now)
        exchange(libraries, now)
    exchange(libraries, 13.0)
    assert same(libraries[0], libraries[1])
    assert same(libraries[0], libraries[2])


@given(order=st.permutations(range(6)), again=st.lists(st.integers(0, 5), max_size=6))
def test_a_removed_view_stays_removed_in_any_order(order, again):
    messages = [message_of([(1, n, 5.0 * n, 5.0, 2.0)], []) for n in range(5)] + [message_of([], [(1, 2)])]
    library = ViewLibrary(0)
    for index in [*order, *again]:
        library.receive(messages[index], 3.0)
    assert library.candidates().keys == [key(1, n) for n in (0, 1, 3, 4)]


def test_a_lost_removal_is_sent_again_to_a_robot_that_repeats_the_view():
    one, other = ViewLibrary(0), ViewLibrary(1)
    one.add(line(2), torch.tensor([1.0, 2.0]), 1.0, 0.0)
    exchange([one, other], 1.0)
    one.remove([key(0, 0)], 2.0)
    assert one.datagrams(2.0)  # lost
    for second in range(3, 140, 2):
        exchange([one, other], float(second))
    assert other.candidates().keys == [key(0, 1)]
    assert same(one, other)


@pytest.mark.parametrize("is_gone", [False, True])
def test_a_late_robot_receives_all_views_also_without_their_finder(is_gone):
    rng = random.Random(0)
    libraries = [ViewLibrary(robot) for robot in range(2)]
    libraries[0].add(line(10), torch.arange(1.0, 11.0), 0.0, 0.0, most=10)
    exchange(libraries, 0.0)
    team = [libraries[1], ViewLibrary(2)] if is_gone else [*libraries, ViewLibrary(2)]
    for second in range(2, 600, 2):
        exchange(team, float(second), 0.5, rng)
    assert same(team[0], team[-1])
    assert len(team[-1]) == 10


def test_a_view_is_removed_after_its_time_to_live(monkeypatch):
    monkeypatch.setattr(view_library, "TIME_TO_LIVE", 300.0)
    team = [ViewLibrary(robot) for robot in range(2)]
    a, b = team[0].add(line(2), torch.tensor([1.0, 2.0]), 0.0, 0.0)
    for second in range(0, 700, 2):
        if second < 500 and second % 50 == 0:
            team[1].revalue([a], torch.tensor([2.0]), float(second), 0.0)
        exchange(team, float(second))
        if 310 < second < 500:
            assert [len(library) for library in team] == [1, 1]
    assert b not in team[0].candidates().keys
    assert [len(library) for library in team] == [1, 1]
    for second in range(700, 1000, 2):
        exchange(team, float(second))
    assert [len(library) for library in team] == [0, 0]


def test_repetitions_are_few_and_keep_the_budget():
    libraries = [ViewLibrary(robot) for robot in range(3)]
    libraries[0].add(line(40), torch.arange(1.0, 41.0), 0.0, 0.0, most=40)
    exchange(libraries, 0.0)
    assert sum(exchange(libraries, float(second)) for second in range(2, 60, 2)) == 0
    n_bytes = [exchange(libraries, float(second)) for second in range(60, 120, 2)]
    assert max(n_bytes) < 80
    assert sum(n_bytes) < 40 * 25
    libraries[0].revalue(libraries[0].candidates().keys, torch.full((40,), 99.0), 120.0, 0.0)
    assert libraries[0].datagrams(120.0, budget=20) == []
    limited = libraries[0].datagrams(120.0, budget=60)
    assert 0 < sum(map(len, limited)) <= 60
    assert sum(map(len, libraries[0].datagrams(120.0))) > 30


def test_hostile_messages_are_refused_and_memory_is_bounded(monkeypatch):
    monkeypatch.setattr(view_library, "MOST_VIEWS", 30)
    library = ViewLibrary(0)
    library.add(line(1), torch.tensor([1.0]), 0.0, 0.0)
    assert not library.receive(message_of([(0, 1, 0.0, 1.0, 1.0)], []), 1.0)  # not given yet
    assert not library.receive(message_of([], [(0, 5)]), 1.0)
    for n in range(100):
        library.receive(message_of([(1, 2 * n, 0.0, 1.0, 1.0)], [(2, 2 * n)]), 1.0)
    assert len(library) <= 30
    assert library.refused["duplicate_id"] == 2
    assert library.refused["full"] > 60


def test_bad_arguments_are_named():
    with pytest.raises(InvalidArgumentError, match="robot"):
        ViewLibrary(-1)
    with pytest.raises(InvalidArgumentError, match="incarnation"):
        ViewLibrary(0, incarnation=1 << 24)
    with pytest.raises(InvalidArgumentError, match="value"):
        ViewLibrary(0).add(line(1), torch.tensor([math.inf]), 0.0, 0.0)
