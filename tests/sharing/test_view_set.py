"""ViewSet: whatever comes, in whatever order and however often, all end up with the same views."""

from __future__ import annotations

import os
import random

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sharing.view_schedules import PlainViews, Team, run_schedule

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.exploration.mission.checkpoint import load_checkpoint, save_checkpoint
from gmmtorch.sharing import view_set
from gmmtorch.sharing.messages.fields import quantized_poses
from gmmtorch.sharing.messages.message_registry import (
    MAX_BYTES,
    ViewsHeldMessage,
    ViewsMessage,
    decode,
    encode_plan,
)
from gmmtorch.sharing.replica.intervals import Intervals
from gmmtorch.sharing.replica.record_keys import END, first_key, ids_of
from gmmtorch.sharing.view_peers import MOST_PEERS
from gmmtorch.sharing.view_set import View, ViewSet
from gmmtorch.sharing.view_table import ViewTable

N_SCHEDULES = int(os.environ.get("GMMTORCH_SCHEDULES", "8"))
"""`scripts/soak.sh` runs more."""


def pose(x: float = 0.0) -> torch.Tensor:
    return torch.tensor([x, 0.0, 1.0, 0.5], dtype=torch.float64)


def filled(robot: int, n: int, now: float = 1.0) -> ViewSet:
    views, rng = ViewSet(robot, incarnation=5), random.Random(robot)
    for number in range(n):
        views.add(torch.tensor([rng.uniform(-30, 30) for _ in range(4)]), 1.0 + number, now)
    return views


def hear(views: ViewSet, datagrams: list[bytes]) -> None:
    for datagram in datagrams:
        assert views.receive(decode(datagram))


def exchange(sets: list[ViewSet], rounds: int) -> int:
    """All hear all that the others say; returns how many datagrams of views or of details that took."""
    n_said = 0
    for _ in range(rounds):
        for what in ("announcements", "datagrams"):
            said = [(sender, getattr(sender, what)()) for sender in sets]
            n_said += sum(len(datagram) > 16 for _, datagrams in said for datagram in datagrams)
            for sender, datagrams in said:
                for receiver in sets:
                    if receiver is not sender:
                        hear(receiver, datagrams)
    return n_said


# -- merging -----------------------------------------------------------------------------------------------

keys = st.builds(lambda robot, number: first_key(robot) + number, st.integers(0, 2), st.integers(0, 4))
quarters = st.integers(-2, 4).map(lambda n: n / 4)
histories = st.lists(st.tuples(keys, quarters, quarters, quarters) | keys, max_size=12)


def message_of(history: list) -> ViewsMessage:
    """Views (key, stamp, value, x), and keys of dead ones."""
    views = [item for item in history if isinstance(item, tuple)]
    dead = [item for item in history if not isinstance(item, tuple)]
    rows = torch.tensor([view[1:] for view in views], dtype=torch.float64).reshape(-1, 3)
    return ViewsMessage(
        ids_of(np.array([view[0] for view in views], np.int64)),
        torch.stack([pose(x) for x in rows[:, 2].tolist()]) if views else torch.zeros(0, 4),
        rows[:, 1],
        rows[:, 0],
        Intervals.of(np.array(dead, np.int64)),
    )


def distinct(history: list) -> list:
    return list({item if isinstance(item, int) else item[0]: item for item in history}.values())


def joined(parts: list[list]) -> ViewTable:
    table = ViewTable()
    for part in parts:
        table.merge(message_of(distinct(part)))
    return table


@settings(max_examples=100)
@given(parts=st.lists(histories, min_size=3, max_size=3), data=st.data())
def test_merging_is_commutative_associative_and_idempotent_as_a_plain_set_is(parts, data):
    plain = PlainViews()
    for part in parts:
        for item in distinct(part):
            if isinstance(item, int):
                plain.remove([item])
            else:
                key, stamp, value, x = item
                plain.put(key, View(stamp, value, tuple(pose(x).tolist())))
    one = joined(parts)
    assert one.views == plain.alive
    assert one.dead == Intervals.of(np.array(sorted(plain.dead), np.int64))
    other = joined(data.draw(st.permutations([*parts, *parts])))
    nested = joined(parts[1:])
    whole = joined(parts[:1])
    whole.merge(nested.message(nested.alive(), nested.dead))
    whole.merge(whole.message(whole.alive(), whole.dead))
    assert one.digest() == other.digest() == whole.digest()
    assert one.views == other.views == whole.views


@given(parts=st.lists(histories, min_size=2, max_size=2))
def test_digests_are_equal_where_the_sets_are(parts):
    one, other = (joined([part]) for part in parts)
    assert (one.digest() == other.digest()) == (one.views == other.views and one.dead == other.dead)


