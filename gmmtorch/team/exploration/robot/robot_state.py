"""Robot: the state of one member of a team: its map, its planner, its path, and when it stops exploring."""

from __future__ import annotations

from collections import deque

import torch
from torch import Tensor

from gmmtorch.simulation import DepthFrame
from gmmtorch.team.exploration.information.view_library import ViewLibrary
from gmmtorch.team.exploration.mission.options import StoppingRule
from gmmtorch.team.exploration.planning.collision_checking import local_map_of
from gmmtorch.team.exploration.planning.planner_interface import Plan, Planner
from gmmtorch.team.exploration.planning.recovery import shortened
from gmmtorch.team.exploration.planning.roadmap import Roadmap
from gmmtorch.team.exploration.robot.mapper import FrameUpdate, LocalMap, Mapper
from gmmtorch.team.exploration.world.starts import InitialFreeSpace
from gmmtorch.team.sharing import PlanMessage

_NEWS_SHARE = 0.25
"""Share of the best window that teammates must learn before a resting robot explores again."""


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

        Args:
            learned: bits that the robot's own frames have removed from its map so far.
            known: bits removed in total. boxed_in: whether the robot was boxed in since the last call.
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


_RECENT_FRAMES = 12
"""Frames whose returns are obstacles for the planner, even where the map is free."""
_TRAIL_LENGTH = 200
"""Positions of the trail, at most."""
_STANDING = 1e-3
"""Metres per step. A robot that moves less is at rest."""


class Robot:
    """One robot.

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
        library: ViewLibrary,
        roadmap: Roadmap,
        start: InitialFreeSpace,
        rest: StoppingRule,
    ) -> None:
        self.number = number
        self.mapper, self.planner, self.library, self.roadmap = mapper, planner, library, roadmap
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

        Args:
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
