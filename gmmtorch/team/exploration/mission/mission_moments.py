"""What the live viewer shows of a mission, and of one robot of a team."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from gmmtorch.live import COMPONENTS, CurveRecord, Curves, Moment, ViewedCells, ViewedRobot, seen_paths
from gmmtorch.mapping import GaussianMap
from gmmtorch.simulation import DepthCamera
from gmmtorch.team.exploration.mission.mission import Mission
from gmmtorch.team.exploration.mission.replay import ReplayMission
from gmmtorch.team.exploration.robot.agent import Agent
from gmmtorch.team.exploration.robot.mapper import Mapper
from gmmtorch.team.exploration.world.scoring import BeliefMap
from gmmtorch.team.sharing import PlanMessage

ENTROPY, SENT, RECEIVED = "entropy left [%]", "sent [kB]", "received [kB]"
_STANDING = 0.05  # m: shorter motions do not lengthen a path


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
