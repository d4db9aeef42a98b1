"""Replica.changes: applying them gives the map, in any order of datagrams."""

from __future__ import annotations

import random

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.random_components import random_components
from sharing.replica_histories import motion, told
from sharing.replica_model import rows
from sharing.schedules import act, components

from gmmtorch.mapping.components import Components
from gmmtorch.team.sharing.messages.message_registry import decode
from gmmtorch.team.sharing.messages.record_messages import CountersMessage, SupersessionMessage, encode_record
from gmmtorch.team.sharing.replica import authorship
from gmmtorch.team.sharing.replica.record_keys import Intervals
from gmmtorch.team.sharing.replica.replica import Replica

seeds = st.integers(0, 10**6)


class Follower:
    """A map made of changes: mean, support and counts by origin of each component."""

    def __init__(self) -> None:
        self.shapes: dict[int, tuple] = {}
        self.support: dict[int, float] = {}
        self.counts: dict[tuple, float] = {}
        self.rebuilt = 0
        self.batches: list[Components] = []

    def follow(self, replica: Replica) -> None:
        new = replica.changes()
        if new.rebuilt:
            assert not new.added
            assert not len(new.gained)
            self.shapes, self.support, self.counts = {}, {}, {}
            self.rebuilt += 1
            self._enter(replica.components())
            return
        for batch in new.added:
            assert len(batch)
            assert not rows(batch).keys() & self.shapes.keys()  # no component is added twice
            self._enter(batch)
        self.batches += new.added
        assert (new.gained.support > 0).all()
        for key, (mean, _, gain, _, seen) in rows(new.gained).items():
            assert self.shapes[key][0] == mean
            self.support[key] += gain
            for origin, count in seen:
                self.counts[key, origin] += count

    def _enter(self, batch: Components) -> None:
        for key, (mean, covariance, support, flag, seen) in rows(batch).items():
            self.shapes[key], self.support[key] = (mean, covariance, flag), support
            self.counts |= {(key, origin): count for origin, count in seen}

    def agrees(self, replica: Replica) -> bool:
        expected = rows(replica.components())
        counts = {(key, origin): n for key, row in expected.items() for origin, n in row[4]}
        return (
            self.shapes
            == {key: (mean, covariance, flag) for key, (mean, covariance, _, flag, _) in expected.items()}
            and self.support == pytest.approx({key: row[2] for key, row in expected.items()}, rel=1e-9)
            and self.counts == pytest.approx(counts, rel=1e-9, abs=1e-12)
        )


def growth(seed: int, n_acts: int = 14) -> list[bytes]:
    """All datagrams of three robots that add and count, and rewrite counters as soon as possible."""

    def grow(rng: random.Random, robot: Replica) -> None:
        known = robot.components().ids.tolist()
        if not known or rng.random() < 0.4:
            robot.add(components(rng, rng.randint(1, 5)))
        else:
            chosen = rng.sample(known, rng.randint(1, min(4, len(known))))
            robot.count({tuple(row): rng.uniform(0.0, 500.0) for row in chosen})

    rng = random.Random(seed)
    robots = [Replica(robot, incarnation=rng.getrandbits(24)) for robot in range(3)]
    return told(rng, robots, n_acts, grow)


