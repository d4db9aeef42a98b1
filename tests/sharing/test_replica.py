"""Replica: whatever comes, in whatever order and however often, all end up with the same map."""

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

N_SCHEDULES = int(os.environ.get("GMMTORCH_SCHEDULES", "8"))
"""`scripts/soak.sh` runs more."""
seeds = st.integers(0, 10**6)


def exchange(replicas: list[Replica], rounds: int = 6) -> None:
    """All hear all that the others say."""
    for _ in range(rounds):
        for sender in replicas:
            for datagram in [*sender.announcements(), *sender.datagrams()]:
                for receiver in replicas:
                    if receiver is not sender:
                        receiver.receive(datagram)


def history(seed: int, n_acts: int = 14) -> list[bytes]:
    """All that three robots have said that heard one another now and then."""
    rng = random.Random(seed)
    robots = [Replica(robot, incarnation=rng.getrandbits(24)) for robot in range(3)]
    said: list[bytes] = []
    for _ in range(n_acts):
        robot = rng.choice(robots)
        act(rng, robot)
        new = robot.datagrams()
        said += new
        for other in robots:
            if other is not robot and rng.random() < 0.7:
                for datagram in new:
                    other.receive(datagram)
    return said


def everything(replica: Replica) -> list[bytes]:
    """All that a replica tells somebody who holds nothing."""
    for _ in range(4):  # nothing is on its way any more
        replica.datagrams()
    for datagram in [*Replica(1000).announcements(), *Replica(1000).announcements()]:
        replica.receive(datagram)
    return replica.datagrams()


def told(datagrams: list[bytes], robot: int = 9) -> Replica:
    replica = Replica(robot)
    for datagram in datagrams:
        assert replica.receive(datagram)
    return replica


# -- merging -----------------------------------------------------------------------------------------------


