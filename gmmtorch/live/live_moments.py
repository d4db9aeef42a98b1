"""What the live viewer shows of a map that is built, of a mission, and of one robot of a team."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from gmmtorch.exploration.mission.mission import Mission
from gmmtorch.exploration.mission.replay import ReplayMission
from gmmtorch.exploration.robot.agent import Agent
from gmmtorch.exploration.robot.mapper import Mapper
from gmmtorch.exploration.world.scoring import BeliefMap
from gmmtorch.live.live_view import Moment, ViewedCells, ViewedRobot
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.map_builder import MapBuilder
from gmmtorch.sharing.messages.message_registry import PlanMessage
from gmmtorch.sharing.shared_map import SharedMap
from gmmtorch.simulation.sensors.depth_camera import DepthCamera

ENTROPY, SENT, RECEIVED = "entropy left [%]", "sent [kB]", "received [kB]"
SIZE, COMPONENTS = "map [kB]", "components"
_MOST_POINTS = 800  # of a curve that is recorded
_STANDING = 0.05  # m: shorter motions do not lengthen a path

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


class BuildMoments:
    """The moments of a map that a `MapBuilder` builds.

    nbytes: the bytes of the map as they were measured last. shared: the robot's map in that of its team,
    which is shown; None: it is not shared.
    """

    def __init__(
        self, builder: MapBuilder, nbytes: Callable[[], int], shared: SharedMap | None = None
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
            number = self._shared.replica.robot
            teammates = [robot for robot in seen_paths(shown.components()) if robot.number != number]
        own = ViewedRobot(number, poses[:, :-1, -1], poses[-1, :-1, :-1])
        return Moment(shown, [own, *teammates], *self._record.copy())


class MissionMoments:
    """The moments of a scored mission: the first robot's mixture, or the occupied cells of the team."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self._record = CurveRecord()

    def note(self) -> None:
        """Adds the newest values of the score; called after each sample."""
        samples, score = self._mission.score.samples, self._mission.score
        share = 100 / max(1.0, score.union.observable_bits)
        per_robot = enumerate(samples["entropy_bits_per_robot"])
        self._record.add(
            samples["times"][-1],
            lambda: {
                ENTROPY: {
                    **{f"robot {number}": share * curve[-1] for number, curve in per_robot},
                    "team": share * samples["entropy_bits"][-1],
                },
                SENT: {"components": samples["bytes_over_time"][-1] / 1e3},
            },
        )

    def __call__(self) -> Moment:
        """The present moment of the mission."""
        mission, options = self._mission, self._mission.options
        begin = mission.n_ticks % options.ticks_per_plan * options.steps_per_tick
        robots = [
            _flown(
                robot.number,
                trajectory,
                options.camera,
                torch.cat([robot.position[None], robot.path[begin:, :3]]),
            )
            for robot, trajectory in zip(mission.robots, mission.trajectories, strict=True)
        ]
        shown = _shown(mission.robots[0].mapper, mission.score.union)
        return Moment(shown, robots, *self._record.copy())