@pytest.mark.parametrize("seed", range(N_SCHEDULES))
def test_all_agree_once_the_network_heals(seed):
    outcome = run_schedule(seed, n_robots=2 + seed % 4, crash=0.04 * (seed % 2))
    assert outcome.converged
    assert outcome.refused.keys() <= {"own"}
    for views in outcome.sets:
        found = PlainViews.of(views)
        assert found == outcome.held  # nothing is lost that anybody held, and nothing comes back
        assert found.dead <= outcome.done.dead
        assert found.alive.keys() <= outcome.done.alive.keys() | outcome.done.dead
        if not outcome.crashes:
            assert found == outcome.done


def test_schedules_have_trouble_in_them():
    outcomes = [run_schedule(seed) for seed in (3, 5)]
    assert sum(outcome.crashes for outcome in outcomes) > 0
    assert sum(outcome.rounds for outcome in outcomes) > 0


# -- what robots say ---------------------------------------------------------------------------------------


def test_what_is_new_is_told_once_and_others_hold_the_same_bits():
    one, other = ViewSet(0), ViewSet(1)
    keys = [one.add(torch.tensor([0.123456, -7.0, 1.0, 9.0]), 0.1 + n, 3.14159) for n in range(20)]
    one.revalue(keys[3], 77.7, 4.0)
    one.remove(keys[:2])
    told = one.datagrams()
    assert len(told) == 1
    assert one.datagrams() == []
    hear(other, told)
    assert other.views == one.views
    assert other.digest() == one.digest()
    assert len(other.views) == 18


def test_the_routine_announcement_takes_14_bytes_whatever_is_held():
    for views in (ViewSet(3), filled(3, 500)):
        assert [len(datagram) for datagram in views.announcements()] == [14]


def test_ten_thousand_views_leave_a_few_intervals():
    views = ViewSet(2)
    kept = []
    for number in range(10_000):
        key = views.add(pose(number % 50), 1.0, number / 10)
        if number % 2000 == 7:
            kept.append(key)
        else:
            views.remove([key])
        if number % 100 == 0:
            views.datagrams()
    views.datagrams()
    assert sorted(views.views) == kept
    assert len(views.dead) == len(kept) + 1
    sizes = [value.numel() for value in views.state()["table"].values() if isinstance(value, torch.Tensor)]
    assert sum(sizes) < 100
    late = ViewSet(0)
    assert exchange([views, late], 5) <= 3
    assert late.digest() == views.digest()
    views.remove(kept)
    assert len(views.dead) == 1


def test_a_detailed_announcement_takes_two_bytes_a_view():
    views, other = filled(0, 200), ViewSet(1)
    views.remove(sorted(views.views)[::2])
    exchange([views, other], 1)
    other.add(pose(), 1.0, 0.0)
    other.datagrams()  # lost
    said = []
    for _ in range(3):
        hear(views, other.announcements())
        said += views.announcements()
    sizes = sorted(map(len, said))
    assert sizes[:-1] == [14, 14]
    assert 100 < sizes[-1] <= 40 + 2 * 100


def test_a_removal_that_was_lost_is_told_again_with_the_next():
    one, other = filled(0, 5), ViewSet(1)
    hear(other, one.datagrams())
    first, second = sorted(one.views)[:2]
    one.remove([first])
    one.datagrams()  # lost
    one.remove([second])
    hear(other, one.datagrams())
    assert other.digest() == one.digest()


def test_who_joins_late_catches_up_also_where_the_finder_is_gone():
    one, relay, late = filled(0, 300), ViewSet(1), ViewSet(2)
    one.remove(sorted(one.views)[10:40])
    hear(relay, one.datagrams())
    assert exchange([relay, late], 6) < 20
    assert late.digest() == relay.digest() == one.digest()


def test_those_who_hold_the_same_fall_silent():
    sets = [filled(robot, 10) for robot in range(4)]
    exchange(sets, 6)
    assert len({views.digest() for views in sets}) == 1
    assert exchange(sets, 5) == 0


def test_while_changes_are_on_their_way_nobody_asks():
    """A change of one robot's at a time, heard by the others before or after their next announcements."""
    rng = random.Random(0)
    sets = [filled(robot, 3) for robot in range(4)]
    exchange(sets, 1)
    late: list[tuple[ViewSet, list[bytes]]] = []
    for step in range(80):
        for receiver, datagrams in late:
            hear(receiver, datagrams)
        late = []
        sender = sets[step % 4]
        sender.add(pose(step), 1.0, step)
        told = sender.datagrams()
        assert len(told) == 1  # the change: nobody answers anything
        for views in sets:
            if views is not sender:
                late.append((views, told)) if rng.random() < 0.5 else hear(views, told)
        for speaker in sets:
            said = speaker.announcements()
            assert [len(datagram) for datagram in said] == [14]
            for views in sets:
                if views is not speaker:
                    hear(views, said)


