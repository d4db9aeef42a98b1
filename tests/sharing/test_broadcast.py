"""Broadcast, against plain dictionaries of the decoded messages."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.random_components import random_components
from sharing.message_examples import codecs, frame_of_components
from sharing.replica_histories import Follower, rows, told

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mapping.components import Components
from gmmtorch.team.sharing import Broadcast, decode
from gmmtorch.team.sharing.messages.component_messages import (
    ComponentsMessage,
    CountsMessage,
    encode_components,
    encode_counts,
)
from gmmtorch.team.sharing.messages.record_messages import encode_announcements
from gmmtorch.team.sharing.replica.record_keys import Intervals

seeds = st.integers(0, 10**6)


class Model:
    """The expected map: the first component of each id, and the sum of the counts that arrive after it."""

    def __init__(self) -> None:
        self.shapes: dict[int, tuple] = {}
        self.support: dict[int, float] = {}

    def receive(self, datagram: bytes) -> None:
        message = decode(datagram)
        if isinstance(message, ComponentsMessage):
            for key, (mean, covariance, support, flag, seen) in rows(message.components).items():
                if key not in self.shapes:
                    self.shapes[key] = (mean, covariance, flag, tuple(origin for origin, _ in seen))
                    self.support[key] = support
        elif isinstance(message, CountsMessage):
            for (robot, number), count in message.counts.items():
                if robot << 52 | number in self.support:
                    self.support[robot << 52 | number] += count

    def agrees(self, broadcast: Broadcast) -> bool:
        held = broadcast.components()
        found = rows(held.checked()) if len(held) else {}
        shapes = {
            key: (mean, covariance, flag, tuple(origin for origin, _ in seen))
            for key, (mean, covariance, _, flag, seen) in found.items()
        }
        counts = {key: sum(count for _, count in row[4]) for key, row in found.items()}
        return shapes == self.shapes and (
            {key: row[2] for key, row in found.items()} == pytest.approx(self.support, rel=1e-9)
            and counts == pytest.approx(self.support, rel=1e-9)
        )


def history(seed: int, codec: str, n_acts: int = 8) -> list[bytes]:
    """All datagrams of three robots that receive some of each other's."""

    def act(rng: random.Random, robot: Broadcast) -> None:
        held = robot.components()
        if len(held) == 0 or rng.random() < 0.5:
            robot.add(frame_of_components(rng.randint(1, 30), seed=rng.getrandbits(20)))
        else:
            chosen = rng.sample(held.ids.tolist(), rng.randint(1, min(4, len(held))))
            robot.count({(key[0], key[1]): rng.uniform(0.0, 500.0) for key in chosen})

    return told(random.Random(seed), [Broadcast(robot, codec) for robot in range(3)], n_acts, act)


