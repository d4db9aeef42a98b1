"""Tree search, against all branches written out, with an evaluator whose values are made up."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from exploration.voxel_worlds import EVALUATOR, PRIMITIVES, Explorer, surroundings_from, task_of

from gmmtorch.kernels import kernels
from gmmtorch.team.exploration.planning.collision_checking import PeerTrajectories, feasible
from gmmtorch.team.exploration.planning.journeys import DistanceField, Goal
from gmmtorch.team.exploration.planning.planner_interface import PlanningTask
from gmmtorch.team.exploration.planning.tree_search import SearchRule, search_tree
from gmmtorch.team.exploration.planning.view_evaluator import ViewCache, ViewValues

N_BLOCKS = 6


class MadeUp:
    """Views on a lattice of 0.5 m and eighths of a turn, with gains drawn by their keys."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.calls: list[np.ndarray] = []

    def keys(self, poses: torch.Tensor) -> np.ndarray:
        yaw = (poses[:, 3:] / (math.pi / 4)).round().long() % 8
        return torch.cat([(poses[:, :3] / 0.5).round().long(), yaw], 1).numpy()

    def poses(self, keys: np.ndarray) -> torch.Tensor:
        keys = torch.from_numpy(keys)
        return torch.cat([keys[:, :3] * 0.5, keys[:, 3:] * (math.pi / 4)], 1).double()

    def evaluate(self, local_map, keys: np.ndarray) -> ViewValues:
        self.calls.append(keys)
        gain, measured = [], []
        for key in keys.tolist():
            drawn = torch.Generator().manual_seed(hash((self.seed, *key)) % 2**31)
            gain.append(torch.rand(N_BLOCKS, generator=drawn) ** 4)
            measured.append(torch.rand(N_BLOCKS, generator=drawn))
        return ViewValues(torch.stack(gain), torch.stack(measured))


def task_in(
    passable: torch.Tensor, position: tuple[float, float, float], seed: int = 0, **changed
) -> PlanningTask:
    state = torch.tensor([*position, 0.3, 0.0, 0.0, 0.0], dtype=torch.float64)
    given = {"residual": torch.ones(N_BLOCKS), "generator": torch.Generator().manual_seed(seed)}
    return task_of(surroundings_from(passable), state, **{**given, **changed})


ROOM, MIDDLE = torch.zeros(30, 30, 12, dtype=torch.bool), (2.0, 2.5, 1.2)
ROOM[3:27, 3:22, 2:10] = True


def all_branches(task: PlanningTask, depth: int) -> list[tuple[int, ...]]:
    """Every feasible sequence of primitives, longest ones included."""
    found, level = [], [((), task.state)]
    for step in range(depth):
        following = []
        for actions, state in level:
            paths = PRIMITIVES.rollout(state[None])
            braking = PRIMITIVES.braking(paths[:, :, -1])
            peers = task.peers.later(10 * step)
            safe = feasible(paths, braking, task.local_map, peers, start=state[None, None])[0]
            following += [((*actions, a), paths[0, a, -1]) for a in safe.nonzero()[:, 0].tolist()]
        found += [actions for actions, _ in following]
        level = following
    return found


def return_of(task: PlanningTask, evaluator: MadeUp, actions: tuple[int, ...], discount: float) -> float:
    """The return of a branch, one view after the other."""
    state, total = task.state, 0.0
    seen = evaluator.evaluate(None, evaluator.keys(state[None, :4])).measured[0]
    residual = task.residual * (1 - seen)
    for step, action in enumerate(actions):
        state = PRIMITIVES.rollout(state[None])[0, action, -1]
        values = evaluator.evaluate(None, evaluator.keys(state[None, :4]))
        total += discount**step * float((values.gain[0] * residual).sum())
        residual = residual * (1 - values.measured[0])
    return total


