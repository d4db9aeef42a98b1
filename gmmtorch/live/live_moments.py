"""What the live viewer shows of a map that is built."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import torch

from gmmtorch.live.live_view import Moment, ViewedRobot
from gmmtorch.mapping import Components, GaussianMap, MapBuilder, MotionAt, WindowMotions
from gmmtorch.scan import Scan

SIZE, COMPONENTS = "map [kB]", "components"
_MOST_POINTS = 800  # of a curve that is recorded

Curves = Mapping[str, Mapping[str, float]]
"""By title, values by name."""


class CurveRecord:
    """Curves over time with at most 800 points: when they are full, every second point is dropped.

    Attributes:
        times: seconds. curves: by title, values by name; each has a value for each time.
    """

    def __init__(self) -> None:
        self.times: list[float] = []
        self.curves: dict[str, dict[str, list[float]]] = {}
        self._period = 0.0

    def add(self, time: float, read: Callable[[], Curves]) -> None:
        """Adds the values that `read` returns at a time (s), unless the last ones are recent."""
        if self.times and time < self.times[-1] + self._period:
            return
        self.times.append(time)
        for title, values in read().items():
            for name, value in values.items():
                self.curves.setdefault(title, {}).setdefault(name, []).append(value)
        if len(self.times) >= _MOST_POINTS:
            self._period = 2 * (self.times[-1] - self.times[0]) / len(self.times)
            for row in (self.times, *(row for series in self.curves.values() for row in series.values())):
                del row[1::2]

    def copy(self) -> tuple[list[float], dict[str, dict[str, list[float]]]]:
        """The times and the curves as they are now."""
        return list(self.times), {
            title: {name: list(values) for name, values in series.items()}
            for title, series in self.curves.items()
        }


class TeamMap(Protocol):
    """A robot's map as a part of its team's map."""

    @property
    def robot(self) -> int:
        """Number of the robot."""

    def add(self, scan: Scan) -> None:
        """Remembers a scan that the robot has mapped."""

    def publish(self, own: GaussianMap, windows: WindowMotions) -> None:
        """Makes what the team knows of the robot's map that map."""

    def correct(self, motion_at: MotionAt) -> None:
        """Moves the scans that are remembered."""

    def exchange(self, now: float) -> None:
        """Listens, answers and announces."""

    def search(self, now: float) -> None:
        """Searches for the robot's place in a teammate's map, if it is time."""

    def content(self) -> int:
        """Changes whenever the team's map gets new parts."""

    def map(self, own: GaussianMap, codec: str = "float") -> GaussianMap:
        """The map of the team, in the frame of this robot."""


class BuildMoments:
    """The moments of a map that a `MapBuilder` builds.

    nbytes: the bytes of the map as they were measured last. shared: the robot's map in that of its team,
    which is shown; None: it is not shared.
    """

    def __init__(self, builder: MapBuilder, nbytes: Callable[[], int], shared: TeamMap | None = None) -> None:
        self._builder, self._nbytes, self._shared = builder, nbytes, shared
        self._record = CurveRecord()

    def note(self) -> None:
        """Adds to the curves; called after each scan."""
        builder = self._builder
        self._record.add(
            builder.record.seconds,
            lambda: {
                COMPONENTS: {COMPONENTS: float(builder.map.n_final if builder.map.dim else 0)},
                SIZE: {SIZE: self._nbytes() / 1e3},
            },
        )

    def __call__(self) -> Moment:
        """The map of all scans of finished windows; the others are learned if there are some."""
        built, poses = self._builder.map, self._builder.poses
        if built.dim is None:
            return Moment(GaussianMap(), (), *self._record.copy())
        shown, number = built.snapshot() if self._shared is None else self._shared.map(built), 0
        teammates: list[ViewedRobot] = []
        if self._shared is not None:
            number = self._shared.robot
            teammates = [robot for robot in seen_paths(shown.components()) if robot.number != number]
        own = ViewedRobot(number, poses[:, :-1, -1], poses[-1, :-1, :-1])
        return Moment(shown, [own, *teammates], *self._record.copy())


def seen_paths(components: Components) -> list[ViewedRobot]:
    """The robots that learned components, with the places from which these were first seen, in order."""
    order = torch.argsort(components.ids[:, 1], stable=True)
    first = torch.full((len(components),), -1, dtype=torch.int64, device=components.means.device)
    first[components.seen_by.flip(0)] = components.seen_from.flip(0)
    found = []
    for robot in components.ids[:, 0].unique().tolist():
        rows = order[(components.ids[order, 0] == robot) & (first[order] >= 0)]
        origins = components.origins[torch.unique_consecutive(first[rows])].cpu()
        found.append(ViewedRobot(robot, origins, torch.eye(components.dim)))
    return found
