"""FlyingNode: one robot of a team in a process of its own, flying in a simulated world."""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gmmtorch.exploration.mission.forgiving_journal import ForgivingJournal
from gmmtorch.exploration.mission.options import TeamOptions
from gmmtorch.exploration.planning.peer_trajectories import PeerTrajectories
from gmmtorch.exploration.robot.agent import Agent
from gmmtorch.exploration.robot.gmm_mapper import GmmMapper
from gmmtorch.exploration.world.collisions import collides, finely
from gmmtorch.exploration.world.world import World
from gmmtorch.files import write_npz
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.sharing.journal import Journal
from gmmtorch.sharing.messages.message_registry import PlanMessage
from gmmtorch.sharing.replica.replica import Replica
from gmmtorch.sharing.transport.frames import FramedTransport

_MOST_STEPS = 1000  # of a teammate's plan that are looked at


class FlyingNode:
    """Senses, talks, plans and flies in its own copy of a world, in which it sees none of its teammates.

    By a clock (`tick`), it knows of them what they have told of their plans. In step with a simulated team
    (`lockstep`), it is told where they are, as in a `Mission`, and does what that does.

    Args:
        agent: of a team with these options. transport: the agent's; closed with this.
        journal: of the agent's replica, which it has restored; closed with this.
    """

    def __init__(
        self,
        agent: Agent,
        world: World,
        options: TeamOptions,
        transport: FramedTransport,
        journal: Journal | None = None,
    ) -> None:
        self.agent, self.world, self.options = agent, world, options
        self.transport = transport
        self._logbook = None if journal is None else ForgivingJournal(journal)
        if self._logbook is not None:
            agent.keep_in(self._logbook)
        self._n_ticks = 0
        self._listened = self._views_wait = 0.0  # when, by the clock; seconds since views were told
        self._flown = [agent.robot.state[:4].clone()]
        self.n_late = 0
        """Datagrams that a team in step had to go on without, as they had not come."""

    @property
    def robot(self) -> int:
        return self.agent.number

    @property
    def is_over(self) -> bool:
        return self._n_ticks >= round(self.options.duration * self.options.rate)

    # -- by a clock -------------------------------------------------------------------------------

    def tick(self, now: float) -> None:
        """Sense, hear, plan if it is due, and fly on, at the time `now` (s) of any clock."""
        options = self.options
        with torch.inference_mode():
            self.sense(now, torch.zeros(0, 3, dtype=torch.float64))
            self.agent.listen(now)
            if self._n_ticks % options.ticks_per_plan == 0:
                self._plan(now)
            begin = (self._n_ticks % options.ticks_per_plan) * options.steps_per_tick
            self.fly(begin, begin + options.steps_per_tick)

    def listen(self, now: float) -> None:
        """Hear, answer, and announce; views as often as they are told where it plans."""
        self._views_wait += max(0.0, now - self._listened)  # a clock that is set back stands still
        self._listened = now
        with torch.inference_mode():
            self.agent.listen(now)
            self.agent.send(now)
            if self._views_wait >= self.options.dynamics.duration:
                self._tell_views(now)

    def _tell_views(self, now: float) -> None:
        self._views_wait = 0.0
        self.agent.tell_views(now)

    def _plan(self, now: float) -> None:
        agent, options = self.agent, self.options
        agent.survey(now)
        plans = agent.robot.plans
        paths = [
            _ahead(plan, now - agent.heard_at[number], options.dynamics.step)
            for number, plan in sorted(plans.items())
            if len(plan.path)
        ]
        peers = PeerTrajectories.of(paths, 2 * options.dynamics.radius + options.margin)
        agent.propose(now, list(plans), peers, since=now - options.dynamics.duration)
        agent.settle()
        agent.tell_plan(now, self._n_ticks // options.ticks_per_plan)
        self._tell_views(now)

    # -- step by step -----------------------------------------------------------------------------

    def sense(self, now: float, others: Tensor) -> None:
        """Look around, with teammates at (M, 3), learn, and tell."""
        self.agent.learn(self.agent.look(self.world.mesh, others), now)

    def fly(self, begin: int, stop: int) -> Tensor:
        """Fly on from step `begin` of the path to step `stop`; returns the positions on the way (n, 3)."""
        robot = self.agent.robot
        passed = torch.cat([robot.position[None], robot.advance(begin, stop)])
        positions = finely(passed)
        robot.collisions += int(collides(self.world.mesh, positions, self.options.dynamics.radius).any())
        self._flown.append(robot.state[:4].clone())
        self._n_ticks += 1
        return positions

    # -- what there is to say ---------------------------------------------------------------------

    def status(self) -> str:
        mapper, sent = self.agent.robot.mapper, self.transport.traffic()
        left = mapper.belief.entropy_bits / max(1.0, mapper.belief.observable_bits)
        return (
            f"{left:.1%} of the entropy left, {mapper.held.size:,} records, {sent.bytes / 1e3:,.0f} kB sent"
            f"{self.agent.radio.remarks(self._conflicts)}"
        )

    def scalars(self) -> dict[str, float]:
        """What changes as it flies: numbers for a plot."""
        robot, sent = self.agent.robot, self.transport.traffic()
        return {
            "entropy_bits": robot.mapper.belief.entropy_bits,
            "records": float(robot.mapper.held.size),
            "bytes_sent": float(sent.bytes),
            "wire_bytes_sent": float(self.transport.wire_bytes),
            "datagrams_sent": float(sent.datagrams),
            "datagrams_heard": float(self.agent.radio.n_heard),
            "refused": float(sum(self.transport.books(self.robot)["refused"].values())),
            "path_length": robot.path_length,
            "collisions": float(robot.collisions),
        }

    def row(self) -> dict[str, Any]:
        """What the robot leaves in results.json."""
        robot, transport = self.agent.robot, self.transport
        belief, shared = robot.mapper.belief, getattr(robot.mapper, "shared", None)
        components = robot.mapper.components()
        refused = Counter(self.agent.refused)
        for part in (robot.mapper, shared):
            refused.update(getattr(part, "refused", {}))
        return {
            "robot": self.robot,
            "digest": robot.mapper.digest().hex(),
            "views_digest": robot.library.digest().hex(),
            "incarnation": getattr(shared, "incarnation", None),
            "entropy_bits_left": belief.entropy_bits,
            "observable_bits": belief.observable_bits,
            "n_components": None if components is None else len(components),
            "n_records": robot.mapper.held.size,
            **transport.books(self.robot),
            "heard": self.agent.radio.n_heard,
            "damaged": self.agent.radio.n_damaged,
            "not_merged": dict(refused),
            "late": self.n_late,
            "path_length": robot.path_length,
            "collisions": robot.collisions,
            "unkept": 0 if self._logbook is None else self._logbook.n_failed,
            "stage_seconds": self.agent.stage_seconds,
        }

    @property
    def twin(self) -> str | None:
        """What is said of another robot of this number, if there is one."""
        return self.agent.radio.twin(self._conflicts)

    @property
    def _conflicts(self) -> int:
        """Records that came as this robot's, and are not what it said."""
        shared = getattr(self.agent.robot.mapper, "shared", None)
        return shared.conflicts[self.robot] if isinstance(shared, Replica) else 0

    def files(self) -> dict[str, tuple[str, Callable[[Path], object]]]:
        """The map, and where the robot flew."""
        poses, mapper = torch.stack(self._flown).numpy(), self.agent.robot.mapper
        files: dict[str, tuple[str, Callable[[Path], object]]] = {
            "trajectory": ("trajectory.npz", functools.partial(write_npz, poses=poses))
        }
        if isinstance(mapper, GmmMapper) and len(components := mapper.components()):
            made = GaussianMap.of(components, robot=self.robot)
            files["map"] = f"map{made.suffix}", made.save
        return files

    def close(self) -> None:
        """Close the journal, with a last snapshot, and the transport. May be called again."""
        if self._logbook is not None:
            self._logbook.close()
        self.transport.close()


def _ahead(plan: PlanMessage, age: float, step: float) -> Tensor:
    """Where a teammate is one step (s) from now, two, … (S, 3), by a plan that was heard `age` seconds ago.

    Its pose of each time is the plan's next in time, at most half a step of the plan off, which
    `peers.clear_of` allows for.
    """
    n = len(plan.path)
    left = n * plan.step - age
    ahead = step * torch.arange(1, min(max(math.ceil(left / step - 1e-9), 1), _MOST_STEPS) + 1)
    rows = ((age + ahead.double()) / plan.step).round().clamp(1, n).long() - 1
    return plan.path[rows, :3].double()
