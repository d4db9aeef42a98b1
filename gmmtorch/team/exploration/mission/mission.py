"""Mission: robots explore a simulated world, tick by tick, and plan together; MissionScore measures them."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gmmtorch.files import write_npz
from gmmtorch.kernels import mark_cells_of_rays
from gmmtorch.occupancy import Box, to_lattice
from gmmtorch.simulation import DepthFrame
from gmmtorch.team.exploration.mission.driver import Stopwatch
from gmmtorch.team.exploration.mission.options import TeamOptions
from gmmtorch.team.exploration.planning.collision_checking import PeerTrajectories, predicted_path
from gmmtorch.team.exploration.planning.planner_interface import Plan
from gmmtorch.team.exploration.robot.agent import Agent, Robot
from gmmtorch.team.exploration.robot.mapper import FrameUpdate
from gmmtorch.team.exploration.world.scoring import BeliefMap
from gmmtorch.team.exploration.world.world import World, collides, finely, meets_others
from gmmtorch.team.sharing import Network, bytes_of_points

_SEEN_STRIDE = 4  # pixels between the beams, along rows and columns, that mark cells as seen


class MissionScore:
    """Measures a team in a simulated world; the robots never read it.

    Attributes:
        union: map of the evidence of all robots' own frames.
        seen_by: (number of cells,) for each cell of the world's box, a bit for each robot that saw it.
        samples: curves by name, with a value for each entry of "times" (s).
    """

    def __init__(self, world: World, agents: Sequence[Agent], network: Network, options: TeamOptions) -> None:
        self.union = BeliefMap(world.resolution, world.box, world.observable, options.belief, options.device)
        self.seen_by = torch.zeros(world.observable.numel(), dtype=torch.int32, device=options.device)
        self._box = Box(*(side.to(options.device) for side in world.box))
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
        self._note_bytes(frame, update)

    def sample(self, now: float) -> None:
        """Appends the present values to the curves, at the time `now` (s)."""
        s = self.samples
        s["times"].append(now)
        s["entropy_bits"].append(self.union.entropy_bits)
        for curve, robot in zip(s["entropy_bits_per_robot"], self._robots, strict=True):
            curve.append(robot.mapper.belief.entropy_bits)
        traffic = self._network.traffic()
        s["bytes_over_time"].append(traffic.bytes)
        s["wire_bytes_over_time"].append(traffic.wire_bytes)
        s["missing_share"].append(self._missing_share())
        for name, size in self._encoded_bytes.items():
            s[f"{name}_bytes_over_time"].append(size)

    def _note_bytes(self, frame: DepthFrame, update: FrameUpdate) -> None:
        """Adds the bytes of the novel beams in each codec: of returns, and of the ends of no-return beams."""
        self._encoded_bytes["raw_points"] += 12 * int(update.novel.sum())
        names, noise = self._options.codecs, self._options.frame.noise
        for kind in (frame.is_hit, ~frame.is_hit):
            ends = frame.ends[update.novel & kind].cpu()
            if names and len(ends):
                encoded = bytes_of_points(ends, self._world.resolution, noise, names=names)
                for name, size in encoded.items():
                    self._encoded_bytes[name] += size

    def _note_seen(self, robot: Robot, frame: DepthFrame) -> None:
        """Marks the cells that the beams of every few pixels cross, independently of the robot's map."""
        width, world = self._options.camera.width, self._world
        row, column = frame.pixel // width, frame.pixel % width
        some = (row % _SEEN_STRIDE == 0) & (column % _SEEN_STRIDE == 0)
        stops = to_lattice(frame.ends[some], world.resolution, "ends")
        starts = to_lattice(frame.origin, world.resolution, "origin").expand_as(stops)
        marks = self.seen_by.view(world.box.shape)
        mark_cells_of_rays(marks, starts, stops, frame.is_hit[some], self._box.low, 1 << robot.number)

    def _missing_share(self) -> float:
        """Of the records that any robot holds, the largest share that one robot lacks."""
        held = [robot.mapper.shared.held for robot in self._robots]
        everything = functools.reduce(operator.or_, held)
        lacking = max((everything - one).size for one in held)
        return lacking / everything.size if everything else 0.0


COORDINATIONS = ("myopic", "greedy", "distributed_greedy", "random_partition")
_ROUNDS = 3  # of the last two


