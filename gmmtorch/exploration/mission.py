"""Mission: a team explores a simulated world, tick by tick, and is scored as it goes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from gmmtorch.exploration.collisions import collides, meets_others
from gmmtorch.exploration.coordination import Coordination
from gmmtorch.exploration.mapper import Heard, Memo, Sensed
from gmmtorch.exploration.options import TeamOptions
from gmmtorch.exploration.planning import Plan, PlanningTask, Waiting
from gmmtorch.exploration.primitives import Primitives
from gmmtorch.exploration.retreat import retreat
from gmmtorch.exploration.robot import Robot
from gmmtorch.exploration.scoring import BeliefMap
from gmmtorch.exploration.traffic import Traffic
from gmmtorch.exploration.views import ViewEvaluator
from gmmtorch.exploration.world import World
from gmmtorch.occupancy.cell_evidence import cast_evidence, flat_index
from gmmtorch.sharing.messages import (
    PlanMessage,
    ViewsMessage,
    encode_plan,
    encode_views,
)
from gmmtorch.sharing.network import Network
from gmmtorch.sharing.point_codecs import bytes_of_points
from gmmtorch.simulation.depth_camera import DepthFrame

_SEEN_STRIDE = 4  # pixels
_CHECKS_PER_STEP = 4  # for collisions


class Mission:
    """Simulated time passes in ticks of one frame; every robot senses in each, and plans every few.

    Robots hear what the network brings, and one another's committed paths, which a short-range beacon
    would tell them; nothing else passes between them. The evaluator's maps are the robots' own evidence
    (`union`) and what each robot holds (`Robot.mapper.belief`).
    """

    def __init__(
        self,
        world: World,
        robots: list[Robot],
        union: BeliefMap,
        network: Network,
        evaluator: ViewEvaluator,
        coordination: Coordination,
        options: TeamOptions,
        memo: Memo,
    ) -> None:
        self.world, self.robots, self.union, self.network = world, robots, union, network
        self.options = options
        self.tick = 0
        self.samples: dict[str, list[Any]] = {
            "times": [],
            "entropy_bits": [],
            "entropy_bits_per_robot": [[] for _ in robots],
            "bytes_over_time": [],
            "raw_points_bytes_over_time": [],
            **{f"{name}_bytes_over_time": [] for name in options.codecs},
        }
        self.trajectories: list[list[Tensor]] = [[robot.state[:4].clone()] for robot in robots]
        self.stages: dict[str, float] = {}
        self._inner_seconds = 0.0
        # A bit for each robot that saw a cell.
        bits = torch.int16 if len(robots) < 16 else torch.int32
        self.seen_by = torch.zeros(world.observable.numel(), dtype=bits)
        self.coordination = coordination.name
        self._evaluator, self._coordination = evaluator, coordination
        self._primitives = Primitives(options.dynamics)
        self._waiting = Waiting(self._primitives)
        self._generator = torch.Generator().manual_seed(options.seed)
        self._raw = dict.fromkeys(("raw_points", *options.codecs), 0)
        self._memo = memo
        self._sample()

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
            for robot in self.robots:
                self._sense(robot)
            self._exchange(self.now)
            if self.tick % self.options.ticks_per_plan == 0:
                self._plan()
            self._fly()
            self.tick += 1
            if self.is_over:
                self._exchange(self.now)  # what was sent in the last tick
            if self.sampled_now:
                self._sample()

    # -- sensing and sharing ----------------------------------------------------------------------

    def _sense(self, robot: Robot) -> None:
        others = [other.position for other in self.robots if other is not robot]
        with self._timed("rendering"):
            frame = self.options.camera.sense(
                self.world.mesh,
                robot.state[:4],
                torch.stack(others) if others else torch.zeros(0, 3, dtype=torch.float64),
                self.options.dynamics.radius,
                self._generator,
            )
        with self._timed("mapping"):
            sensed = robot.sense(frame)
        with self._timed("scoring"):
            for evidence in sensed.evidence:
                self.union.add(evidence)
            self._note_seen(robot, frame)
            self._raw["raw_points"] += 12 * int(sensed.novel.sum())
            for name, size in self._encoded(frame, sensed).items():
                self._raw[name] += size
        with self._timed("sharing"):
            for kind, datagrams in sensed.messages.items():
                self.network.send(robot.number, datagrams, self.now, kind)

    def _encoded(self, frame: DepthFrame, sensed: Sensed) -> dict[str, int]:
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

    def _exchange(self, now: float) -> None:
        """Every robot takes in what has reached it by `now`."""
        for robot in self.robots:
            heard = self._heard(robot, now)
            with self._timed("mapping"):
                robot.mapper.receive(heard)
            for item in heard:
                if isinstance(item.message, ViewsMessage):
                    robot.library.merge(item.message)
                elif isinstance(item.message, PlanMessage):
                    robot.plans[item.message.sender] = (item.message.time, item.message.views)

    def _heard(self, robot: Robot, now: float) -> list[Heard]:
        """What has reached a robot by `now`, and what it says."""
        with self._timed("sharing"):
            return [
                Heard(sender, datagram, self._memo.decoded(datagram))
                for sender, datagram in self.network.deliver(robot.number, now)
            ]

    # -- planning ---------------------------------------------------------------------------------

    def _plan(self) -> None:
        with self._timed("planning"):
            surroundings = {
                robot.number: robot.surroundings(
                    self.options.planning_prior, self.options.dynamics.radius, self.options.window
                )
                for robot in self.robots
            }
            resting = [robot.rests(self.now) for robot in self.robots]
            for robot in self.robots:
                robot.roadmap.update(surroundings[robot.number])
        said: set[int] = set()
        proposed: dict[int, Plan] = {}

        def say(fixed: dict[int, Plan]) -> None:
            """Fixed plans are told as soon as others plan after them."""
            for number, plan in fixed.items():
                if number not in said and self.options.shares:
                    said.add(number)
                    datagrams = encode_plan(
                        number, self.tick, self.now, self.options.dynamics.step, plan.path[:, :4], plan.views
                    )
                    self.network.send(number, datagrams, self.now, "plans")

        def plan_of(number: int, fixed: dict[int, Plan]) -> Plan:
            robot = self.robots[number]
            say(fixed)
            self._exchange(self.now + self.options.plan_slack * len(fixed))
            view = surroundings[number]
            known = [
                poses for other, (when, poses) in robot.plans.items() if other in fixed and when >= self.now
            ]
            task = PlanningTask(
                robot=number,
                state=robot.state,
                surroundings=view,
                traffic=self._traffic(number, fixed, proposed),
                residual=self._evaluator.residual(view, torch.cat(known) if known else torch.zeros(0, 4)),
                library=robot.library,
                roadmap=robot.roadmap,
                now=self.now,
                generator=self._generator,
                trail=robot.trail,
            )
            if resting[number]:
                plan = self._waiting.rest(task)
            else:
                plan = retreat(self._primitives, task) or robot.planner.plan(task)
            proposed[number] = plan
            return plan

        with self._timed("planning"):
            plans = self._coordination.coordinate(range(len(self.robots)), plan_of, self._generator)
            for number, plan in plans.items():
                self.robots[number].follow(plan)
        with self._timed("sharing"):
            say(plans)
            if self.options.shares:
                for robot in self.robots:
                    datagrams = encode_views(robot.library.take_changes())
                    self.network.send(robot.number, datagrams, self.now, "views")

    def _traffic(self, number: int, fixed: dict[int, Plan], proposed: dict[int, Plan]) -> Traffic:
        """Where the others may be: on what they settled on or proposed, or braking if that may change."""
        is_final = self._coordination.name != "distributed_greedy"
        paths = []
        for robot in self.robots:
            if robot.number == number:
                continue
            plan = fixed.get(robot.number, proposed.get(robot.number))
            if plan is not None:
                paths.append(torch.cat([plan.path, plan.braking])[:, :3])
            if plan is None or not (is_final or robot.number in fixed):
                paths.append(robot.braking[:, :3])
        return Traffic.of(paths, 2 * self.options.dynamics.radius + self.options.margin)

    # -- flying -----------------------------------------------------------------------------------

    def _fly(self) -> None:
        options = self.options
        begin = (self.tick % options.ticks_per_plan) * options.steps_per_tick
        with self._timed("flying"):
            flown = []
            for robot in self.robots:
                passed = torch.cat(
                    [robot.position[None], robot.advance(begin, begin + options.steps_per_tick)]
                )
                # Between two states a robot may touch what it touches at neither.
                flown.append(_finely(passed, _CHECKS_PER_STEP))
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
        for name, size in self._raw.items():
            s[f"{name}_bytes_over_time"].append(size)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        """Wall time to a stage, but for what stages within it take."""
        begin, outer, self._inner_seconds = time.perf_counter(), self._inner_seconds, 0.0
        yield
        spent = time.perf_counter() - begin
        self.stages[stage] = self.stages.get(stage, 0.0) + spent - self._inner_seconds
        self._inner_seconds = outer + spent

    # -- keeping ----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Everything that changes, for a checkpoint."""
        return {
            "tick": self.tick,
            "robots": [robot.checkpoint() for robot in self.robots],
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
        for robot, kept in zip(self.robots, state["robots"], strict=True):
            robot.restore(kept)
        self.union.restore(state["union"])
        self.network.restore(state["network"])
        self.samples = state["samples"]
        self.trajectories = [list(path) for path in state["trajectories"]]
        self.stages = {name: float(seconds) for name, seconds in state["stages"].items()}
        seen, bits = state["seen_by"]
        self.seen_by = torch.zeros_like(self.seen_by).index_copy_(0, seen, bits.to(self.seen_by.dtype))
        self._generator.set_state(state["generator"])
        self._raw = {name: int(size) for name, size in state["raw"].items()}


def _finely(positions: Tensor, n: int) -> Tensor:
    """Positions (1 + n S, 3) evenly on the way through positions (1 + S, 3)."""
    share = torch.arange(1, n + 1, dtype=positions.dtype)[:, None] / n
    between = positions[:-1, None] + share * (positions[1:, None] - positions[:-1, None])
    return torch.cat([positions[:1], between.reshape(-1, 3)])