def test_search_finds_the_best_of_all_branches():
    rule = SearchRule(depth=2, n_rounds=20, n_leaves=64, discount=0.8)
    for seed in range(3):
        task, evaluator = task_in(ROOM, MIDDLE, seed, residual=torch.rand(N_BLOCKS)), MadeUp(seed)
        found = search_tree(PRIMITIVES, rule, task, ViewCache(task, evaluator))
        assert found is not None
        branches = all_branches(task, 2)
        assert len(branches) > 50
        best = max(return_of(task, evaluator, branch, 0.8) for branch in branches)
        assert found.value == pytest.approx(best, rel=1e-5)
        again = return_of(task, evaluator, tuple(found.actions), 0.8)
        assert again == pytest.approx(found.value, rel=1e-5)
        assert found.information == pytest.approx(
            return_of(task, evaluator, tuple(found.actions), 1.0), rel=1e-5
        )


def test_found_describes_its_branch():
    task, evaluator = task_in(ROOM, MIDDLE), MadeUp(0)
    found = search_tree(PRIMITIVES, SearchRule(), task, ViewCache(task, evaluator))
    assert found is not None
    assert 1 <= len(found.actions) <= 4
    states = [task.state]
    for action in found.actions:
        states.append(PRIMITIVES.rollout(states[-1][None])[0, action, -1])
    torch.testing.assert_close(found.views, torch.stack(states[1:])[:, :4])
    torch.testing.assert_close(found.path, PRIMITIVES.rollout(task.state[None])[0, found.actions[0]])
    torch.testing.assert_close(found.braking, PRIMITIVES.braking(found.path[-1]))


def test_search_evaluates_each_view_once_in_batches():
    task, evaluator = task_in(ROOM, MIDDLE), MadeUp(0)
    search_tree(PRIMITIVES, SearchRule(n_rounds=4, n_leaves=32), task, ViewCache(task, evaluator))
    assert len(evaluator.calls) <= 5
    keys = [tuple(key) for key in np.concatenate(evaluator.calls).tolist()]
    assert len(keys) == len(set(keys))
    assert 40 < len(keys) <= 129


def test_rest_of_the_last_branch_is_tried_first():
    task, evaluator = task_in(ROOM, MIDDLE), MadeUp(7)
    full = SearchRule(depth=2, n_rounds=20, n_leaves=64)
    best = search_tree(PRIMITIVES, full, task, ViewCache(task, evaluator))
    brief = SearchRule(depth=2, n_rounds=1, n_leaves=1)
    found = search_tree(PRIMITIVES, brief, task, ViewCache(task, evaluator), first=best.actions)
    assert found.actions == best.actions
    assert found.value == pytest.approx(best.value)
    beyond = search_tree(
        PRIMITIVES, brief, task, ViewCache(task, evaluator), first=[0, 0, 0, 0, 0]
    )  # flies into the wall
    assert beyond is not None
    assert len(beyond.actions) <= 2


def test_search_with_a_goal_approaches_it():
    task = task_in(ROOM, MIDDLE)
    goal_at = torch.tensor([[4.6, 3.4, 1.4]], dtype=torch.float64)
    goal = Goal(DistanceField.to(task.local_map, goal_at), weight=2.0, yaw=1.5)
    found = search_tree(PRIMITIVES, SearchRule(), task, goal=goal)
    assert found is not None
    assert found.information == 0
    assert found.progress > 1.5
    assert float((found.views[-1, :3] - goal_at).norm()) < 1.0
    costs = [float(goal.cost(task.state))]
    state = task.state
    for action in found.actions:
        state = PRIMITIVES.rollout(state[None])[0, action, -1]
        costs.append(float(goal.cost(state)))
    sooner = sum(2.0 * 0.9**i * (a - b) for i, (a, b) in enumerate(itertools.pairwise(costs)))
    assert found.value == pytest.approx(sooner, rel=1e-6)


