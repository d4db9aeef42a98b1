"""Coordination on a toy: robots choose sets to cover, and every choice can be enumerated."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.exploration.planning.coordination import COORDINATIONS, Coordination

Choices = list[list[frozenset[int]]]
"""Of each robot, the sets that it may cover."""


def coordinate(name, robots, plan, generator, n_rounds=3):
    """The plans of a team by the rule of that name."""
    return Coordination(name, n_rounds).coordinate(robots, plan, generator)


@dataclass(frozen=True)
class Cover:
    cells: frozenset[int]
    value: float


def planner_of(choices: Choices):
    """The best choice of a robot given the others', and a record of who was asked given whom."""
    asked: list[tuple[int, tuple[int, ...]]] = []

    def plan(robot: int, fixed: dict[int, Cover]) -> Cover:
        asked.append((robot, tuple(sorted(fixed))))
        taken = frozenset().union(*(cover.cells for cover in fixed.values()))
        best = max(choices[robot], key=lambda cells: len(cells - taken))
        return Cover(best, len(best - taken))

    return plan, asked


def covered(plans: dict[int, Cover]) -> int:
    return len(frozenset().union(*(cover.cells for cover in plans.values())))


def optimum(choices: Choices) -> int:
    return max(len(frozenset().union(*pick)) for pick in itertools.product(*choices))


teams = st.lists(
    st.lists(st.frozensets(st.integers(0, 11), max_size=5), min_size=1, max_size=4), min_size=1, max_size=4
)


@given(choices=teams, name=st.sampled_from(COORDINATIONS), seed=st.integers(0, 99), n=st.integers(1, 5))
def test_each_robot_gets_one_feasible_plan(choices, name, seed, n):
    plan, _ = planner_of(choices)
    plans = coordinate(name, range(len(choices)), plan, torch.Generator().manual_seed(seed), n)
    assert sorted(plans) == list(range(len(choices)))
    assert all(cover.cells in choices[robot] for robot, cover in plans.items())


@given(choices=teams, n=st.integers(0, 2))
def test_greedy_covers_at_least_half_of_the_optimum(choices, n):
    generator = torch.Generator().manual_seed(0)
    for name, rounds in (("greedy", 1), ("distributed_greedy", len(choices) + n)):
        plan, _ = planner_of(choices)
        plans = coordinate(name, range(len(choices)), plan, generator, rounds)
        assert 2 * covered(plans) >= optimum(choices)


@given(choices=teams)
def test_distributed_greedy_with_a_round_for_each_takes_the_best_gain_first(choices):
    plan, _ = planner_of(choices)
    left, taken = dict(enumerate(choices)), frozenset()
    expected = []
    while left:
        gains = {robot: max(len(cells - taken) for cells in sets) for robot, sets in left.items()}
        robot = max(sorted(gains), key=lambda r: gains[r])
        taken |= max(left.pop(robot), key=lambda cells: len(cells - taken))
        expected.append(robot)
    plans = coordinate("distributed_greedy", range(len(choices)), plan, torch.Generator(), len(choices))
    assert list(plans) == expected
    assert covered(plans) == len(taken)


def test_coordination_passes_the_right_plans():
    choices: Choices = [[frozenset({robot})] for robot in range(4)]
    plan, asked = planner_of(choices)
    coordinate("greedy", range(4), plan, torch.Generator())
    assert asked == [(0, ()), (1, (0,)), (2, (0, 1)), (3, (0, 1, 2))]
    plan, asked = planner_of(choices)
    coordinate("myopic", range(4), plan, torch.Generator())
    assert asked == [(robot, ()) for robot in range(4)]
    plan, asked = planner_of(choices)
    coordinate("distributed_greedy", range(4), plan, torch.Generator(), 2)
    assert asked == [*((robot, ()) for robot in range(4)), (2, (0, 1)), (3, (0, 1))]


@given(seed=st.integers(0, 200), n_rounds=st.integers(1, 4))
def test_random_partition_considers_all_earlier_rounds(seed, n_rounds):
    choices: Choices = [[frozenset({robot})] for robot in range(6)]
    rule = Coordination("random_partition", n_rounds)
    rounds = rule.rounds(6, torch.Generator().manual_seed(seed))
    assert sorted(itertools.chain(*rounds)) == list(range(6))
    assert len(rounds) <= n_rounds
    assert all(rounds)
    plan, asked = planner_of(choices)
    rule.coordinate(range(6), plan, torch.Generator().manual_seed(seed))
    before: list[int] = []
    expected = []
    for robots in rounds:
        expected += [(robot, tuple(sorted(before))) for robot in robots]
        before += robots
    assert asked == expected


def test_bad_input_is_named():
    with pytest.raises(InvalidArgumentError, match="coordination='chaos'"):
        Coordination("chaos")
    with pytest.raises(InvalidArgumentError, match="n_rounds=0"):
        Coordination("greedy", 0)
