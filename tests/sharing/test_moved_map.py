"""Replica.publish of a map that corrected poses have moved: few records, and the moved map at all robots."""

from __future__ import annotations

import math
import random

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sharing.replica_histories import exchange
from sharing.schedules import components
from torch import Tensor

from gmmtorch.mapping.components import Components
from gmmtorch.team.sharing.messages.record_messages import CorrectionMessage
from gmmtorch.team.sharing.replica import moved_map
from gmmtorch.team.sharing.replica.moved_map import MovedMap
from gmmtorch.team.sharing.replica.replica import Replica

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
    monkeypatch.setattr(moved_map, "_MOST_RUNS", most)
    robot = Robot(random.Random(1), Replica(0))
    robot.publish()
    n_held = robot.replica.held.size
    robot.motions = [motion(1.0, 0.3), STILL, motion(-2.0, -0.1)]
    robot.publish()
    assert robot.replica.held.size > n_held + 2
    assert all(len(record.moved) <= most for record in robot.corrections())
    assert_equal(robot.replica.components(), robot.map())
