"""The evaluator of a simulated team: the union of all robots' evidence, and curves over time."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from typing import Any

import torch

from gmmtorch.evaluation.codecs.point_codecs import bytes_of_points
from gmmtorch.exploration.mission.options import TeamOptions
from gmmtorch.exploration.robot.agent import Agent
from gmmtorch.exploration.robot.mapper import FrameUpdate
from gmmtorch.exploration.robot.robot_state import Robot
from gmmtorch.exploration.world.scoring import BeliefMap
from gmmtorch.exploration.world.world import World
from gmmtorch.occupancy.voxels.boxes import flat_index
from gmmtorch.occupancy.voxels.ray_casting import cast_evidence
from gmmtorch.sharing.transport.simulated_network import Network
from gmmtorch.simulation.sensors.depth_camera import DepthFrame

_SEEN_STRIDE = 4
"""Pixels between the beams, along rows and columns, that mark cells as seen."""


class MissionScore:
    """Measures a team in a simulated world; the robots never read it.

    Attributes:
        union: map of the evidence of all robots' own frames.
        seen_by: (number of cells,) for each cell of the world's box, a bit for each robot that saw it.
        samples: curves by name, with a value for each entry of "times" (s).
    """

    def __init__(self, world: World, agents: Sequence[Agent], network: Network, options: TeamOptions) -> None:
        self.union = BeliefMap(world.resolution, world.box, world.observable, options.belief)
        bits = torch.int16 if len(agents) < 16 else torch.int32
        self.seen_by = torch.zeros(world.observable.numel(), dtype=bits)
        self.samples: dict[str, list[Any]] = {
            "times": [],
            "entropy_bits": [],
            "entropy_bits_per_robot": [[] for _ in agents],
            "bytes_over_time": [],
            "wire_bytes_over_time": [],
            "missing_share": [],
            "raw_points_bytes_over_time": [],
            **{f"{name}_bytes_over_time": [] for name in options.codecs},
        }
        self._world, self._network, self._options = world, network, options
        self._robots = [agent.robot for agent in agents]
        self._encoded_bytes = dict.fromkeys(("raw_points", *options.codecs), 0)
        self.sample(0.0)

    def note(self, robot: Robot, frame: DepthFrame, update: FrameUpdate) -> None:
        """Adds a frame of a robot, and what its map made of it."""
        for evidence in update.evidence:
            self.union.add(evidence)
        self._note_seen(robot, frame)
        self._encoded_bytes["raw_points"] += 12 * int(update.novel.sum())
        for name, size in self._sizes(frame, update).items():
            self._encoded_bytes[name] += size

    def sample(self, now: float) -> None:
        """Appends the present values to the curves, at the time `now` (s)."""
        s = self.samples
        s["times"].append(now)
        s["entropy_bits"].append(self.union.entropy_bits)
        for curve, robot in zip(s["entropy_bits_per_robot"], self._robots, strict=True):
            curve.append(robot.mapper.belief.entropy_bits)
        s["bytes_over_time"].append(self._network.n_bytes)
        s["wire_bytes_over_time"].append(self._network.n_wire_bytes)
        s["missing_share"].append(self._missing_share())
        for name, size in self._encoded_bytes.items():
            s[f"{name}_bytes_over_time"].append(size)

    def _sizes(self, frame: DepthFrame, update: FrameUpdate) -> dict[str, int]:
        """Bytes of the novel beams in each compared codec: of returns, and of the ends of no-return beams."""
        sizes = dict.fromkeys(self._options.codecs, 0)
        for kind in (frame.is_hit, ~frame.is_hit):
            ends = frame.ends[update.novel & kind]
            if sizes and len(ends):
                encoded = bytes_of_points(
                    ends, self._world.resolution, self._options.frame.noise, names=tuple(sizes)
                )
                for name, size in encoded.items():
                    sizes[name] += size
        return sizes

    def _note_seen(self, robot: Robot, frame: DepthFrame) -> None:
        """Marks the cells that the beams of every few pixels cross, independently of the robot's map."""
        width, world = self._options.camera.width, self._world
        row, column = frame.pixel // width, frame.pixel % width
        some = (row % _SEEN_STRIDE == 0) & (column % _SEEN_STRIDE == 0)
        seen = cast_evidence(frame.origin, frame.ends[some], frame.is_hit[some], world.resolution, world.box)
        flat, _ = flat_index(seen.cells - world.box.low, world.box.shape)
        self.seen_by[flat] |= 1 << robot.number

    def _missing_share(self) -> float:
        """Of the records that any robot holds, the largest share that one robot lacks."""
        held = [robot.mapper.shared.held for robot in self._robots]
        everything = functools.reduce(operator.or_, held)
        lacking = max((everything - one).size for one in held)
        return lacking / everything.size if everything else 0.0
