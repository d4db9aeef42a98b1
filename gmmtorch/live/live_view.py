"""LiveView: a map that grows, its robots and its curves in the browser, drawn by a thread of its own."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from gmmtorch.live import viewer_scene
from gmmtorch.live.map_viewer import MapViewer, Rgb
from gmmtorch.live.viewer_scene import RobotNodes
from gmmtorch.mapping import Components, GaussianMap, MapBuilder, MotionAt, WindowMotions
from gmmtorch.pose import Pose
from gmmtorch.report import colour
from gmmtorch.scan import Scan

_PERIOD = 0.5  # s between two pictures, at least
_SHARE = 0.25  # of the time that the thread draws, at most
_MOST_POINTS = 400  # of a curve
_CURVE_HEIGHT = 120  # pixels

_log = logging.getLogger(__name__)


class ViewedRobot(NamedTuple):
    """A robot as the viewer shows it.

    number: its id. path: (S, 3) its positions so far, world metres; the last one is the present one.
    rotation: (3, 3) world ← camera (x right, y down, z ahead), or world ← sensor without a camera.
    camera: horizontal and vertical field of view, rad. ahead: (A, 3) positions that it will fly to.
    """

    number: int
    path: Tensor
    rotation: Tensor
    camera: tuple[float, float] | None = None
    ahead: Tensor = torch.zeros(0, 3)


class ViewedCells(NamedTuple):
    """Occupied cells: centres (C, 3) and side, metres."""

    centres: Tensor
    side: float


class Moment(NamedTuple):
    """What the viewer shows at a moment; nothing in it may change afterwards.

    shown: the map: components, or occupied cells.
    curves: by title, values by name; each has a value for each entry of `times` (s).
    """

    shown: GaussianMap | ViewedCells
    robots: Sequence[ViewedRobot] = ()
    times: Sequence[float] = ()
    curves: Mapping[str, Mapping[str, Sequence[float]]] = {}


class LiveView:
    """Shows a map that grows in the browser.

        view = LiveView()
        print(view.url)
        for scan in scans:
            built.insert(scan)
            view.offer(lambda: Moment(GaussianMap.of(built.components())))
        view.stop()

    A thread draws. Taking and drawing moments takes at most a quarter of the time. Without a browser nothing
    is drawn, and `offer` does not call its argument. Several browsers see the same. One that goes away stops
    nothing.

    Args:
        host, port, origins: where the page is served, see `MapViewer`.

    Raises `GmmTorchError` if viser is not installed, and `InvalidArgumentError` for a host that is not of
    this machine.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 8080, origins: Sequence[str] = ()) -> None:
        self.viewer = MapViewer(GaussianMap(), host=host, port=port, origins=origins)
        self._robots: dict[int, RobotNodes] = {}
        self._plots: dict[str, Any] = {}
        self._changed = threading.Condition()
        self._waiting: Moment | None = None
        self._is_busy = self._is_stopped = False
        self._begin = self._next = 0.0  # of the last picture, and before the next one, s
        self.n_drawn = 0
        """Pictures drawn so far."""
        self._thread = threading.Thread(target=self._work, name="viewer", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """The address of the page."""
        return self.viewer.url

    def offer(self, take: Callable[[], Moment]) -> None:
        """Shows what `take` returns, if a browser is connected and the last picture is old enough."""
        if self._is_busy or time.monotonic() < self._next or not self.viewer.n_viewers:
            return
        self._begin = time.monotonic()
        self._hand_over(take)

    def finish(self, take: Callable[[], Moment]) -> None:
        """Draws what `take` returns, for browsers to come as well; returns when it is drawn."""
        self._wait()
        self._hand_over(take)
        self._wait()

    def _wait(self) -> None:
        with self._changed:
            self._changed.wait_for(lambda: not self._is_busy)

    def stop(self) -> None:
        """Ends the thread and the server; does nothing the second time."""
        if self._is_stopped:
            return
        with self._changed:
            self._is_stopped = True
            self._changed.notify_all()
        self._thread.join()
        self.viewer.stop()

    def _hand_over(self, take: Callable[[], Moment]) -> None:
        with torch.inference_mode():  # missions run in it, and their tensors must not be changed outside
            moment = take()
        with self._changed:
            self._waiting, self._is_busy = moment, True
            self._changed.notify_all()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting is not None or self._is_stopped)
                moment, self._waiting = self._waiting, None
            if self._is_stopped or moment is None:
                return
            try:
                with torch.inference_mode():
                    self._draw(moment)
                self.n_drawn += 1
            except Exception:  # the map goes on without its picture
                _log.exception("The browser viewer could not draw the map.")
            with self._changed:
                spent = time.monotonic() - self._begin
                self._next = self._begin + max(_PERIOD, spent / _SHARE)
                self._is_busy = False
                self._changed.notify_all()

    def _draw(self, moment: Moment) -> None:
        colours = [robot_colour(robot.number) for robot in moment.robots]
        paths = [robot.path for robot in moment.robots]
        if isinstance(moment.shown, GaussianMap):
            self.viewer.update(moment.shown, paths, colours if len(paths) > 1 else ())
        else:
            self.viewer.update_cells(*moment.shown, paths, colours)
        for robot in moment.robots:
            if len(robot.path):
                self._place(robot)
        for title, series in moment.curves.items():
            self._plot(title, moment.times, series)

    def _place(self, robot: ViewedRobot) -> None:
        if robot.number not in self._robots:
            scene, hue = self.viewer.server.scene, robot_colour(robot.number)
            self._robots[robot.number] = RobotNodes(scene, robot.number, hue, robot.camera)
        shift = self.viewer.shift
        (path,) = viewer_scene.in_space([robot.path[-1:]])
        (ahead,) = viewer_scene.in_space([robot.ahead])
        turned = Pose(robot.rotation.double().cpu(), torch.zeros(len(robot.rotation)).double())
        wxyz = turned.quaternion()[[3, 0, 1, 2]].numpy()
        self._robots[robot.number].place(wxyz, (path[0] - shift).numpy(), (ahead - shift).numpy())

    def _plot(self, title: str, times: Sequence[float], series: Mapping[str, Sequence[float]]) -> None:
        """Draws or extends a plot of curves over time."""
        step = -(-len(times) // _MOST_POINTS)
        rows = [np.asarray(row, np.float64)[::-1][:: max(step, 1)][::-1] for row in (times, *series.values())]
        if len(rows[0]) < 2:
            return
        data = tuple(np.ascontiguousarray(row) for row in rows)
        if title in self._plots:
            self._plots[title].data = data
            return
        from viser import uplot

        lines = [
            uplot.Series(label=name, stroke="rgb({}, {}, {})".format(*robot_colour(k)), width=2)
            for k, name in enumerate(series)
        ]
        gui = self.viewer.server.gui
        self._plots[title] = gui.add_uplot(
            data,
            (uplot.Series(label="s"), *lines),
            title=title,
            height=_CURVE_HEIGHT,
            order=-1.0,  # above the controls
            scales={"x": uplot.Scale(time=False)},
            legend=uplot.Legend(show=len(lines) > 1),
        )


def robot_colour(number: int) -> Rgb:
    """The colour of a robot, RGB, 0 to 255; the same as in pictures."""
    red, green, blue = bytes.fromhex(colour(number).removeprefix("#"))
    return red, green, blue


SIZE, COMPONENTS = "map [kB]", "components"
_MOST_RECORDED = 800  # of a curve that is recorded

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
        if len(self.times) >= _MOST_RECORDED:
            self._period = 2 * (self.times[-1] - self.times[0]) / len(self.times)
            for row in (self.times, *(row for series in self.curves.values() for row in series.values())):
                del row[1::2]

    def copy(self) -> tuple[list[float], dict[str, dict[str, list[float]]]]:
        """The times and the curves as they are now."""
        return list(self.times), deepcopy(self.curves)


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

    def __init__(
        self, builder: MapBuilder[GaussianMap], nbytes: Callable[[], int], shared: TeamMap | None = None
    ) -> None:
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
