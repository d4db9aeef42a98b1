"""Agent: one robot of a team and its radio, as it would be alone on a machine of its own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from typing import Any

import torch
from torch import Tensor

from gmmtorch.exploration.information.view_evaluator import ViewEvaluator
from gmmtorch.exploration.mission.options import TeamOptions
from gmmtorch.exploration.mission.stopwatch import Stopwatch
from gmmtorch.exploration.planning.peer_trajectories import PeerTrajectories
from gmmtorch.exploration.planning.planner_interface import Plan, PlanningTask, Waiting
from gmmtorch.exploration.planning.primitives import Primitives
from gmmtorch.exploration.planning.recovery import retreat
from gmmtorch.exploration.robot.local_map import LocalMap
from gmmtorch.exploration.robot.mapper import FrameUpdate, Memo
from gmmtorch.exploration.robot.radio import Logbook, Radio
from gmmtorch.exploration.robot.robot_state import Robot
from gmmtorch.sharing.messages.message_registry import (
    MAX_BYTES,
    PlanMessage,
    ViewsHeldMessage,
    ViewsMessage,
    encode_plan,
)
from gmmtorch.sharing.transport.simulated_network import Transport
from gmmtorch.simulation.sensors.depth_camera import DepthFrame
from gmmtorch.simulation.worlds.mesh_world import MeshWorld

_SEEDS = 1 << 10  # robots of a mission that draw differently
_LATE = 10  # plans by which one may come too late; one that is older is of a robot that began anew
_TOLD_AGAIN = 10  # plans of a robot that stays where it is, of which teammates are told one
_PATIENCE = 15  # plans in a row that lead nowhere: at a start, to find a way out takes up to six
_OF_VIEWS = (ViewsMessage, ViewsHeldMessage)


class Agent:
    """Senses, talks, and plans. All that it knows of its team is what its transport brings; who flies
    close by, a short-range beacon tells (`peers` in `propose`).

    Args:
        robot: what it knows and does. transport: its end of the network.
        evaluator: of views. memo: of what datagrams say; shared by the robots of a simulation.
        watch: times its stages.
    """

    def __init__(
        self,
        robot: Robot,
        transport: Transport,
        evaluator: ViewEvaluator,
        primitives: Primitives,
        options: TeamOptions,
        memo: Memo,
        watch: Stopwatch,
    ) -> None:
        self.robot, self.options = robot, options
        self.radio = Radio(
            robot.number, transport, options.announce_every, options.budget, decode=memo.decoded
        )
        self._evaluator, self._primitives, self._timed = evaluator, primitives, watch
        self.heard_at: dict[int, float] = {}
        """When each teammate's last plan came, by this robot's own clock."""
        self.refused: Counter[str] = Counter()
        """How many plans were not believed: "stranger" (of no teammate, or not of the one who sent it)."""
        self._waiting = Waiting(primitives, _PATIENCE)
        # Of its own, so that what one robot draws does not depend on what others do.
        seed = options.seed * _SEEDS + robot.number
        self._generator = torch.Generator().manual_seed(seed)
        self._local_map: LocalMap | None = None
        self._rests = False
        self._plan: Plan | None = None
        self._told: Tensor | None = None  # where it stays, as teammates were told
        self._silent = 0

    @property
    def number(self) -> int:
        return self.robot.number

    @property
    def braking(self) -> Tensor:
        return self.robot.braking

    @property
    def stage_seconds(self) -> dict[str, float]:
        """Wall seconds by stage; of all robots together, where they share a stopwatch."""
        return dict(self._timed.seconds)

    def digest(self) -> bytes:
        """Equal for robots that hold the same map."""
        return self.robot.mapper.digest()

    def keep_in(self, logbook: Logbook) -> None:
        """From now on keep what is said and heard of the map. What the logbook has restored of it is taken
        for known."""
        self.radio.logbook = logbook
        self.robot.mapper.center_on(self.robot.position)
        self.robot.mapper.receive([])

    # -- sensing ----------------------------------------------------------------------------------

    def look(self, mesh: MeshWorld, others: Tensor) -> DepthFrame:
        """What its camera sees of a world, with teammates at (M, 3), which it knows not to map."""
        with self._timed("rendering"):
            return self.options.camera.sense(
                mesh, self.robot.state[:4], others, self.options.dynamics.radius, self._generator
            )

    def learn(self, frame: DepthFrame, now: float) -> FrameUpdate:
        """Take in a frame, and tell the team."""
        with self._timed("mapping"):
            sensed = self.robot.sense(frame)
        with self._timed("sharing"):
            self.send(now)
        return sensed

    # -- the team ---------------------------------------------------------------------------------

    def send(self, now: float) -> None:
        """What its map has for the team, and every while what it holds."""
        if not self.options.shares:
            return
        mapper, library = self.robot.mapper, self.robot.library
        datagrams = self.radio.within_budget(mapper.datagrams, now)
        urgent = mapper.is_behind or library.differs
        if self.radio.announces(now, (mapper.version, library.version), urgent):
            datagrams += [*mapper.announcements(), *library.announcements()]
        self.radio.tell(datagrams, now)

    def tell_views(self, now: float) -> None:
        """The team of views worth going to, as far as the map has left of the budget."""
        library = self.robot.library
        with self._timed("sharing"):
            if self.options.shares:
                views = self.radio.within_budget(
                    lambda budget: library.datagrams(budget=budget), now, spare=MAX_BYTES
                )
                self.radio.tell(views, now)

    def listen(self, now: float) -> None:
        """Take in what has come by `now`, in an order that does not depend on who was quicker."""
        with self._timed("sharing"):
            heard = self.radio.hear(now)
        for item in heard:
            if isinstance(item.message, PlanMessage):
                self._note_plan(item.sender, item.message, now)
            elif isinstance(item.message, _OF_VIEWS):
                self.robot.library.receive(item.message, now)
        with self._timed("mapping"):
            taken = self.robot.mapper.receive(
                [item for item in heard if not isinstance(item.message, (PlanMessage, *_OF_VIEWS))]
            )
            self.radio.keep(taken)

    def _note_plan(self, sender: int, plan: PlanMessage, now: float) -> None:
        """Keep a teammate's plan, unless it is known, or a later one has overtaken it.

        One whose number is not higher is of a robot that began anew, if it is much lower, or comes when the
        path that is known has been flown.
        """
        if plan.sender != sender or plan.sender == self.number or plan.sender >= self.options.size:
            self.refused["stranger"] += 1
            return
        known = self.robot.plans.get(sender)
        if known is not None:
            is_flown = now - self.heard_at[sender] >= known.step * len(known.path)
            if 0 <= known.number - plan.number <= _LATE and not is_flown:
                return
        self.robot.plans[sender] = plan
        self.heard_at[sender] = now

    # -- planning ---------------------------------------------------------------------------------

    def survey(self, now: float) -> None:
        """Look at the map around: what the plan is made from, whatever comes in meanwhile."""
        robot, options = self.robot, self.options
        with self._timed("planning"):
            self._local_map = robot.local_map(options.planning_prior, options.dynamics.radius, options.window)
            self._rests = robot.rests(now)
            robot.roadmap.update(self._local_map)

    def propose(
        self, now: float, fixed: Collection[int], peers: PeerTrajectories, since: float | None = None
    ) -> Plan:
        """A plan from the last survey, given the views of the teammates whose plans are fixed, as far as they
        have come `since` (s); None: now."""
        if self._local_map is None:
            raise RuntimeError("survey() comes before propose().")
        with self._timed("planning"):
            known = [
                heard.views.to(torch.float64)
                for number, heard in sorted(self.robot.plans.items())
                if number in fixed and self.heard_at[number] >= (now if since is None else since)
            ]
            task = PlanningTask(
                robot=self.number,
                state=self.robot.state,
                local_map=self._local_map,
                peers=peers,
                residual=self._evaluator.residual(
                    self._local_map, torch.cat(known) if known else torch.zeros(0, 4)
                ),
                library=self.robot.library,
                roadmap=self.robot.roadmap,
                now=now,
                generator=self._generator,
                trail=self.robot.trail,
            )
            if self._rests:
                self._plan = self._waiting.rest(task)
            else:
                self._plan = (
                    retreat(self._primitives, task)
                    or self._waiting.boxed_in(task)
                    or self.robot.planner.plan(task)
                )
        return self._plan

    def settle(self) -> None:
        """Follow the plan that was proposed last."""
        if self._plan is not None:
            self.robot.follow(self._plan)

    def tell_plan(self, now: float, number: int) -> None:
        """The team of the plan that was proposed last, as number so-and-so."""
        if self._plan is None or not self.options.shares or self._stays(self._plan):
            return
        with self._timed("sharing"):
            path, views = self._plan.path[:, :4], self._plan.views
            step = self.options.dynamics.step
            self.radio.tell(encode_plan(self.number, number, now, step, path, views), now)

    def _stays(self, plan: Plan) -> bool:
        """Whether a plan stays where the team was told lately that the robot stays."""
        moves = bool((plan.path[:, :4] != plan.path[-1, :4]).any())
        here = None if moves or not self._rests else plan.path[-1, :4]
        if here is None or self._told is None or not torch.equal(here, self._told):
            self._told, self._silent = here, 0
            return False
        self._silent = (self._silent + 1) % _TOLD_AGAIN
        return self._silent != 0

    # -- keeping ----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Everything that changes, at the end of a tick."""
        return {
            "robot": self.robot.checkpoint(),
            "generator": self._generator.get_state(),
            "waiting": self._waiting.state(),
            "told": self._told,
            "silent": self._silent,
            "heard_at": [[number, when] for number, when in self.heard_at.items()],
            "radio": self.radio.state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `state`."""
        self.robot.restore(state["robot"])
        self._generator.set_state(state["generator"])
        self._waiting.restore(state["waiting"])
        self._told, self._silent = state["told"], int(state["silent"])
        self.heard_at = {int(number): float(when) for number, when in state["heard_at"]}
        self.radio.restore(state["radio"])
