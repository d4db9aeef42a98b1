"""MapPublisher: whatever a map becomes, and wherever lives of its robot end, its records are the map."""

from __future__ import annotations

import random
from dataclasses import replace

import torch
from exploration.replays import content
from hypothesis import given, settings
from hypothesis import strategies as st
from sharing.schedules import components

from gmmtorch.exploration.mission.map_publisher import MapPublisher
from gmmtorch.mapping.components import Components
from gmmtorch.sharing.replica.replica import Replica


def grown(rng: random.Random, known: Components) -> Components:
    """A map that has forgotten some, learned some, and perhaps some twice."""
    kept = [row for row in range(len(known)) if rng.random() < 0.8]
    fresh = components(rng, rng.randint(0, 4))
    parts = [known.selected(torch.tensor(kept, dtype=torch.int64)), fresh]
    return Components.concatenate(parts if rng.random() < 0.7 else [*parts, fresh])


def empty() -> Components:
    return components(random.Random(0), 1).selected(torch.zeros(0, dtype=torch.int64))


@settings(max_examples=10)
@given(seed=st.integers(0, 10**6))
def test_records_are_the_map_in_one_life_and_all_that_changes_is_said(seed):
    rng, replica, observer = random.Random(seed), Replica(3), Replica(9)
    publication, known = MapPublisher(replica), empty()
    for _ in range(6):
        before, known = content(known), grown(rng, known)
        n = replica.n_components
        publication.update(known, whole=rng.random() < 0.5)
        assert content(replica.components()) == content(known)
        version = replica.version
        publication.update(known, whole=True)
        assert replica.version == version  # nothing is said twice
        said = replica.datagrams()
        assert bool(said) == (content(known) != before)
        assert all(observer.receive(datagram) for datagram in said)
        assert n <= 60
    assert observer.digest() == replica.digest()


@settings(max_examples=3)
@given(seed=st.integers(0, 10**6))
def test_a_life_goes_on_where_another_was_cut_off_and_says_no_more_than_it_must(seed):
    """Of what was said some datagrams are lost with the disk; these come back later from others."""
    rng, team, known = random.Random(seed), Replica(9), empty()
    for _ in range(4):
        replica = Replica(3)
        remembered = [datagram for datagram in everything(team) if rng.random() < 0.7]
        for datagram in remembered:
            replica.receive(datagram)
        publication = MapPublisher(replica)
        for _ in range(2):
            known = grown(rng, known)
            publication.update(known, whole=False)
            assert not content(known) - content(replica.components())  # nothing is missing
            tell(rng, replica, team)
        for datagram in everything(team):
            replica.receive(datagram)
        publication.update(known, whole=True)
        assert content(replica.components()) == content(known)  # and nothing there twice
        tell(rng, replica, team, whole=True)
        assert content(team.components()) == content(known)


def tell(rng: random.Random, replica: Replica, team: Replica, whole: bool = False) -> None:
    datagrams = replica.datagrams()
    for datagram in datagrams:
        if whole or rng.random() < 0.7:
            assert team.receive(datagram)
    if whole:
        for datagram in everything(replica):
            team.receive(datagram)


def everything(replica: Replica) -> list[bytes]:
    """All records, for one who has none."""
    nobody, copy = Replica(1000), Replica(replica.robot)
    copy.restore(replica.state())
    for _ in range(2):  # others' records go to who still lacks them at its next announcement
        for datagram in nobody.announcements():
            copy.receive(datagram)
    return copy.datagrams()


def test_counts_of_others_do_not_make_it_say_anything_again():
    rng, replica, other = random.Random(0), Replica(3), Replica(4)
    publication, known = MapPublisher(replica), components(random.Random(1), 5)
    publication.update(known, whole=True)
    for datagram in replica.datagrams():
        other.receive(datagram)
    other.count({tuple(row): 10.0 * rng.random() + 1 for row in other.components().ids.tolist()})
    for datagram in other.datagrams():
        assert replica.receive(datagram)
    assert float(replica.components().support.sum()) > float(known.support.sum())
    version = replica.version
    publication.update(known, whole=True)
    assert replica.version == version


def test_components_of_others_are_left_alone():
    replica, other = Replica(3), Replica(4)
    other.add(components(random.Random(1), 5))
    for datagram in other.datagrams():
        assert replica.receive(datagram)
    known = components(random.Random(2), 3)
    MapPublisher(replica).update(known, whole=True)
    assert content(replica.components()) == content(known, other.components())
    again = replace(known, support=known.support * 2, seen_count=known.seen_count * 2)
    MapPublisher(replica).update(again, whole=True)
    assert content(replica.components()) == content(again, other.components())