class AgentMoments:
    """The moments of one robot of a team: its map, itself, and its teammates by their messages.

    trajectory: poses (4,) of the robot, to which its mission appends; None: it is only a listener.
    traffic: kilobytes by title of the curve.
    """

    def __init__(
        self, agent: Agent, trajectory: list[Tensor] | None, traffic: Callable[[], tuple[str, float]]
    ) -> None:
        self._agent, self._trajectory, self._traffic = agent, trajectory, traffic
        self._record = CurveRecord()
        self._flown: dict[int, list[Tensor]] = {}

    def note(self, now: float) -> None:
        """Adds to the curves and to the teammates' paths at the robot's time (s)."""
        self._record.add(now, self._curves)
        for number, plan in self._agent.robot.plans.items():
            place, _ = self._flight(plan, now)
            flown = self._flown.setdefault(number, [place])
            if float((place[:3] - flown[-1][:3]).norm()) > _STANDING:
                flown.append(place)

    def _curves(self) -> Curves:
        belief = self._agent.robot.mapper.belief
        title, kilobytes = self._traffic()
        share = 100 * belief.entropy_bits / max(1.0, belief.observable_bits)
        return {ENTROPY: {"map": share}, title: {"robot": kilobytes}}

    def _flight(self, plan: PlanMessage, now: float) -> tuple[Tensor, Tensor]:
        """The pose (4,) of a teammate that flies a plan, and the positions (A, 3) ahead of it."""
        step = int((now - self._agent.heard_at[plan.sender]) / plan.step)
        row = min(max(step, 0), len(plan.path) - 1)
        return plan.path[row].double(), plan.path[row:, :3].double()

    def __call__(self, now: float) -> Moment:
        """The moment at the robot's time (s)."""
        agent, camera, robots = self._agent, self._agent.options.camera, []
        if self._trajectory is not None:
            robots.append(_flown(agent.number, self._trajectory, camera, torch.zeros(0, 3)))
        for number, flown in sorted(self._flown.items()):
            pose, ahead = self._flight(agent.robot.plans[number], now)
            robots.append(_flown(number, [*flown, pose], camera, ahead))
        return Moment(_shown(agent.robot.mapper, agent.robot.mapper.belief), robots, *self._record.copy())


class ReplayMoments:
    """The moments of a robot that replays a log: the team's map, and the robots where their newest
    components were seen from."""

    def __init__(self, mission: ReplayMission, traffic: Callable[[], tuple[str, float]]) -> None:
        self._mission, self._traffic = mission, traffic
        self._record = CurveRecord()

    def note(self, now: float) -> None:
        """Adds to the curves at the robot's time (s)."""
        self._record.add(now, self._curves)

    def _curves(self) -> Curves:
        title, kilobytes = self._traffic()
        return {
            COMPONENTS: {COMPONENTS: float(self._mission.replica.n_components)},
            title: {"robot": kilobytes},
        }

    def __call__(self, now: float) -> Moment:
        """The moment at the robot's time (s)."""
        replica, own = self._mission.replica, self._mission.map
        if not replica.n_components:
            return Moment(GaussianMap(), (), *self._record.copy())
        shown = own.snapshot(replica.components(), calibration=replica.calibration)
        return Moment(shown, seen_paths(shown.components()), *self._record.copy())


def _shown(mapper: Mapper, belief: BeliefMap) -> GaussianMap | ViewedCells:
    """The mixture of a mapper, or the occupied cells of an evaluation if it has none."""
    components, resolution = mapper.components(), belief.grid.resolution
    if components is not None:
        if not len(components):
            return GaussianMap()
        return GaussianMap.of(components, resolution=resolution)
    stored = belief.grid.cells()
    occupied = belief.rule.probability(stored.hits, stored.misses) > belief.rule.occupied
    return ViewedCells((stored.cells[occupied].double().cpu() + 0.5) * resolution, resolution)


def _flown(number: int, poses: Sequence[Tensor], camera: DepthCamera, ahead: Tensor) -> ViewedRobot:
    """A robot with a level camera after poses (4,): x, y, z, yaw. ahead (A, 3): where it flies."""
    fov = camera.horizontal_fov, camera.vertical_fov
    path, yaw = torch.stack(list(poses))[:, :3], float(poses[-1][3])
    return ViewedRobot(number, path, camera_rotation(yaw), fov, ahead)


def camera_rotation(yaw: float) -> Tensor:
    """Rotation (3, 3), world ← camera (x right, y down, z ahead), of a level camera with this yaw (rad)."""
    ahead = [math.cos(yaw), math.sin(yaw), 0.0]
    right = [math.sin(yaw), -math.cos(yaw), 0.0]
    return torch.tensor([right, [0.0, 0.0, -1.0], ahead], dtype=torch.float64).T


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