def coordinate(
    name: str,
    n_robots: int,
    plan: Callable[[int, dict[int, Plan]], Plan],
    generator: torch.Generator,
    n_rounds: int = _ROUNDS,
) -> dict[int, Plan]:
    """The plans of robots 0 … n_robots − 1 by one of `COORDINATIONS`, in the order in which they were fixed.

    "myopic": each robot plans as if it were alone. "greedy": robots plan one after the other, and each
    considers all earlier plans; if the joint value is monotone and submodular, the result is at least half
    of the optimum. The other rules take `n_rounds` rounds. In a round robots plan at the same time and
    consider the plans of the rounds before. "random_partition": each robot plans in one random round.
    "distributed_greedy": all remaining robots plan in every round, and an equal share of them, those with
    the best plans, keep their plans.

    plan: called with a robot and the plans of other robots that it must consider; returns its plan.
    """
    everyone, settled = list(range(n_robots)), dict[int, Plan]()
    if name == "distributed_greedy":
        left = everyone
        for k in range(n_rounds):
            found = {robot: plan(robot, dict(settled)) for robot in left}
            best = sorted(left, key=lambda robot: -found[robot].value)  # the first of equals comes first
            best = best[: -(-len(left) // (n_rounds - k))]
            settled.update((robot, found[robot]) for robot in best)
            left = [robot for robot in left if robot not in best]
        return settled
    rounds = [everyone]
    if name == "greedy":
        rounds = [[robot] for robot in everyone]
    elif name == "random_partition":
        drawn = torch.randint(n_rounds, (n_robots,), generator=generator).tolist()
        rounds = [[robot for robot in everyone if drawn[robot] == k] for k in range(n_rounds)]
    for robots in rounds:
        settled.update({robot: plan(robot, dict(settled)) for robot in robots})
    return settled


class Mission:
    """Robots that sense in every tick, and plan every few ticks. A tick lasts one frame of the camera.

    With a simulated `network`, all robots of the team are here: they plan together, their cameras mask one
    another, and they avoid one another's committed paths as if a short-range beacon sent them. Without one,
    the mission has one robot of a team whose other robots run in other processes: it plans alone, and
    learns about its teammates only from their messages.

    Args:
        agents: sorted by robot id. watch: times the agents' stages.
        network: the transport of all agents, if it is simulated. score: the evaluator, with a network only.
    """

    def __init__(
        self,
        world: World,
        agents: Sequence[Agent],
        options: TeamOptions,
        watch: Stopwatch,
        network: Network | None = None,
        score: MissionScore | None = None,
    ) -> None:
        self.world, self.agents, self.options, self.watch = world, list(agents), options, watch
        self.n_ticks = 0
        """Ticks done."""
        self.trajectories: list[list[Tensor]] = [[robot.state[:4].clone()] for robot in self.robots]
        """Poses (4,) x, y, z, yaw of each robot: at the start, and after each tick."""
        # Robots that share nothing plan independently.
        self.coordination = options.coordination if options.shares else "myopic"
        self._network, self._score = network, score
        self._mesh = world.mesh.to(options.device)  # where cameras see it
        self._generator = torch.Generator().manual_seed(options.seed)
        self._views_sent_at = 0.0

    @property
    def robots(self) -> list[Robot]:
        return [agent.robot for agent in self.agents]

    @property
    def network(self) -> Network:
        """Raises `RuntimeError` if the robots talk over a real network."""
        if self._network is None:
            raise RuntimeError("This mission has no simulated network.")
        return self._network

    @property
    def score(self) -> MissionScore:
        """Raises `RuntimeError` if the mission is not scored."""
        if self._score is None:
            raise RuntimeError("This mission has no score.")
        return self._score

    @property
    def tick_seconds(self) -> float:
        return self.options.tick_seconds

    @property
    def elapsed(self) -> float:
        """Simulated seconds of the ticks done."""
        return self.n_ticks * self.tick_seconds

    @property
    def is_over(self) -> bool:
        return self.elapsed >= self.options.duration - 1e-9

    @property
    def has_sampled(self) -> bool:
        """Whether the last tick added to the curves of the score."""
        return self.n_ticks % self.options.ticks_per_sample == 0 or self.is_over

    def tick(self, now: float) -> None:
        """Senses, exchanges messages, plans if it is due, and flies, at the time `now` (s)."""
        options = self.options
        with torch.inference_mode():  # without it, autograd bookkeeping takes a sixth of the time
            if self._network is not None:
                self._network.place(torch.stack([robot.position for robot in self.robots]))
            for agent in self.agents:
                self._sense(agent, now)
            self._listen(now)
            if self.n_ticks % options.ticks_per_plan == 0:
                self._plan(now)
            self._fly()
            self.n_ticks += 1
            if self.is_over and self._network is not None:
                self._listen(self.elapsed)  # receives what was sent in the last tick
            if self._score is not None and self.has_sampled:
                self._score.sample(self.elapsed)

    def exchange(self, now: float) -> None:
        """Listens, answers and announces at the time `now` (s); sends views once every planning period."""
        with torch.inference_mode():
            sends_views = now >= self._views_sent_at + self.options.dynamics.duration
            for agent in self.agents:
                agent.listen(now)
                agent.send_map(now)
                if sends_views:
                    agent.send_views(now)
            if sends_views:
                self._views_sent_at = now

    def content(self) -> tuple[int, ...]:
        """Changes whenever a robot adds records to its map."""
        return tuple(robot.mapper.shared.version for robot in self.robots)

    def converge(self, limit: float) -> float | None:
        """Lets robots of a simulated team exchange messages without moving until all have the same digest.
        Returns the simulated seconds that it takes, or None if it takes more than `limit` seconds."""
        with torch.inference_mode():
            for tick in range(math.floor(limit * self.options.rate) + 1):
                if len({agent.digest() for agent in self.agents}) == 1:
                    return tick / self.options.rate
                now = self.elapsed + tick / self.options.rate
                for agent in self.agents:
                    agent.send_map(now)
                    agent.send_views(now)
                self._listen(now + self.tick_seconds)
        return None

    def save_trajectories(self, folder: Path) -> None:
        """Writes poses (T, 4) of each robot, one per tick, as arrays robot_0, … of trajectories.npz."""
        poses = {f"robot_{n}": torch.stack(path).numpy() for n, path in enumerate(self.trajectories)}
        write_npz(folder / "trajectories.npz", **poses)

    def _sense(self, agent: Agent, now: float) -> None:
        others = [other.position for other in self.robots if other is not agent.robot]
        there = torch.stack(others) if others else torch.zeros(0, 3, dtype=torch.float64)
        frame = agent.capture(self._mesh, there)
        update = agent.learn(frame, now)
        if self._score is not None:
            with self.watch("scoring"):
                self._score.note(agent.robot, frame, update)

    def _listen(self, now: float) -> None:
        for agent in self.agents:
            agent.listen(now)

    def _plan(self, now: float) -> None:
        number = self.n_ticks // self.options.ticks_per_plan
        if self._network is not None:
            plan_together(self.agents, self.coordination, self.options, now, number, self._generator)
        else:
            for agent in self.agents:
                plan_alone(agent, self.options, now, number)
        self._views_sent_at = now

    def _fly(self) -> None:
        """Moves the robots along their paths; counts ticks in which they touch a surface or each other."""
        options = self.options
        begin = (self.n_ticks % options.ticks_per_plan) * options.steps_per_tick
        with self.watch("flying"):
            flown = []
            for robot, trajectory in zip(self.robots, self.trajectories, strict=True):
                passed = torch.cat(
                    [robot.position[None], robot.advance(begin, begin + options.steps_per_tick)]
                )
                flown.append(finely(passed))
                trajectory.append(robot.state[:4].clone())
            met = meets_others(torch.stack(flown), options.dynamics.radius).any(1)
            for robot, positions, has_met in zip(self.robots, flown, met.tolist(), strict=True):
                touched = bool(collides(self.world.mesh, positions, options.dynamics.radius).any())
                robot.collisions += int(touched) + int(has_met)


def plan_together(
    agents: Sequence[Agent],
    coordination: str,
    options: TeamOptions,
    now: float,
    number: int,
    generator: torch.Generator,
) -> dict[int, Plan]:
    """Makes and follows the next plan of every robot of a simulated team.

    A robot sends its final plan before the robots that plan after it listen; they wait for it as long as the
    network takes.

    agents: sorted by robot id. number: of the planning round. generator: for the coordination's draws.

    Returns the plans by robot id, in the order in which they became final.
    """
    for agent in agents:
        agent.begin_planning(now)
    sent: set[int] = set()
    proposed: dict[int, Plan] = {}

    def send(final: Collection[int]) -> None:
        for robot in final:
            if robot not in sent:
                sent.add(robot)
                agents[robot].send_plan(now, number)

    def plan_of(robot: int, final: dict[int, Plan]) -> Plan:
        send(final)
        agent = agents[robot]
        agent.listen(now + options.plan_slack * len(final))
        peers = _peer_trajectories(agents, robot, final, proposed, coordination, options)
        proposed[robot] = agent.propose(now, final, peers)
        return proposed[robot]

    plans = coordinate(coordination, len(agents), plan_of, generator)
    for robot in plans:
        agents[robot].follow()
    send(plans)
    for agent in agents:
        agent.send_views(now)
    return plans


def plan_alone(agent: Agent, options: TeamOptions, now: float, number: int) -> None:
    """Makes and follows the next plan of a robot whose teammates run in other processes. The robot avoids the
    paths of the plans that it has heard, and discounts the views of those heard in the last planning
    period."""
    agent.begin_planning(now)
    heard, dynamics = agent.robot.plans, options.dynamics
    paths = [
        predicted_path(plan, now - agent.heard_at[peer], dynamics.step)
        for peer, plan in sorted(heard.items())
        if len(plan.path)
    ]
    peers = PeerTrajectories.of(paths, options.separation)
    agent.propose(now, list(heard), peers, since=now - dynamics.duration)
    agent.follow()
    agent.send_plan(now, number)
    agent.send_views(now)


def _peer_trajectories(
    agents: Sequence[Agent],
    robot: int,
    final: Mapping[int, Plan],
    proposed: Mapping[int, Plan],
    coordination: str,
    options: TeamOptions,
) -> PeerTrajectories:
    """Where the other robots may be: on their final or proposed plan, and braking if that may change."""
    stays_final = coordination != "distributed_greedy"
    paths = []
    for other in agents:
        if other.number == robot:
            continue
        plan = final.get(other.number, proposed.get(other.number))
        if plan is not None:
            paths.append(torch.cat([plan.path, plan.braking])[:, :3])
        if plan is None or not (stays_final or other.number in final):
            paths.append(other.robot.braking[:, :3])
    return PeerTrajectories.of(paths, options.separation)