@settings(max_examples=5, deadline=None)
@given(seed=seeds, order=st.randoms(use_true_random=False))
def test_added_and_gained_components_are_the_map(seed, order):
    """For any order, loss and repetition of datagrams, and any number of reads."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(authorship, "_MOST_OUTDATED", 1)
        patch.setattr(authorship, "_MOST_SHORT", 2)
        said = growth(seed)
    heard = [datagram for datagram in said if order.random() < 0.9]
    heard += order.sample(heard, len(heard) // 3)
    order.shuffle(heard)
    replica, follower = Replica(9), Follower()
    for datagram in heard:
        assert replica.receive(datagram)
        if order.random() < 0.3:
            follower.follow(replica)
            assert follower.agrees(replica)
    follower.follow(replica)
    assert follower.agrees(replica)
    assert not follower.rebuilt  # rewritten counters do not change the map
    nothing = replica.changes()
    assert (nothing.added, len(nothing.gained), nothing.rebuilt) == ([], 0, False)


@settings(max_examples=4, deadline=None)
@given(seed=seeds)
def test_a_follower_that_rebuilds_has_the_map(seed):
    rng = random.Random(seed)
    robots, followers = [Replica(robot, incarnation=robot) for robot in range(2)], [Follower(), Follower()]
    late: list[bytes] = []
    for _ in range(20):
        which = rng.randrange(2)
        act(rng, robots[which])
        late += [datagram for datagram in robots[which].datagrams() for _ in range(rng.choice([0, 1, 1, 2]))]
        rng.shuffle(late)
        for datagram in [late.pop() for _ in range(rng.randint(0, len(late)))]:
            robots[rng.randrange(2)].receive(datagram)
        for replica, follower in zip(robots, followers, strict=True):
            if rng.random() < 0.6:
                follower.follow(replica)
                assert follower.agrees(replica)


def test_batches_equal_datagrams_at_all_robots():
    one, other = Replica(0), Replica(1)
    for seed, k in enumerate((30, 300, 1)):
        one.add(random_components(3, k=k, seed=seed))
    datagrams = one.datagrams()
    for datagram in datagrams:
        other.receive(datagram, decode(datagram))
    own, heard = one.changes().added, other.changes().added
    assert len(own) == len(heard) == len(datagrams) > 4
    for mine, theirs, datagram in zip(own, heard, datagrams, strict=True):
        sent = decode(datagram).components
        for name, value in vars(mine).items():
            assert torch.equal(value, getattr(theirs, name)), name
            assert torch.equal(value, getattr(sent, name)), name


def test_counters_of_unknown_components_wait_for_them():
    one, other = Replica(0), Replica(1)
    ids = [tuple(row) for row in one.add(random_components(3, k=3)).tolist()]
    shapes = one.datagrams()
    one.count({ids[0]: 64.0, ids[1]: 8.0})
    for datagram in one.datagrams():
        other.receive(datagram)
    assert len(other.changes().gained) == 0
    for datagram in shapes:
        other.receive(datagram)
    new = other.changes()
    assert len(new.added) == 1
    gained = {
        tuple(row): float(gain) for row, gain in zip(new.gained.ids.tolist(), new.gained.support, strict=True)
    }
    assert gained == {ids[0]: 64.0, ids[1]: 8.0}
    assert float(new.gained.seen_count.sum()) == pytest.approx(72.0)
    one.count({ids[1]: 8.0})
    for datagram in one.datagrams():
        other.receive(datagram)
    assert [float(gain) for gain in other.changes().gained.support] == [8.0]


def test_a_component_without_points_gains_them_evenly():
    one = Replica(0)
    bare = random_components(3, k=1, seed=3, n_origins=4, max_sightings=1)
    bare = Components(
        **{
            **vars(bare),
            "support": torch.zeros(1, dtype=torch.float64),
            "seen_by": torch.zeros(2, dtype=torch.int64),
            "seen_from": torch.arange(2),
            "seen_count": torch.zeros(2, dtype=torch.float64),
        }
    )
    name = tuple(one.add(bare)[0].tolist())
    one.count({name: 16.0})
    assert one.changes().gained.seen_count.tolist() == one.components().seen_count.tolist() == [8.0, 8.0]


def test_only_changes_of_known_components_demand_a_rebuild():
    one, follower = Replica(0), Follower()
    ids = one.add(random_components(3, k=4))
    one.add(random_components(3, k=0), supersedes=ids[:1])
    follower.follow(one)
    assert not follower.rebuilt  # these components were not reported yet
    one.add(random_components(3, k=2, seed=1), supersedes=ids[1:2])
    follower.follow(one)
    assert follower.rebuilt == 1
    one.correct(0, motion(2.0), ids[2:])
    follower.follow(one)
    assert follower.rebuilt == 2
    assert follower.agrees(one)
    late = Replica(1)
    late.changes()
    for datagram in one.datagrams():  # components arrive superseded and corrected
        late.receive(datagram)
    assert late.digest() == one.digest()


def test_components_that_arrive_after_their_correction_are_corrected():
    one, other, follower = Replica(0), Replica(1), Follower()
    ids = one.add(random_components(3, k=4))
    shapes = one.datagrams()
    one.correct(0, motion(2.0), ids)
    follower.follow(other)
    for datagram in [*one.datagrams(), *shapes]:
        other.receive(datagram)
        follower.follow(other)
    assert not follower.rebuilt
    assert follower.agrees(other)


def test_falling_counters_demand_a_rebuild():
    """A lower count from another robot is accepted, and the follower starts over."""
    one, other, follower = Replica(0), Replica(5, incarnation=2), Follower()
    key = one.add(random_components(3, k=1))[0].tolist()
    other.count({tuple(key): 64.0})
    for datagram in other.datagrams():
        one.receive(datagram)
    follower.follow(one)
    first = 5 << 52 | 2 << 28
    less = CountersMessage(first + 1, np.array([key[1]], np.int64), np.array([8], np.int64))
    assert one.receive(encode_record(less))
    old, new = Intervals.span(first, first + 1), Intervals.span(first + 1, first + 2)
    assert one.receive(encode_record(SupersessionMessage(first + 2, old, new)))
    follower.follow(one)
    assert follower.rebuilt == 1
    assert follower.agrees(one)
