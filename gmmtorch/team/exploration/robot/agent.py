"""Agent: one robot of a team with its camera, its radio and its planning; Robot, its state; when it rests."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Collection

import torch
from torch import Tensor

from gmmtorch.mapping import Components
from gmmtorch.simulation import DepthFrame, MeshWorld
from gmmtorch.team.exploration.mission.driver import Stopwatch
from gmmtorch.team.exploration.mission.options import StoppingRule, TeamOptions
from gmmtorch.team.exploration.planning.collision_checking import LocalMap, PeerTrajectories, local_map_of
from gmmtorch.team.exploration.planning.journeys import Roadmap
from gmmtorch.team.exploration.planning.planner_interface import (
    Plan,
    Planner,
    PlanningTask,
    Waiting,
    retreat,
    shortened,
)
from gmmtorch.team.exploration.planning.primitives import Primitives
from gmmtorch.team.exploration.planning.view_evaluator import ViewEvaluator
from gmmtorch.team.exploration.robot.mapper import FrameUpdate, Mapper, Memo
from gmmtorch.team.exploration.world.starts import InitialFreeSpace
from gmmtorch.team.sharing import (
    MAX_BYTES,
    ComponentsMessage,
    PlanMessage,
    Radio,
    Store,
    Transport,
    ViewLibrary,
    ViewsMessage,
    encode_plan,
)

_NEWS_SHARE = 0.25  # share of the best window that teammates must learn before a resting robot explores again


class StoppingCriterion:
    """Decides from the entropy that a robot's own frames remove from its map whether the robot should rest.

    The expected gain of views is no criterion: it stays high where only slivers are left that no camera
    resolves. A resting robot wakes once its teammates have removed a quarter of its best window; it then
    flies for at least one window. Time in which the robot was boxed in does not count.

    Attributes:
        rests: whether the robot should rest.
    """

    def __init__(self, rule: StoppingRule) -> None:
        self.rests = False
        self._rule = rule
        self._window: deque[tuple[float, float]] = deque()  # time (s) and bits learned
        self._best = 0.0  # bits learned in the best window
        self._known_at_rest = 0.0  # bits
        self._noted_at: float | None = None  # s
        self._boxed_in = 0.0  # seconds that do not count

    def note(self, now: float, learned: float, known: float, boxed_in: bool = False) -> None:
        """Updates the criterion at the time `now` (s).

        learned: bits that the robot's own frames have removed from its map so far. known: bits removed in
        total. boxed_in: whether the robot was boxed in since the last call.
        """
        if boxed_in and self._noted_at is not None:
            self._boxed_in += now - self._noted_at
        self._noted_at = now
        if self.rests:
            if known - self._known_at_rest >= _NEWS_SHARE * self._best:
                self.rests = False
                self._window.clear()
            return
        if boxed_in:
            return
        now -= self._boxed_in
        self._window.append((now, learned))
        while len(self._window) > 1 and self._window[1][0] <= now - self._rule.window:
            self._window.popleft()
        begin, before = self._window[0]
        if now - begin < self._rule.window:
            return
        self._best = max(self._best, learned - before)
        if learned - before < self._rule.share * self._best:
            self.rests, self._known_at_rest = True, known


_RECENT_FRAMES = 12  # frames whose returns are obstacles for the planner, even where the map is free
_TRAIL_LENGTH = 200  # positions of the trail, at most
_STANDING = 1e-3  # metres per step. A robot that moves less is at rest.


class Robot:
    """The state of one robot.

    Attributes:
        state: (7,) x, y, z, yaw (m, rad) and the velocities v, v_z, ω (m/s, rad/s).
        path: (S, 7) states of the plan that it follows. braking: (B, 7) how it comes to rest after it.
        trail: (N, 3), metres, recent positions, the latest last; at first the way to its start.
        plans: the last plan heard of each teammate, by robot id.
        path_length: metres flown. collisions: ticks with a collision.
    """

    def __init__(
        self,
        number: int,
        pose: Tensor,
        mapper: Mapper,
        planner: Planner,
        start: InitialFreeSpace,
        rest: StoppingRule,
        incarnation: int = 0,
    ) -> None:
        self.number, self.mapper, self.planner = number, mapper, planner
        self.library, self.roadmap = ViewLibrary(number, incarnation=incarnation), Roadmap()
        self.state = torch.cat([pose.double(), torch.zeros(3, dtype=torch.float64)])
        self.path = self.state[None].clone()
        self.braking = self.state[None].clone()
        self.path_length = 0.0
        self.collisions = 0
        self.plans: dict[int, PlanMessage] = {}
        self.trail = start.trail.clone()
        self.stopping = StoppingCriterion(rest)
        self._known_free = start.known_free
        self._recent: deque[Tensor] = deque(maxlen=_RECENT_FRAMES)  # cells of the returns of each frame
        self._plan_kind = ""
        self._learned = 0.0  # bits that its own frames removed from the entropy of its map

    @property
    def position(self) -> Tensor:
        return self.state[:3]

    def follow(self, plan: Plan) -> None:
        """Follows a plan that starts at the present state."""
        self.path, self.braking = plan.path, plan.braking
        self._plan_kind = plan.kind

    def advance(self, begin: int, stop: int) -> Tensor:
        """Flies from step `begin` of the path to step `stop`; returns the positions (stop - begin, 3)."""
        flown = self.path[begin:stop]
        if len(flown):
            steps = torch.cat([self.state[None], flown])[:, :3]
            self.path_length += float((steps[1:] - steps[:-1]).norm(dim=1).sum())
            self.state = flown[-1].clone()
            self._extend_trail(flown[:, :3])
        return flown[:, :3]

    def _extend_trail(self, flown: Tensor) -> None:
        """Adds positions (S, 3) to the trail; a recovery flies back along the trail, and shortens it."""
        if self._plan_kind == "retreat":
            self.trail = shortened(self.trail, flown)
            return
        way = torch.cat([self.trail[-1:], flown])
        moved = (way[1:] - way[:-1]).norm(dim=1) > _STANDING
        self.trail = torch.cat([self.trail, flown[moved]])[-_TRAIL_LENGTH:]

    def sense(self, frame: DepthFrame) -> FrameUpdate:
        """Learns from a frame of its camera."""
        self.mapper.center_on(self.position)
        before = self.mapper.belief.known_bits
        update = self.mapper.sense(frame)
        self._learned += self.mapper.belief.known_bits - before
        self._remember_returns(frame)
        return update

    def should_rest(self, now: float) -> bool:
        """Whether it has learned too little lately to continue; see `StoppingCriterion`."""
        self.stopping.note(
            now, self._learned, self.mapper.belief.known_bits, boxed_in=self._plan_kind == "boxed_in"
        )
        return self.stopping.rests

    def _remember_returns(self, frame: DepthFrame) -> None:
        """Stores the cells of a frame's returns, which the planner avoids."""
        resolution = self.mapper.local.resolution
        cells = (frame.ends[frame.is_hit] / resolution).floor().long()
        if len(cells) == 0:
            return
        low, size = cells.amin(0), cells.amax(0) - cells.amin(0) + 1
        hit = torch.zeros(size.tolist(), dtype=torch.bool, device=cells.device)
        hit[(cells - low).unbind(1)] = True
        self._recent.append((hit.nonzero() + low).cpu())

    def local_map(self, planning_prior: float, radius: float, window: tuple[int, int, int]) -> LocalMap:
        """A snapshot of `window` cells around the robot, for the planner.

        planning_prior: occupancy probability of unobserved cells. radius: of the robot, metres.
        """
        local, rule = self.mapper.local, self.mapper.belief.rule
        box = local.around(self.position, window)
        hits, misses = torch.stack(local.evidence(box)).cpu()  # the planner works on the CPU
        recent = list(self._recent)
        return local_map_of(
            box.low.cpu(),
            local.resolution,
            hits,
            misses,
            prior=rule.prior,
            planning_prior=planning_prior,
            free_below=rule.free,
            radius=radius,
            known_free=self._known_free,
            obstacles=torch.cat(recent) if recent else torch.zeros(0, 3, dtype=torch.int64),
        )


