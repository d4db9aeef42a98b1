"""Replica: the order, repetition and loss of datagrams do not change the final map."""

from __future__ import annotations

import os
import random
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.random_components import random_components
from sharing.message_examples import frame_of_components, sealed
from sharing.replica_model import Model, rows
from sharing.schedules import act, components, run_schedule

import gmmtorch as gt
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.codec.component_batch import quantized
from gmmtorch.sharing.messages.message_registry import MAX_BYTES, decode, encode_components, encode_counts
from gmmtorch.sharing.replica.records import MOST_VIEWPOINTS
from gmmtorch.sharing.replica.replica import Replica

N_SCHEDULES = int(os.environ.get("GMMTORCH_SCHEDULES", "4"))
"""`scripts/soak.sh` runs more."""
seeds = st.integers(0, 10**6)


def exchange(replicas: list[Replica], rounds: int = 6) -> None:
    """Each replica receives all datagrams of the others."""
    for _ in range(rounds):
        for sender in replicas:
            for datagram in [*sender.announcements(), *sender.datagrams()]:
                for receiver in replicas:
                    if receiver is not sender:
                        receiver.receive(datagram)


def history(seed: int, n_acts: int = 14) -> list[bytes]:
    """All datagrams of three robots that receive some of each other's."""
    rng = random.Random(seed)
    robots = [Replica(robot, incarnation=rng.getrandbits(24)) for robot in range(3)]
    sent: list[bytes] = []
    for _ in range(n_acts):
        robot = rng.choice(robots)
        act(rng, robot)
        new = robot.datagrams()
        sent += new
        for other in robots:
            if other is not robot and rng.random() < 0.7:
                for datagram in new:
                    other.receive(datagram)
    return sent


def everything(replica: Replica) -> list[bytes]:
    """All datagrams that a replica sends to a robot without records."""
    for _ in range(4):  # so that no record is in flight
        replica.datagrams()
    for datagram in [*Replica(1000).announcements(), *Replica(1000).announcements()]:
        replica.receive(datagram)
    return replica.datagrams()


def replica_of(datagrams: list[bytes], robot: int = 9) -> Replica:
    replica = Replica(robot)
    for datagram in datagrams:
        assert replica.receive(datagram)
    return replica


# -- merging ---------------------------------------------------------------------------------------------


