"""Memory stays bounded whatever strangers send, and honest robots still exchange records."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import pytest
import torch
from mapping.random_components import random_components

from gmmtorch.team.sharing.messages.message_registry import decode, encode_components
from gmmtorch.team.sharing.messages.record_messages import (
    RECORD_BYTES,
    AnnouncementMessage,
    CountersMessage,
    RecordMessage,
    SupersessionMessage,
    encode_record,
)
from gmmtorch.team.sharing.replica import anti_entropy, records
from gmmtorch.team.sharing.replica.anti_entropy import PATIENCE
from gmmtorch.team.sharing.replica.record_keys import END, Intervals, first_key, ids_of
from gmmtorch.team.sharing.replica.replica import Replica

STRANGER, OWNER = 900, 901
BURIED = first_key(OWNER)
"""The first of many keys that one supersession has superseded."""


def spread(begin: int, n: int) -> Intervals:
    """n keys, no two adjacent."""
    return Intervals.of(begin + 2 * np.arange(n))


def announcement(number: int, begin: int, n: int = 550) -> AnnouncementMessage:
    """An announcement of n separate keys; `number` selects the part of all keys."""
    begin += 2 * n * number
    return AnnouncementMessage(number % 5 + 1, 0, begin, begin + 2 * n, spread(begin, n))


def n_intervals(by_robot: Mapping[int, Intervals]) -> int:
    return sum(map(len, by_robot.values()))


def supersession_of_many(new: Intervals | None = None) -> bytes:
    old = Intervals.span(BURIED, BURIED + (1 << 27))
    return encode_record(SupersessionMessage(BURIED + (1 << 27), old, new or Intervals.empty()))


def n_accepted(replica: Replica, messages: Iterator[RecordMessage]) -> int:
    """The number of messages that the replica merges."""
    datagrams = map(encode_record, messages)
    return sum(replica.receive(datagram) for datagram in datagrams if len(datagram) <= RECORD_BYTES)


def assert_replica_still_works(replica: Replica) -> None:
    """The replica can still add, supersede, count and correct, and others can merge its records."""
    other = Replica(77)
    ids = replica.add(random_components(3, k=8))
    replica.count({tuple(row): 5.0 for row in ids.tolist()})
    replica.correct(1, torch.eye(4, dtype=torch.float64), ids)
    kept = replica.add(random_components(3, k=2, seed=1), supersedes=ids[:3])
    assert all(other.receive(datagram) for datagram in replica.datagrams())
    mine = {tuple(row) for row in [*ids[3:].tolist(), *kept.tolist()]}
    assert {tuple(row) for row in other.components().ids.tolist()} == mine
    again = Replica(replica.robot)
    assert again.load(*replica.stored()) == 0
    assert again.digest() == replica.digest()


@pytest.mark.parametrize(("table", "begin"), [("gaps", BURIED), ("theirs", first_key(STRANGER))])
def test_remembered_announcements_are_bounded(table, begin):
    """Each announces another part: gaps in superseded keys, or records that no robot holds."""
    replica = Replica(0)
    assert replica.receive(supersession_of_many())
    n = anti_entropy.MOST_REMEMBERED // 550 + 40
    for number in range(n):
        assert replica.receive(b"\x1a", announcement(number, begin))
    backlog = replica._backlog
    sizes = {"gaps": n_intervals(backlog._gaps), "theirs": n_intervals(backlog._theirs)}
    assert sizes[table] > anti_entropy.MOST_REMEMBERED // 2
    assert max(sizes.values()) <= anti_entropy.MOST_REMEMBERED
    assert not backlog.due


def test_a_flooding_robot_is_forgotten_and_honest_ones_are_not():
    replica, honest = Replica(0), Replica(7)
    honest.add(random_components(3, k=5))
    for datagram in honest.announcements():
        assert replica.receive(datagram)
    for number in range(anti_entropy.MOST_REMEMBERED // 550 + 40):
        replica.receive(b"\x1a", announcement(number, first_key(STRANGER)))
    assert replica.missing.covers(honest.held)


@pytest.mark.parametrize("again", [False, True])
def test_invented_records_are_missing_only_for_a_while(again):
    replica = Replica(0)
    invented = AnnouncementMessage(5, 0, 0, END, spread(first_key(5), 3))
    replica.receive(b"\x1a", invented)
    for _ in range(PATIENCE - 1):
        replica.announcements()
    assert replica.missing == invented.held
    if again:  # the robot announces again
        replica.receive(b"\x1a", AnnouncementMessage(5, 0, 0, first_key(1), Intervals.empty()))
    replica.announcements()
    assert bool(replica.missing) == again
    for _ in range(PATIENCE):
        replica.announcements()
    assert not replica.missing
    replica.receive(b"\x1a", invented)
    assert replica.missing == invented.held  # it counts again


def test_keys_in_flight_are_bounded():
    """Superseded components arrive, and `datagrams` is never called."""
    replica = Replica(0)
    assert replica.receive(supersession_of_many())
    shape = random_components(3, k=1000, n_origins=1, max_sightings=1)
    (message, *_) = (decode(datagram) for datagram in encode_components(shape))
    n = len(message.components)
    for number in range(anti_entropy.MOST_IN_FLIGHT // n + 20):
        keys = BURIED + 2 * n * number + 2 * np.arange(n)
        components = replace(message.components, ids=ids_of(keys))
        assert replica.receive(b"\x11", replace(message, components=components))
    assert sum(map(len, replica._backlog._in_flight)) <= anti_entropy.MOST_IN_FLIGHT


def test_counters_are_bounded(monkeypatch):
    """A datagram has 7000 equal counters."""
    most = 1 << 17
    monkeypatch.setattr(records, "MOST_ENTRIES", most)

    def counters() -> Iterator[CountersMessage]:
        steps = np.zeros(7000, np.int64)
        for number in range(40):
            keys = first_key(STRANGER) + 7000 * number + np.arange(7000)
            yield CountersMessage(first_key(number % 5) + number, keys, steps)

    replica = Replica(50, most_components=10)
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    n = n_accepted(replica, counters())
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert n == most // 7000
    assert replica.refused == {"full": 40 - n}
    assert grown <= 32 * most + (1 << 20)
    assert_replica_still_works(replica)
    # Superseded records make room.
    key = first_key(0) + (1 << 20)
    old = Intervals.span(first_key(0), key)
    assert n_accepted(replica, iter([SupersessionMessage(key, old, Intervals.empty())])) == 1
    # Known or superseded records are accepted, and as many others as there is room for.
    assert n_accepted(replica, counters()) == n + len(range(0, 40, 5))


def test_other_records_are_bounded(monkeypatch):
    monkeypatch.setattr(records, "MOST_OTHERS", 200)

    def small() -> Iterator[CountersMessage]:
        for number in range(250):
            yield CountersMessage(first_key(number % 20) + number, np.array([number]), np.array([7]))

    replica = Replica(50, most_components=10)
    assert n_accepted(replica, small()) == 200
    assert replica.refused == {"full": 50}
    assert_replica_still_works(replica)


@pytest.mark.parametrize("waits", [False, True])
def test_intervals_of_keys_are_bounded(waits):
    """Separate superseded keys; or keys that wait for a successor."""
    successor = Intervals.span(BURIED + (1 << 27), BURIED + (1 << 27) + 1)

    def scattered() -> Iterator[SupersessionMessage]:
        for number in range(60):
            old = spread(BURIED + 800 * number, 400)
            yield SupersessionMessage(
                BURIED + (1 << 26) + number, old, successor if waits else Intervals.empty()
            )

    replica = Replica(50, most_components=10)
    n = n_accepted(replica, scattered())
    assert n == (records.MOST_INTERVALS - 1) // 400
    assert replica.refused == {"full": 60 - n}
    assert len(replica.held) <= records.MOST_INTERVALS
    component = replace(random_components(3, k=1), ids=ids_of(successor.numbers()))
    replica.receive(encode_components(component)[0])
    assert len(replica.held) <= 2 * records.MOST_INTERVALS
    assert_replica_still_works(replica)


def test_own_components_have_room_beyond_the_limit():
    replica = Replica(50, most_components=10)
    for robot in range(3):
        for datagram in encode_components(random_components(3, k=5, robot=robot)):
            replica.receive(datagram)
    assert replica.n_components == 10
    assert replica.refused == {"full": 1}
    assert_replica_still_works(replica)
