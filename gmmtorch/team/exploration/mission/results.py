"""Rows of results.json, of a mission and of missions side by side; and snapshots of a mission."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import torch

from gmmtorch.team.exploration.mission.mission import Mission
from gmmtorch.team.exploration.mission.options import THESIS
from gmmtorch.team.exploration.mission.paired_statistics import time_to_share
from gmmtorch.team.exploration.world.scoring import accuracy, disagreement, overlap

PLANNING = ("planner", "information", "coordination", "planning_prior")
NETWORK = (
    *("delay", "jitter", "bandwidth", "loss", "duplication", "reach", "partitions"),
    *("announce", "budget"),
)
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
        "coordination": mission.coordination.name,
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


# -- missions side by side ------------------------------------------------------------------------


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
    """Rows with t50 and t90 (s): when the entropy reduction first reaches 50 and 90 % of a reference.

    The reference, `reference_bits`, is the mean final reduction of E1 (`grid_shared`). Without missions of E1
    it is that of the best variant.
    """
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

    Args:
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