@pytest.mark.parametrize("owner", [0, 7, 40])
def test_in_a_large_team_few_answer_one_who_lacks_something(owner):
    """Whether the finder is the first of them, in the midst of them, or gone."""
    sets = [ViewSet(robot) for robot in range(16)]
    finder = sets[owner] if owner < 16 else ViewSet(owner)
    for number in range(30):
        finder.add(pose(number), 1.0, 0.0)
    told = finder.datagrams()
    for views in sets:
        if views is not finder and views.robot != 3:
            hear(views, told)
    assert exchange(sets, 8) <= 10  # details of the one and of one or two others, and the answer
    assert len({views.digest() for views in sets}) == 1


def test_a_view_that_one_holds_as_it_was_is_put_right_though_a_byte_of_the_check_agrees():
    """Among 300 that are out of date one or two look right by one byte."""
    one, other = filled(0, 300), ViewSet(1)
    hear(other, one.datagrams())
    for key in list(one.views):
        one.revalue(key, 99.0, 50.0)
    while one.datagrams():
        pass  # lost
    exchange([one, other], 12)
    assert other.views == one.views


def test_the_budget_is_kept_and_what_waits_comes_later():
    one, other = filled(0, 400), ViewSet(1)
    one.remove(sorted(one.views)[::10])
    rounds = 0
    while told := one.datagrams(max_bytes=1000, budget=1500):
        assert sum(map(len, told)) <= 1500
        assert max(map(len, told)) <= 1000
        hear(other, told)
        rounds += 1
    assert rounds > 2
    assert other.digest() == one.digest()
    many = filled(2, 3000)
    assert len(many.datagrams()) == view_set.MOST_DATAGRAMS


def test_a_later_value_counts_though_the_clock_is_behind():
    one, other = ViewSet(0), ViewSet(1)
    key = one.add(pose(), 50.0, 1000.0)
    hear(other, one.datagrams())
    other.revalue(key, 20.0, 3.0)
    hear(one, other.datagrams())
    assert one.views[key].value == other.views[key].value == 20.0
    other.remove([key])
    other.revalue(key, 30.0, 2000.0)
    hear(one, [*other.datagrams()])
    assert not one.views
    hear(one, encode_of(key, View(9999.0, 1.0, tuple(pose().tolist()))))
    assert not one.views  # for good


def encode_of(key: int, view: View) -> list[bytes]:
    table = ViewTable()
    table.put(key, view)
    return view_set.encode_views(table.message(table.alive(), table.dead))


# -- lives -------------------------------------------------------------------------------------------------


def test_a_robot_that_lost_its_disk_gives_no_number_twice_and_its_views_live_on():
    one, other = ViewSet(0), ViewSet(1)
    before = {one.add(pose(number), 1.0, 0.0) for number in range(5)}
    hear(other, one.datagrams())
    reborn = ViewSet(0)
    after = {reborn.add(pose(10.0 + number), 1.0, 1.0) for number in range(5)}
    assert not before & after
    exchange([reborn, other], 6)
    assert set(reborn.views) == set(other.views) == before | after
    reborn.remove(before)
    hear(other, reborn.datagrams())
    assert set(other.views) == after
    assert not reborn.conflicts


def test_restored_it_says_the_same_bytes(tmp_path):
    """In the midst of trouble, all robots, through a file."""

    def said(restored: bool) -> list[int]:
        team = Team(random.Random(4), 4, loss=0.4)
        sizes = []
        for team.now in range(60):
            for robot in range(4):
                if team.rng.random() < 0.4:
                    team.act(robot)
                team.say(robot, "datagrams")
                if team.now % 3 == 0:
                    team.say(robot, "announcements")
            team.deliver()
            sizes.append(dict(team.n_bytes))
            sizes.append([views.digest() for views in team.sets])
            if restored and team.now in (20, 37):
                for robot, views in enumerate(team.sets):
                    save_checkpoint(tmp_path / "views", views.state())
                    team.sets[robot] = ViewSet(robot, incarnation=views.incarnation)
                    team.sets[robot].restore(load_checkpoint(tmp_path / "views"))
        assert team.n_bytes["announcements"] > 60 / 3 * 4 * 14  # somebody asked
        return sizes

    assert said(restored=False) == said(restored=True)


