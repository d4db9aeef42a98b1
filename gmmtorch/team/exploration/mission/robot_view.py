"""What the process of one robot reports: a status line, scalars, a row of results, and files."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from gmmtorch.errors import GmmTorchError
from gmmtorch.files import write_npz
from gmmtorch.mapping import GaussianMap
from gmmtorch.team.exploration.mission.mission import Mission
from gmmtorch.team.exploration.mission.replay import ReplayMission
from gmmtorch.team.exploration.robot.gmm_mapper import GmmMapper
from gmmtorch.team.sharing import FramedTransport, Network, Radio, Replica, SharedMap, robot_of_frame

Files = Mapping[str, tuple[str, Callable[[Path], object]]]
"""By name: the file name, and what writes the file to a path."""


class DuplicateIdError(GmmTorchError):
    """Another robot uses this robot's id."""


class FlyingRobotView:
    """The robot of a `Mission` without simulated network.

    `status` is one short line for a terminal, `scalars` are numbers for a plot over time, `row` is the row
    of results.json, and `files` are the robot's map and what else it made.
    """

    def __init__(self, mission: Mission, transport: FramedTransport) -> None:
        (self._agent,) = mission.agents
        self._mission, self._transport = mission, transport
        self._shared = self._agent.robot.mapper.shared
        self.robot = self._agent.number

    def check_id(self) -> None:
        """Raises `DuplicateIdError` if another robot uses this robot's id."""
        _check_id(self._agent.radio, self._n_conflicts)

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
            **self._transport.books(self.robot),
            **_reception(self._agent.radio),
            "not_merged": dict(Counter(self._agent.refused) + Counter(shared.refused)),
            "path_length": robot.path_length,
            "collisions": robot.collisions,
            "unkept": _n_unkept(self._agent.radio),
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
        _check_id(self._mission.shared.radio, self._replica.duplicates[self.robot])

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
            **sharing_row(mission.shared),
            "stage_seconds": mission.watch.seconds,
        }

    def files(self) -> Files:
        """The team's map as this robot holds it, and the robot's own map."""
        maps = {"map": self._replica.map(codec="quantized"), "own_map": self._mission.map}
        return {name: (f"{name}{made.suffix}", made.save) for name, made in maps.items() if made.n_components}


RobotView = FlyingRobotView | ReplayingRobotView


def sharing_row(shared: SharedMap) -> dict[str, Any]:
    """What a robot shared with its team, as a part of a row of results.json."""
    replica = shared.replica
    return {
        "robot": replica.robot,
        "digest": replica.digest().hex(),
        "incarnation": replica.incarnation,
        "frame": _placement(replica),
        "n_components": replica.n_components,
        "n_records": replica.held.size,
        "missing": replica.missing.size,
        **shared.radio.transport.books(replica.robot),
        **_reception(shared.radio),
        "not_merged": dict(replica.refused),
        "conflicts": {str(robot): n for robot, n in sorted(replica.duplicates.items()) if n},
        "unkept": _n_unkept(shared.radio),
    }


def _placement(replica: Replica) -> dict[str, Any]:
    """The robot in whose frame the map is (None: the world), and the pose of this robot's frame in it."""
    root, transform = replica.placement
    robot = robot_of_frame(root)
    return {
        "of_robot": None if robot < 0 else robot,
        "transform": None if transform is None else transform.tolist(),
    }


def _check_id(radio: Radio, n_conflicts: int) -> None:
    if (message := radio.duplicate_id(n_conflicts)) is not None:
        raise DuplicateIdError(message)


def _reception(radio: Radio) -> dict[str, int]:
    return {"heard": radio.n_received, "damaged": radio.n_damaged}


def _n_unkept(radio: Radio) -> int:
    """Batches of records that the store could not keep."""
    return 0 if radio.store is None else radio.store.n_failed
