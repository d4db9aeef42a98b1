"""PointTimes: when the points of a sensor were measured, by a rule that holds for all of its messages.

Drivers state times of points in s, ms, µs or ns, or as shares of the sweep; counted from the stamp of the
message, or on the clock of the stamps, or on another clock. One message does not show which, and a single
wrong value misleads about it, so the first messages decide together.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gmmtorch.datasets.ros.bag_poses import Record
from gmmtorch.datasets.trajectory import NANOSECONDS
from gmmtorch.errors import DataError

N_SAMPLES = 10
"""Messages that decide the rule."""
_UNITS = (NANOSECONDS, 1_000_000, 1_000, 1)  # nanoseconds in s, ms, µs, ns
_SWEEP = (2_000_000, 600_000_000)
"""Shortest and longest plausible sweep of a sensor in ns; at most one unit of time falls into it."""
_LONGEST_TURN = 150_000_000
"""Scans further apart (ns) may be thinned out, so that their rate does not state how long a sweep is."""
_SHARES = (0.25, 0.8)
"""Numbers up to 1 with a range below the first are seconds, those above the second shares of a sweep."""
_NEAR = NANOSECONDS  # times of points within this of the stamp (ns) are of its clock
_SLACK = 1.05  # sweeps of a sensor differ by less than this factor
_ALIKE = 1.3  # messages whose times spread more than this over the usual have a wrong one
_CONTINUOUS = 0.75  # a sweep of this share of the time between scans, or more, may last until the next scan
_OVERLAP = 1.3  # longest sweep as a multiple of the time between scans
_MOST_WRONG = 0.1  # if a larger share of the points has wrong times, all times are doubtful
_FEWEST_STEPS = 20  # fewest steps of a float32 in a sweep: absolute times in float32 have steps of 128 s
_SMALL = 1e5  # times below it, in any unit, are not those of a calendar
_MOST_SAMPLED = 8192  # points of a message that show how long its sweep is
_FEW = 20  # fewer points do not show that their times increase
_CONSTANT = "their times do not vary"
_CONTRADICTION = "their times contradict the rate of the scans"
_NO_UNIT = "the unit of their times is not clear"
_NO_DURATION = "their times are shares of a sweep, whose duration the rate of the scans does not state"


class Rate(NamedTuple):
    """How the messages of a sensor follow each other.

    interval: usual time in ns between the stamps of a frame; None: not known. is_regular: whether nearly all
    intervals are similar. delay: usual time in ns from the stamp to receipt; None: stamps are times of
    receipt.
    """

    interval: float | None
    is_regular: bool
    delay: float | None

    @staticmethod
    def of(records: Sequence[Record], clock: str) -> Rate:
        """The rate of messages of a topic, which may have several frames. clock: header or received."""
        times = np.array([record.stamp for record in records], np.int64)
        frames = np.array([record.frame for record in records])
        steps = np.concatenate([np.diff(times[frames == frame]) for frame in np.unique(frames)])
        steps = steps[steps > 0]
        delay = float(np.median([record.time - record.stamp for record in records]))
        interval = float(np.median(steps)) if len(steps) else None
        is_regular = interval is not None and np.mean(np.abs(steps - interval) < interval / 4) > 0.8
        return Rate(interval, bool(is_regular), None if clock == "received" else delay)


class PointTimes:
    """When points were measured, in ns after the stamps of their messages.

    `learn` takes the first `N_SAMPLES` messages with times; `offsets` follows the rule that they show.

    Args:
        is_laser: whether times are those of the beams of a LaserScan, in ns after its first beam.
    """

    def __init__(self, is_laser: bool) -> None:
        self._is_laser = is_laser
        self._samples: list[_Sample] = []
        self._rule = _Rule(trouble="their times are not finite")

    def learn(self, values: np.ndarray | None, stamp: int, rate: Rate) -> None:
        """Decides the rule again with the times (N,) of one more message, unless it has enough."""
        if values is None or len(self._samples) >= N_SAMPLES:
            return
        sample = _sample(values, stamp)
        if sample is not None:
            self._samples.append(sample)
            self._rule = (_laser_rule if self._is_laser else _rule)(self._samples, rate)

    def offsets(self, values: np.ndarray, stamp: int) -> tuple[np.ndarray, np.ndarray | None]:
        """When the points of a message with times (N,) in its own form were measured.

        Returns times in ns after the stamp, (K,) int64, and which points (N,) bool they are of, those with
        times that fit into the sweep; None: all. Raises `DataError` with the reason if they cannot be used.
        """
        rule = self._rule
        if rule.trouble:
            raise DataError(rule.trouble)
        found = _whole(values)
        kept = _of_one_sweep(found, rule.longest / rule.unit)
        found = found if kept is None else found[kept]
        if len(found) < (1 - _MOST_WRONG) * len(values):
            raise DataError("their times are not of one sweep")
        low = found.min()
        offsets = np.round((found - low).astype(np.float64) * rule.unit).astype(np.int64)
        if rule.clock != _OTHER:
            first = _nanoseconds(low, rule.unit) - (stamp if rule.clock == _STAMP else 0)
            if abs(first - rule.first) > (rule.longest if rule.clock == _MESSAGE else _NEAR):
                raise DataError("their times are far from the stamp")
            offsets += first
        last = int(offsets.max())
        duration = last - int(offsets.min())
        if duration == 0 and len(found) > _FEW:
            raise DataError(_CONSTANT)
        if rule.interval is not None and duration > _OVERLAP * rule.interval:
            raise DataError(_CONTRADICTION)
        return offsets - last if rule.is_at_end and last > 0 else offsets, kept


_MESSAGE, _STAMP, _OTHER = "the stamp of the message", "the clock of the stamps", "another clock"


class _Rule(NamedTuple):
    """How a sensor states times of points.

    unit: ns per unit of the field. clock: what times count from; of another clock, the first point is at the
    stamp. first: usual time of the first point in ns after the stamp. longest: sweep in ns, with slack.
    is_at_end: times count from the first point, but the last one is at the stamp. interval: see `Rate`.
    trouble: why times cannot be used; empty if they can.
    """

    unit: float = 1
    clock: str = _MESSAGE
    first: float = 0.0
    longest: float = np.inf
    is_at_end: bool = False
    interval: float | None = None
    trouble: str = ""


class _Sample(NamedTuple):
    """First and last time of a message in the unit of its field, without times far from the others.

    step: distance of two float32 numbers of this size; 0: times have another type.
    """

    low: float
    high: float
    step: float
    stamp: int


def _rule(samples: list[_Sample], rate: Rate) -> _Rule:
    durations = np.array([sample.high - sample.low for sample in samples], np.float64)
    usual = float(np.median(durations))
    if samples[0].step > 0 and usual < _FEWEST_STEPS * samples[0].step and abs(samples[0].low) > _SMALL:
        return _Rule(trouble="their times are absolute in float32, which is too coarse")
    if usual == 0:
        return _Rule(trouble=_CONSTANT)
    unit, trouble = _unit(samples, usual, rate)
    if unit is None:
        return _Rule(trouble=trouble)
    sweep = float(durations[durations <= _ALIKE * usual].max()) * unit
    if rate.interval is not None and sweep > _CONTINUOUS * rate.interval:
        sweep = max(sweep, min(rate.interval, _SWEEP[1]))
    clock, first = _clock(samples, unit, sweep)
    counts_from_first = clock == _OTHER or (clock == _MESSAGE and first > -sweep / 10)
    is_at_end = (counts_from_first or rate.delay is None) and clock != _STAMP and _is_at_end(sweep, rate)
    return _Rule(unit, clock, first, _SLACK * sweep, is_at_end, rate.interval)


def _laser_rule(samples: list[_Sample], rate: Rate) -> _Rule:
    """The rule for times in ns after the first beam of each message."""
    sweep = float(np.median([sample.high for sample in samples]))
    trouble = _CONTRADICTION if rate.interval is not None and sweep > _OVERLAP * rate.interval else ""
    return _Rule(is_at_end=_is_at_end(sweep, rate), interval=rate.interval, trouble=trouble)


def _clock(samples: list[_Sample], unit: float, sweep: float) -> tuple[str, float]:
    """What times count from, and the usual time (ns) of the first point from there.

    Times from the stamp are near zero and alike in all messages; those on its clock are near the stamp.
    """
    lows = [_nanoseconds(sample.low, unit) for sample in samples]
    first = np.array(lows, np.float64)
    after = np.array([low - sample.stamp for low, sample in zip(lows, samples, strict=True)], np.float64)
    (first_at, first_spread), (after_at, after_spread) = _centre(first), _centre(after)
    is_alike = (first_spread, abs(first_at)) <= (after_spread, abs(after_at))
    if abs(after_at) < _NEAR and not is_alike:
        return _STAMP, after_at
    if abs(first_at) < _NEAR and first_spread < sweep:
        return _MESSAGE, first_at
    return (_STAMP if abs(after_at) < _NEAR else _OTHER), after_at


def _centre(times: np.ndarray) -> tuple[float, float]:
    """The median, and the median distance from it."""
    middle = float(np.median(times))
    return middle, float(np.median(np.abs(times - middle)))


def _is_at_end(sweep: float, rate: Rate) -> bool:
    """Whether the stamp is that of the last point, for times that count from the first one.

    A message that arrives sooner after its stamp than its sweep lasts has the stamp of the sweep's end, as
    some drivers write it. If both times are equal, the recording does not state when it was received.
    """
    return rate.delay is None or 0 < rate.delay < sweep / 2


def _unit(samples: list[_Sample], usual: float, rate: Rate) -> tuple[float | None, str]:
    """Nanoseconds per unit of times whose usual duration is known; or None, and why it is not clear."""
    unit = next((unit for unit in _UNITS if _SWEEP[0] <= usual * unit <= _SWEEP[1]), None)
    largest = float(np.median([max(abs(sample.low), abs(sample.high)) for sample in samples]))
    may_be_shares = isinstance(samples[0].low, float) and largest < _SLACK and usual > _SHARES[0]
    if not may_be_shares:
        return unit, _NO_UNIT
    if unit is not None and rate.interval is not None and 0.7 < usual * unit / rate.interval < 1.3:
        return unit, ""
    if usual < _SHARES[1]:
        return None, _NO_UNIT
    if rate.interval is None or not rate.is_regular or rate.interval > _LONGEST_TURN:
        return None, _NO_DURATION
    return rate.interval, ""


def _whole(values: np.ndarray) -> np.ndarray:
    """Whole numbers as int64, whose differences have a sign; other numbers as they are."""
    return values.astype(np.int64) if values.dtype.kind in "iu" else values


def _nanoseconds(value: float, unit: float) -> int:
    """A time in ns, exact for whole numbers of a whole unit."""
    is_whole = isinstance(value, int | np.integer) and isinstance(unit, int)
    return int(value) * int(unit) if is_whole else round(float(value) * unit)


@np.errstate(over="ignore", invalid="ignore")
def _of_one_sweep(times: np.ndarray, longest: float) -> np.ndarray | None:
    """Which times (N,) bool are of the sweep of the given duration that most of them are of; None: all.

    If times increase but for a few, these few are wrong too, and so may be those before or after them.
    """
    kept, inside = None, times
    if times.dtype.kind == "f" and not np.isfinite(times).all():
        kept = np.isfinite(times)
        inside = times[kept]
    if len(inside) and float(inside.max()) - float(inside.min()) > longest:
        ordered = np.sort(inside)
        reach = int(longest) if ordered.dtype.kind == "i" else longest
        ends = np.searchsorted(ordered, ordered + reach, "right")
        counts = ends - np.arange(len(ordered))
        most = np.flatnonzero(counts == counts.max())
        lasts = ordered[ends[most] - 1]
        shortest = int(np.argmin(lasts - ordered[most]))
        kept = (times >= ordered[most[shortest]]) & (times <= lasts[shortest])
        inside = times[kept]
    falls = np.flatnonzero(inside[:-1] - inside[1:] > longest / 100)
    if 0 < len(falls) <= max(1, len(inside) // 100) and len(inside) > _FEW:
        fits = np.ones(len(inside), bool)
        fits[falls] = fits[falls + 1] = False
        if (np.diff(inside[fits]) >= -longest / 100).all():
            kept = np.ones(len(times), bool) if kept is None else kept
            kept[kept] = fits
    return kept


@np.errstate(over="ignore", invalid="ignore")
def _sample(values: np.ndarray, stamp: int) -> _Sample | None:
    """Where the times of a message begin and end; None without a finite one.

    Times that are half a sweep away from nine tenths of the points, or across a gap that is four times as
    wide as any among those, are not of the sweep.
    """
    some = values[:: len(values) // _MOST_SAMPLED | 1]  # an odd step reaches all columns of an image
    ordered = np.sort(_whole(some if some.dtype.kind in "iu" else some[np.isfinite(some)]))
    if len(ordered) == 0:
        return None
    middle, n_core = ordered[len(ordered) // 2], len(ordered) - int(_MOST_WRONG * len(ordered))
    after = ordered.astype(np.float64) - float(middle)
    begin = int(np.argmin(after[n_core - 1 :] - after[: len(after) - n_core + 1]))
    core = after[begin : begin + n_core]
    duration = core[-1] - core[0]
    gap = max(4 * np.diff(core).max(initial=0), duration / 50)
    last = core[-1] + _reach(after[begin + n_core :] - core[-1], gap, duration / 2)
    first = core[0] - _reach(core[0] - after[:begin][::-1], gap, duration / 2)
    is_whole = ordered.dtype.kind == "i"
    low, high = (middle.item() + (int(end) if is_whole else end) for end in (first, last))
    step = float(np.spacing(np.abs(middle))) if ordered.dtype == np.float32 else 0.0
    return _Sample(low, high, step, stamp)


def _reach(distances: np.ndarray, gap: float, most: float) -> float:
    """The last of increasing distances before a gap that is too wide, or before `most`."""
    apart = np.flatnonzero((np.diff(distances, prepend=0.0) > gap) | (distances > most))
    near = distances[: apart[0]] if len(apart) else distances
    return float(near[-1]) if len(near) else 0.0
