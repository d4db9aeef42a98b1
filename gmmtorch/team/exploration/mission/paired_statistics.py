"""Statistics over trials with several seeds: means with confidence bands, and paired differences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.scan import ArrayLike


class Band(NamedTuple):
    """Mean (T,) over trials, and the confidence limits low (T,) and high (T,) of the expected value."""

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


class Interval(NamedTuple):
    """Mean over trials, and the confidence limits low and high of the expected value."""

    mean: float
    low: float
    high: float


def mean_band(curves: ArrayLike, confidence: float = 0.95) -> Band:
    """Mean of S curves (S, T) and its Student's t interval at each of T times.

    mean ± t_{S−1} s/√S, with s the sample standard deviation. For S = 1 the spread is unknown, and the band
    is (−∞, ∞).

    Raises `InvalidArgumentError` for no curve, values that are not finite, or a confidence outside (0, 1).
    """
    from scipy.stats import t

    values = _finite("curves", curves, 2)
    if len(values) == 0:
        raise InvalidArgumentError(f"curves has shape {values.shape}; give at least one trial.")
    if not 0 < confidence < 1:
        raise InvalidArgumentError(f"confidence={confidence} must lie between 0 and 1; 0.95 is usual.")
    n, mean = len(values), values.mean(0)
    if n == 1:
        return Band(mean, np.full_like(mean, -np.inf), np.full_like(mean, np.inf))
    half = t.ppf((1 + confidence) / 2, n - 1) * values.std(0, ddof=1) / np.sqrt(n)
    return Band(mean, mean - half, mean + half)


def paired_interval(a: ArrayLike, b: ArrayLike, confidence: float = 0.95) -> Interval:
    """Student's t interval of the mean of a − b, over pairs of trials (S,) with the same seed and start.

    Pairing removes the variance that both trials of a seed share. A single pair gives (−∞, ∞).
    """
    first, second = _finite("a", a, 1), _finite("b", b, 1)
    if first.shape != second.shape:
        raise InvalidArgumentError(
            f"a has shape {first.shape} and b {second.shape}; they must have one trial for each seed."
        )
    return Interval(*(float(value[0]) for value in mean_band((first - second)[:, None], confidence)))


def time_to_share(times: ArrayLike, reduction: ArrayLike, reference: float, share: float) -> float | None:
    """First time (s) at which `reduction` (T,) reaches `share` of `reference`; None if it never does.

    The reduction is linear between the times (T,). A reference of zero or less also gives None.

    Raises `InvalidArgumentError` for shapes that disagree, decreasing times, values that are not finite,
    or a share outside (0, 1].
    """
    when, value = _finite("times", times, 1), _finite("reduction", reduction, 1)
    if when.shape != value.shape or (np.diff(when) < 0).any():
        raise InvalidArgumentError(
            f"times has shape {when.shape} and reduction {value.shape}; give one value for each time, with "
            "increasing times."
        )
    if not 0 < share <= 1:
        raise InvalidArgumentError(f"share={share} must lie in (0, 1].")
    if not np.isfinite(reference):
        raise InvalidArgumentError(f"reference={reference} must be a finite reduction (bits).")
    target = share * reference
    reached = np.flatnonzero(value >= target)
    if reference <= 0 or len(reached) == 0:
        return None
    i = int(reached[0])
    if i == 0:
        return float(when[0])
    part = (target - value[i - 1]) / (value[i] - value[i - 1])
    return float(when[i - 1] + part * (when[i] - when[i - 1]))


def on_common_times(times: Sequence[ArrayLike], curves: Sequence[ArrayLike]) -> tuple[np.ndarray, np.ndarray]:
    """Curves (S, T) of several trials, interpolated at common times (T,); returns the times and the curves.

    The times are all times of all trials within the interval that every trial covers. Interpolation is
    linear. Raises `InvalidArgumentError` without trials, for an empty trial, or if the trials have no
    common interval.
    """
    if len(times) != len(curves) or len(times) == 0:
        raise InvalidArgumentError(
            f"times has {len(times)} and curves {len(curves)} trials; give equally many, at least one."
        )
    when = [_finite("times", t, 1) for t in times]
    values = [_finite("curves", c, 1) for c in curves]
    for t, c in zip(when, values, strict=True):
        if t.shape != c.shape or len(t) == 0 or (np.diff(t) < 0).any():
            raise InvalidArgumentError(
                f"times has shape {t.shape} and its curve {c.shape}; give one value for each time, with "
                "increasing times."
            )
    start, stop = max(t[0] for t in when), min(t[-1] for t in when)
    if stop < start:
        raise InvalidArgumentError(f"One trial ends at {stop:g} s, before another starts at {start:g} s.")
    grid = np.unique(np.concatenate([t[(t >= start) & (t <= stop)] for t in when]))
    return grid, np.stack([np.interp(grid, t, c) for t, c in zip(when, values, strict=True)])


def _finite(name: str, values: ArrayLike, n_axes: int) -> np.ndarray:
    # Lists are not converted through a tensor, which would make them float32.
    plain = values.detach().cpu().numpy() if isinstance(values, Tensor) else values
    array = np.asarray(plain, dtype=np.float64)
    if array.ndim != n_axes or not np.isfinite(array).all():
        raise InvalidArgumentError(
            f"{name} has shape {array.shape}; expected {n_axes} axes and only finite values."
        )
    return array
