"""SharedMap: robots hold one map, each in its own frame; TokenBucket: what they may send."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
import torch
from exploration.replays import content, log, mapped
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.components import Components
from gmmtorch.team.sharing import Network, Replica, SharedMap
from gmmtorch.team.sharing.radio import TokenBucket
from gmmtorch.team.sharing.transport.simulated_network import LinkConditions


def of_robot(components: Components, robot: int) -> Components:
    return components.selected((components.ids[:, 0] == robot).nonzero()[:, 0])


def exchanged(team: list[SharedMap], begin: float, n_rounds: int = 60) -> None:
    for step in range(n_rounds):
        for shared in team:
            shared.exchange(begin + step / 10)


def test_robots_hold_the_components_of_all_although_datagrams_are_lost():
    network = Network(2, LinkConditions(loss=0.3), seed=1)
    team = [SharedMap(Replica(number), network) for number in range(2)]
    own = [mapped("incremental", log(12)[half]).components() for half in (slice(6), slice(6, 12))]
    for shared, components in zip(team, own, strict=True):
        before = shared.content()
        shared.replica.publish(components, whole=True)
        assert shared.content() != before
    exchanged(team, 0.0, n_rounds=200)
    assert network.reception().lost > 0
    assert team[0].replica.digest() == team[1].replica.digest()
    for shared in team:
        assert content(shared.components()) == content(*own)


def test_the_components_are_in_the_frame_of_the_robot():
    network = Network(2)
    team = [SharedMap(Replica(number, own_frame=True), network) for number in range(2)]
    components = mapped("incremental", log(6)).components()
    for shared in team:
        shared.replica.publish(components, whole=True)
    exchanged(team, 0.0)
    alone = team[1].components()
    assert set(alone.ids[:, 0].tolist()) == {1}  # the frames are unrelated yet
    cos, sin = math.cos(0.7), math.sin(0.7)
    frame = torch.tensor(
        [[cos, -sin, 5.0], [sin, cos, -2.0], [0, 0, 1]], dtype=torch.float64
    )  # robot 0's frame ← robot 1's
    team[1].replica.join(team[1].replica.other_frames[0], frame)
    exchanged(team, 10.0)
    turn, shift = frame[:2, :2], frame[:2, 2]
    expected = [alone.means @ turn.T + shift, (alone.means - shift) @ turn]
    for number, (shared, placed) in enumerate(zip(team, expected, strict=True)):
        found = shared.components()
        assert torch.allclose(of_robot(found, number).means, alone.means, atol=1e-9)
        assert torch.allclose(of_robot(found, 1 - number).means, placed, atol=1e-9)
        assert torch.allclose(
            torch.linalg.eigvalsh(of_robot(found, 1 - number).covariances),
            torch.linalg.eigvalsh(alone.covariances),
            atol=1e-9,
        )


LEAST = 1200
rates = st.integers(1, 5000)
steps = st.lists(st.tuples(st.integers(0, 80), st.integers(0, 4000)), min_size=1, max_size=40)
"""Eighths of a second until the next time, and the bytes wanted then."""


@given(rate=rates, steps=steps)
def test_all_that_the_rate_allows_may_be_sent(rate: int, steps: list[tuple[int, int]]) -> None:
    bucket, tokens, most, now = TokenBucket(rate), Fraction(max(rate, LEAST)), max(rate, LEAST), 0.0
    for eighths, wanted in steps:
        now += eighths / 8
        tokens = min(Fraction(most), tokens + Fraction(rate * eighths, 8))
        assert bucket.available(now) == bucket.available(now) == math.floor(tokens)
        taken = min(wanted, math.floor(tokens))
        bucket.take(taken)
        tokens -= taken


def test_excess_bytes_delay_later_ones() -> None:
    bucket = TokenBucket(1000.0)
    assert bucket.available(5.0) == 1200
    bucket.take(3200)
    assert [bucket.available(t) for t in (5.0, 6.0, 7.0, 7.5, 9.0)] == [0, 0, 0, 500, 1200]


def test_a_clock_that_is_set_back_adds_nothing() -> None:
    bucket = TokenBucket(100.0)
    bucket.take(bucket.available(1e9))
    assert [bucket.available(t) for t in (50.0, 51.0, 51.0, 40.0, 42.0)] == [0, 100, 100, 100, 300]


@pytest.mark.parametrize("rate", [0.0, -5.0, math.inf, math.nan])
def test_invalid_rates_are_rejected(rate: float) -> None:
    with pytest.raises(InvalidArgumentError, match=r"budget=.*above zero"):
        TokenBucket(rate)
