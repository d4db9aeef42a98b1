"""Synthetic rows of exploration trials with realistic values."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gmmtorch.team.exploration.mission.results import time_to_share

OBSERVABLE_BITS, REFERENCE_BITS = 1.6e6, 1.43e6
_PACE = {"gmm_shared": 330.0, "grid_shared": 335.0, "grid_isolated": 470.0, "gmm_thesis": 350.0}
_STAGES = {
    "gmm_shared": {"sensing": 0.1, "mapping": 0.42, "planning": 0.36, "sharing": 0.05, "scoring": 0.04},
    "grid_shared": {"sensing": 0.12, "mapping": 0.2, "planning": 0.45, "sharing": 0.16, "scoring": 0.04},
    "grid_isolated": {"sensing": 0.14, "mapping": 0.18, "planning": 0.6, "sharing": 0.001, "scoring": 0.05},
    "gmm_thesis": {"sensing": 0.1, "mapping": 0.5, "planning": 0.36, "sharing": 0.05, "scoring": 0.04},
}
_FLOOR = {"gmm_shared": 0.045, "grid_shared": 0.04, "grid_isolated": 0.11, "gmm_thesis": 0.05}


def trial(
    framework: str, seed: int, duration: float = 1600.0, n_robots: int = 3, **fields: Any
) -> dict[str, Any]:
    """One trial: entropy falls as 1/(1 + (t/τ)^1.6) to a floor, at a different pace for each seed."""
    random = np.random.default_rng([seed, list(_PACE).index(framework)])
    times = np.arange(0.0, duration + 1, 10.0)
    pace = fields.pop("pace", _PACE[framework]) * math.exp(random.normal(0, 0.07))
    left = _FLOOR[framework] + (1 - _FLOOR[framework]) / (1 + (times / pace) ** 1.6)
    left = np.minimum.accumulate(left * np.exp(np.cumsum(random.normal(0, 0.004, len(times)))))
    left[0] = 1.0
    own = 0.6 if framework == "grid_isolated" else 0.99
    robots = [1 - (1 - left) * own * (1 - 0.05 * i) for i in range(n_robots)]
    found = 1 - left  # novel points grow with the explored share, and slowly with time
    raw = 12 * (3.1e6 * found + 400 * times)
    sent = {"gmm_shared": raw / 58, "grid_shared": raw, "grid_isolated": 0 * raw, "gmm_thesis": raw / 9}[
        framework
    ]
    mixture = framework.startswith("gmm")
    path = n_robots * 0.7 * duration
    reduction = OBSERVABLE_BITS * (1 - left)
    return {
        "framework": framework,
        "seed": seed,
        "world": "warehouse",
        "n_robots": n_robots,
        "duration": duration,
        "times": times.tolist(),
        "entropy_bits": (OBSERVABLE_BITS * left).tolist(),
        "entropy_bits_per_robot": [(OBSERVABLE_BITS * robot).tolist() for robot in robots],
        "observable_bits": OBSERVABLE_BITS,
        "entropy_reduction_bits": float(reduction[-1]),
        "t50": time_to_share(times, OBSERVABLE_BITS * (1 - left), REFERENCE_BITS, 0.5),
        "t90": time_to_share(times, OBSERVABLE_BITS * (1 - left), REFERENCE_BITS, 0.9),
        "bytes_sent": int(sent[-1]),
        "bytes_raw_points": int(raw[-1]),
        "bytes_over_time": sent.astype(int).tolist(),
        "bytes_by_kind": {"records": int(0.95 * sent[-1]), "plans": int(0.05 * sent[-1])},
        "raw_points_bytes_over_time": raw.astype(int).tolist(),
        "octree_bytes_over_time": (raw / 21).astype(int).tolist() if mixture else None,
        "draco_bytes_over_time": (raw / 9).astype(int).tolist() if mixture else None,
        "map_disagreement": 0.004 if framework != "grid_isolated" else 0.31,
        "auc": {"gmm_shared": 0.972, "grid_shared": 0.969, "grid_isolated": 0.94, "gmm_thesis": 0.96}[
            framework
        ]
        + random.normal(0, 0.002),
        "cross_entropy_bits": 0.2 * OBSERVABLE_BITS,
        "collisions": 0,
        "path_length": path,
        "coverage_per_metre": float(0.008 * reduction[-1] / path),
        "overlap": 0.2,
        "wall_seconds": (wall := duration / random.uniform(4, 6)),
        "stage_seconds": {name: share * wall for name, share in _STAGES[framework].items()},
        "reference_bits": REFERENCE_BITS,
        "planning_prior": 0.125,
        "planner": "mcts",
        "information": "csqmi",
        "coordination": "distributed_greedy",
        **fields,
    }


def protocol(n_seeds: int = 5, duration: float = 1600.0) -> list[dict[str, Any]]:
    """Trials of all frameworks with several seeds each."""
    return [trial(framework, seed, duration) for seed in range(n_seeds) for framework in _PACE]


def planner_variants(n_seeds: int = 5) -> list[dict[str, Any]]:
    """Trials of all planners and planning priors."""
    variants = [
        ("mcts", "csqmi", 0.125, 330.0),
        ("mcts", "csqmi", 0.5, 380.0),
        ("mcts", "fsmi", 0.125, 340.0),
        ("frontier", "csqmi", 0.125, 420.0),
        ("random", "csqmi", 0.125, 900.0),
    ]
    return [
        trial("gmm_shared", seed, planner=planner, information=information, planning_prior=prior, pace=pace)
        for seed in range(n_seeds)
        for planner, information, prior, pace in variants
    ]


def flights(n_robots: int = 3, n: int = 600, seed: int = 0) -> list[np.ndarray]:
    """Poses (T, 4) of each robot, metres and radians, in a hall of 50 × 40 m, a second apart."""
    random = np.random.default_rng(seed)
    paths = []
    for i in range(n_robots):
        turns = np.cumsum(random.normal(0, 0.1, n)) + 2 * math.pi * i / n_robots
        steps = 0.8 * np.stack([np.cos(turns), np.sin(turns)], 1)
        flat = np.array([4.0 + 2 * i, 4.0 + i]) + np.cumsum(steps, 0)
        # Reflect at the walls.
        size = np.array([50.0, 40.0])
        flat = 1 + np.abs((flat % (2 * (size - 2))) - (size - 2))
        height = 2.5 + 1.2 * np.sin(np.arange(n) / 40 + i)
        paths.append(np.concatenate([flat, height[:, None], turns[:, None]], 1))
    return paths


def networks(n_seeds: int = 3, duration: float = 600.0) -> list[dict[str, Any]]:
    """Trials of E0 with a lossless network, with losses, and with a partition of one minute."""
    cut = {"begin": 60.0, "end": 120.0, "groups": [[0], [1, 2]]}
    variants = [(0.0, []), (0.1, []), (0.3, []), (0.5, []), (0.0, [cut])]
    rows = []
    for seed in range(n_seeds):
        lossless: dict[str, Any] = {}
        for loss, partitions in variants:
            row = trial("gmm_shared", seed, duration, pace=90 * (1 + 0.1 * loss), loss=loss)
            times = np.asarray(row["times"])
            ripple = np.random.default_rng([seed, round(10 * loss)]).uniform(0.3, 1, len(times))
            missing = ripple * (0.4 + 3 * loss) / (10 + times)
            if partitions:
                apart = np.clip((times - 60) / 60, 0, 1) * 0.45
                missing = np.where((times >= 60) & (times < 130), np.maximum(apart, missing), missing)
            wire = 8e5 * (1 + 1.2 * loss + 0.05 * bool(partitions)) * (1 - np.exp(-times / 180))
            row |= {
                "partitions": partitions,
                "missing_share": np.minimum(missing, 1).tolist(),
                "wire_bytes_over_time": wire.astype(int).tolist(),
                "wire_bytes": int(wire[-1]),
                "map_disagreement": 1e-3 * loss,
            }
            lossless = lossless or row
            row["t90_ratio"] = row["t90"] / lossless["t90"] if row["t90"] else None
            row["wire_ratio"] = row["wire_bytes"] / lossless["wire_bytes"]
            row["healed_after"] = 10.0 if partitions else None
            rows.append(row)
    return rows
