"""Loops that are closed while a map is built: the error of the poses, the time, and what a team receives.

    OMP_NUM_THREADS=1 python benchmarks/live_loops.py --data FOLDER [--names intel hall] [--most 450]

FOLDER holds laser2d/ and hall/. Scans go through odometry into a map, one by one, as in gmmtorch-ros with
sensor.poses=mixture; the windows of the map are published to a replica.
Errors are those of all poses at the end, with the first pose at the truth. Seconds are CPU time.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from harness import Case, Row, cpu_seconds, run
from odometry import MOST, first

import gmmtorch as gt
from gmmtorch.evaluation.trajectories import absolute_trajectory_error
from gmmtorch.localization import Odometry
from gmmtorch.mapping.window_motions import WindowMotions
from gmmtorch.sharing import Replica
from gmmtorch.sharing.messages.envelope import Kind, parse_datagram
from gmmtorch.sharing.shared_map import SharedMap
from gmmtorch.sharing.transport.simulated_network import Network


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


def measured(data: Path, name: str, most: int | None) -> Row:
    """The row of one recording."""
    scans, robot, true = first(most, data, name), Robot(), []
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


def measure(options: Any) -> Iterator[Row]:
    return (measured(options.data, name, options.most) for name in options.names)


SECONDS = ("seconds of a pose", "to move and publish the map (largest)")
FORMATS = dict.fromkeys(SECONDS, ".2f") | dict.fromkeys(("scans", "corrections", "components"), ".0f")
FORMATS["searches and moves, relative to the poses"] = "{:.0f}%"
CASE = Case(
    "live-loops",
    measure,
    "Errors are those of all poses at the end, with the first pose at the truth. CPU seconds.",
    FORMATS,
    ("intel", "hall"),
)

if __name__ == "__main__":
    run(__doc__, CASE, most=MOST)
