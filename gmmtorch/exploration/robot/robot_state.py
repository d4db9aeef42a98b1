"""Robot: one member of a team, with its map, its planner, and the path it is on."""

from __future__ import annotations

from collections import deque
from typing import Any

import torch
from torch import Tensor

from gmmtorch.exploration.information.view_library import ViewLibrary
from gmmtorch.exploration.planning.collision_checking import local_map_of
from gmmtorch.exploration.planning.planner_interface import Plan, Planner
from gmmtorch.exploration.planning.recovery import shortened
from gmmtorch.exploration.planning.roadmap import Roadmap
from gmmtorch.exploration.robot.initial_free_space import InitialFreeSpace
from gmmtorch.exploration.robot.local_map import LocalMap
from gmmtorch.exploration.robot.mapper import FrameUpdate, Mapper
from gmmtorch.exploration.robot.stopping_criterion import StoppingCriterion, StoppingRule
from gmmtorch.sharing.messages.message_registry import PlanMessage
from gmmtorch.simulation.sensors.depth_camera import DepthFrame

_REMEMBERED = 12  # frames whose returns are kept away from, whatever the map makes of them
_TRAIL = 200  # positions flown through lately
_STANDING = 1e-3  # metres in a step


class Robot:
    """What one robot knows and does.

    state: (7,) x, y, z, yaw and the velocities v, v_z, ω now. path: (S, 7) the states of the plan it
    follows. braking: (B, 7) how it would come to rest after it. trail: (N, 3) where it flew lately, the
    latest last; at first the way on which it was carried to its start.
    """

    def __init__(
        self,
        number: int,
        pose: Tensor,
        mapper: Mapper,
        planner: Planner,
        library: ViewLibrary,
        roadmap: Roadmap,
        launch: InitialFreeSpace,
        rest: StoppingRule | None = None,
    ) -> None:
        self.number = number
        self.mapper, self.planner, self.library, self.roadmap = mapper, planner, library, roadmap
        self.state = torch.cat([pose.double(), torch.zeros(3, dtype=torch.float64)])
        self.path = self.state[None].clone()
        self.braking = self.state[None].clone()
        self.path_length = 0.0
        self.collisions = 0
        self.plans: dict[int, PlanMessage] = {}  # the last heard of each teammate
        self._known_free = launch.known_free
        self._recent: deque[Tensor] = deque(maxlen=_REMEMBERED)
        self._kind = ""  # of the plan it follows
        self.trail = launch.trail.clone()
        self.returns = StoppingCriterion(rest)
        self._learned = 0.0

    @property
    def position(self) -> Tensor:
        return self.state[:3]

    def follow(self, plan: Plan) -> None:
        """Take up a plan that starts at the present state."""
        self.path, self.braking = plan.path, plan.braking
        self._kind = plan.kind

    def advance(self, begin: int, stop: int) -> Tensor:
        """Fly on from step `begin` of the path to step `stop`; returns the positions on the way (n, 3)."""
        flown = self.path[begin:stop]
        if len(flown):
            steps = torch.cat([self.state[None], flown])[:, :3]
            self.path_length += float((steps[1:] - steps[:-1]).norm(dim=1).sum())
            self.state = flown[-1].clone()
            self._remember_way(flown[:, :3])
        return flown[:, :3]

    def _remember_way(self, flown: Tensor) -> None:
        """The trail, with positions flown through (S, 3); a retreat takes away of it what it went back."""
        if self._kind == "retreat":
            self.trail = shortened(self.trail, flown)
            return
        way = torch.cat([self.trail[-1:], flown])
        moved = (way[1:] - way[:-1]).norm(dim=1) > _STANDING
        self.trail = torch.cat([self.trail, flown[moved]])[-_TRAIL:]

    def sense(self, frame: DepthFrame) -> FrameUpdate:
        """Learn from a frame of its camera."""
        self.mapper.center_on(self.position)
        before = self.mapper.belief.known_bits
        sensed = self.mapper.sense(frame)
        self._learned += self.mapper.belief.known_bits - before
        self._remember(frame)
        return sensed

    def rests(self, now: float) -> bool:
        """Whether it has learned too little lately to fly on, though it could."""
        self.returns.note(
            now, self._learned, self.mapper.belief.known_bits, boxed_in=self._kind == "boxed_in"
        )
        return self.returns.rests

    def _remember(self, frame: DepthFrame) -> None:
        """Keep the cells of a frame's returns, which the planner stays clear of."""
        resolution = self.mapper.local.resolution
        cells = (frame.ends[frame.is_hit] / resolution).floor().long()
        if len(cells) == 0:
            return
        low, size = cells.amin(0), cells.amax(0) - cells.amin(0) + 1
        hit = torch.zeros(size.tolist(), dtype=torch.bool)
        hit[(cells - low).unbind(1)] = True
        self._recent.append(hit.nonzero() + low)

    def local_map(
        self, planning_prior: float, radius: float, window: tuple[int, int, int] | None = None
    ) -> LocalMap:
        """What the planner is given to read: so many cells around the robot, or all of its local map."""
        local, rule = self.mapper.local, self.mapper.belief.rule
        box = local.box if window is None else local.around(self.position, window)
        hits, misses = local.evidence(box)
        recent = list(self._recent)
        return local_map_of(
            box.low,
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

    def checkpoint(self) -> dict[str, Any]:
        """Everything that changes, for a file."""
        return {
            "mapper": self.mapper.state(),
            "planner": self.planner.state(),
            "library": self.library.state(),
            "roadmap": self.roadmap.state(),
            "state": self.state,
            "path": self.path,
            "braking": self.braking,
            "path_length": self.path_length,
            "collisions": self.collisions,
            "plans": [dict(vars(plan)) for plan in self.plans.values()],
            "recent": list(self._recent),
            "trail": self.trail,
            "kind": self._kind,
            "returns": self.returns.state(),
            "learned": self._learned,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        for name in ("mapper", "planner", "library", "roadmap"):
            getattr(self, name).restore(state[name])
        self.state, self.path, self.braking = state["state"], state["path"], state["braking"]
        self.path_length = float(state["path_length"])
        self.collisions = int(state["collisions"])
        self.plans = {int(plan["sender"]): PlanMessage(**plan) for plan in state["plans"]}
        self._recent = deque(state["recent"], maxlen=_REMEMBERED)
        self.trail, self._kind = state["trail"], str(state["kind"])
        self.returns.restore(state["returns"])
        self._learned = float(state["learned"])
