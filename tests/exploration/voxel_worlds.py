"""Small worlds of voxels, a camera that sees them by walking along its beams, and a robot that explores."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gmmtorch.occupancy import Box, cast_evidence
from gmmtorch.team.exploration.planning.collision_checking import (
    LocalMap,
    PeerTrajectories,
    cells_in_sphere,
    local_map_of,
)
from gmmtorch.team.exploration.planning.journeys import Roadmap
from gmmtorch.team.exploration.planning.planner_interface import Plan, Planner, PlanningTask
from gmmtorch.team.exploration.planning.primitives import Dynamics, Primitives
from gmmtorch.team.exploration.planning.view_evaluator import ViewEvaluator
from gmmtorch.team.sharing.view_library import ViewLibrary

RESOLUTION = 0.2
PRIMITIVES = Primitives(Dynamics())
EVALUATOR = ViewEvaluator(math.radians(87), math.radians(58), 6.0, RESOLUTION, n_beams=120)
NOBODY = PeerTrajectories.of([])


def surroundings_from(passable: Tensor, low: tuple[int, int, int] = (0, 0, 0)) -> LocalMap:
    """LocalMap in which all is known: passable cells are free."""
    known = torch.ones_like(passable)
    occupancy = torch.where(passable, 0.0, 1.0)
    return LocalMap(torch.tensor(low), RESOLUTION, occupancy, known, passable, passable)


def task_of(local_map: LocalMap, state: Tensor, **changes: Any) -> PlanningTask:
    """The task of a robot alone, of which nothing is known but its map."""
    n_blocks = math.prod(-(-n // 4) for n in local_map.shape)
    given = {
        "peers": NOBODY,
        "residual": torch.ones(n_blocks),
        "library": ViewLibrary(0),
        "roadmap": Roadmap(),
        "now": 0.0,
        "generator": torch.Generator().manual_seed(0),
        "trail": state[None, :3],
        **changes,
    }
    return PlanningTask(state=state, local_map=local_map, **given)


def hollow(nx: int, ny: int, nz: int) -> Tensor:
    """A closed room (nx, ny, nz), True where occupied."""
    solid = torch.ones(nx, ny, nz, dtype=torch.bool)
    solid[1:-1, 1:-1, 1:-1] = False
    return solid


def two_rooms() -> Tensor:
    """Two rooms of 5 × 6 × 2.6 m behind one another, with a door 1.4 m wide between."""
    solid = hollow(54, 32, 15)
    solid[26:28] = True
    solid[26:28, 12:19, 1:12] = False
    return solid


def corridor() -> Tensor:
    """An L of two corridors 2 m wide, 12 and 8 m long."""
    solid = torch.ones(62, 42, 13, dtype=torch.bool)
    solid[1:61, 1:11, 1:12] = False
    solid[51:61, 1:41, 1:12] = False
    return solid


@dataclass
class Explorer:
    """A robot in a world `solid` that remembers all it has seen; the world is its window."""

    solid: Tensor
    state: Tensor
    library: ViewLibrary
    roadmap: Roadmap
    hits: Tensor
    misses: Tensor
    start: Tensor
    seen: list[float]
    flown: float = 0.0
    now: float = 0.0

    @classmethod
    def at(cls, solid: Tensor, pose: tuple[float, float, float, float], robot: int = 0) -> Explorer:
        state = torch.tensor([*pose, 0.0, 0.0, 0.0], dtype=torch.float64)
        zeros = torch.zeros(solid.shape)
        library = ViewLibrary(robot)
        explorer = cls(solid, state, library, Roadmap(), zeros, zeros.clone(), state[:3].clone(), seen=[])
        explorer.sense(state)
        return explorer

    def sense(self, state: Tensor) -> None:
        """Walk along 40 × 30 beams in steps of 4 cm."""
        tan_h, tan_v = math.tan(math.radians(87) / 2), math.tan(math.radians(58) / 2)
        u, v = torch.meshgrid(
            torch.linspace(-tan_h, tan_h, 40), torch.linspace(-tan_v, tan_v, 30), indexing="ij"
        )
        beams = torch.stack([torch.ones(1200), u.flatten(), v.flatten()], 1).double()
        beams = beams / beams.norm(dim=1, keepdim=True)
        c, s = math.cos(float(state[3])), math.sin(float(state[3]))
        turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
        steps = torch.arange(0.04, 6.0, 0.04, dtype=torch.float64)
        points = state[:3] + steps[:, None] * (beams @ turn.T)[:, None]  # (R, T, 3)
        cell = (points / RESOLUTION).floor().long()
        size = torch.tensor(self.solid.shape)
        inside = ((cell >= 0) & (cell < size)).all(-1)
        cell = torch.where(inside[..., None], cell, 0)
        struck = self.solid[cell.unbind(-1)] & inside
        is_hit = struck.any(1)
        last = torch.where(is_hit, struck.int().argmax(1), len(steps) - 1)
        ends = points[torch.arange(len(points)), last]
        evidence = cast_evidence(state[:3], ends, is_hit, RESOLUTION, Box(torch.zeros(3).long(), size))
        at = evidence.cells.unbind(1)
        self.hits[at] += evidence.hits
        self.misses[at] += evidence.misses
        self.seen.append(float(((self.hits + self.misses) > 0).float().mean()))

    def know_all(self) -> Explorer:
        self.misses[~self.solid] = 9.0
        self.hits[self.solid] = 9.0
        return self

    def local_map(self) -> LocalMap:
        return local_map_of(
            torch.zeros(3, dtype=torch.int64),
            RESOLUTION,
            self.hits.clone(),
            self.misses.clone(),
            prior=1.0,
            planning_prior=0.125,
            free_below=0.35,
            radius=0.3,
            known_free=cells_in_sphere(self.start, 1.3, RESOLUTION),
        )

    def task(self, generator: torch.Generator, peers: PeerTrajectories = NOBODY) -> PlanningTask:
        local_map = self.local_map()
        self.roadmap.update(local_map)
        memory = {"library": self.library, "roadmap": self.roadmap, "now": self.now}
        return task_of(local_map, self.state, peers=peers, generator=generator, **memory)

    def follow(self, plan: Plan) -> None:
        """Fly the path, looking twice on the way; the body must touch nothing."""
        path = torch.cat([self.state[None], plan.path])
        self.flown += float((path[1:, :3] - path[:-1, :3]).norm(dim=1).sum())
        for row in (5, 10):
            self.sense(path[row])
        self.state = plan.path[-1].clone()
        self.now += 2.0

    def clearance(self, points: Tensor) -> float:
        """Least metres from points (N, 3) to an occupied cell of the world."""
        low = self.solid.nonzero().double() * RESOLUTION
        gap = torch.maximum(low - points[:, None], points[:, None] - low - RESOLUTION).clamp_min(0)
        return float(gap.norm(dim=-1).min())


def explore(planner: Planner, explorer: Explorer, n_plans: int, seed: int = 0) -> list[Plan]:
    """As many plans in a row, each flown to its end."""
    generator = torch.Generator().manual_seed(seed)
    plans = []
    for _ in range(n_plans):
        plans.append(planner.plan(explorer.task(generator)))
        explorer.follow(plans[-1])
    return plans
