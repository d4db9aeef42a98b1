"""Mission: a team explores a simulated world, tick by tick, and is scored as it goes."""

from __future__ import annotations

import functools
import math
import operator
from typing import Any

import torch
from torch import Tensor

from gmmtorch.evaluation.codecs.point_codecs import bytes_of_points
from gmmtorch.exploration.mission.options import TeamOptions
from gmmtorch.exploration.mission.stopwatch import Stopwatch
from gmmtorch.exploration.planning.coordination import Coordination
from gmmtorch.exploration.planning.planning_round import take_turns
from gmmtorch.exploration.robot.agent import Agent
from gmmtorch.exploration.robot.mapper import FrameUpdate
from gmmtorch.exploration.robot.robot_state import Robot
from gmmtorch.exploration.world.collisions import collides, finely, meets_others
from gmmtorch.exploration.world.scoring import BeliefMap
from gmmtorch.exploration.world.world import World
from gmmtorch.occupancy.voxels.boxes import flat_index
from gmmtorch.occupancy.voxels.ray_casting import cast_evidence
from gmmtorch.sharing.transport.simulated_network import Network
from gmmtorch.simulation.sensors.depth_camera import DepthFrame

_SEEN_STRIDE = 4  # pixels


class Mission:
    """Simulated time passes in ticks of one frame; every robot senses in each, and plans every few.

    Robots hear what the network brings, and one another's committed paths, which a short-range beacon
    would tell them; nothing else passes between them. The evaluator's maps are the robots' own evidence
    (`union`) and what each robot holds (`Robot.mapper.belief`).

    Args:
        agents: by number. union: new. watch: the one that times the agents' stages.
    """

    def __init__(
        self,
        world: World,
        agents: list[Agent],
        union: BeliefMap,
        network: Network,
        coordination: Coordination,
        options: TeamOptions,
        watch: Stopwatch,
    ) -> None:
        self.world, self.agents, self.union, self.network = world, agents, union, network
        self.options, self.watch = options, watch
        self.tick = 0
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
        self.trajectories: list[list[Tensor]] = [[robot.state[:4].clone()] for robot in self.robots]
        # A bit for each robot that saw a cell.
        bits = torch.int16 if len(agents) < 16 else torch.int32
        self.seen_by = torch.zeros(world.observable.numel(), dtype=bits)
        self.coordination = coordination.name
        self._coordination = coordination
        self._generator = torch.Generator().manual_seed(options.seed)
        self._raw = dict.fromkeys(("raw_points", *options.codecs), 0)
        self._sample()

    @property
    def robots(self) -> list[Robot]:
        return [agent.robot for agent in self.agents]

    @property
    def stages(self) -> dict[str, float]:
        """Wall seconds by stage, of all robots together."""
        return self.watch.seconds

    # -- time -------------------------------------------------------------------------------------

    @property
    def now(self) -> float:
        """Simulated seconds since the start."""
        return self.tick * self.options.tick_seconds

    @property
    def is_over(self) -> bool:
        return self.now >= self.options.duration - 1e-9

    @property
    def sampled_now(self) -> bool:
        """Whether the last step ended with numbers noted."""
        return self.tick % self.options.ticks_per_sample == 0 or self.is_over

    def step(self) -> None:
        """One tick: sense, exchange, plan if it is due, fly on."""
        with torch.inference_mode():  # a sixth of the time of small operations is book-keeping for gradients
            self.network.place(torch.stack([robot.position for robot in self.robots]))
            for agent in self.agents:
                self._sense(agent)
            self._listen()
            if self.tick % self.options.ticks_per_plan == 0:
                number = self.tick // self.options.ticks_per_plan
                take_turns(self.agents, self._coordination, self.options, self.now, number, self._generator)
            self._fly()
            self.tick += 1
            if self.is_over:
                self._listen()  # to what was sent in the last tick
            if self.sampled_now:
                self._sample()

    def converge(self, limit: float) -> float | None:
        """Robots go on talking where they are, without a look around, until all hold the same; returns for
        how many seconds, at most `limit`, or None if that is not enough."""
        with torch.inference_mode():
            for tick in range(math.floor(limit * self.options.rate) + 1):
                if len({agent.digest() for agent in self.agents}) == 1:
                    return tick / self.options.rate
                now = self.now + tick / self.options.rate
                for agent in self.agents:
                    agent.send(now)
                    agent.tell_views(now)
                for agent in self.agents:
                    agent.listen(now + self.options.tick_seconds)
        return None

    # -- sensing ----------------------------------------------------------------------------------

    def _sense(self, agent: Agent) -> None:
        others = [other.position for other in self.robots if other is not agent.robot]
        there = torch.stack(others) if others else torch.zeros(0, 3, dtype=torch.float64)
        frame = agent.look(self.world.mesh, there)
        sensed = agent.learn(frame, self.now)
        with self.watch("scoring"):
            for evidence in sensed.evidence:
                self.union.add(evidence)
            self._note_seen(agent.robot, frame)
            self._raw["raw_points"] += 12 * int(sensed.novel.sum())
            for name, size in self._encoded(frame, sensed).items():
                self._raw[name] += size

    def _listen(self) -> None:
        for agent in self.agents:
            agent.listen(self.now)

    def _encoded(self, frame: DepthFrame, sensed: FrameUpdate) -> dict[str, int]:
        """Bytes that the novel beams of a frame take by other codecs: returns, and ends of the others."""
        sizes = dict.fromkeys(self.options.codecs, 0)
        for kind in (frame.is_hit, ~frame.is_hit):
            ends = frame.ends[sensed.novel & kind]
            if sizes and len(ends):
                for name, size in bytes_of_points(
                    ends, self.world.resolution, self.options.frame.noise, names=tuple(sizes)
                ).items():
                    sizes[name] += size
        return sizes

    def _note_seen(self, robot: Robot, frame: DepthFrame) -> None:
        """Which cells a robot has seen: by the beams of every few pixels, whatever its map makes of them."""
        width = self.options.camera.width
        row, column = frame.pixel // width, frame.pixel % width
        some = (row % _SEEN_STRIDE == 0) & (column % _SEEN_STRIDE == 0)
        seen = cast_evidence(
            frame.origin, frame.ends[some], frame.is_hit[some], self.world.resolution, self.world.box
        )
        flat, _ = flat_index(seen.cells - self.world.box.low, self.world.box.shape)
        self.seen_by[flat] |= 1 << robot.number

    # -- flying -----------------------------------------------------------------------------------

    def _fly(self) -> None:
        options = self.options
        begin = (self.tick % options.ticks_per_plan) * options.steps_per_tick
        with self.watch("flying"):
            flown = []
            for robot in self.robots:
                passed = torch.cat(
                    [robot.position[None], robot.advance(begin, begin + options.steps_per_tick)]
                )
                flown.append(finely(passed))
                self.trajectories[robot.number].append(robot.state[:4].clone())
            met = meets_others(torch.stack(flown), options.dynamics.radius).any(1)
            for robot, positions, has_met in zip(self.robots, flown, met.tolist(), strict=True):
                touched = bool(collides(self.world.mesh, positions, options.dynamics.radius).any())
                robot.collisions += int(touched) + int(has_met)

    # -- score ------------------------------------------------------------------------------------

    def _sample(self) -> None:
        """Note the numbers of now."""
        s = self.samples
        s["times"].append(self.now)
        s["entropy_bits"].append(self.union.entropy_bits)
        for curve, robot in zip(s["entropy_bits_per_robot"], self.robots, strict=True):
            curve.append(robot.mapper.belief.entropy_bits)
        s["bytes_over_time"].append(self.network.n_bytes)
        s["wire_bytes_over_time"].append(self.network.n_wire_bytes)
        s["missing_share"].append(self._missing_share())
        for name, size in self._raw.items():
            s[f"{name}_bytes_over_time"].append(size)

    def _missing_share(self) -> float:
        """Of the records that anybody holds, what share the robot lacks that lacks the most."""
        held = [agent.robot.mapper.held for agent in self.agents]
        everything = functools.reduce(operator.or_, held)
        lacking = max((everything - one).size for one in held)
        return lacking / everything.size if everything else 0.0

    # -- keeping ----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Everything that changes, for a checkpoint."""
        return {
            "tick": self.tick,
            "agents": [agent.state() for agent in self.agents],
            "union": self.union.state(),
            "network": self.network.state(),
            "samples": self.samples,
            "trajectories": [torch.stack(path) for path in self.trajectories],
            "stages": self.stages,
            "seen_by": torch.stack([seen := self.seen_by.nonzero().squeeze(1), self.seen_by[seen].long()]),
            "generator": self._generator.get_state(),
            "raw": self._raw,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint, as if nothing had come between."""
        self.tick = int(state["tick"])
        for agent, kept in zip(self.agents, state["agents"], strict=True):
            agent.restore(kept)
        self.union.restore(state["union"])
        self.network.restore(state["network"])
        self.samples = state["samples"]
        self.trajectories = [list(path) for path in state["trajectories"]]
        self.watch.seconds = {name: float(seconds) for name, seconds in state["stages"].items()}
        seen, bits = state["seen_by"]
        self.seen_by = torch.zeros_like(self.seen_by).index_copy_(0, seen, bits.to(self.seen_by.dtype))
        self._generator.set_state(state["generator"])
        self._raw = {name: int(size) for name, size in state["raw"].items()}
