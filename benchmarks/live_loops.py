"""Loops that are closed while a map is built: the error of the poses, the time, and what a team receives.

    OMP_NUM_THREADS=1 python benchmarks/live_loops.py --data FOLDER [--names intel hall] [--most 450]

FOLDER holds laser2d/ and hall/. Scans go through odometry into a map, one by one, as in gmmtorch-ros with
sensor.poses=mixture; the windows of the map are published to a replica. Writes a table of BENCHMARKS.md.
Errors are those of all poses at the end, with the first pose at the truth. Seconds are CPU time. One thread.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from odometry import opened
from tables import hardware, markdown, publish

import gmmtorch as gt
from gmmtorch.localization import Odometry
from gmmtorch.localization.trajectory_errors import absolute_trajectory_error
from gmmtorch.mapping.map_builder import WindowMotions
from gmmtorch.team.sharing import Replica
from gmmtorch.team.sharing.messages.datagrams import Kind, parse_datagram
from gmmtorch.team.sharing.shared_map import SharedMap
from gmmtorch.team.sharing.transport.simulated_network import Network


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
        begin = time.process_time()
        result = call()
        self.seconds[part].append(time.process_time() - begin)
        return result

    def correct(self) -> None:
        if self.windows.correct(self.map, self.odometry.poses[self.kept]) is not None:
            self.publish()

    def publish(self) -> None:
        self.shared.publish(self.map, self.windows)
        for datagram in self.shared.replica.datagrams():
            is_correction = parse_datagram(datagram)[0] is Kind.CORRECTION
            self.n_bytes["corrections" if is_correction else "components"] += len(datagram)


def measured(data: Path, name: str, most: int | None) -> dict[str, object]:
    """The row of the table of one recording."""
    scans, robot, true = opened(data, name, most), Robot(), []
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
        "seconds of a pose": f"{statistics.mean(pose):.2f}",
        "of a search (mean, largest)": f"{statistics.mean(searched):.2f}, {max(searched):.2f}",
        "to move and publish the map (largest)": f"{max(move, default=0.0):.2f}",
        "searches and moves, relative to the poses": f"{(sum(search) + sum(move)) / sum(pose):.0%}",
        "components": len(robot.map.components()),
        "sent: components, corrections": ", ".join(f"{n / 1e3:.0f} kB" for n in robot.n_bytes.values()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--names", nargs="+", default=["intel", "hall"])
    parser.add_argument("--most", type=int)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = [measured(options.data, name, options.most) for name in options.names]
    publish("live-loops", f"{markdown(list(rows[0]), [list(row.values()) for row in rows])}\n\n{hardware()}")


if __name__ == "__main__":
    main()