_SEEDS_PER_MISSION = 1 << 10  # robot ids for which the random draws differ
_LATEST_PLANS = 10  # A plan whose number is lower than the last one's by more comes from a restarted robot
_RESTING_PLANS = 10  # plans of a robot at rest, of which one is sent
_VIEWS_EVERY = 40.0  # seconds between messages of views: many change or are removed before they are sent
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
        self._places: dict[int, tuple[float, Tensor]] = {}  # where teammates were, (N, 3), and when
        self._newest: dict[int, int] = {}  # sequence of the newest component of each teammate
        self._told_at = -math.inf  # time of the newest plan, or frame with components, that it sent
        self._sensed_at = self._learned_at = -math.inf  # times of the last frame, and of the last with news
        self.refused: Counter[str] = Counter()
        self._evaluator, self._primitives = evaluator, primitives
        self._waiting = Waiting(primitives, _PATIENCE)
        # Each robot has its own generator, so its draws do not depend on the other robots.
        seed = options.seed * _SEEDS_PER_MISSION + robot.number
        self._generator = torch.Generator().manual_seed(seed)
        self._local_map: LocalMap | None = None  # none is needed at rest
        self._rests = False
        self._seen_from: tuple[Tensor, tuple[Tensor, Tensor]] | None = None  # the last pose, and its beams
        self._plan: Plan | None = None
        self._views_at = self._map_at = -math.inf  # when views, and the map, were due last
        self._held_at = -math.inf  # since when few records wait for more to come
        self._sent_pose: Tensor | None = None  # where it rests, according to the last plan sent
        self._n_unsent = 0  # plans at that pose since

    @property
    def number(self) -> int:
        """The robot's id."""
        return self.robot.number

    def digest(self) -> bytes:
        """Equal for robots that hold the same map."""
        return self.robot.mapper.shared.digest()

    def keep_in(self, store: Store) -> None:
        """Stores the map's records from now on, and adds the records that the store restored to the map."""
        self.radio.store = store
        self.robot.mapper.center_on(self.robot.position)
        self.robot.mapper.receive([])

    def capture(self, mesh: MeshWorld, others: Tensor) -> DepthFrame:
        """A depth image of the world, in which teammates at (M, 3) are masked."""
        with self.watch("rendering"):
            options = self.options
            pose = self.robot.state[:4]
            if self._seen_from is None or not torch.equal(self._seen_from[0], pose):
                self._seen_from = pose.clone(), options.camera.beams(mesh, pose)
            return options.camera.sense(
                mesh, pose, others, options.dynamics.radius, self._generator, self._seen_from[1]
            )

    def learn(self, frame: DepthFrame, now: float) -> FrameUpdate:
        """Learns from a frame, and sends what is due of the map."""
        with self.watch("mapping"):
            update = self.robot.sense(frame)
        self._sensed_at, self._learned_at = now, now if update.evidence else self._learned_at
        with self.watch("sharing"):
            self.send_map(now)
        return update

    def send_map(self, now: float) -> None:
        """Sends what is due of the map, and announcements if they are due; less than a datagram once
        in a planning period only, so that components of several frames share it. While it flies, few
        records wait longer: they tell teammates little, and a datagram of their own takes many bytes."""
        shared, period = self.robot.mapper.shared, self.options.dynamics.duration
        is_early = self._map_at <= now < self._map_at + period - 1e-9  # or the clock was set back
        if not self.options.shares or (is_early and shared.waits):
            return
        self._map_at = now
        flies = self._sensed_at <= now < self._sensed_at + period
        is_held = self._held_at <= now < self._held_at + self._longest_hold - 1e-9
        if is_held and flies and shared.is_little:
            datagrams = shared.datagrams(budget=0)  # so that records in flight arrive
        else:
            datagrams = self.radio.within_budget(lambda budget: shared.datagrams(budget=budget), now)
            self._held_at = now
        if datagrams:
            self._told_at = max(self._told_at, self._learned_at)
        if self.radio.announcements.due(now, (shared.version,), bool(shared.missing), shared.is_complete):
            datagrams += shared.announcements()
        self.radio.send(datagrams, now)

    def send_views(self, now: float) -> None:
        """Sends views every `_VIEWS_EVERY` seconds, if the map leaves enough of the budget."""
        library = self.robot.library
        is_due = not self._views_at <= now < self._views_at + _VIEWS_EVERY  # or the clock was set back
        with self.watch("sharing"):
            if self.options.shares and is_due:
                views = self.radio.within_budget(
                    lambda budget: library.datagrams(budget=budget), now, spare=MAX_BYTES
                )
                self.radio.send(views, now)
                self._views_at = now if views else self._views_at

    def listen(self, now: float) -> None:
        """Merges the messages that arrived by the time `now` (s)."""
        with self.watch("sharing"):
            received = self.radio.receive(now)
        for item in received:
            if isinstance(item.message, PlanMessage):
                self._note_plan(item.sender, item.message, now)
            elif isinstance(item.message, ViewsMessage):
                self.robot.library.receive(item.message, now)
            elif isinstance(item.message, ComponentsMessage):
                self._note_place(item.sender, item.message.components, now)
        with self.watch("mapping"):
            merged = self.robot.mapper.receive(
                [item for item in received if not isinstance(item.message, PlanMessage | ViewsMessage)]
            )
            self.radio.keep(merged)

    def _note_plan(self, sender: int, plan: PlanMessage, now: float) -> None:
        """Stores a teammate's plan, unless it is a repetition or a later plan has overtaken it. A plan with a
        lower number comes from a restarted robot if it is much lower, or if the stored path has been
        flown."""
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
        self._places[sender] = now, torch.cat([plan.path, plan.views])[:, :3].double()

    def _note_place(self, sender: int, components: Components, now: float) -> None:
        """Stores from where a teammate has seen its newest component, which it may have held back."""
        newest = int(components.ids[:, 1].argmax())
        robot, sequence = components.ids[newest].tolist()
        is_teammate = robot == sender != self.number and sender < self.options.size
        if is_teammate and sequence > self._newest.get(sender, -1):
            self._newest[sender] = sequence
            origins = components.origins[components.seen_from[components.seen_by == newest]]
            self._places[sender] = now - self._longest_hold, origins.double()

    @property
    def _longest_hold(self) -> float:
        """Seconds for which components wait until they are sent, at most."""
        return max(self.options.dynamics.duration, self.options.announce_every)

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

        final: ids of the teammates whose views are discounted, if their plan arrived at the time `since` (s)
        or later; None: `now`. peers: committed paths of the other robots, which the plan avoids.
        """
        with self.watch("planning"):
            if self._local_map is None:
                self._plan = self._waiting.rest(self.robot.state)
                return self._plan
            known = [
                torch.cat([heard.path[-1:], heard.views]).to(torch.float64)
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
        """Sends the plan proposed last, as that of planning round `number`, unless it changes no plan of a
        teammate."""
        if self._plan is None or not self.options.shares:
            return
        with self.watch("sharing"):
            path, views, step = self._plan.path[:, :4], self._plan.views, self.options.dynamics.step
            if len(views) and torch.equal(views[0], path[-1]):
                views = views[1:]  # a robot always observes from the end of its path
            if self._is_far(torch.cat([path, views])[:, :3], now) or self._repeats(self._plan):
                return
            if len(path) % 2 == 0:
                path, step = path[1::2], 2 * step  # a path is interpolated
            self.radio.send(encode_plan(self.number, number, now, step, path, views), now)
            self._told_at = now

    def _is_far(self, places: Tensor, now: float) -> bool:
        """Whether places (N, 3) of a plan are out of the range of a camera from all teammates, wherever these
        have flown since their last plans and components; and farther than two robots fly until the next plan.
        So what both may see is little, and no paths cross. A teammate that was told later where this robot is
        knows better than this robot whether it is near, and sends its plan if so."""
        options = self.options
        speed = math.hypot(options.dynamics.speed, options.dynamics.climb)
        reach = max(options.camera.max_range, 2 * speed * options.dynamics.duration)
        if len(self._places) < options.size - 1:
            return False
        for then, theirs in self._places.values():
            apart = torch.cdist(places.double(), theirs).amin().item() if len(theirs) else 0.0
            if apart <= reach + speed * max(0.0, now - max(then, self._told_at)):
                return False
        return True

    def _repeats(self, plan: Plan) -> bool:
        """Whether a plan rests at the pose of the last plan sent, and need not be sent again yet."""
        moves = bool((plan.path[:, :4] != plan.path[-1, :4]).any())
        pose = None if moves or not self._rests else plan.path[-1, :4]
        if pose is None or self._sent_pose is None or not torch.equal(pose, self._sent_pose):
            self._sent_pose, self._n_unsent = pose, 0
            return False
        self._n_unsent = (self._n_unsent + 1) % _RESTING_PLANS
        return self._n_unsent != 0