def test_goal_cost_includes_the_way_and_the_turns():
    here = surroundings_from(torch.ones(50, 50, 10, dtype=torch.bool))
    goal_at = torch.tensor([[8.2, 5.0, 1.0]], dtype=torch.float64)
    goal = Goal(DistanceField.to(here, goal_at), weight=1.0, yaw=math.pi / 2)

    def cost(x: float, y: float, z: float, yaw: float) -> float:
        return float(goal.cost(torch.tensor([x, y, z, yaw, 0, 0, 0], dtype=torch.float64)))

    assert cost(3.2, 5.0, 1.0, 0.0) == pytest.approx(
        5.0 + 1.25 * math.pi / 2, abs=0.5
    )  # straight on, then left
    assert cost(3.2, 5.0, 1.0, math.pi) == pytest.approx(5.0 + 1.25 * 1.5 * math.pi, abs=0.5)
    assert cost(8.2, 5.0, 1.0, math.pi / 2) == pytest.approx(0.0, abs=0.1)
    assert cost(8.2, 5.0, 1.0, -math.pi / 2) == pytest.approx(1.25 * math.pi, abs=0.1)


def test_search_keeps_clear_of_peers_in_time():
    other = torch.tensor([[2.9, 2.7, 1.2]], dtype=torch.float64)
    task = task_in(ROOM, MIDDLE, peers=PeerTrajectories.of([other]))
    found = search_tree(PRIMITIVES, SearchRule(), task, ViewCache(task, MadeUp(0)))
    assert found is not None
    apart = (found.path[:, :3] - other).norm(dim=1)
    assert float(apart.min()) > 0.7
    assert float((found.views[:, :3] - other).norm(dim=1).min()) > 0.7


def test_search_at_the_start_looks_around():
    """All that is free is the sphere around the start: there is nowhere to go, but much to see."""
    solid = torch.zeros(40, 40, 20, dtype=torch.bool)
    explorer = Explorer.at(solid, (4.0, 4.0, 2.0, 0.0))
    explorer.hits.zero_()
    explorer.misses.zero_()
    task = explorer.task(torch.Generator().manual_seed(0))
    found = search_tree(PRIMITIVES, SearchRule(), task, ViewCache(task, EVALUATOR))
    assert found is not None
    assert found.information > 0
    looks = [float(yaw) for yaw in found.views[:, 3]]
    assert max(looks) - min(0.0, *looks) > 1.5


@pytest.mark.parametrize("seed", range(12))
def test_the_fused_tree_is_that_of_its_twin(seed):
    """With views, goals, teammates, walls, a branch to begin with, and a start in a corner or in a wall."""
    draw = torch.Generator().manual_seed(seed)
    passable = ROOM & (torch.rand(ROOM.shape, generator=draw) > 0.01 * (seed % 3))
    place = (MIDDLE, (0.65, 0.65, 0.45), (0.5, 0.5, 0.3))[seed % 3]
    peers = PeerTrajectories(
        torch.tensor([2.0, 2.5, 1.2]).double() + torch.randn(2, 25, 3, generator=draw).double().cumsum(1) / 8
    )
    rule = SearchRule(depth=2 + seed % 3, n_rounds=3, n_leaves=24)
    found = []
    for kind in ("torch", "fused"):
        with kernels(kind):
            task = task_in(passable, place, seed, **({"peers": peers} if seed % 2 else {}))
            goal = None
            if seed % 4 > 1:
                target = torch.tensor([[4.0, 3.0, 1.2]]).double()
                goal = Goal(DistanceField.to(task.local_map, target), 0.3, 1.0)
            memory = None if seed % 4 == 3 else ViewCache(task, MadeUp(seed))
            branch = search_tree(PRIMITIVES, rule, task, memory, goal, [seed % 5, 3, 7])
            found.append((branch, torch.rand((), generator=task.generator)))
    (one, drawn), (other, also_drawn) = found
    assert drawn == also_drawn
    assert (one is None) == (other is None)
    if one is not None and other is not None:
        assert one.actions == other.actions
        for name in ("path", "braking", "views"):
            assert torch.equal(getattr(one, name), getattr(other, name))
        for name in ("value", "information", "progress"):
            assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-6, abs=1e-9)
