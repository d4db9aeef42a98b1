"""Agent: one robot of a team with its camera, its radio, and its planning."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection

import torch
from torch import Tensor

from gmmtorch.simulation import DepthFrame, MeshWorld
from gmmtorch.team.exploration.information.view_evaluator import ViewEvaluator
from gmmtorch.team.exploration.mission.driver import Stopwatch
from gmmtorch.team.exploration.mission.options import TeamOptions
from gmmtorch.team.exploration.planning.coordination import PeerTrajectories
from gmmtorch.team.exploration.planning.planner_interface import Plan, PlanningTask
from gmmtorch.team.exploration.planning.primitives import Primitives
from gmmtorch.team.exploration.planning.recovery import Waiting, retreat
from gmmtorch.team.exploration.robot.mapper import FrameUpdate, LocalMap, Memo
from gmmtorch.team.exploration.robot.robot_state import Robot
from gmmtorch.team.sharing import (
    MAX_BYTES,
    PlanMessage,
    Radio,
    RecordStore,
    Transport,
    ViewsMessage,
    encode_plan,
)

_SEEDS_PER_MISSION = 1 << 10
"""Robot ids for which the random draws differ."""
_LATEST_PLANS = 10
"""A plan whose number is lower than the last one's by more comes from a restarted robot."""
_RESTING_PLANS = 10
"""Plans of a robot at rest, of which one is sent."""
_PATIENCE = 15
"""Consecutive plans without progress after which a robot looks around. Leaving a start takes up to six."""


