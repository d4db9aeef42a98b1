"""StoppingCriterion, against its rule evaluated over all notes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.exploration.robot.robot_state import StoppingCriterion, StoppingRule

GAINS = st.lists(st.floats(0, 100), min_size=1, max_size=60)


def first_rest_by_definition(gains: list[float], every: float, rule: StoppingRule) -> int | None:
    """The first note after which a robot without news rests."""
    times = [i * every for i in range(len(gains))]
    learned = [sum(gains[: i + 1]) for i in range(len(gains))]
    best = 0.0
    for i, now in enumerate(times):
        before = [j for j in range(i + 1) if times[j] <= now - rule.window]
        if before:
            gained = learned[i] - learned[max(before)]
            best = max(best, gained)
            if gained < rule.share * best:
                return i
    return None


@given(gains=GAINS, every=st.sampled_from([1.0, 2.0, 7.0]), share=st.sampled_from([0.0, 0.1, 0.6, 0.9]))
def test_a_robot_rests_when_the_rule_says_so(gains, every, share):
    rule = StoppingRule(share, window=10.0)
    returns, learned = StoppingCriterion(rule), 0.0
    expected = first_rest_by_definition(gains, every, rule)
    for i, gain in enumerate(gains):
        learned += gain
        returns.note(i * every, learned, known=learned)
        assert returns.rests == (expected is not None and i >= expected)
        if returns.rests:
            learned -= gain  # at rest it learns nothing, and so is not woken
            break


@given(
    gains=st.lists(st.tuples(st.integers(0, 100), st.booleans()), min_size=1, max_size=60),
    share=st.sampled_from([0.1, 0.9]),
)
def test_time_boxed_in_does_not_count(gains, share):
    rule = StoppingRule(share, window=10.0)
    returns, learned = StoppingCriterion(rule), 0.0
    told: list[float] = []  # of the notes that count
    since = 0.0
    for i, (gain, boxed_in) in enumerate(gains):
        boxed_in &= i > 0  # before the first note there was nothing
        learned, since = learned + gain, since + gain
        returns.note(100.0 + 2.0 * i, learned, known=0.0, boxed_in=boxed_in)
        if not boxed_in:
            told.append(since)
            since = 0.0
        assert returns.rests == (first_rest_by_definition(told, 2.0, rule) is not None)
        if returns.rests:
            break


def test_a_robot_that_stays_boxed_in_never_rests():
    returns = StoppingCriterion(StoppingRule(0.9, window=10.0))
    for now in (0, 5, 9):
        returns.note(now, 100.0 * now, 0.0)
    for now in range(10, 2000):
        returns.note(now, 900.0, 0.0, boxed_in=True)
        assert not returns.rests
    returns.note(2001, 900.0, 0.0)
    assert not returns.rests  # of all that time 11 s count, in which it learned much
    for now in (2004, 2012):
        returns.note(now, 900.0, 0.0)
    assert returns.rests


def resting() -> StoppingCriterion:
    """At rest at 30 s, having learned 100 bits in its best 10 s, with 150 known."""
    returns = StoppingCriterion(StoppingRule(0.05, window=10.0))
    for now, learned in ((0, 0), (10, 100), (20, 110), (30, 110)):
        assert not returns.rests
        returns.note(now, learned, 40.0 + learned)
    assert returns.rests
    return returns


def test_news_wake_a_resting_robot_for_at_least_a_window():
    returns = resting()
    returns.note(32, 110, 170.0)
    assert returns.rests
    returns.note(34, 110, 175.0)
    assert not returns.rests
    for now in (36, 40, 45):
        returns.note(now, 110, 175.0)
        assert not returns.rests
    returns.note(46, 110, 175.0)
    assert returns.rests


def test_a_zero_share_never_rests():
    returns = StoppingCriterion(StoppingRule(0.0, window=4.0))
    for now in range(50):
        returns.note(now, 0.0, 0.0)
    assert not returns.rests


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"share": -0.1}, "planner.rest=-0.1"),
        ({"share": 1.0}, "planner.rest=1.0"),
        ({"share": float("nan")}, "planner.rest=nan"),
        ({"window": 0.0}, "window=0.0"),
        ({"window": float("inf")}, "window=inf"),
    ],
)
def test_invalid_stopping_rules_are_rejected(options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        StoppingRule(**options)
