"""Rows of results.json, of one mission and of several side by side; their statistics; and snapshots."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.scan import ArrayLike
from gmmtorch.team.exploration.mission.mission import Mission
from gmmtorch.team.exploration.mission.options import THESIS
from gmmtorch.team.exploration.world.scoring import accuracy, disagreement, overlap

T = TypeVar("T")


class Interval(NamedTuple, Generic[T]):
    """Mean over trials, and the confidence limits low and high of the expected value."""

    mean: T
    low: T
    high: T


Band = Interval[np.ndarray]
"""The same at T times, each (T,)."""


def mean_band(curves: ArrayLike, confidence: float = 0.95) -> Band:
    """Mean of S curves (S, T) and its Student's t interval at each of T times. mean ± t_{S−1} s/√S, with s
    the sample standard deviation. For S = 1 the spread is unknown, and the band is (−∞, ∞). Raises
    `InvalidArgumentError` for no curve, values that are not finite, or a confidence outside (0, 1)."""
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


def paired_interval(a: ArrayLike, b: ArrayLike, confidence: float = 0.95) -> Interval[float]:
    """Student's t interval of the mean of a − b, over pairs of trials (S,) with the same seed and start.
    Pairing removes the variance that both trials of a seed share. A single pair gives (−∞, ∞)."""
    first, second = _finite("a", a, 1), _finite("b", b, 1)
    if first.shape != second.shape:
        raise InvalidArgumentError(
            f"a has shape {first.shape} and b {second.shape}; they must have one trial for each seed."
        )
    mean, low, high = (float(value[0]) for value in mean_band((first - second)[:, None], confidence))
    return Interval(mean, low, high)


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


PLANNING = ("planner", "information", "coordination", "planning_prior")
NETWORK = ("delay", "jitter", "bandwidth", "loss", "duplication", "reach", "partitions", "announce", "budget")
VARIANT = ("framework", *PLANNING, *THESIS, *NETWORK)
"""Fields of a row that say which variant of a study it belongs to."""
_LOSSES = ("loss", "partitions")


def mission_row(mission: Mission, wall_seconds: float) -> dict[str, Any]:
    """Everything measured of a scored mission, except what needs other rows (`with_times`)."""
    world, options, score = mission.world, mission.options, mission.score
    union, network, samples = score.union, mission.network, score.samples
    traffic = network.traffic()
    cells = world.observable.nonzero() + world.box.low
    occupied = world.occupied[world.observable]
    seen = score.seen_by.cpu()[world.observable.reshape(-1)]
    robots_seeing = sum(((seen >> k) & 1 for k in range(options.size)), torch.zeros_like(seen))
    length = sum(robot.path_length for robot in mission.robots)
    components = [robot.mapper.components() for robot in mission.robots]
    volume = union.n_observed * world.resolution**3
    return {
        "framework": options.framework,
        "seed": options.seed,
        "world": world.name,
        "n_robots": options.size,
        "duration": options.duration,
        "planner": options.planner,
        "information": options.information,
        "coordination": mission.coordination,
        **options.learning,
        "planning_prior": options.planning_prior,
        "delay": options.latency,
        "jitter": options.jitter,
        "bandwidth": options.bandwidth,
        "loss": options.loss,
        "duplication": options.duplication,
        "reach": options.reach,
        "partitions": [
            {"begin": cut.begin, "end": cut.end, "groups": [list(group) for group in cut.groups]}
            for cut in options.partitions
        ],
        "announce": options.announce_every,
        "budget": options.budget,
        "resolution": world.resolution,
        **samples,
        "observable_bits": union.observable_bits,
        "entropy_reduction_bits": union.observable_bits - union.entropy_bits,
        "bytes_sent": traffic.bytes,
        "wire_bytes": traffic.wire_bytes,
        "bytes_by_kind": network.bytes_by_kind,
        "bytes_raw_points": samples["raw_points_bytes_over_time"][-1],
        **{f"bytes_{name}": samples[f"{name}_bytes_over_time"][-1] for name in options.codecs},
        "datagrams": traffic.datagrams,
        "reception": network.reception()._asdict(),
        "n_components": None if components[0] is None else len(components[0]),
        "map_disagreement": disagreement([r.mapper.belief for r in mission.robots], cells),
        **accuracy(union, cells, occupied),
        "observed_share": union.n_observed / max(1, len(cells)),
        "collisions": sum(robot.collisions for robot in mission.robots),
        "path_length": length,
        "coverage_per_metre": volume / length if length > 0 else None,
        "overlap": overlap(robots_seeing),
        "wall_seconds": wall_seconds,
        "stage_seconds": dict(mission.watch.seconds),
        "simulated_per_wall_seconds": mission.elapsed / wall_seconds if wall_seconds > 0 else None,
    }


def variant_of(
    row: Mapping[str, Any], fields: Sequence[str] = VARIANT, without: Collection[str] = ()
) -> tuple[Any, ...]:
    """The values of a row's `fields`, in their order, without some; hashable."""
    return tuple(_hashable(row.get(field)) for field in fields if field not in without)


def differing(rows: Sequence[Mapping[str, Any]], without: Collection[str] = ()) -> list[str]:
    """The fields of `VARIANT` in which rows differ. The name `gmm_thesis` means the options `THESIS`."""
    free = [row for row in rows if row.get("framework") != "gmm_thesis"]
    return [
        field
        for field in VARIANT
        if field not in without
        and len({_hashable(row.get(field)) for row in (free if field in THESIS else rows)}) > 1
    ]


