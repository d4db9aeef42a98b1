"""TokenBucket: available bytes against exact fractions and over all time spans."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.team.sharing.radio import TokenBucket

LEAST = 1200
rates = st.integers(1, 5000)
steps = st.lists(st.tuples(st.integers(0, 80), st.integers(0, 4000)), min_size=1, max_size=40)
"""Eighths of a second until the next time, and the bytes wanted then."""


def spent(bucket: TokenBucket, steps: list[tuple[int, int]]) -> list[tuple[float, int]]:
    """(time, bytes) of a user that takes as many of the wanted bytes as available."""
    now, found = 0.0, []
    for eighths, wanted in steps:
        now += eighths / 8
        found.append((now, min(wanted, bucket.available(now))))
        bucket.take(found[-1][1])
    return found


@given(rate=rates, steps=steps)
def test_any_span_takes_at_most_the_rate_and_a_burst(rate: int, steps: list[tuple[int, int]]) -> None:
    taken = spent(TokenBucket(rate), steps)
    for i, j in itertools.combinations_with_replacement(range(len(taken)), 2):
        span = taken[j][0] - taken[i][0]
        assert sum(n for _, n in taken[i : j + 1]) <= rate * span + max(rate, LEAST)


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


def test_a_datagram_fits_however_low_the_rate() -> None:
    bucket = TokenBucket(0.5)
    bucket.take(bucket.available(0.0))
    assert [bucket.available(t) for t in (2.0, 2399.0, 2400.0, 1e9)] == [1, 1199, 1200, 1200]


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
