"""Replica: restarts, limits, hostile datagrams, and bounded memory whatever strangers send."""

from __future__ import annotations

import random
import tracemalloc
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import pytest
import torch
from mapping.random_components import random_components
from sharing.message_examples import forged, frame_of_components
from sharing.replica_histories import everything, exchange, history, replica_of

import gmmtorch as gt
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.team.sharing import MAX_BYTES, Replica, decode
from gmmtorch.team.sharing.messages.component_messages import encode_components, encode_counts
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
from gmmtorch.team.sharing.replica.records import MOST_VIEWPOINTS

# -- restarts --------------------------------------------------------------------------------------


def test_a_robot_that_lost_its_disk_recovers_its_records_and_repeats_no_id():
    one, other = Replica(0), Replica(1)
    one.add(random_components(3, k=20, seed=1))
    exchange([one, other])
    reborn = Replica(0)
    before = {tuple(row) for row in other.components().ids.tolist()}
    ids = reborn.add(random_components(3, k=20, seed=2))
    assert not before & {tuple(row) for row in ids.tolist()}
    exchange([reborn, other], 4)
    assert reborn.digest() == other.digest()
    assert reborn.n_components == 40
    reborn.add(random_components(3, k=0), supersedes=torch.tensor(sorted(before)))  # of its earlier session
    exchange([reborn, other])
    assert other.n_components == 20
    assert not reborn.duplicates
    assert not other.duplicates


def test_duplicate_robot_ids_are_detected():
    one, twin, other = Replica(0), Replica(0), Replica(1)
    one.add(random_components(3, k=3, seed=1))
    twin.add(random_components(3, k=3, seed=2))
    exchange([one, twin, other])
    assert one.duplicates[0] > 0
    assert twin.duplicates[0] > 0
    assert not other.duplicates


def test_one_id_with_two_contents_is_refused():
    """Two robots have the same id and the same incarnation."""
    one, twin = Replica(4, incarnation=7), Replica(4, incarnation=7)
    one.add(random_components(3, k=3, seed=1))
    twin.add(random_components(3, k=3, seed=2))
    other = replica_of(one.datagrams())
    digest = other.digest()
    assert not any(other.receive(datagram) for datagram in twin.datagrams())
    assert other.duplicates == {4: 1}
    assert other.refused == {"duplicate_id": 1}
    assert other.digest() == digest
    more = Replica(4, incarnation=7)
    more.add(random_components(3, k=9, seed=1))  # keys that `one` has not given yet
    assert not any(one.receive(datagram) for datagram in more.datagrams())
    assert one.duplicates[4] == 1


# -- limits and hostile input ----------------------------------------------------------------------


def test_within_a_budget_the_most_informative_components_are_sent_first():
    one = Replica(0)
    near = random_components(3, k=192, seed=1, extent=2.0, deviations=(0.01, 0.02))
    far = random_components(3, k=96, seed=2, extent=200.0, deviations=(0.5, 1.0))
    one.add(near)
    large = {tuple(row) for row in one.add(far).tolist()}
    sent, rounds = [], 0
    while datagrams := one.datagrams(budget=1300):
        assert sum(map(len, datagrams)) <= 1300
        sent += [tuple(row) for datagram in datagrams for row in decode(datagram).components.ids.tolist()]
        rounds += 1
    assert rounds > 1
    assert set(sent[:96]) == large
    assert len(sent) == len(set(sent)) == 288
    assert replica_of(everything(one)).digest() == one.digest()


def test_within_a_budget_few_large_components_go_before_many_small_ones():
    one = Replica(0)
    one.add(random_components(3, k=128, seed=3, extent=100.0, deviations=(0.4, 0.5)))
    few = one.add(random_components(3, k=8, seed=4, extent=100.0, deviations=(1.0, 1.1))).tolist()
    first = decode(one.datagrams(budget=1300)[0]).components
    assert sorted(first.ids[:8].tolist()) == sorted(few)


@pytest.mark.parametrize("n", [1, 128, 129, 400])
@pytest.mark.parametrize("max_bytes", [1000, 1100, MAX_BYTES])
def test_each_component_is_sent_once_in_datagrams_of_any_requested_size(n, max_bytes):
    """Also if they were encoded for longer ones, or are smaller than the first guess."""
    one, other = Replica(0, dim=3), Replica(1, dim=3)
    for made in (random_components(3, k=n), frame_of_components(n)):
        ids = one.add(made)
        datagrams = one.datagrams(max_bytes)
        sizes = [len(datagram) for datagram in datagrams]
        assert max(sizes) <= max_bytes
        sent = [row for datagram in datagrams for row in decode(datagram).components.ids.tolist()]
        assert sorted(sent) == sorted(ids.tolist())
        assert all(other.receive(datagram) for datagram in datagrams)
    assert sum(sizes[:-1]) >= 0.85 * max_bytes * (len(sizes) - 1)
    assert other.digest() == one.digest()


