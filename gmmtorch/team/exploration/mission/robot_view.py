"""What a mission, or the process of one robot, shows: status, scalars, rows, files and the live view."""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gmmtorch.files import write_npz
from gmmtorch.live import COMPONENTS, CurveRecord, Curves, Moment, ViewedCells, ViewedRobot, seen_paths
from gmmtorch.mapping import GaussianMap
from gmmtorch.simulation import DepthCamera
from gmmtorch.team.exploration.mission.mission import Mission
from gmmtorch.team.exploration.mission.replay import ReplayMission
from gmmtorch.team.exploration.robot.agent import Agent
from gmmtorch.team.exploration.robot.mapper import GmmMapper, Mapper
from gmmtorch.team.exploration.world.scoring import BeliefMap
from gmmtorch.team.sharing import FramedTransport, Network, PlanMessage, Replica

Files = Mapping[str, tuple[str, Callable[[Path], object]]]
"""By name: the file name, and what writes the file to a path."""


class FlyingRobotView:
    """The robot of a `Mission` without simulated network. `status` is one short line for a terminal,
    `scalars` are numbers for a plot over time, `row` is the row of results.json, and `files` are the robot's
    map and what else it made."""

    def __init__(self, mission: Mission, transport: FramedTransport) -> None:
        (self._agent,) = mission.agents
        self._mission, self._transport = mission, transport
        self._shared = self._agent.robot.mapper.shared
        self.robot = self._agent.number

    def check_id(self) -> None:
        """Raises `GmmTorchError` if another robot uses this robot's id."""
        self._agent.radio.check_id(self._n_conflicts)

    @property
    def _n_conflicts(self) -> int:
        return self._shared.duplicates[self.robot] if isinstance(self._shared, Replica) else 0

    def status(self) -> str:
        belief = self._agent.robot.mapper.belief
        left = belief.entropy_bits / max(1.0, belief.observable_bits)
        return (
            f"{left:.1%} of the entropy left, {self._shared.held.size:,} records, "
            f"{self._transport.traffic().bytes / 1e3:,.0f} kB sent"
            f"{self._agent.radio.warnings(self._n_conflicts)}"
        )

    def scalars(self) -> dict[str, float]:
        robot = self._agent.robot
        books = self._transport.books(self.robot)
        return {
            "entropy_bits": robot.mapper.belief.entropy_bits,
            "records": float(self._shared.held.size),
            "bytes_sent": float(books["bytes_sent"]),
            "wire_bytes_sent": float(books["wire_bytes"]),
            "datagrams_sent": float(books["datagrams"]),
            "datagrams_heard": float(self._agent.radio.n_received),
            "refused": float(sum(books["refused"].values())),
            "path_length": robot.path_length,
            "collisions": float(robot.collisions),
        }

    def row(self) -> dict[str, Any]:
        robot, shared = self._agent.robot, self._shared
        belief, components = robot.mapper.belief, robot.mapper.components()
        return {
            "robot": self.robot,
            "digest": shared.digest().hex(),
            "views_digest": robot.library.digest().hex(),
            "incarnation": shared.incarnation if isinstance(shared, Replica) else None,
            "entropy_bits_left": belief.entropy_bits,
            "observable_bits": belief.observable_bits,
            "n_components": None if components is None else len(components),
            "n_records": shared.held.size,
            **self._agent.radio.row(),
            "not_merged": dict(Counter(self._agent.refused) + Counter(shared.refused)),
            "path_length": robot.path_length,
            "collisions": robot.collisions,
            "stage_seconds": dict(self._mission.watch.seconds),
        }

    def files(self) -> Files:
        poses = torch.stack(self._mission.trajectories[0]).numpy()
        mapper = self._agent.robot.mapper
        files: dict[str, tuple[str, Callable[[Path], object]]] = {
            "trajectory": ("trajectory.npz", functools.partial(write_npz, poses=poses))
        }
        if isinstance(mapper, GmmMapper) and len(components := mapper.components()):
            made = GaussianMap.of(components, robot=self.robot)
            files["map"] = f"map{made.suffix}", made.save
        return files


class ReplayingRobotView:
    """The robot of a `ReplayMission`; see `FlyingRobotView`."""

    def __init__(self, mission: ReplayMission, transport: FramedTransport | Network) -> None:
        self._mission, self._transport = mission, transport
        self._replica = mission.replica
        self.robot = self._replica.robot

    def check_id(self) -> None:
        self._mission.shared.radio.check_id(self._replica.duplicates[self.robot])

    def status(self) -> str:
        n_scans, replica = self._mission.n_scans, self._replica
        total = "?" if n_scans is None else f"{n_scans:,}"
        return (
            f"scan {self._mission.position:,}/{total}, {replica.n_components:,} components, "
            f"{replica.missing.size:,} missing, "
            f"{self._transport.traffic(self.robot).bytes / 1e3:,.0f} kB sent"
            f"{self._mission.shared.radio.warnings(replica.duplicates[self.robot])}"
        )

    def scalars(self) -> dict[str, float]:
        replica, books = self._replica, self._transport.books(self.robot)
        return {
            "scans": float(self._mission.position),
            "components": float(replica.n_components),
            "records": float(replica.held.size),
            "missing": float(replica.missing.size),
            "bytes_sent": float(books["bytes_sent"]),
            "datagrams_sent": float(books["datagrams"]),
            "datagrams_heard": float(self._mission.shared.radio.n_received),
            "wire_bytes_sent": float(books["wire_bytes"]),
            "wire_bytes_received": float(books["wire_bytes_received"]),
            "refused": float(sum(books["refused"].values()) + sum(replica.refused.values())),
        }

    def row(self) -> dict[str, Any]:
        mission = self._mission
        return {
            "scans": mission.position,
            "n_scans": mission.n_scans,
            "resumed_at": mission.resumed_at,
            "unread": mission.n_unread,
            **mission.shared.row(),
            "stage_seconds": mission.watch.seconds,
        }

    def files(self) -> Files:
        """The team's map as this robot holds it, and the robot's own map."""
        maps = {"map": self._replica.map(codec="quantized"), "own_map": self._mission.map}
        return {name: (f"{name}{made.suffix}", made.save) for name, made in maps.items() if made.n_components}


RobotView = FlyingRobotView | ReplayingRobotView


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
        n_steps = round((now - self._agent.heard_at[plan.sender]) / plan.step)
        row = min(max(n_steps - 1, 0), len(plan.path) - 1)  # pose k is that after k + 1 steps
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
