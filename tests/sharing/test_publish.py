"""Replica.publish: the records of a robot equal its map, also after changes, restarts and corrected poses."""

from __future__ import annotations

import math
import random

import pytest
import torch
from exploration.replays import content
from hypothesis import given, settings
from hypothesis import strategies as st
from sharing.replica_histories import everything, exchange
from sharing.schedules import components
from torch import Tensor

from gmmtorch.mapping.components import Components
from gmmtorch.team.sharing import MovedMap, Replica
from gmmtorch.team.sharing.messages.record_messages import CorrectionMessage
from gmmtorch.team.sharing.replica import authorship


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


N_SCANS = 3
STILL = torch.eye(4, dtype=torch.float64)


def motion(x: float, yaw: float) -> Tensor:
    cos, sin = math.cos(yaw), math.sin(yaw)
    rows = [[cos, -sin, 0, x], [sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    return torch.tensor(rows, dtype=torch.float64)


class Robot:
    """A robot with a map of the components of three scans."""

    def __init__(self, rng: random.Random, replica: Replica) -> None:
        self.rng, self.replica = rng, replica
        self.before = components(rng, 12)
        self.scans = torch.arange(12) % N_SCANS
        self.motions = [STILL] * N_SCANS

    def map(self) -> Components:
        found = self.before
        for scan, step in enumerate(self.motions):
            found = found.transformed(step, self.scans == scan)
        return found

    def grow(self, n: int) -> None:
        """Some components go, and n come, of any scan, where the scan is now."""
        kept = torch.tensor([row for row in range(len(self.before)) if self.rng.random() < 0.9])
        self.before = Components.concatenate([self.before.selected(kept.long()), components(self.rng, n)])
        new = torch.tensor([self.rng.randrange(N_SCANS) for _ in range(n)], dtype=torch.int64)
        self.scans = torch.cat([self.scans[kept.long()], new])

    def publish(self) -> None:
        self.replica.publish(self.map(), whole=True, moved=MovedMap(self.before, self.scans, self.motions))

    def corrections(self) -> list[CorrectionMessage]:
        return self.replica._records.of(CorrectionMessage)


def assert_equal(found: Components, expected: Components) -> None:
    """Equal up to the rounding of the codec, by which a mean moves by an eighth of a deviation on an axis."""
    assert len(found) == len(expected)
    if not len(expected):
        return
    gap = torch.cdist(found.means, expected.means)
    near = gap.argmin(0)
    assert near.unique().numel() == len(expected)
    size = expected.covariances.diagonal(dim1=1, dim2=2).sum(1).sqrt()
    assert bool((gap.amin(0) < 0.3 * size + 1e-6).all())
    seen = [c.origins[c.seen_from[c.seen_by == 0]].mean(0) for c in (found.rearranged(near), expected)]
    assert torch.allclose(*seen, atol=0.02)


def test_a_moved_scan_is_one_record_and_no_component_is_sent_again():
    robot, teammate = Robot(random.Random(0), Replica(0)), Replica(1)
    robot.publish()
    exchange([robot.replica, teammate])
    n_held = robot.replica.held.size
    robot.motions = [motion(1.0, 0.3), STILL, motion(-2.0, -0.1)]
    robot.publish()
    assert [record.scan for record in robot.corrections()] == [0, 2]
    assert robot.replica.held.size == n_held + 2
    robot.publish()
    assert robot.replica.held.size == n_held + 2
    sent = robot.replica.datagrams()
    assert sum(map(len, sent)) < 250
    assert all(teammate.receive(datagram) for datagram in sent)
    assert teammate.digest() == robot.replica.digest()
    assert_equal(teammate.components(), robot.map())


@settings(max_examples=6)
@given(seed=st.integers(0, 10**6))
def test_any_order_of_changes_corrections_and_restarts_gives_the_moved_map(seed):
    rng, teammate = random.Random(seed), Replica(1)
    robot = Robot(rng, Replica(0))
    checkpoint = robot.before, robot.scans, robot.motions
    for _ in range(8):
        kind = rng.choice(["grow", "move", "move", "restart", "checkpoint"])
        if kind == "grow":
            robot.grow(rng.randint(0, 6))
        elif kind == "move":
            scan = rng.randrange(N_SCANS)
            moved = motion(rng.uniform(-3, 3), rng.uniform(-1, 1))
            robot.motions = [moved if i == scan else one for i, one in enumerate(robot.motions)]
        elif kind == "restart":
            stored = robot.replica.stored()
            robot.replica = Replica(0)
            assert robot.replica.load(*stored) == 0
            robot.before, robot.scans, robot.motions = checkpoint
        else:
            checkpoint = robot.before, robot.scans, robot.motions
        robot.publish()
        for datagram in robot.replica.datagrams():
            if rng.random() < 0.7:
                teammate.receive(datagram)
        assert_equal(robot.replica.components(), robot.map())
    exchange([robot.replica, teammate])
    assert teammate.digest() == robot.replica.digest()
    assert_equal(teammate.components(), robot.map())


@pytest.mark.parametrize("most", [1, 2])
def test_components_of_too_many_intervals_are_sent_again(monkeypatch, most):
    monkeypatch.setattr(authorship, "_MOST_RUNS", most)
    robot = Robot(random.Random(1), Replica(0))
    robot.publish()
    n_held = robot.replica.held.size
    robot.motions = [motion(1.0, 0.3), STILL, motion(-2.0, -0.1)]
    robot.publish()
    assert robot.replica.held.size > n_held + 2
    assert all(len(record.moved) <= most for record in robot.corrections())
    assert_equal(robot.replica.components(), robot.map())
