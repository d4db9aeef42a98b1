"""Replica: restarts, limits, and hostile datagrams."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest
import torch
from mapping.random_components import random_components
from sharing.message_examples import forged, frame_of_components
from sharing.replica_histories import everything, exchange, history, replica_of

import gmmtorch as gt
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.team.sharing.messages.message_registry import (
    MAX_BYTES,
    decode,
    encode_components,
    encode_counts,
)
from gmmtorch.team.sharing.replica.records import MOST_VIEWPOINTS
from gmmtorch.team.sharing.replica.replica import Replica

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


def test_a_loaded_replica_continues():
    one, other = Replica(0), Replica(1)
    m = gt.GaussianMap.of(replace(random_components(3, k=30), ids=torch.tensor([[0, n] for n in range(30)])))
    one.add(m)
    one.count({tuple(one.components().ids[0].tolist()): 9.0})
    again = Replica(0)
    assert again.load(*one.stored()) == 0
    assert again.digest() == one.digest()
    assert len(again.add(m)) == 0  # equal components are not written again
    exchange([again, other])
    assert other.digest() == again.digest()


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


@pytest.mark.parametrize("max_bytes", [1000, 1100, 1200])
def test_datagrams_fit_any_requested_size(max_bytes):
    """Also for records that were encoded for longer datagrams."""
    one = Replica(0)
    for seed in range(2):
        ids = one.add(random_components(3, k=400, seed=seed))
        datagrams = one.datagrams(max_bytes=max_bytes)
        sizes = [len(datagram) for datagram in datagrams]
        assert max(sizes) <= max_bytes
        sent = [row for datagram in datagrams for row in decode(datagram).components.ids.tolist()]
        assert sorted(sent) == sorted(ids.tolist())
    assert sum(sizes[:-1]) > 0.85 * max_bytes * (len(sizes) - 1)  # the encoder uses the size of the last call


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


@pytest.mark.parametrize("n", [1, 128, 129, 300])
@pytest.mark.parametrize("max_bytes", [1000, MAX_BYTES])
def test_each_component_is_sent_once(n: int, max_bytes: int) -> None:
    # Small components: more fit into a datagram than the first guess.
    one, other = Replica(0, dim=3), Replica(1, dim=3)
    one.add(frame_of_components(n))
    datagrams = one.datagrams(max_bytes)
    assert all(len(datagram) <= max_bytes for datagram in datagrams)
    sent = [tuple(name) for datagram in datagrams for name in decode(datagram).components.ids.tolist()]
    assert len(sent) == len(set(sent)) == n
    assert all(other.receive(datagram) for datagram in datagrams)
    assert other.digest() == one.digest()
