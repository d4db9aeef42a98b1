"""TokenBucket: what may be sent, against exact fractions and over every span of time."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.sharing.transport.token_bucket import TokenBucket

LEAST = 1200
rates = st.integers(1, 5000)
steps = st.lists(st.tuples(st.integers(0, 80), st.integers(0, 4000)), min_size=1, max_size=40)
"""Eighths of a second to the next time, and how many bytes are wanted there."""


def spent(bucket: TokenBucket, steps: list[tuple[int, int]]) -> list[tuple[float, int]]:
    """(time, bytes) of who takes what it wants, as far as it may."""
    now, found = 0.0, []
    for eighths, wanted in steps:
        now += eighths / 8
        found.append((now, min(wanted, bucket.available(now))))
        bucket.take(found[-1][1])
    return found


@given(rate=rates, steps=steps)
def test_no_span_has_more_than_the_rate_and_a_burst(rate: int, steps: list[tuple[int, int]]) -> None:
    taken = spent(TokenBucket(rate), steps)
    for i, j in itertools.combinations_with_replacement(range(len(taken)), 2):
        span = taken[j][0] - taken[i][0]
        assert sum(n for _, n in taken[i : j + 1]) <= rate * span + max(rate, LEAST)


@given(rate=rates, steps=steps)
def test_all_that_the_rate_allows_may_be_sent(rate: int, steps: list[tuple[int, int]]) -> None:
    """What is there is known to the byte."""
    bucket, tokens, most, now = TokenBucket(rate), Fraction(max(rate, LEAST)), max(rate, LEAST), 0.0
    for eighths, wanted in steps:
        now += eighths / 8
        tokens = min(Fraction(most), tokens + Fraction(rate * eighths, 8))
        assert bucket.available(now) == bucket.available(now) == math.floor(tokens)
        taken = min(wanted, math.floor(tokens))
        bucket.take(taken)
        tokens -= taken


def test_a_datagram_fits_however_low_the_rate() -> None:
    bucket = TokenBucket(0.5)
    bucket.take(bucket.available(0.0))
    assert [bucket.available(t) for t in (2.0, 2399.0, 2400.0, 1e9)] == [1, 1199, 1200, 1200]


def test_what_was_too_much_is_paid_for_later() -> None:
    bucket = TokenBucket(1000.0)
    assert bucket.available(5.0) == 1200
    bucket.take(3200)
    assert [bucket.available(t) for t in (5.0, 6.0, 7.0, 7.5, 9.0)] == [0, 0, 0, 500, 1200]


def test_a_clock_that_is_set_back_brings_nothing_for_that_step() -> None:
    bucket = TokenBucket(100.0)
    bucket.take(bucket.available(1e9))
    assert [bucket.available(t) for t in (50.0, 51.0, 51.0, 40.0, 42.0)] == [0, 100, 100, 100, 300]


@pytest.mark.parametrize("rate", [0.0, -5.0, math.inf, math.nan])
def test_rates_that_make_no_sense(rate: float) -> None:
    with pytest.raises(InvalidArgumentError, match=r"budget=.*above zero"):
        TokenBucket(rate)
