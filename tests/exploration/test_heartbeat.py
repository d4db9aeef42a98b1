"""When announcements are due, by enumeration and against the rule said in other words."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.exploration.robot.heartbeat import Heartbeat

contents = st.lists(st.integers(0, 1), min_size=1, max_size=120)


def beats(heartbeat: Heartbeat, contents: list[int], begin: float = 0.0, step: float = 1.0) -> list[float]:
    """Times at which it was due, asked every `step` seconds."""
    times = [begin + step * n for n in range(len(contents))]
    return [time for time, content in zip(times, contents, strict=True) if heartbeat.due(time, (content, 7))]


def by_rule(period: int, contents: list[int]) -> list[int]:
    """The same of whole seconds: a pause doubles with each announcement in a row that said nothing new."""
    told, last, stale, due = contents[0], 0, 0, []
    for now, content in enumerate(contents):
        pause = period if content != told else period * min(2**stale, 16)
        if now and now - last >= pause:
            stale = stale + 1 if content == told else 0
            told, last = content, now
            due.append(now)
    return due


def test_while_nothing_changes_it_beats_ever_more_seldom() -> None:
    assert beats(Heartbeat(5.0), [3] * 400) == [5, 15, 35, 75, 155, 235, 315, 395]
    assert beats(Heartbeat(0.25), [3] * 40, 1e9, 0.125) == [1e9 + x for x in (0.25, 0.75, 1.75, 3.75)]


def test_while_something_changes_it_keeps_the_period() -> None:
    assert beats(Heartbeat(5.0), list(range(31))) == [5, 10, 15, 20, 25, 30]


def test_a_change_is_told_at_once_after_a_long_pause_and_soon_again() -> None:
    assert beats(Heartbeat(5.0), [3] * 100 + [4] * 51) == [5, 15, 35, 75, 100, 105, 115, 135]


def test_while_something_is_missing_it_does_not_slow_down() -> None:
    heartbeat = Heartbeat(5.0)
    due = [now for now in range(60) if heartbeat.due(float(now), (3,), urgent=now < 22 or now > 40)]
    assert due == [5, 10, 15, 20, 25, 35, 41, 46, 51, 56]


@given(period=st.integers(1, 6), contents=contents)
def test_it_beats_by_the_rule(period: int, contents: list[int]) -> None:
    found = beats(Heartbeat(float(period)), contents)
    assert found == by_rule(period, contents)
    assert all(b - a >= period for a, b in zip([0, *found], found, strict=False))


@given(contents=contents, cut=st.integers(0, 120))
def test_restored_it_goes_on_alike(contents: list[int], cut: int) -> None:
    whole, first, second = (Heartbeat(3.0) for _ in range(3))
    expected = beats(whole, contents)
    before = beats(first, contents[:cut])
    second.restore(json.loads(json.dumps(first.state())))
    assert before + beats(second, contents[cut:], float(len(contents[:cut]))) == expected
    assert second.state() == whole.state()


def test_a_clock_that_was_set_back_starts_the_first_period() -> None:
    heartbeat = Heartbeat(5.0)
    assert beats(heartbeat, [3] * 100, 1e6) == [1e6 + x for x in (5, 15, 35, 75)]
    assert beats(heartbeat, [3] * 40, -20.0) == [-15.0, -5.0, 15.0]


@pytest.mark.parametrize("period", [0.0, -1.0, math.inf, math.nan])
def test_periods_that_make_no_sense(period: float) -> None:
    with pytest.raises(InvalidArgumentError, match=r"announce_every=.*above zero"):
        Heartbeat(period)
