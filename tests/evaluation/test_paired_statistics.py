"""Bands and intervals against SciPy, first times against a fine search."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.team.exploration import mean_band, on_common_times, paired_interval, time_to_share


@pytest.mark.parametrize("n", [2, 5, 30])
@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.99])
def test_mean_band_matches_scipy_t_intervals(n, confidence):
    curves = np.random.default_rng(n).normal(3, 2, (n, 4))
    mean, low, high = mean_band(torch.from_numpy(curves), confidence)
    for i in range(4):
        expected = stats.ttest_1samp(curves[:, i], 0).confidence_interval(confidence)
        assert mean[i] == pytest.approx(curves[:, i].mean())
        assert (low[i], high[i]) == pytest.approx(tuple(expected))


def test_one_trial_has_an_infinite_interval():
    mean, low, high = mean_band([[1.0, 2.0]])
    np.testing.assert_array_equal(mean, [1, 2])
    assert (low == -math.inf).all()
    assert (high == math.inf).all()
    assert paired_interval([3.0], [1.0]) == (2.0, -math.inf, math.inf)


def test_paired_interval_matches_the_paired_t_test():
    random = np.random.default_rng(0)
    shared = random.normal(0, 10, 5)  # effect of the seed on both
    a, b = shared + random.normal(1, 0.1, 5), shared + random.normal(0, 0.1, 5)
    mean, low, high = paired_interval(a, b)
    expected = stats.ttest_rel(a, b).confidence_interval(0.95)
    assert mean == pytest.approx((a - b).mean())
    assert (low, high) == pytest.approx(tuple(expected))
    assert low > 0.5  # the seeds' deviation of 10 cancels
    assert paired_interval([1.0, 1.0], [1.0, 1.0]) == (0, 0, 0)


def test_mean_band_has_the_stated_coverage():
    trials = np.random.default_rng(1).normal(0, 1, (5, 20_000))
    _, low, high = mean_band(trials, 0.9)
    covered = ((low < 0) & (high > 0)).mean()
    assert covered == pytest.approx(0.9, abs=4 * math.sqrt(0.09 / 20_000))


@given(
    st.lists(st.floats(-10, 10), min_size=1, max_size=8),
    st.floats(0.1, 10),
    st.floats(0.05, 1),
)
def test_time_to_share_matches_a_fine_search(reduction, reference, share):
    times = np.arange(len(reduction)) * 3.0
    found = time_to_share(times, reduction, reference, share)
    fine = np.linspace(0, times[-1], 20_001)
    reached = np.interp(fine, times, reduction) >= share * reference
    if not reached.any():
        at_knot = max(reduction) >= share * reference  # reached at one point between the fine ones
        assert found is None or at_knot
        return
    # The fine search is never early.
    assert found is not None
    assert found <= fine[reached.argmax()] + 1e-9
    assert np.interp(found, times, reduction) == pytest.approx(share * reference, abs=1e-6) or found == 0
    before = fine[fine < found - 1e-6]
    assert (np.interp(before, times, reduction) < share * reference).all()


def test_time_to_share_by_hand():
    times, reduction = [0.0, 10.0, 20.0, 30.0], [0.0, 40.0, 30.0, 100.0]
    assert time_to_share(times, reduction, 100, 0.2) == 5.0
    assert time_to_share(times, reduction, 100, 0.35) == 8.75  # the reduction falls again later
    assert time_to_share(times, reduction, 100, 1.0) == 30.0
    assert time_to_share(times, reduction, 200, 0.9) is None
    assert time_to_share([5.0], [50.0], 100, 0.5) == 5.0
    assert time_to_share([0.0, 1600.1], [0.0, 1.0], 1, 1) == 1600.1  # lists are not rounded to float32
    assert time_to_share([], [], 100, 0.5) is None
    assert time_to_share(times, reduction, 0.0, 0.5) is None


def test_trials_are_interpolated_at_common_times():
    grid, curves = on_common_times([[0, 2, 4], [1, 3, 5]], [[0.0, 4.0, 8.0], [1.0, 9.0, 25.0]])
    np.testing.assert_array_equal(grid, [1, 2, 3, 4])
    np.testing.assert_allclose(curves, [[2, 4, 6, 8], [1, 5, 9, 17]])


def test_invalid_trials_raise():
    with pytest.raises(InvalidArgumentError, match="at least one trial"):
        mean_band(np.empty((0, 3)))
    with pytest.raises(InvalidArgumentError, match="finite values"):
        mean_band([[1.0, math.nan]])
    with pytest.raises(InvalidArgumentError, match="confidence=1"):
        mean_band([[1.0], [2.0]], 1.0)
    with pytest.raises(InvalidArgumentError, match="one trial for each seed"):
        paired_interval([1.0, 2.0], [1.0])
    with pytest.raises(InvalidArgumentError, match="share=0"):
        time_to_share([0.0], [0.0], 1.0, 0.0)
    with pytest.raises(InvalidArgumentError, match="reference=nan"):
        time_to_share([0.0], [0.0], math.nan, 0.5)
    with pytest.raises(InvalidArgumentError, match="increasing times"):
        time_to_share([1.0, 0.0], [0.0, 1.0], 1.0, 0.5)
    with pytest.raises(InvalidArgumentError, match="before another starts"):
        on_common_times([[0.0, 1.0], [2.0, 3.0]], [[0.0, 1.0], [2.0, 3.0]])
    with pytest.raises(InvalidArgumentError, match="at least one"):
        on_common_times([], [])
    with pytest.raises(InvalidArgumentError, match="one value for each time"):
        on_common_times([[]], [[]])