def compared(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of missions with all fields that need the other rows: `with_times`, `with_network_costs`."""
    return with_network_costs(with_times(rows))


def with_times(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with t50 and t90 (s): when the entropy reduction first reaches 50 and 90 % of a reference. The
    reference, `reference_bits`, is the mean final reduction of E1 (`grid_shared`). Without missions of E1 it
    is that of the best variant."""
    final: dict[tuple[Any, ...], list[float]] = {}
    for row in rows:
        final.setdefault(variant_of(row), []).append(row["entropy_reduction_bits"])
    means = {variant: sum(bits) / len(bits) for variant, bits in final.items()}
    of_grids = [bits for variant, bits in means.items() if variant[0] == "grid_shared"]
    reference = max(of_grids or means.values(), default=0.0)
    timed = []
    for row in rows:
        reduction = [row["observable_bits"] - bits for bits in row["entropy_bits"]]
        times = {
            f"t{round(100 * share)}": time_to_share(row["times"], reduction, reference, share)
            for share in (0.5, 0.9)
        }
        timed.append({**row, "reference_bits": reference, **times})
    return timed


def with_network_costs(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with what sharing cost, compared with the same mission on a network without losses.

    - `bits_per_byte`: entropy reduction (bits) per byte on the wire, headers included.
    - `t90_ratio`, `wire_ratio`: t90 and bytes on the wire, divided by those of the lossless companion: the
      mission of the same seed that differs only in `loss` and `partitions`, and has neither.
    - `healed_after`: simulated seconds from the end of the last partition to the first sample whose
      `missing_share` is at most the companion's largest during that partition.

    A field is None if nothing was sent, if a time was never reached, or without companion.

    rows: with t90 (`with_times`).
    """
    lossless: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in rows:
        if not any(row.get(field) for field in _LOSSES):
            lossless.setdefault(_pair_key(row), row)
    return [{**row, **_costs(row, lossless.get(_pair_key(row), {}))} for row in rows]


def _hashable(value: Any) -> Any:
    return str(value) if isinstance(value, list) else value


def _pair_key(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """Equal for a mission and its lossless companion."""
    return (row.get("seed"), *variant_of(row, without=_LOSSES))


def _costs(row: Mapping[str, Any], companion: Mapping[str, Any]) -> dict[str, float | None]:
    return {
        "bits_per_byte": _ratio(row["entropy_reduction_bits"], row["wire_bytes"]),
        "t90_ratio": _ratio(row["t90"], companion.get("t90")),
        "wire_ratio": _ratio(row["wire_bytes"], companion.get("wire_bytes")),
        "healed_after": _healed_after(row, companion),
    }


def _ratio(part: float | None, whole: float | None) -> float | None:
    return None if part is None or whole is None or whole <= 0 else part / whole


def _healed_after(row: Mapping[str, Any], companion: Mapping[str, Any]) -> float | None:
    if not row.get("partitions") or not companion:
        return None
    last = max(row["partitions"], key=lambda cut: cut["end"])
    usual = [share for time, share in _missing(companion) if last["begin"] <= time < last["end"]]
    if not usual:  # the partition is shorter than the time between samples
        return None
    healed = (t for t, share in _missing(row) if t >= last["end"] and share <= max(usual))
    when = next(healed, None)
    return None if when is None else when - last["end"]


def _missing(row: Mapping[str, Any]) -> list[tuple[float, float]]:
    """(time, missing share) of each sample."""
    return list(zip(row["times"], row["missing_share"], strict=True))


_MOST_SNAPSHOTS = 16
_SHARES = (0.2, 0.5, 0.8)


class Snapshot(NamedTuple):
    """tick: number of ticks done. bits: entropy reduction so far. content: what was taken of the mission."""

    tick: int
    bits: float
    content: dict[str, Any]


class Snapshots:
    """At most 17 snapshots of a scored mission: the first, the last, and some between at about equal steps of
    entropy.

    The final entropy is not known in advance. So the class takes a snapshot after each step of entropy; once
    there are 16, it doubles the step and drops the snapshots between.

    Args:
        take: returns the content of a snapshot.
    """

    def __init__(self, take: Callable[[Mission], dict[str, Any]]) -> None:
        self._take = take
        self._step = 0.0  # bits
        self.taken: list[Snapshot] = []

    def update(self, mission: Mission) -> None:
        """Takes a snapshot if it is due. Called after every tick."""
        union = mission.score.union
        bits = union.observable_bits - union.entropy_bits
        if self.taken and not mission.is_over and bits <= self.taken[-1].bits + self._step:
            return
        if len(self.taken) == _MOST_SNAPSHOTS:
            self._thin()
        self.taken.append(Snapshot(mission.n_ticks, bits, self._take(mission)))

    def _thin(self) -> None:
        first, *others = self.taken
        self._step = 2 * (others[-1].bits - first.bits) / _MOST_SNAPSHOTS
        self.taken = [first]
        for snapshot in others:
            if snapshot.bits >= self.taken[-1].bits + self._step:
                self.taken.append(snapshot)

    def chosen(self) -> list[Snapshot]:
        """The last snapshot, and those nearest to `_SHARES` of the final reduction, sorted by time."""
        *left, end = self.taken
        chosen = [end]
        for share in _SHARES[: len(left)]:
            bits = [abs(snapshot.bits - share * end.bits) for snapshot in left]
            chosen.append(left.pop(bits.index(min(bits))))
        return sorted(chosen, key=lambda snapshot: snapshot.tick)
