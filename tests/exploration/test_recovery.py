"""Back along the trail, and only where nothing else is left."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from exploration.voxel_worlds import PRIMITIVES, surroundings_from, task_of
from torch import Tensor

from gmmtorch.exploration.planning.coordination import PeerTrajectories
from gmmtorch.exploration.planning.planner_interface import PlanningTask
from gmmtorch.exploration.planning.recovery import retreat, shortened

SHAPE = (40, 40, 20)
HERE = torch.tensor([4.1, 4.1, 2.1], dtype=torch.float64)


def corner(n: int = 20) -> Tensor:
    """A trail (n, 3) that comes along y, turns, and ends at HERE along x, a tenth of a metre a step."""
    way = HERE.repeat(n, 1)
    back = torch.arange(n - 1, -1, -1, dtype=torch.float64) / 10
    way[:, 0] -= back.clamp_max(0.5)
    way[:, 1] -= (back - 0.5).clamp_min(0)
    return way


def task(free: bool = False, trail: Tensor | None = None, **changes: Any) -> PlanningTask:
    """A robot at rest at HERE, in a world that it takes for occupied, or free."""
    state = torch.cat([HERE, torch.tensor([0.7, 0, 0, 0], dtype=torch.float64)])
    trail = corner() if trail is None else trail
    given = {"state": state, "local_map": surroundings_from(torch.full(SHAPE, free)), "trail": trail}
    return task_of(**{**given, **changes})


def test_recovery_flies_back_and_ends_at_rest() -> None:
    plan = retreat(PRIMITIVES, task())
    assert plan is not None
    assert plan.kind == "retreat"
    dynamics = PRIMITIVES.dynamics
    places = torch.cat([HERE[None], plan.path[:, :3]])
    assert len(plan.path) == dynamics.n_steps
    # Every place is on the trail: on the last half metre along x, or on what is along y before it.
    on_x = (places[:, 1] - HERE[1]).abs() < 1e-9
    on_y = (places[:, 0] - (HERE[0] - 0.5)).abs() < 1e-9
    assert bool((on_x | on_y).all())
    assert plan.path[-1, :3].tolist() == pytest.approx([3.6, 3.8, 2.1])
    speed = (places[1:] - places[:-1]).norm(dim=1) / dynamics.step
    rest = torch.zeros(1, dtype=speed.dtype)
    change = torch.cat([rest, speed, rest]).diff().abs() / dynamics.step
    assert float(speed.max()) < dynamics.speed
    assert float(change.max()) <= dynamics.acceleration
    assert bool((plan.path[:, 3] == 0.7).all())
    assert bool((plan.path[:, 4:] == 0).all())
    assert torch.equal(plan.braking, plan.path[-1:])


def test_repeated_recovery_returns_to_the_start_of_the_trail() -> None:
    trail, state = corner(), task().state
    first = trail[0]
    for _ in range(4):
        plan = retreat(PRIMITIVES, task(trail=trail, state=state))
        if plan is None:
            break
        trail, state = shortened(trail, plan.path[:, :3]), plan.path[-1]
    assert state[:3].tolist() == pytest.approx(first.tolist(), abs=1e-9)
    assert len(trail) == 1


@pytest.mark.parametrize("case", ["it fits", "it moves", "no trail", "somebody is there"])
def test_recovery_is_none_if_the_robot_can_leave(case: str) -> None:
    moving = torch.cat([HERE, torch.tensor([0.7, 0.4, 0, 0], dtype=torch.float64)])
    behind = corner()[-6] - torch.tensor([0.6, 0.0, 0.0])
    tasks = {
        "it fits": task(free=True),
        "it moves": task(state=moving),
        "no trail": task(trail=HERE[None]),
        "somebody is there": task(peers=PeerTrajectories.of([behind[None]])),
    }
    assert retreat(PRIMITIVES, tasks[case]) is None
    assert retreat(PRIMITIVES, task()) is not None