@settings(max_examples=6, deadline=None)
@given(seed=seeds, order=st.randoms(use_true_random=False))
def test_order_and_repetition_do_not_matter(seed, order):
    sent = history(seed)
    again = [*sent, *order.sample(sent, len(sent) // 2)]
    order.shuffle(again)
    one, other = replica_of(sent), replica_of(again)
    assert one.digest() == other.digest()
    for name, value in vars(one.components()).items():
        assert torch.equal(value, getattr(other.components(), name)), name


@settings(max_examples=3, deadline=None)
@given(seed=seeds, order=st.randoms(use_true_random=False))
def test_grouping_does_not_matter(seed, order):
    """Three replicas that received parts and then exchange them equal one that received everything."""
    sent = history(seed)
    parts: list[list[bytes]] = [[], [], []]
    for datagram in sent:
        order.choice(parts).append(datagram)
    robots = [replica_of(part, robot=9 + number) for number, part in enumerate(parts)]
    order.shuffle(robots)
    exchange(robots)
    assert {robot.digest() for robot in robots} == {replica_of(sent).digest()}


@settings(max_examples=8, deadline=None)
@given(seed=seeds, order=st.randoms(use_true_random=False))
def test_any_part_of_a_history_equals_a_plain_model(seed, order):
    sent = [datagram for datagram in history(seed) if order.random() < 0.8]
    order.shuffle(sent)
    replica, model = replica_of(sent), Model()
    for datagram in sent:
        model.receive(datagram)
    found, expected = rows(replica.components()), model.components()
    assert found.keys() == expected.keys()
    for key, (mean, _, support, flag, seen) in found.items():
        shift = model.shift(key)
        assert mean == pytest.approx([a + b for a, b in zip(expected[key][0], shift, strict=True)], abs=1e-9)
        assert support == pytest.approx(model.support(key))
        assert flag == expected[key][3]
        assert sum(count for _, count in seen) == pytest.approx(support)
        assert len(seen) == len(expected[key][4])


@pytest.mark.parametrize("seed", range(N_SCHEDULES))
def test_all_replicas_agree_once_the_network_heals(seed):
    outcome = run_schedule(seed)
    assert outcome.converged
    assert outcome.complete
    assert outcome.refused.keys() <= {"own"}  # no datagram of a robot is damaged or in conflict
    one = outcome.replicas[0].components()
    for replica in outcome.replicas[1:]:
        for name, value in vars(one).items():
            assert torch.equal(value, getattr(replica.components(), name)), name


# -- sending ---------------------------------------------------------------------------------------------


def test_the_example_of_the_docs():
    """The example at the top of docs/replica.md."""
    scan = gt.datasets.load("synthetic_building_2d")[0]
    m = gt.GaussianMap(window=1)
    m.insert(scan)
    r = gt.sharing.Replica(robot=0)
    r.add(m)
    other = gt.sharing.Replica(robot=1)
    sent = r.datagrams(max_bytes=1200)
    assert sent
    assert all(len(datagram) <= 1200 for datagram in sent)
    assert all(other.receive(datagram) for datagram in sent)
    assert r.digest() == other.digest()
    assert other.map().n_components == m.n_components
    points = torch.rand(50, 2, dtype=torch.float64) * 4
    assert torch.allclose(other.map().occupancy(points), m.occupancy(points), atol=1e-9)
    assert r.datagrams() == []


def test_all_replicas_hold_the_bits_of_the_sender():
    given_ = random_components(3, k=150)
    one, other = Replica(0), Replica(1)
    ids = one.add(given_)
    exchange([one, other], 1)
    held = other.components()
    order = torch.tensor([held.ids.tolist().index(row) for row in ids.tolist()])
    expected = quantized(given_)
    for name in ("means", "covariances", "support", "max_range"):
        assert torch.equal(getattr(held, name)[order], getattr(expected, name)), name
    assert one.map().n_components == 150


def test_a_changed_map_sends_only_its_changes():
    one, other = Replica(0), Replica(1)
    m = gt.GaussianMap.of(replace(random_components(3, k=60), ids=torch.tensor([[0, n] for n in range(60)])))
    assert len(one.add(m)) == 60
    one.datagrams()
    assert len(one.add(m)) == 0
    assert one.datagrams() == []
    motion = torch.eye(4, dtype=torch.float64)
    motion[0, 3] = 1.0
    moved = m.ids[:5].clone()
    m.transform(motion, moved)
    fresh = m.components().selected(torch.arange(3, 60))  # without the first three
    m = gt.GaussianMap.of(fresh)
    assert len(one.add(m)) == 2
    exchange([one, other])
    assert sorted(map(tuple, quantized(fresh).means.tolist())) == sorted(
        map(tuple, other.components().means.tolist())
    )


def test_superseded_components_stay_until_all_successors_arrive():
    one = Replica(0)
    old = one.add(random_components(3, k=5, seed=1))
    first = one.datagrams()
    one.add(random_components(3, k=4, seed=2), supersedes=old[:2])
    second = one.datagrams()
    supersession = [datagram for datagram in second if datagram[0] == 0x1B]
    successors = [datagram for datagram in second if datagram[0] == 0x11]
    assert len(supersession) == len(successors) == 1
    other = replica_of([*first, *supersession])
    assert other.n_components == 5
    assert other.receive(successors[0])
    assert other.n_components == 7
    assert other.digest() == one.digest()
    assert replica_of([*second, *first]).digest() == one.digest()


def test_counters_are_summed_over_robots_and_not_over_messages():
    robots = [Replica(robot) for robot in range(3)]
    name = tuple(robots[0].add(random_components(3, k=1))[0].tolist())
    exchange(robots)
    support = float(robots[0].components().support)
    for robot in robots[1:]:
        robot.count({name: 256.0})
        robot.count({name: 256.0})
    exchange(robots)
    exchange(robots)
    assert {float(robot.components().support) for robot in robots} == {support + 2 * 512}
    assert float(robots[0].components().seen_count.sum()) == pytest.approx(support + 1024)


def test_counter_records_stay_few():
    one, other = Replica(0), Replica(1)
    ids = [tuple(row) for row in one.add(random_components(3, k=60)).tolist()]
    rng, sizes = random.Random(0), []
    counted = dict.fromkeys(ids, 0.0)
    for second in range(90):
        gains = dict.fromkeys(rng.sample(ids, 3), 2.0 ** (second // 8))
        for name, gain in gains.items():
            counted[name] += gain
        one.count(gains)
        if rng.random() < 0.8:  # the other datagrams are lost
            for datagram in one.datagrams():
                other.receive(datagram)
        sizes.append(len(one.stored()[1]))
    assert max(sizes) < 40
    exchange([one, other])
    assert other.digest() == one.digest()
    own = quantized(random_components(3, k=60)).support
    found = other.components()
    order = torch.tensor([found.ids.tolist().index(list(name)) for name in ids])
    expected = torch.tensor(list(counted.values()), dtype=torch.float64)
    assert torch.allclose(found.support[order] - own, expected, rtol=0.1)


def test_the_last_correction_of_a_scan_counts():
    one, other = Replica(0), Replica(1)
    given_ = random_components(3, k=6)
    ids = one.add(given_)
    turn = torch.tensor([[0.0, -1, 0, 2], [1, 0, 0, 0], [0, 0, 1, -1], [0, 0, 0, 1]], dtype=torch.float64)
    first = torch.eye(4, dtype=torch.float64)
    first[0, 3] = 50.0
    one.correct(7, first, ids[:4])
    late = one.datagrams()
    one.correct(7, turn, ids[:4])
    for datagram in [*one.datagrams(), *late]:
        other.receive(datagram)
    assert one.digest() == other.digest()
    expected = quantized(given_).transformed(turn, torch.arange(6) < 4)
    found = other.components()
    order = torch.tensor([found.ids.tolist().index(row) for row in ids.tolist()])
    assert torch.allclose(found.means[order], expected.means, atol=1e-9)
    assert torch.allclose(found.covariances[order], expected.covariances, atol=1e-12)
    seen = torch.zeros(6, 3, dtype=torch.float64).index_add_(
        0, found.seen_by, found.origins[found.seen_from] * found.seen_count[:, None]
    )
    wanted = torch.zeros(6, 3, dtype=torch.float64).index_add_(
        0, expected.seen_by, expected.origins[expected.seen_from] * expected.seen_count[:, None]
    )
    assert torch.allclose(seen[order], wanted)


def test_supersession_records_stay_few():
    """A map whose components are superseded repeatedly keeps few supersessions."""
    rng, one = random.Random(0), Replica(0, incarnation=1)
    alive = one.add(components(rng, 40))
    sizes = []
    for _ in range(75):
        chosen = torch.randperm(len(alive), generator=torch.Generator().manual_seed(rng.getrandbits(30)))
        new = one.add(components(rng, 2), supersedes=alive[chosen[:2]])
        alive = torch.cat([alive[chosen[2:]], new])
        sizes.append(len(one.stored()[1]))
    assert one.n_components == 40
    assert max(sizes) <= 70
    late = Replica(1)
    exchange([one, late])
    assert late.digest() == one.digest()


# -- restarts --------------------------------------------------------------------------------------------


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


# -- limits and hostile input ----------------------------------------------------------------------------


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


def test_memory_is_bounded():
    full = Replica(1, most_components=10)
    one = Replica(0)
    one.add(random_components(3, k=8))
    for datagram in one.datagrams():
        assert full.receive(datagram)
    one.add(random_components(3, k=8, seed=3))
    assert not any(full.receive(datagram) for datagram in one.datagrams())
    assert full.refused == {"full": 1}
    assert full.n_components == 8


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


def forged(first: bytes, body: bytes) -> bytes:
    """A datagram with a valid checksum and any body."""
    return first + sealed(body) if first == b"\x11" else sealed(first + body)


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
            datagram = bytearray(forged(bytes(datagram[:1]), bytes(body)))
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
