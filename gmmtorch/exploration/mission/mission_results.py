"""The row that a finished mission leaves in results.json."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from gmmtorch.evaluation.paired_statistics import time_to_share
from gmmtorch.exploration.mission.mission import Mission
from gmmtorch.exploration.mission.variants import variant_of
from gmmtorch.exploration.world.scoring import accuracy, disagreement, overlap


def row_of(mission: Mission, wall_seconds: float) -> dict[str, Any]:
    """Everything measured of a mission; t50 and t90 come with `with_times`, which knows its companions."""
    world, options, union = mission.world, mission.options, mission.union
    cells = world.observable.nonzero() + world.box.low
    occupied = world.occupied[world.observable]
    seen = mission.seen_by[world.observable.reshape(-1)]
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
        "codec": options.codec,
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
        **mission.samples,
        "observable_bits": union.observable_bits,
        "entropy_reduction_bits": union.observable_bits - union.entropy_bits,
        "bytes_sent": mission.network.n_bytes,
        "wire_bytes": mission.network.n_wire_bytes,
        "bytes_by_kind": mission.network.bytes_by_kind,
        "bytes_raw_points": mission.samples["raw_points_bytes_over_time"][-1],
        **{f"bytes_{name}": mission.samples[f"{name}_bytes_over_time"][-1] for name in options.codecs},
        "datagrams": mission.network.n_datagrams,
        "reception": mission.network.reception()._asdict(),
        "n_components": None if components[0] is None else len(components[0]),
        "map_disagreement": disagreement([r.mapper.belief for r in mission.robots], cells),
        **accuracy(union, cells, occupied),
        "observed_share": union.n_observed / max(1, len(cells)),
        "collisions": sum(robot.collisions for robot in mission.robots),
        "path_length": length,
        "coverage_per_metre": volume / length if length > 0 else None,
        "overlap": _finite(overlap(robots_seeing)),
        "wall_seconds": wall_seconds,
        "stage_seconds": dict(mission.stages),
        "simulated_per_wall_seconds": mission.now / wall_seconds if wall_seconds > 0 else None,
    }


def with_times(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with t50 and t90: when the reduction first reaches that share of E1's mean final one.

    Without trials of E1 (`grid_shared`) beside them, missions are measured by the mean final reduction of
    the best of the variants they are of; `reference_bits` says what it is.
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


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
