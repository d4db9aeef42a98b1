"""Whatever strangers say, and however much of it: memory stays bounded, and who is honest gets through."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import pytest
import torch
from mapping.random_components import random_components

from gmmtorch.sharing.messages.announcements import AnnouncementMessage, encode_announcements
from gmmtorch.sharing.messages.message_registry import (
    MAX_BYTES,
    decode,
    encode_components,
)
from gmmtorch.sharing.messages.record_messages import (
    RECORD_BYTES,
    CountersMessage,
    RecordMessage,
    SupersessionMessage,
    encode_record,
)
from gmmtorch.sharing.replica import anti_entropy, records
from gmmtorch.sharing.replica.anti_entropy import PATIENCE
from gmmtorch.sharing.replica.changes import ChangeLog
from gmmtorch.sharing.replica.component_table import ComponentTable
from gmmtorch.sharing.replica.counters import Counters
from gmmtorch.sharing.replica.intervals import Intervals
from gmmtorch.sharing.replica.record_keys import END, first_key, ids_of
from gmmtorch.sharing.replica.replica import Replica

STRANGER, OWNER = 900, 901
BURIED = first_key(OWNER)
"""The first of many keys that one supersession has superseded: a gap may be anywhere in them."""


def spread(begin: int, n: int) -> Intervals:
    """n keys, none next to another."""
    return Intervals.of(begin + 2 * np.arange(n))


def announcement(number: int, begin: int, n: int = 550) -> AnnouncementMessage:
    """Of a stranger of many: n keys, and nothing between them; `number` says which part of all keys."""
    begin += 2 * n * number
    return AnnouncementMessage(number % 5 + 1, 0, begin, begin + 2 * n, spread(begin, n))


def n_intervals(by_robot: Mapping[int, Intervals]) -> int:
    return sum(map(len, by_robot.values()))


def burying(new: Intervals | None = None) -> bytes:
    old = Intervals.span(BURIED, BURIED + (1 << 27))
    return encode_record(SupersessionMessage(BURIED + (1 << 27), old, new or Intervals.empty()))


def told(replica: Replica, messages: Iterator[RecordMessage]) -> int:
    """How many of these the replica takes in."""
    datagrams = map(encode_record, messages)
    return sum(replica.receive(datagram) for datagram in datagrams if len(datagram) <= RECORD_BYTES)


def goes_on(replica: Replica) -> None:
    """It adds, supersedes, counts and corrects, whatever others have filled it with; others can hear it."""
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


# -- a map -------------------------------------------------------------------------------------------------


def test_such_announcements_are_datagrams():
    message = announcement(3, 0)
    (datagram,) = encode_announcements(3, 0, message.held)
    assert len(datagram) <= MAX_BYTES
    assert decode(datagram).held == message.held


@pytest.mark.parametrize(("table", "begin"), [("gaps", BURIED), ("theirs", first_key(STRANGER))])
def test_announcements_without_end(table, begin):
    """Of holes in what is superseded here, and of what nobody holds, each of another part of all keys."""
    replica = Replica(0)
    assert replica.receive(burying())
    n = anti_entropy.MOST_REMEMBERED // 550 + 40
    for number in range(n):
        assert replica.receive(b"\x1a", announcement(number, begin))
    backlog = replica._backlog
    sizes = {"gaps": n_intervals(backlog._gaps), "theirs": n_intervals(backlog._theirs)}
    assert sizes[table] > anti_entropy.MOST_REMEMBERED // 2
    assert max(sizes.values()) <= anti_entropy.MOST_REMEMBERED
    assert not backlog.due


def test_who_announces_without_end_is_forgotten_and_the_honest_are_not():
    replica, honest = Replica(0), Replica(7)
    honest.add(random_components(3, k=5))
    for datagram in honest.announcements():
        assert replica.receive(datagram)
    for number in range(anti_entropy.MOST_REMEMBERED // 550 + 40):
        replica.receive(b"\x1a", announcement(number, first_key(STRANGER)))
    assert replica.missing.covers(honest.held)


@pytest.mark.parametrize("again", [False, True])
def test_what_nobody_has_is_missing_for_a_while_alone(again):
    replica = Replica(0)
    invented = AnnouncementMessage(5, 0, 0, END, spread(first_key(5), 3))
    replica.receive(b"\x1a", invented)
    for _ in range(PATIENCE - 1):
        replica.announcements()
    assert replica.missing == invented.held
    if again:  # somebody is there
        replica.receive(b"\x1a", AnnouncementMessage(5, 0, 0, first_key(1), Intervals.empty()))
    replica.announcements()
    assert bool(replica.missing) == again
    for _ in range(PATIENCE):
        replica.announcements()
    assert not replica.missing
    replica.receive(b"\x1a", invented)
    assert replica.missing == invented.held  # it may be there after all


def test_what_is_taken_to_be_on_its_way_is_bounded():
    """Where nobody asks for datagrams: components that are superseded here come, whatever they are."""
    replica = Replica(0)
    assert replica.receive(burying())
    shape = random_components(3, k=1000, n_origins=1, max_sightings=1)
    (message, *_) = (decode(datagram) for datagram in encode_components(shape))
    n = len(message.components)
    for number in range(anti_entropy.MOST_IN_FLIGHT // n + 20):
        keys = BURIED + 2 * n * number + 2 * np.arange(n)
        components = replace(message.components, ids=ids_of(keys))
        assert replica.receive(b"\x11", replace(message, components=components))
    assert sum(map(len, replica._backlog._in_flight)) <= anti_entropy.MOST_IN_FLIGHT


def test_totals_without_end(monkeypatch):
    """7000 in a datagram, as all are alike."""
    most = 1 << 17
    monkeypatch.setattr(records, "MOST_ENTRIES", most)

    def totals() -> Iterator[CountersMessage]:
        steps = np.zeros(7000, np.int64)
        for number in range(40):
            keys = first_key(STRANGER) + 7000 * number + np.arange(7000)
            yield CountersMessage(first_key(number % 5) + number, keys, steps)

    replica = Replica(50, most_components=10)
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    n = told(replica, totals())
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert n == most // 7000
    assert replica.refused == {"full": 40 - n}
    assert grown <= 32 * most + (1 << 20)
    goes_on(replica)
    # Who supersedes its own makes room.
    key = first_key(0) + (1 << 20)
    old = Intervals.span(first_key(0), key)
    assert told(replica, iter([SupersessionMessage(key, old, Intervals.empty())])) == 1
    # Those that are here, or are superseded, and as many of others as have gone.
    assert told(replica, totals()) == n + len(range(0, 40, 5))


def test_records_without_end(monkeypatch):
    monkeypatch.setattr(records, "MOST_OTHERS", 200)

    def small() -> Iterator[CountersMessage]:
        for number in range(250):
            yield CountersMessage(first_key(number % 20) + number, np.array([number]), np.array([7]))

    replica = Replica(50, most_components=10)
    assert told(replica, small()) == 200
    assert replica.refused == {"full": 50}
    goes_on(replica)


@pytest.mark.parametrize("waits", [False, True])
def test_names_without_end(waits):
    """Superseded ones, far apart; or waiting for a successor that is to come."""
    successor = Intervals.span(BURIED + (1 << 27), BURIED + (1 << 27) + 1)

    def scattered() -> Iterator[SupersessionMessage]:
        for number in range(60):
            old = spread(BURIED + 800 * number, 400)
            yield SupersessionMessage(
                BURIED + (1 << 26) + number, old, successor if waits else Intervals.empty()
            )

    replica = Replica(50, most_components=10)
    n = told(replica, scattered())
    assert n == (records.MOST_INTERVALS - 1) // 400
    assert replica.refused == {"full": 60 - n}
    assert len(replica.held) <= records.MOST_INTERVALS
    component = replace(random_components(3, k=1), ids=ids_of(successor.numbers()))
    replica.receive(encode_components(component)[0])
    assert len(replica.held) <= 2 * records.MOST_INTERVALS
    goes_on(replica)


def test_components_of_others_leave_room_for_those_of_this_robot():
    replica = Replica(50, most_components=10)
    for robot in range(3):
        for datagram in encode_components(random_components(3, k=5, robot=robot)):
            replica.receive(datagram)
    assert replica.n_components == 10
    assert replica.refused == {"full": 1}
    goes_on(replica)


def test_changes_that_nobody_asks_for_are_bounded():
    """Records without entries, too."""
    log = ChangeLog()
    log.read(ComponentTable(), Counters(), [])
    for _ in range(100):
        log.counted(np.zeros(0, np.int64))
    assert len(log._touched) == 100
    for _ in range(1 << 16):
        log.counted(np.zeros(0, np.int64))
    assert log._touched is None
