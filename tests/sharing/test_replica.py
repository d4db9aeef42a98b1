"""Replica: the order, repetition and loss of datagrams do not change the final map."""

from __future__ import annotations

import os
import random
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.map_cases import assert_same_components
from mapping.random_components import random_components
from sharing.replica_histories import Model, exchange, history, motion, replica_of, rows, told_twice
from sharing.schedules import components, run_schedule

import gmmtorch as gt
from gmmtorch.mapping.codec.quantization import quantized
from gmmtorch.team.sharing.replica.replica import Replica

N_SCHEDULES = int(os.environ.get("GMMTORCH_SCHEDULES", "4"))
"""`scripts/soak.sh` runs more."""


seeds = st.integers(0, 10**6)


# -- merging ---------------------------------------------------------------------------------------


@settings(max_examples=6, deadline=None)
@given(seed=seeds, order=st.randoms(use_true_random=False))
def test_order_and_repetition_do_not_matter(seed, order):
    one, other = told_twice(history(seed), order)
    assert_same_components(one.components(), other.components())


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
        assert_same_components(one, replica.components())


# -- sending ---------------------------------------------------------------------------------------


def test_a_changed_map_sends_only_its_changes():
    one, other = Replica(0), Replica(1)
    m = gt.GaussianMap.of(replace(random_components(3, k=60), ids=torch.tensor([[0, n] for n in range(60)])))
    assert len(one.add(m)) == 60
    one.datagrams()
    assert len(one.add(m)) == 0
    assert one.datagrams() == []
    m.transform(motion(1.0), m.ids[:5].clone())
    fresh = m.components().selected(torch.arange(3, 60))  # without the first three
    m = gt.GaussianMap.of(fresh)
    assert len(one.add(m)) == 2
    exchange([one, other])
    assert sorted(map(tuple, quantized(fresh).means.tolist())) == sorted(
        map(tuple, other.components().means.tolist())
    )


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


def test_only_short_records_of_counters_are_merged():
    one, other, rng = Replica(0), Replica(1), random.Random(0)
    ids = [tuple(row) for row in one.add(random_components(3, k=900)).tolist()]
    for _ in range(20):
        one.count({name: 2.0 ** rng.randint(3, 12) for name in rng.sample(ids[20:], 40)})
    long = one.stored()[1]
    assert len(long) == 20
    assert min(map(len, long)) >= 64
    for name in ids[:20]:
        one.count({name: 9.0})
    found = one.stored()[1]
    assert [datagram for datagram in found if datagram in long] == long
    assert 2 <= len(found) - len(long) <= 18
    exchange([one, other])
    assert other.digest() == one.digest()


def test_the_last_correction_of_a_scan_counts():
    one, other = Replica(0), Replica(1)
    given_ = random_components(3, k=6)
    ids = one.add(given_)
    turn = torch.tensor([[0.0, -1, 0, 2], [1, 0, 0, 0], [0, 0, 1, -1], [0, 0, 0, 1]], dtype=torch.float64)
    one.correct(7, motion(50.0), ids[:4])
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