class Agent:
    """One robot and its radio. It learns about its teammates only from messages, and from the paths that the
    caller of `propose` gives it.

    Args:
        robot: its map, planner and path. transport: the network.
        evaluator: of views. memo: cache of decoded datagrams; shared by the robots of a simulation.
        watch: times its stages.

    Attributes:
        heard_at: time (s), by this robot's clock, at which each teammate's last plan arrived.
        refused: plans that were ignored: "stranger" (not from a teammate, or under another sender's id).
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
        self.robot, self.options, self.watch = robot, options, watch
        self.radio = Radio(
            robot.number, transport, options.announce_every, options.budget, decode=memo.decoded
        )
        self.heard_at: dict[int, float] = {}
        self.refused: Counter[str] = Counter()
        self._evaluator, self._primitives = evaluator, primitives
        self._waiting = Waiting(primitives, _PATIENCE)
        # Each robot has its own generator, so its draws do not depend on the other robots.
        seed = options.seed * _SEEDS_PER_MISSION + robot.number
        self._generator = torch.Generator().manual_seed(seed)
        self._local_map: LocalMap | None = None  # none is needed at rest
        self._rests = False
        self._seen_from: tuple[Tensor, Tensor] | None = None  # the last pose, and the distances there
        self._plan: Plan | None = None
        self._sent_pose: Tensor | None = None  # where it rests, according to the last plan sent
        self._n_unsent = 0  # plans at that pose since

    @property
    def number(self) -> int:
        """The robot's id."""
        return self.robot.number

    def digest(self) -> bytes:
        """Equal for robots that hold the same map."""
        return self.robot.mapper.shared.digest()

    def keep_in(self, store: RecordStore) -> None:
        """Stores the map's records from now on, and adds the records that the store restored to the map."""
        self.radio.store = store
        self.robot.mapper.center_on(self.robot.position)
        self.robot.mapper.receive([])

    # -- sensing ----------------------------------------------------------------------------------

    def capture(self, mesh: MeshWorld, others: Tensor) -> DepthFrame:
        """A depth image of the world, in which teammates at (M, 3) are masked."""
        with self.watch("rendering"):
            options = self.options
            pose = self.robot.state[:4]
            if self._seen_from is None or not torch.equal(self._seen_from[0], pose):
                self._seen_from = pose.clone(), options.camera.distances(mesh, pose)
            frame = options.camera.sense(
                mesh, pose, others, options.dynamics.radius, self._generator, self._seen_from[1]
            )
            return frame.to(options.device)

    def learn(self, frame: DepthFrame, now: float) -> FrameUpdate:
        """Learns from a frame, and sends what is due of the map."""
        with self.watch("mapping"):
            update = self.robot.sense(frame)
        with self.watch("sharing"):
            self.send_map(now)
        return update

    # -- messages ---------------------------------------------------------------------------------

    def send_map(self, now: float) -> None:
        """Sends what is due of the map, and announcements if they are due."""
        if not self.options.shares:
            return
        shared, library = self.robot.mapper.shared, self.robot.library
        datagrams = self.radio.within_budget(lambda budget: shared.datagrams(budget=budget), now)
        urgent = bool(shared.missing)
        if self.radio.announcements.due(now, (shared.version, library.version), urgent):
            datagrams += shared.announcements()
        self.radio.send(datagrams, now)

    def send_views(self, now: float) -> None:
        """Sends views, if the map leaves enough of the budget."""
        library = self.robot.library
        with self.watch("sharing"):
            if self.options.shares:
                views = self.radio.within_budget(
                    lambda budget: library.datagrams(budget=budget), now, spare=MAX_BYTES
                )
                self.radio.send(views, now)

    def listen(self, now: float) -> None:
        """Merges the messages that arrived by the time `now` (s)."""
        with self.watch("sharing"):
            received = self.radio.receive(now)
        for item in received:
            if isinstance(item.message, PlanMessage):
                self._note_plan(item.sender, item.message, now)
            elif isinstance(item.message, ViewsMessage):
                self.robot.library.receive(item.message, now)
        with self.watch("mapping"):
            merged = self.robot.mapper.receive(
                [item for item in received if not isinstance(item.message, PlanMessage | ViewsMessage)]
            )
            self.radio.keep(merged)

    def _note_plan(self, sender: int, plan: PlanMessage, now: float) -> None:
        """Stores a teammate's plan, unless it is a repetition or a later plan has overtaken it.

        A plan with a lower number comes from a restarted robot if it is much lower, or if the stored path has
        been flown.
        """
        if plan.sender != sender or plan.sender == self.number or plan.sender >= self.options.size:
            self.refused["stranger"] += 1
            return
        known = self.robot.plans.get(sender)
        if known is not None:
            is_flown = now - self.heard_at[sender] >= known.step * len(known.path)
            if 0 <= known.number - plan.number <= _LATEST_PLANS and not is_flown:
                return
        self.robot.plans[sender] = plan
        self.heard_at[sender] = now

    # -- planning ---------------------------------------------------------------------------------

    def begin_planning(self, now: float) -> None:
        """Takes the snapshot of the map that `propose` uses. Later messages do not change it."""
        robot, options = self.robot, self.options
        with self.watch("planning"):
            self._rests = robot.should_rest(now)
            self._local_map = None
            if not self._rests:
                self._local_map = robot.local_map(
                    options.planning_prior, options.dynamics.radius, options.window
                )
                robot.roadmap.update(self._local_map)

    def propose(
        self, now: float, final: Collection[int], peers: PeerTrajectories, since: float | None = None
    ) -> Plan:
        """A plan from the last snapshot.

        Args:
            final: ids of the teammates whose views are discounted, if their plan arrived at the time `since`
                (s) or later; None: `now`.
            peers: committed paths of the other robots, which the plan avoids.
        """
        with self.watch("planning"):
            if self._local_map is None:
                self._plan = self._waiting.rest(self.robot.state)
                return self._plan
            known = [
                heard.views.to(torch.float64)
                for number, heard in sorted(self.robot.plans.items())
                if number in final and self.heard_at[number] >= (now if since is None else since)
            ]
            task = PlanningTask(
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
            self._plan = (
                retreat(self._primitives, task)
                or self._waiting.boxed_in(task)
                or self.robot.planner.plan(task)
            )
        return self._plan

    def follow(self) -> None:
        """Follows the plan proposed last."""
        if self._plan is not None:
            self.robot.follow(self._plan)

    def send_plan(self, now: float, number: int) -> None:
        """Sends the plan proposed last, as that of planning round `number`."""
        if self._plan is None or not self.options.shares or self._repeats(self._plan):
            return
        with self.watch("sharing"):
            path, views = self._plan.path[:, :4], self._plan.views
            step = self.options.dynamics.step
            self.radio.send(encode_plan(self.number, number, now, step, path, views), now)

    def _repeats(self, plan: Plan) -> bool:
        """Whether a plan rests at the pose of the last plan sent, and need not be sent again yet."""
        moves = bool((plan.path[:, :4] != plan.path[-1, :4]).any())
        pose = None if moves or not self._rests else plan.path[-1, :4]
        if pose is None or self._sent_pose is None or not torch.equal(pose, self._sent_pose):
            self._sent_pose, self._n_unsent = pose, 0
            return False
        self._n_unsent = (self._n_unsent + 1) % _RESTING_PLANS
        return self._n_unsent != 0