@settings(max_examples=6, deadline=None)
@given(seed=seeds, order=st.randoms(use_true_random=False))
def test_order_and_repetition_do_not_matter(seed, order):
    said = history(seed)
    again = [*said, *order.sample(said, len(said) // 2)]
    order.shuffle(again)
    one, other = told(said), told(again)
    assert one.digest() == other.digest()
    for name, value in vars(one.components()).items():
        assert torch.equal(value, getattr(other.components(), name)), name


@settings(max_examples=3, deadline=None)
@given(seed=seeds, order=st.randoms(use_true_random=False))
def test_grouping_does_not_matter(seed, order):
    """Three that each heard a part, and tell one another, hold what one holds that heard all."""
    said = history(seed)
    parts: list[list[bytes]] = [[], [], []]
    for datagram in said:
        order.choice(parts).append(datagram)
    robots = [told(part, robot=9 + number) for number, part in enumerate(parts)]
    order.shuffle(robots)
    exchange(robots)
    assert {robot.digest() for robot in robots} == {told(said).digest()}


@settings(max_examples=8, deadline=None)
@given(seed=seeds, order=st.randoms(use_true_random=False))
def test_any_part_of_a_history_says_what_plain_dictionaries_say(seed, order):
    said = [datagram for datagram in history(seed) if order.random() < 0.8]
    order.shuffle(said)
    replica, model = told(said), Model()
    for datagram in said:
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
def test_all_agree_once_the_network_heals(seed):
    outcome = run_schedule(seed)
    assert outcome.converged
    assert outcome.complete
    assert outcome.refused.keys() <= {"own"}  # nothing that robots say is damaged, or in conflict
    one = outcome.replicas[0].components()
    for replica in outcome.replicas[1:]:
        for name, value in vars(one).items():
            assert torch.equal(value, getattr(replica.components(), name)), name


def test_schedules_have_trouble_in_them():
    outcomes = [run_schedule(seed, n_steps=25) for seed in (3, 4)]
    assert sum(outcome.crashes for outcome in outcomes) > 0
    assert sum(outcome.rounds for outcome in outcomes) > 0


# -- what a robot says -------------------------------------------------------------------------------------


def test_the_contract():
    """The first lines of docs/replica.md: say, hear, and hold the same map."""
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


def test_all_robots_hold_the_bits_that_the_sender_holds():
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


def test_a_map_that_changes_says_only_what_has_changed():
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
    fresh = m.components().selected(torch.arange(3, 60))  # three are gone
    m = gt.GaussianMap.of(fresh)
    assert len(one.add(m)) == 2
    exchange([one, other])
    assert sorted(map(tuple, quantized(fresh).means.tolist())) == sorted(
        map(tuple, other.components().means.tolist())
    )


def test_old_components_count_until_all_of_their_successors_have_come():
    one = Replica(0)
    old = one.add(random_components(3, k=5, seed=1))
    first = one.datagrams()
    one.add(random_components(3, k=4, seed=2), supersedes=old[:2])
    second = one.datagrams()
    supersession = [datagram for datagram in second if datagram[0] == 0x1B]
    successors = [datagram for datagram in second if datagram[0] == 0x11]
    assert len(supersession) == len(successors) == 1
    other = told([*first, *supersession])
    assert other.n_components == 5
    assert other.receive(successors[0])
    assert other.n_components == 7
    assert other.digest() == one.digest()
    assert told([*second, *first]).digest() == one.digest()  # what is dead on arrival stays so


def test_counts_are_summed_over_robots_and_not_over_messages():
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


def test_counts_outlive_their_being_written_again():
    """Totals are written anew now and then, and what was out of date is superseded."""
    one, other = Replica(0), Replica(1)
    ids = [tuple(row) for row in one.add(random_components(3, k=40)).tolist()]
    for exponent in range(12):
        one.count(dict.fromkeys(ids, 2.0**exponent))
    before = quantized(random_components(3, k=40)).support.sort().values
    exchange([one, other])
    gained = other.components().support.sort().values - before
    assert other.digest() == one.digest()
    assert torch.allclose(gained, torch.full_like(gained, 2.0**12), rtol=0.1)
    assert len(one.stored()[1]) < 12


def test_records_of_counts_stay_few_however_often_one_counts():
    one, other = Replica(0), Replica(1)
    ids = [tuple(row) for row in one.add(random_components(3, k=150)).tolist()]
    rng, sizes = random.Random(0), []
    counted = dict.fromkeys(ids, 0.0)
    for second in range(250):
        gains = dict.fromkeys(rng.sample(ids, 3), 2.0 ** (second // 20))
        for name, gain in gains.items():
            counted[name] += gain
        one.count(gains)
        if rng.random() < 0.8:  # the rest is lost
            for datagram in one.datagrams():
                other.receive(datagram)
        sizes.append(len(one.stored()[1]))
    assert max(sizes) < 40
    exchange([one, other])
    assert other.digest() == one.digest()
    own = quantized(random_components(3, k=150)).support
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


def test_what_is_superseded_takes_bounded_room():
    """A map that is merged again and again: the records that say so do not pile up."""
    rng, one = random.Random(0), Replica(0, incarnation=1)
    alive = one.add(components(rng, 40))
    sizes = []
    for _ in range(150):
        chosen = torch.randperm(len(alive), generator=torch.Generator().manual_seed(rng.getrandbits(30)))
        new = one.add(components(rng, 2), supersedes=alive[chosen[:2]])
        alive = torch.cat([alive[chosen[2:]], new])
        sizes.append(len(one.stored()[1]))
    assert one.n_components == 40
    assert max(sizes) <= 70
    late = Replica(1)
    exchange([one, late])
    assert late.digest() == one.digest()


# -- lives -------------------------------------------------------------------------------------------------


def test_a_robot_that_lost_its_disk_gets_back_what_it_had_said_and_gives_no_name_twice():
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
    reborn.add(random_components(3, k=0), supersedes=torch.tensor(sorted(before)))  # still its own
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


def test_two_robots_of_one_number_are_found_out():
    one, twin, other = Replica(0), Replica(0), Replica(1)
    one.add(random_components(3, k=3, seed=1))
    twin.add(random_components(3, k=3, seed=2))
    exchange([one, twin, other])
    assert one.duplicates[0] > 0
    assert twin.duplicates[0] > 0
    assert not other.duplicates


def test_one_name_with_two_contents_is_refused_by_all():
    """Where somebody gave two robots the same number and the same incarnation."""
    one, twin = Replica(4, incarnation=7), Replica(4, incarnation=7)
    one.add(random_components(3, k=3, seed=1))
    twin.add(random_components(3, k=3, seed=2))
    other = told(one.datagrams())
    digest = other.digest()
    assert not any(other.receive(datagram) for datagram in twin.datagrams())
    assert other.duplicates == {4: 1}
    assert other.refused == {"duplicate_id": 1}
    assert other.digest() == digest
    more = Replica(4, incarnation=7)
    more.add(random_components(3, k=9, seed=1))  # numbers that `one` has not given yet
    assert not any(one.receive(datagram) for datagram in more.datagrams())
    assert one.duplicates[4] == 1


# -- limits and hostile input ------------------------------------------------------------------------------


def test_under_a_budget_the_most_informative_go_first():
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
    assert told(everything(one)).digest() == one.digest()


@pytest.mark.parametrize("max_bytes", [1000, 1100, 1200])
def test_what_is_new_fits_whatever_is_asked_for(max_bytes):
    """Also where it had been written for longer datagrams."""
    one = Replica(0)
    for seed in range(2):
        ids = one.add(random_components(3, k=400, seed=seed))
        datagrams = one.datagrams(max_bytes=max_bytes)
        sizes = [len(datagram) for datagram in datagrams]
        assert max(sizes) <= max_bytes
        sent = [row for datagram in datagrams for row in decode(datagram).components.ids.tolist()]
        assert sorted(sent) == sorted(ids.tolist())
    assert sum(sizes[:-1]) > 0.85 * max_bytes * (len(sizes) - 1)  # it knows by now what is asked for


def test_what_is_decoded_already_need_not_be_again():
    one, two, three = Replica(0), Replica(1), Replica(2)
    one.add(random_components(3, k=20))
    one.count({(0, 1): 3.0})
    for datagram in [*one.datagrams(), *one.announcements()]:
        assert two.receive(datagram, decode(datagram)) == three.receive(datagram)
    assert two.digest() == three.digest() == one.digest()
    floats = encode_components(random_components(3, k=3, robot=7), "float")[0]
    assert not two.receive(floats, decode(floats))  # not as all would hold them
    assert not two.receive(floats, "nonsense")
    assert not two.receive(None, decode(floats))
    assert two.refused == {"other": 2, "damaged": 1}


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


def test_other_dimensions_kinds_and_crowds_of_sightings_are_refused():
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


def test_a_component_of_the_most_sightings_can_be_passed_on():
    made = random_components(
        3, k=1, n_origins=MOST_VIEWPOINTS, max_sightings=1, extent=1e6, deviations=(1e-6, 1e5)
    )
    made = replace(
        made,
        seen_by=torch.zeros(MOST_VIEWPOINTS, dtype=torch.int64),
        seen_from=torch.arange(MOST_VIEWPOINTS),
        seen_count=torch.logspace(0, 3, MOST_VIEWPOINTS, dtype=torch.float64),
    )
    one = Replica(1023, incarnation=(1 << 24) - 1)
    one.add(made)
    assert all(len(datagram) <= 1000 for datagram in one.datagrams(max_bytes=1000))


@pytest.fixture(scope="module")
def sound() -> list[bytes]:
    said = history(5, 30)
    return [*said, *told(said).announcements()]


def test_hostile_bytes_never_raise(sound):
    rng = random.Random(0)
    assert {datagram[0] for datagram in sound} >= {0x11, 0x1A, 0x1B, 0x1C, 0x1D}
    replica = told(sound[:5])
    for trial in range(1500):
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
    assert replica.refused["damaged"] > 500
    components_ = replica.components()
    assert bool(torch.isfinite(components_.means).all())
    for datagram in replica.datagrams():  # whatever it took in, it can pass on
        assert len(datagram) <= MAX_BYTES
    for not_bytes in (None, "text", 3, bytearray(b"\x11"), []):
        assert not replica.receive(not_bytes)
    assert len(replica.digest()) == 16
    assert Replica(9).load(*replica.stored()) == 0


def forged(first: bytes, body: bytes) -> bytes:
    """A datagram with a checksum that is right, whatever is in it."""
    return first + sealed(body) if first == b"\x11" else sealed(first + body)


@settings(max_examples=100, deadline=None)
@given(data=st.binary(max_size=1300))
def test_noise_never_raises(data):
    assert not Replica(0).receive(data)


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
def test_bad_arguments_say_what_is_wrong(what, wrong):
    with pytest.raises(InvalidArgumentError, match=what):
        wrong()


@pytest.mark.parametrize("n", [1, 127, 128, 129, 168, 200, 300, 500])
@pytest.mark.parametrize("max_bytes", [1000, MAX_BYTES])
def test_each_component_is_said_once(n: int, max_bytes: int) -> None:
    # Small ones, of which more fit into a datagram than are tried at first.
    one, other = Replica(0, dim=3), Replica(1, dim=3)
    one.add(frame_of_components(n))
    datagrams = one.datagrams(max_bytes)
    assert all(len(datagram) <= max_bytes for datagram in datagrams)
    said = [tuple(name) for datagram in datagrams for name in decode(datagram).components.ids.tolist()]
    assert len(said) == len(set(said)) == n
    assert all(other.receive(datagram) for datagram in datagrams)
    assert other.digest() == one.digest()
