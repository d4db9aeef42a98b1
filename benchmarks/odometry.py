"""Poses estimated from scans alone, against true ones, beside KISS-ICP.

    python benchmarks/odometry.py --data FOLDER --only odometry [--names hall] [--every 2] [--seeds 0 1]
    python benchmarks/odometry.py --data FOLDER --only live-loops --most 450

FOLDER holds hall/, courtyard/, street/ and laser2d/. `--most` limits the scans of each. Each run moves all
points by noise of 1 mm, because a step that is nearly ambiguous may change with it. The first run also scores
the map of the scans with the given and with the estimated poses, as gmmtorch-occupancy does. `--every 2`
keeps every second scan of each recording, and `--reversed` takes them from the last one to the first.

In `live-loops` scans go through odometry into a map, one by one, as in gmmtorch-ros with
sensor.poses=mixture; loops are closed meanwhile, and the windows of the map are published to a replica.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import torch

import gmmtorch as gt
from gmmtorch.datasets import Dataset
from gmmtorch.experiments.evaluation import Protocol, choose, evaluate, methods
from gmmtorch.experiments.harness import Case, Row, cpu_seconds, held_out, recording, run
from gmmtorch.localization import Odometry
from gmmtorch.localization.odometry import METHODS, with_odometry
from gmmtorch.localization.trajectory_errors import absolute_trajectory_error, relative_pose_error
from gmmtorch.mapping.map_builder import WindowMotions
from gmmtorch.team.sharing import Replica
from gmmtorch.team.sharing.messages.datagrams import Kind, parse_datagram
from gmmtorch.team.sharing.shared_map import SharedMap
from gmmtorch.team.sharing.transport.simulated_network import Network

NOISE = 1e-3  # metres of standard deviation that move every point of a run
WRONG = 0.2  # metres of a step
RESOLUTION = {2: 0.1, 3: 0.2}  # metres of a cell


class Chosen(Dataset):
    """Some scans of a recording. Noise moves their points, another one for each seed; None: no noise."""

    def __init__(self, source: Dataset, numbers: range, seed: int | None = None) -> None:
        super().__init__(source.name, source.ranges)
        self._source, self._numbers, self._seed = source, numbers, seed

    def with_noise(self, seed: int) -> Chosen:
        return Chosen(self._source, self._numbers, seed)

    def _count(self) -> int:
        return len(self._numbers)

    def _read(self, index: int) -> gt.Scan:
        scan = self._source[self._numbers[index]]
        if self._seed is None:
            return scan
        draw = torch.Generator().manual_seed(len(self) * self._seed + index)
        return replace(scan, points=scan.points + NOISE * torch.randn(scan.points.shape, generator=draw))

    def _known_pose(self, index: int) -> torch.Tensor | None:
        return self._source.pose(self._numbers[index])


def chosen(options: Any, name: str) -> Chosen:
    """The scans of a recording that the options name."""
    source = recording(options.data, name)
    numbers = range(len(source))[:: options.every][: options.most]
    return Chosen(source, numbers[::-1] if options.reversed else numbers)


def measured(scans: Chosen, method: str, seed: int) -> dict[str, Any]:
    """The figures of one run."""
    jittered = scans.with_noise(seed)
    seconds, (posed, trajectory) = cpu_seconds(lambda: with_odometry(jittered, method))
    true = torch.stack([posed.own_pose(index) for index in range(len(posed))])
    steps, found = relative_pose_error(trajectory.poses, true), trajectory.found
    # A lost scan has no pose of its own: a step goes from a scan that was found to the next one.
    believed = relative_pose_error(trajectory.poses[found], true[found]).distances
    return {
        "ate": f"{absolute_trajectory_error(trajectory.poses, true).rmse:.2f}",
        "rpe": f"{steps.rmse:.2f}",
        "step": float(steps.distances.median()),
        "wrong": str(int((believed > WRONG).sum())),
        "lost": str(int((~found).sum())),
        "closures": str(trajectory.n_closures),
        "rate": len(posed) / seconds,
        "posed": posed,
    }


def map_score(scans: Dataset, name: str) -> float:
    """AUC of the map of the scans that are not held out, without a budget of bytes."""
    resolution = RESOLUTION[scans[0].dim]
    factories = choose(("point",), methods(partial(gt.GaussianMap, cutoff=3.0)))
    protocol = Protocol(held_out(scans), (1.0,), "beams", (resolution,), max_beams=50_000)
    return float(evaluate(name, list(scans), factories, protocol).rows[0]["auc"])


def measure(options: Any) -> Iterator[Row]:
    """A row for each recording and method, of runs by seed."""
    for name in options.names:
        scans = chosen(options, name)
        for method in options.methods:
            runs = [measured(scans, method, seed) for seed in options.seeds]
            each = {part: ", ".join(r[part] for r in runs) for part in ("ate", "rpe", "wrong")}
            if method == "mixture":
                each |= {part: ", ".join(r[part] for r in runs) for part in ("lost", "closures")}
            row: dict[str, Any] = {
                "data": name + (f", every {options.every}" if options.every > 1 else ""),
                "scans": len(scans),
                "odometry": method,
                "ATE": each["ate"] + " m",
                "RPE": each["rpe"] + " m",
                "median step error": 1e3 * statistics.median(r["step"] for r in runs),
                f"steps off by over {WRONG} m": each["wrong"],
                "lost scans": each.get("lost"),
                "closures": each.get("closures"),
                "scans/s": statistics.median(r["rate"] for r in runs),
            }
            if method == "mixture":
                scores = [f"{map_score(which, name):.3f}" for which in (scans, runs[0]["posed"])]
                row["AUC given → estimated poses"] = " → ".join(scores)
            yield row


class Robot:
    """Odometry, a map and a replica, and the seconds that each part takes."""

    def __init__(self) -> None:
        self.odometry, self.map, self.windows = Odometry(), gt.GaussianMap(), WindowMotions()
        self.shared = SharedMap(Replica(0), Network(1))
        self.seconds: dict[str, list[float]] = {"pose": [], "search": [], "move": []}
        self.n_bytes = {"components": 0, "corrections": 0}
        self.kept: list[int] = []  # scans in the map

    def take(self, points: torch.Tensor) -> None:
        """Maps a scan (N, D) in the frame of the sensor."""
        location = self.timed("pose", lambda: self.odometry.add(points))
        if self.timed("search", self.odometry.close_loops):
            self.timed("move", self.correct)
        if location.found:
            pose = self.odometry.poses[-1]
            self.kept.append(len(self.odometry.poses) - 1)
            self.map.insert(gt.Scan(points, torch.zeros(points.shape[1])).transformed(pose))
            self.windows.add(pose)
            if self.map.n_pending == 0:
                self.windows.end()
                self.publish()

    def timed(self, part: str, call: Callable[[], Any]) -> Any:
        seconds, result = cpu_seconds(call)
        self.seconds[part].append(seconds)
        return result

    def correct(self) -> None:
        if self.windows.correct(self.map, self.odometry.poses[self.kept]) is not None:
            self.publish()

    def publish(self) -> None:
        self.shared.publish(self.map, self.windows)
        for datagram in self.shared.replica.datagrams():
            is_correction = parse_datagram(datagram)[0] is Kind.CORRECTION
            self.n_bytes["corrections" if is_correction else "components"] += len(datagram)


def looped(options: Any, name: str) -> Row:
    """The row of one recording."""
    scans, robot, true = chosen(options, name), Robot(), []
    for number in range(len(scans)):
        true.append(scans.pose(number))
        robot.take(scans[number].transformed(torch.linalg.inv(true[-1])).points)
    chain = robot.odometry.trajectory(loops=False).poses
    errors = [
        absolute_trajectory_error(poses, torch.stack(true), align="first").rmse
        for poses in (chain, robot.odometry.poses)
    ]
    pose, search, move = (robot.seconds[part] for part in ("pose", "search", "move"))
    searched = [seconds for seconds in search if seconds > 0.01] or [0.0]  # other scans are no keyframes
    return {
        "data": name,
        "scans": len(true),
        "ATE without → with loops": " → ".join(f"{error:.2f}" for error in errors) + " m",
        "corrections": len(move),
        "seconds of a pose": statistics.mean(pose),
        "of a search (mean, largest)": f"{statistics.mean(searched):.2f}, {max(searched):.2f}",
        "to move and publish the map (largest)": max(move, default=0.0),
        "searches and moves, relative to the poses": 100 * (sum(search) + sum(move)) / sum(pose),
        "components": len(robot.map.components()),
        "sent: components, corrections": ", ".join(f"{n / 1e3:.0f} kB" for n in robot.n_bytes.values()),
    }


def live_loops(options: Any) -> Iterator[Row]:
    return (looped(options, name) for name in options.names)


FORMATS = {"scans": ".0f", "median step error": "{:.0f} mm", "scans/s": ".1f"}
SECONDS = ("seconds of a pose", "to move and publish the map (largest)")
LOOPS = dict.fromkeys(SECONDS, ".2f") | dict.fromkeys(("scans", "corrections", "components"), ".0f")
LOOPS["searches and moves, relative to the poses"] = "{:.0f}%"
NAMES = ("intel", "aces", "orebro", "freiburg-101", "seattle", "hall", "courtyard", "street")
CASES = (
    Case(
        "odometry",
        measure,
        "A cell with several numbers has one for each run. Steps are those between scans that were found.",
        FORMATS,
        NAMES,
        tuple(METHODS),
        key=3,
    ),
    Case(
        "live-loops",
        live_loops,
        "Errors are those of all poses at the end, with the first pose at the truth. CPU seconds.",
        LOOPS,
        ("intel", "hall"),
    ),
)

if __name__ == "__main__":
    run(
        __doc__,
        *CASES,
        most={"type": int, "help": "scans of each recording"},
        every={"type": int, "default": 1, "help": "keep every n-th scan"},
        reversed={"action": "store_true", "help": "from the last scan to the first"},
        seeds={"type": int, "nargs": "+", "default": [0, 1, 2]},
    )
