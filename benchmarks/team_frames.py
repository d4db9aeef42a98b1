"""Two robots that map two parts of one log, each in a frame of its own, and join one frame; and robots whose
teammate is in another place. Draws docs/images/team_frames.png.

    OMP_NUM_THREADS=1 python benchmarks/team_frames.py --data $GMMTORCH_DATA

A robot's frame begins at its first sensor position, with its heading, upright. The robots exchange all
datagrams every five scans; robot 1 then searches for one scan. When both logs are over, it goes on while
places are left. Errors are those of the places of robot 1's components in the frame of robot 0.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from pages import ROOT
from torch import Tensor

import gmmtorch as gt
from gmmtorch.datasets import Dataset
from gmmtorch.datasets.base import start_frame
from gmmtorch.experiments.harness import Case, Row, recording, run
from gmmtorch.mapping.components import Components
from gmmtorch.report.style import PALETTE, save_figure
from gmmtorch.team.sharing import FrameJoiner, Replica
from gmmtorch.team.sharing.messages.message_registry import kind_of

EVERY = 5  # scans between two exchanges
PARTS = (
    ("freiburg-101", "halves"),
    ("courtyard", "halves"),
    ("hall", "halves"),
    ("hall", "every second scan"),
    ("aces", "halves"),
    ("intel", "halves"),
)
FLAT, DEEP = ("intel", "aces", "freiburg-101"), ("hall", "courtyard", "street")
PLACES = 40  # scans of a foreign log that are searched for


class Robot:
    """One of two robots with its part of a log."""

    def __init__(self, number: int, scans: Dataset, part: Sequence[int]) -> None:
        self.replica = Replica(number, incarnation=number, own_frame=True)
        self.map = gt.GaussianMap(gt.IncrementalRule(), robot=number)
        self.frame = start_frame(scans, part[0])
        self.joiner = FrameJoiner(self.replica)
        self.scans, self.part, self.n_read = scans, part, 0
        self.sent = {"all": 0, "frames": 0}

    @property
    def is_over(self) -> bool:
        return self.n_read == len(self.part)

    def read(self, n: int) -> None:
        """Maps the next scans, and publishes the components of full windows."""
        for number in self.part[self.n_read : self.n_read + n]:
            scan = self.scans[number].transformed(torch.linalg.inv(self.frame))
            self.map.insert(scan)
            self.joiner.add(scan)
            self.n_read += 1
        if self.is_over:
            self.map.finish()
        if self.is_over or not self.map.n_pending:
            self.replica.publish(self.map.components(), whole=False)

    def send(self, other: Robot) -> None:
        for datagram in self.replica.datagrams():
            self.sent["all"] += len(datagram)
            self.sent["frames"] += len(datagram) * (kind_of(datagram) == "frames")
            other.replica.receive(datagram)


def joined(scans: Dataset, split: str) -> tuple[Robot, Robot, str, float]:
    """Both robots, the scan of robot 1 at which it first joined, and the seconds of a search."""
    n = len(scans)
    parts = [range(n // 2), range(n // 2, n)] if split == "halves" else [range(0, n, 2), range(1, n, 2)]
    one, two = (Robot(number, scans, part) for number, part in enumerate(parts))
    seconds, when = 0.0, "never"
    while not (one.is_over and two.is_over):
        for robot, other in ((one, two), (two, one)):
            robot.read(EVERY)
            robot.send(other)
        begin = time.process_time()
        if two.joiner.search() and when == "never":
            when = f"{two.n_read} of {len(two.part)}"
        seconds += time.process_time() - begin
    before, begin = -1, time.process_time()
    while two.joiner.n_searches > before:
        before = two.joiner.n_searches
        if two.joiner.search() and when == "never":
            when = "afterwards"
    seconds += time.process_time() - begin
    two.send(one)
    return one, two, when, seconds / max(1, two.joiner.n_searches)


def row(name: str, split: str, one: Robot, two: Robot, when: str, seconds: float) -> Row:
    places, transform = two.map.components().means, two.replica.placement.transform
    errors = ["–", "–", "–"]
    if transform is not None:
        error = torch.linalg.inv(two.frame) @ one.frame @ transform
        dim = len(error) - 1
        off = (places @ error[:dim, :dim].T + error[:dim, dim] - places).norm(dim=1)
        angle = torch.linalg.matrix_norm(error[:dim, :dim] - torch.eye(dim)) / math.sqrt(2)
        metres = (float(each) for each in (off.square().mean().sqrt(), off.max()))
        errors = [*(f"{each:.3f}" for each in metres), f"{math.degrees(float(angle)):.2f}"]
    located = f"{two.joiner.n_located} of {two.joiner.n_searches}"
    n_bytes = (one.sent[kind] + two.sent[kind] for kind in ("all", "frames"))
    return name, split, when, located, *errors, *n_bytes, seconds


def foreign(source: Dataset, target: Dataset) -> tuple[int, int, int]:
    """Scans of one place in the map of another: searched for, located, and frames joined."""
    theirs = Robot(0, target, range(len(target)))
    theirs.read(len(target))
    ours = Robot(1, source, range(len(source)))
    theirs.send(ours)
    step = max(1, len(source) // PLACES)
    n_joined = 0
    for number in range(0, len(source), step):
        ours.joiner.add(source[number])
        n_joined += ours.joiner.search()
    return ours.joiner.n_searches, ours.joiner.n_located, n_joined


def picture(one: Robot, two: Robot, file: Path) -> None:
    """Both maps in their own frames, laid over each other as they are, and after joining."""
    import matplotlib.pyplot as plt

    own = [one.map.components(), two.map.components()]
    shared = one.replica.components()
    after = [shared.selected((shared.ids[:, 0] == number).nonzero().squeeze(1)) for number in (0, 1)]
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2))
    for axis, maps, title in zip(
        axes, (own, after), ("each in its own frame", "robot 1 joined the frame of robot 0"), strict=True
    ):
        for number, m in enumerate(maps):
            axis.plot(*drawn(m).T, ",", color=PALETTE[number], alpha=0.6)
            axis.plot([], [], "s", color=PALETTE[number], label=f"robot {number}")
        axis.set_aspect("equal")
        axis.set_title(title)
        axis.set_xlabel("x (m)")
        axis.set_ylabel("y (m)")
    axes[0].legend(loc="best")
    save_figure(figure, file)


def drawn(components: Components) -> Tensor:
    """Points (N, 2) of the surfaces."""
    solid = components.selected((~components.max_range).nonzero().squeeze(1))
    draw = torch.Generator().manual_seed(0)
    noise = torch.randn(len(solid), 12, 2, 1, generator=draw, dtype=torch.float64)
    roots = torch.linalg.cholesky(solid.covariances)[:, None]
    return (solid.means[:, None, :, None] + roots @ noise).reshape(-1, 2)


def own_places(options: Any) -> Iterator[Row]:
    for name, split in PARTS:
        if name not in options.names:
            continue
        outcome = joined(recording(options.data, name), split)
        if name == "freiburg-101":
            picture(*outcome[:2], options.figure)
        yield row(name, split, *outcome)


def other_places(options: Any) -> Iterator[Row]:
    for names in (DEEP, FLAT):
        logs = {name: recording(options.data, name) for name in names}
        for source, target in itertools.permutations(names, 2):
            yield f"{source} in {target}", *foreign(logs[source], logs[target])


CASES = (
    Case(
        "team-frames",
        own_places,
        "Errors are those of the places of robot 1's components in the frame of robot 0. Bytes are those of "
        "both robots.",
        {
            **dict.fromkeys(("log", "parts", "joined at scan", "scans located"), ""),
            **dict.fromkeys(("error (m)", "at most (m)", "turn (°)"), ""),
            "bytes": ",.0f",
            "of frames": ".0f",
            "CPU s a search": ".2f",
        },
        tuple(dict.fromkeys(name for name, _ in PARTS)),
        key=2,
    ),
    Case(
        "foreign-frames",
        other_places,
        "About forty scans of one log are searched for in the whole map of another.",
        {
            "scans of … in the map of …": "",
            **dict.fromkeys(("searched", "located", "frames joined"), ".0f"),
        },
    ),
)

if __name__ == "__main__":
    run(__doc__, *CASES, figure={"type": Path, "default": ROOT / "docs/images/team_frames.png"})
