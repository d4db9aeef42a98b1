"""Replica.publish: the records of a robot equal its map, also after changes and restarts."""

from __future__ import annotations

import random

import torch
from exploration.replays import content
from hypothesis import given, settings
from hypothesis import strategies as st
from sharing.replica_histories import everything
from sharing.schedules import components

from gmmtorch.mapping.components import Components
from gmmtorch.team.sharing.replica.replica import Replica


def changed(rng: random.Random, before: Components) -> Components:
    """The map without some components and with some new ones, perhaps twice."""
    kept = [row for row in range(len(before)) if rng.random() < 0.8]
    new = components(rng, rng.randint(0, 4))
    parts = [before.selected(torch.tensor(kept, dtype=torch.int64)), new]
    return Components.concatenate(parts if rng.random() < 0.7 else [*parts, new])


def empty() -> Components:
    return components(random.Random(0), 1).selected(torch.zeros(0, dtype=torch.int64))


@settings(max_examples=3)
@given(seed=st.integers(0, 10**6))
def test_records_equal_the_map_and_only_changes_are_sent(seed):
    rng, replica, observer = random.Random(seed), Replica(3), Replica(9)
    known = empty()
    for _ in range(6):
        before, known = content(known), changed(rng, known)
        replica.publish(known, whole=rng.random() < 0.5)
        assert content(replica.components()) == content(known)
        version = replica.version
        replica.publish(known, whole=True)
        assert replica.version == version
        sent = replica.datagrams()
        assert bool(sent) == (content(known) != before)
        assert all(observer.receive(datagram) for datagram in sent)
    assert observer.digest() == replica.digest()


@settings(max_examples=1)
@given(seed=st.integers(0, 10**6))
def test_a_session_continues_a_killed_one(seed):
    """Some datagrams are lost with the disk; teammates send them later."""
    rng, team, known = random.Random(seed), Replica(9), empty()
    for _ in range(3):
        replica = Replica(3)
        for datagram in [datagram for datagram in everything(team) if rng.random() < 0.7]:
            replica.receive(datagram)
        for _ in range(2):
            known = changed(rng, known)
            replica.publish(known, whole=False)
            assert not content(known) - content(replica.components())
            for datagram in replica.datagrams():
                if rng.random() < 0.7:
                    assert team.receive(datagram)
        for datagram in everything(team):
            replica.receive(datagram)
        replica.publish(known, whole=True)
        assert content(replica.components()) == content(known)
        for datagram in [*replica.datagrams(), *everything(replica)]:
            team.receive(datagram)
        assert content(team.components()) == content(known)


def test_counts_of_other_robots_do_not_repeat_records():
    rng, replica, other = random.Random(0), Replica(3), Replica(4)
    known = components(random.Random(1), 5)
    replica.publish(known, whole=True)
    for datagram in replica.datagrams():
        other.receive(datagram)
    other.count({tuple(row): 10.0 * rng.random() + 1 for row in other.components().ids.tolist()})
    for datagram in other.datagrams():
        assert replica.receive(datagram)
    assert float(replica.components().support.sum()) > float(known.support.sum())
    version = replica.version
    replica.publish(known, whole=True)
    assert replica.version == version