def test_a_new_life_takes_what_was_saved_and_numbers_anew():
    one = filled(0, 4)
    reborn = ViewSet(0, incarnation=6)
    reborn.restore(one.state())
    assert reborn.digest() == one.digest()
    assert reborn.add(pose(), 1.0, 9.0) == first_key(0, 6)
    assert one.add(pose(), 1.0, 9.0) == first_key(0, 5) + 4


@pytest.mark.parametrize("where", ["robot", "table", "peers", "due", "n"])
def test_a_damaged_state_is_refused(where):
    one = filled(0, 3)
    for damage in (None, {}, torch.tensor([5, 1])):
        with pytest.raises(DataError):
            ViewSet(0, incarnation=5).restore({**one.state(), where: damage})
    table = one.state()["table"]
    with pytest.raises(DataError):
        ViewSet(0).restore({**one.state(), "table": {**table, "dead": torch.tensor([0, END])}})


# -- hostile -----------------------------------------------------------------------------------------------


def test_two_robots_of_one_number_are_found_out():
    one, twin = ViewSet(4, incarnation=7), ViewSet(4, incarnation=7)
    one.add(pose(), 1.0, 0.0)
    twin.add(pose(), 1.0, 0.0)
    twin.add(pose(9.0), 1.0, 0.0)
    digest = one.digest()
    assert [one.receive(decode(datagram)) for datagram in twin.datagrams()] == [False]
    assert one.conflicts == {4: 1}
    assert one.digest() == digest


def test_nobody_buries_views_that_are_to_come():
    one = ViewSet(0)
    assert not one.receive(message_of([])) or one.dead == Intervals.empty()
    everything = ViewsMessage(*vars(message_of([])).values())
    everything = ViewsMessage(
        everything.ids, everything.poses, everything.values, everything.stamps, Intervals.span(0, END)
    )
    assert not one.receive(everything)
    assert one.refused == {"conflict": 1}
    assert not one.dead


def test_an_echo_and_other_messages_change_nothing():
    one = filled(0, 3)
    said = [*one.announcements(), *one.datagrams()]
    assert [one.receive(decode(datagram)) for datagram in said] == [False, True]
    assert not one.receive(decode(encode_plan(1, 1, 0.0, 0.2, torch.zeros(1, 4))[0]))
    assert one.refused == {"own": 1, "other": 1}
    assert one.datagrams() == []


def test_memory_is_bounded(monkeypatch):
    monkeypatch.setattr(view_set, "MOST_VIEWS", 50)
    monkeypatch.setattr(view_set, "MOST_INTERVALS", 50)
    one, other = filled(0, 40), filled(1, 20)
    (datagram,) = other.datagrams()
    assert not one.receive(decode(datagram))
    assert one.refused == {"full": 1}
    holes = message_of([first_key(9) + 2 * number for number in range(60)])
    assert not one.receive(holes)
    assert len(one.dead) == 0
    for sender in range(2, 2 + 3 * MOST_PEERS):
        one.receive(ViewsHeldMessage(sender, bytes(8)))
    assert len(one.state()["peers"]["peers"]) == MOST_PEERS
    for _ in range(200):
        one.add(pose(), 1.0, 0.0)
        one.datagrams()
    assert len(one.state()["peers"]["recent"]) <= 64
    assert len(one.views) == 240  # its own it does take


def test_who_announces_nonsense_for_ever_is_answered_now_and_then():
    one = filled(0, 100)
    one.datagrams()
    n_details = 0
    for number in range(100):
        one.receive(ViewsHeldMessage(1, number.to_bytes(8, "little")))
        n_details += len(one.announcements()[0]) > 14
    assert n_details <= 50
    assert one.datagrams() == []


def test_bad_arguments_are_named():
    views = ViewSet(0)
    for call, name in (
        (lambda: ViewSet(1024), "robot=1024"),
        (lambda: ViewSet(0, incarnation=1 << 24), "incarnation"),
        (lambda: views.datagrams(max_bytes=999), "max_bytes"),
        (lambda: views.datagrams(budget=-1), "budget"),
        (lambda: views.announcements(max_bytes=1201), "max_bytes"),
        (lambda: views.add(torch.full((4,), 1e12), 1.0, 0.0), "poses"),
        (lambda: views.add(pose(), float("nan"), 0.0), "value"),
        (lambda: views.add(pose(), 1.0, float("inf")), "now"),
    ):
        with pytest.raises(InvalidArgumentError, match=name):
            call()
    assert not views.views
    assert views.add(pose(), 1e9, 0.0) == first_key(0, views.incarnation)  # none was taken for what failed
    assert quantized_poses(pose()[None])[0].tolist() == list(next(iter(views.views.values())).pose)
    assert MAX_BYTES == 1200