def test_other_dimensions_kinds_and_too_many_viewpoints_are_refused():
    one = Replica(0)
    one.add(random_components(3, k=3))
    flat = random_components(2, k=3)
    crowd = random_components(3, k=1, n_origins=60, max_sightings=1)
    crowd = replace(
        crowd,
        seen_by=torch.zeros(60, dtype=torch.int64),
        seen_from=torch.arange(60),
        seen_count=torch.ones(60, dtype=torch.float64),
        support=torch.tensor([60.0], dtype=torch.float64),
    )
    assert MOST_VIEWPOINTS < 60
    for datagram in [*encode_components(flat), *encode_components(crowd)]:
        assert not one.receive(datagram)
    assert one.refused == {"unfit": 2}
    for datagram in [*encode_components(flat, "float"), *encode_counts(1, {(0, 1): 2.0})]:
        assert not one.receive(datagram)
    assert one.refused["other"] == 2
    with pytest.raises(InvalidArgumentError, match="2-dimensional"):
        one.add(flat)
    with pytest.raises(InvalidArgumentError, match="limit_origins"):
        one.add(crowd)


@pytest.fixture(scope="module")
def sound() -> list[bytes]:
    sent = history(5, 30)
    return [*sent, *replica_of(sent).announcements()]


def test_hostile_bytes_never_raise(sound):
    rng = random.Random(0)
    assert {datagram[0] for datagram in sound} >= {0x11, 0x1A, 0x1B, 0x1C, 0x1D}
    replica = replica_of(sound[:5])
    for trial in range(700):
        datagram = bytearray(rng.choice(sound))
        body = datagram[1:-4]
        if trial % 3 == 0:
            datagram = bytearray(rng.randbytes(rng.randint(0, 1300)))
        elif trial % 3 == 1:
            datagram = datagram[: rng.randrange(len(datagram))]
        else:
            for _ in range(rng.randint(1, 3)):
                body[rng.randrange(len(body))] ^= 1 << rng.randrange(8)
            datagram = bytearray(forged(bytes(datagram), bytes(body)))
        assert replica.receive(bytes(datagram)) in (True, False)
    assert replica.refused["damaged"] > 230
    components_ = replica.components()
    assert bool(torch.isfinite(components_.means).all())
    for datagram in replica.datagrams():  # all that it merged can be sent
        assert len(datagram) <= MAX_BYTES
    for not_bytes in (None, "text", 3, bytearray(b"\x11"), []):
        assert not replica.receive(not_bytes)
    assert len(replica.digest()) == 16
    assert Replica(9).load(*replica.stored()) == 0


@pytest.mark.parametrize(
    ("what", "wrong"),
    [
        ("robot=-1", lambda: Replica(-1)),
        ("robot=1024", lambda: Replica(1024)),
        ("incarnation", lambda: Replica(0, incarnation=1 << 24)),
        ("dim=4", lambda: Replica(0, dim=4)),
        ("max_bytes=999", lambda: Replica(0).datagrams(max_bytes=999)),
        ("max_bytes=1201", lambda: Replica(0).announcements(max_bytes=1201)),
        ("budget", lambda: Replica(0).datagrams(budget=-1)),
        ("supersedes", lambda: Replica(0).add(random_components(3, k=1), supersedes=torch.zeros(3))),
        ("robot=0", lambda: Replica(0).add(random_components(3, k=1), supersedes=torch.tensor([[1, 0]]))),
        ("robots", lambda: Replica(3).add(gt.GaussianMap.of(random_components(3, k=1)))),
        ("nan", lambda: Replica(0).count({(0, 1): float("nan")})),
        ("rigid", lambda: Replica(0).correct(0, 2 * torch.eye(4), torch.tensor([[0, 1]]))),
        ("own", lambda: Replica(0).correct(0, torch.eye(4), torch.tensor([[1, 1]]))),
    ],
)
def test_invalid_arguments_are_named(what, wrong):
    with pytest.raises(InvalidArgumentError, match=what):
        wrong()


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