@codecs
@settings(max_examples=3, deadline=None)
@given(seed=seeds, order=st.randoms(use_true_random=False))
def test_messages_in_any_order_equal_a_plain_model(codec: str, seed: int, order: random.Random) -> None:
    said = [datagram for datagram in history(seed, codec) if order.random() < 0.85]
    said += order.sample(said, len(said) // 2)  # some arrive twice
    order.shuffle(said)
    one, model = Broadcast(9, codec), Model()
    for datagram in said:
        assert one.receive(datagram, decode(datagram) if order.random() < 0.5 else None)
        model.receive(datagram)
    assert model.agrees(one)
    assert not one.refused


@codecs
@settings(max_examples=2, deadline=None)
@given(seed=seeds, order=st.randoms(use_true_random=False))
def test_changes_of_a_broadcast_are_its_map(codec: str, seed: int, order: random.Random) -> None:
    said = history(seed, codec)
    order.shuffle(said)
    one, follower = Broadcast(9, codec), Follower()
    for datagram in said:
        before = one.version
        one.receive(datagram)
        if order.random() < 0.4:
            follower.follow(one)
            assert follower.agrees(one)
            again = one.changes()
            assert again.added == [] == again.gained.ids.tolist()
        assert one.version >= before
    follower.follow(one)
    assert follower.agrees(one)
    assert not follower.rebuilt


@codecs
def test_the_sender_holds_the_decoded_components(codec: str) -> None:
    one, model = Broadcast(3, codec), Model()
    ids = [one.add(frame_of_components(40, seed=seed)) for seed in range(3)]
    one.count({(3, 0): 5.0, (3, 119): 7.0, (3, 120): 9.0, (2, 0): 1.0})  # the last two ids are unknown
    for datagram in one.datagrams():
        model.receive(datagram)
    assert torch.cat(ids).tolist() == [[3, number] for number in range(120)] == one.components().ids.tolist()
    assert model.agrees(one)
    assert one.datagrams() == one.announcements() == []
    assert one.held == Intervals.empty()
    assert one.digest() == b""


def test_datagrams_beyond_the_budget_are_sent_later() -> None:
    one, other = Broadcast(0, "float"), Broadcast(0, "float")
    for each in (one, other):
        each.add(frame_of_components(40))
        each.count({(0, 3): 5.0})
    due, got = one.datagrams(), []
    assert len(due) > 4
    assert other.datagrams(budget=0) == other.datagrams(budget=len(due[0]) - 1) == []
    for budget in (len(due[0]), len(due[1]) + len(due[2]) + 3, 10**9):
        sent = other.datagrams(budget=budget)
        assert 0 < sum(map(len, sent)) <= budget
        got += sent
    assert got == due


# -- refused messages ------------------------------------------------------------------------------------


def test_unfit_messages_are_refused_and_counted() -> None:
    one = Broadcast(0, "float")
    flat = replace(random_components(2, k=3, n_origins=1, max_sightings=1, robot=1))
    gaps = frame_of_components(4, robot=1)
    gaps = replace(gaps, ids=gaps.ids * 2)
    mixed = frame_of_components(2, robot=1)
    mixed = replace(mixed, ids=torch.tensor([[1, 0], [2, 1]]))
    for bad in (flat, gaps, mixed):
        for datagram in encode_components(bad, "float"):
            assert not one.receive(datagram)
    for datagram in encode_announcements(1, 0, Intervals.span(0, 5)):
        assert not one.receive(datagram)
    assert one.refused == {"unfit": 3, "other": 1}
    assert len(one.components()) == 0
    assert one.version == 0


@pytest.mark.parametrize(("name", "most"), [("MOST_ROWS", 12), ("MOST_BATCHES", 3)])
def test_a_full_broadcast_refuses_others_and_sends_its_own(
    name: str, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"gmmtorch.team.sharing.broadcast.{name}", most)
    one = Broadcast(0, "float")
    batches = [shifted(frame_of_components(5, robot=1), first) for first in (0, 5, 10, 15)]
    (counted,) = encode_counts(1, {(1, 0): 2.0, (1, 1): 2.0}, "float")
    told = [*(encode_components(batch, "float")[0] for batch in batches[:2]), counted]
    assert all(one.receive(datagram) for datagram in told)
    support = float(one.components().support.sum())
    for datagram in [*(encode_components(batch, "float")[0] for batch in batches[2:]), counted]:
        assert not one.receive(datagram)
    assert one.refused == {"full": 3}
    assert len(one.components()) == 10
    assert float(one.components().support.sum()) == support
    one.add(frame_of_components(4))
    assert one.datagrams()
    assert len(one.components()) == 14


@pytest.mark.parametrize(("first", "size"), [(0, 12), (4, 2), (3, 9), (0, 6), (5, 5), (9, 20)])
def test_overlapping_batches_are_ignored(first: int, size: int) -> None:
    one = Broadcast(0, "float")
    (datagram,) = encode_components(shifted(frame_of_components(5, robot=1), 5), "float")
    one.receive(datagram)
    for datagram in encode_components(shifted(frame_of_components(size, robot=1, seed=4), first), "float")[
        :1
    ]:
        one.receive(datagram)
    assert one.components().ids.tolist() == [[1, number] for number in range(5, 10)]


def shifted(components: Components, first: int) -> Components:
    return replace(components, ids=components.ids + torch.tensor([0, first]))


def test_damaged_messages_and_invalid_arguments_are_errors() -> None:
    one = Broadcast(0)
    with pytest.raises(DataError):
        one.receive(b"\x11nonsense")
    with pytest.raises(InvalidArgumentError, match="codec"):
        Broadcast(0, "zip")
    with pytest.raises(InvalidArgumentError, match="robot"):
        Broadcast(-1)
    assert one.datagrams() == []
    assert len(one.components()) == 0
    assert one.changes().added == []
