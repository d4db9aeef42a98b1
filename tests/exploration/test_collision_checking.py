"""Safety: inflation, free space and feasible paths against brute force over bodies, cells and times."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.team.exploration.planning.collision_checking import (
    LocalMap,
    PeerTrajectories,
    cells_in_sphere,
    feasible,
    inflated,
    local_map_of,
)
from gmmtorch.team.exploration.planning.primitives import Dynamics, Primitives

LIBRARY = Primitives(Dynamics())
RADIUS, CELL = 0.3, 0.2
SHAPE = (48, 48, 24)
LOW = torch.tensor([-24, -24, -12])


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def known(
    blocked: Tensor, low: Tensor = LOW, resolution: float = CELL, radius: float = RADIUS, **more: Tensor
) -> LocalMap:
    """LocalMap in which all is free but the blocked cells."""
    counts = 100.0 * blocked, 100.0 * ~blocked
    rule = {"prior": 1.0, "planning_prior": 0.125, "free_below": 0.25}
    return local_map_of(low, resolution, *counts, radius=radius, **rule, **more)


def unseen(shape: tuple[int, ...] = SHAPE, low: Tensor = LOW, **options: Any) -> LocalMap:
    """LocalMap in which nothing was observed."""
    rule = {"prior": 1.0, "planning_prior": 0.125, "free_below": 0.25, "radius": RADIUS, **options}
    return local_map_of(low, CELL, torch.zeros(shape), torch.zeros(shape), **rule)


def fine_path(states: Tensor, n: int = 40, step: float = 0.2) -> Tensor:
    """Positions (..., L·n, 3) along states (..., L + 1, 7), by small steps at the velocities in between."""
    share = (torch.arange(n, dtype=torch.float64) + 0.5) / n
    a, b = states[..., :-1, None, 4:], states[..., 1:, None, 4:]
    velocity = (a + (b - a) * share[:, None]).flatten(-3, -2)
    yaw = states[..., :1, 3] + (velocity[..., 2] * (step / n)).cumsum(-1) - velocity[..., 2] * (step / n / 2)
    v, climb = velocity[..., 0], velocity[..., 1]
    moved = torch.stack([v * yaw.cos(), v * yaw.sin(), climb], -1) * (step / n)
    return states[..., :1, :3] + moved.cumsum(-2)


def gaps(points: Tensor, cells: Tensor, resolution: float = CELL) -> Tensor:
    """Metres (N, C) from points (N, 3) to cells (C, 3) of the lattice."""
    low = cells.double() * resolution
    nearest = points[:, None].clamp(low, low + resolution)
    return (points[:, None] - nearest).norm(dim=-1)


def with_start(state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rollouts (P, S, 7), braking (P, B, 7), and whole paths (P, L, 7) with the start, from a state (7,)."""
    rollout = LIBRARY.rollout(state[None])[0]
    braking = LIBRARY.braking(rollout[:, -1])
    return rollout, braking, torch.cat([state.expand(len(LIBRARY), 1, 7), rollout, braking], 1)


@given(
    seed=st.integers(0, 10**6),
    shape=st.tuples(*[st.integers(1, 7)] * 3),
    radius=st.floats(0.01, 1.0),
    resolution=st.floats(0.05, 1.5),
)
def test_inflated_equals_pairwise_comparison(seed, shape, radius, resolution):
    if radius / resolution > 6:
        resolution = radius / 6
    blocked = torch.rand(shape, generator=seeded(seed)) < 0.05
    reach = math.ceil(radius / resolution) + 1
    around = torch.nn.functional.pad(blocked, (reach,) * 6, value=True)
    apart = (torch.arange(-reach, reach + 1).abs() - 1).clamp_min(0).double() * resolution
    gap = (apart[:, None, None].square() + apart[:, None].square() + apart.square()).sqrt()
    ball = (gap < radius - 1e-9).double()[None, None]
    touched = torch.nn.functional.conv3d(around.double()[None, None], ball)[0, 0] > 0.5
    assert torch.equal(inflated(blocked, radius, resolution), touched)


def test_local_map_occupancy_equals_pseudo_counts():
    hits = torch.tensor([0.0, 0, 3, 0.5, 1, 0.5, 1]).view(7, 1, 1).expand(7, 4, 4)
    misses = torch.tensor([0.0, 9, 1, 0, 18, 7, 20]).view(7, 1, 1).expand(7, 4, 4)
    given_hits, given_misses = hits.clone(), misses.clone()
    found = local_map_of(
        torch.tensor([1, 2, 3]), 0.5, given_hits, given_misses,
        prior=0.5, planning_prior=0.125, free_below=0.25, radius=0.3,
    )  # fmt: skip
    expected = [0.125, 0.125 / 10, 3.125 / 5, 0.625 / 1.5, 1.125 / 20, 0.625 / 8.5, 1.125 / 22]
    assert found.occupancy[:, 0, 0].tolist() == pytest.approx(expected)
    assert found.observed[:, 2, 1].tolist() == [False, True, True, True, True, True, True]
    # θ: ½, 0.05, 0.7, 0.667, 0.075, 0.118, 0.068; of the last three, one was hit by every 19th ray.
    assert found.free[:, 3, 3].tolist() == [False, True, False, False, False, True, True]
    assert not bool(found.passable.any())  # at 0.5 m, the body needs more than four cells
    assert found.occupancy.dtype == torch.float32
    assert torch.equal(given_hits, hits)
    assert torch.equal(given_misses, misses)


@given(seed=st.integers(0, 10**6), radius=st.floats(0.05, 2.0), far=st.sampled_from([0, 2_500_000]))
def test_cells_in_sphere_lie_entirely_inside(seed, radius, far):
    generator = seeded(seed)
    low = torch.tensor([-4 + far, 3, -6])
    center = (low + torch.rand(3, generator=generator, dtype=torch.float64) * 9) * CELL
    found = unseen((9, 8, 10), low, known_free=cells_in_sphere(center, radius, CELL))
    cells = torch.cartesian_prod(*[torch.arange(n) for n in (9, 8, 10)]) + low
    corner = torch.tensor(list(itertools.product((0, 1), repeat=3)))
    farthest = ((cells[:, None] + corner).double() * CELL - center).norm(dim=-1).amax(1)
    sure = (farthest - radius).abs() > 1e-6
    assert torch.equal(found.free.flatten()[sure], (farthest <= radius)[sure])
    assert not bool(found.observed.any())


def test_only_staying_is_feasible_in_unknown_space():
    state = torch.tensor([0.1, 0.1, 0.1, 0.0, 0, 0, 0], dtype=torch.float64)
    elsewhere = known(torch.zeros(SHAPE, dtype=torch.bool), LOW + 10_000)
    in_place = (LIBRARY.commands[:, :2] == 0).all(1)
    rollout, braking, _ = with_start(state)
    peers = PeerTrajectories.of([state[None, :3] + 0.1])
    for local_map in (unseen(), elsewhere):
        for more in ({"start": state}, {"start": state, "radius": RADIUS}):
            for others in (None, peers):
                assert torch.equal(feasible(rollout, braking, local_map, others, **more), in_place)


@given(seed=st.integers(0, 10**6), density=st.floats(0.0005, 0.006))
def test_feasible_paths_touch_only_free_cells_until_rest(seed, density):
    generator = seeded(seed)
    blocked = torch.rand(SHAPE, generator=generator) < density
    blocked[20:29, 20:29, 8:17] = False
    local_map = known(blocked)
    limits = torch.tensor([0.3, 0.3, 0.3, 3, 1.5, 0.75, 1.2], dtype=torch.float64)
    state = (torch.rand(7, generator=generator, dtype=torch.float64) * 2 - 1) * limits
    state[4] = state[4].abs()
    rollout, braking, whole = with_start(state)
    good = feasible(rollout, braking, local_map, start=state)
    points = fine_path(whole[good], 10).flatten(0, 1)
    inside = torch.floor(points / CELL).long() - LOW
    margin = math.ceil(RADIUS / CELL) - 1
    assert bool(((inside >= margin) & (inside < torch.tensor(SHAPE) - margin)).all())
    cells = blocked.nonzero() + LOW
    if len(points) and len(cells):
        assert float(gaps(points, cells).min()) > RADIUS


def test_feasible_accepts_some_paths_among_obstacles():
    shares = []
    for seed in range(8):
        blocked = torch.rand(SHAPE, generator=seeded(seed)) < 0.003
        blocked[20:29, 20:29, 8:17] = False
        state = torch.tensor([0.1, 0.1, 0.1, 0.5 * seed, 0, 0, 0], dtype=torch.float64)
        rollout, braking, _ = with_start(state)
        shares.append(float(feasible(rollout, braking, known(blocked), start=state).double().mean()))
    assert 0.25 < sum(shares) / len(shares) < 0.9


def test_feasible_checks_between_states_and_while_braking():
    state = torch.tensor([-1.0, 0.1, 0.1, 0, 1.5, 0, 0], dtype=torch.float64)
    rollout, braking, whole = with_start(state)
    straight = 0
    assert LIBRARY.commands[straight].tolist() == [1.5, 0, 0]
    # Only the cells in x from 0.0 to 0.2 m are forbidden, which lie between two states.
    xs = whole[straight, :, 0]
    local_map = known(torch.zeros(SHAPE, dtype=torch.bool))
    between = local_map.passable.clone()
    gap = [c for c in range(-4, 10) if not bool(((xs / CELL).floor() == c).any())]
    between[gap[0] - int(LOW[0])] = False
    pierced = LocalMap(LOW, CELL, local_map.occupancy, local_map.observed, local_map.free, between)
    assert bool(feasible(rollout, braking, local_map, start=state)[straight])
    assert not bool(feasible(rollout, braking, pierced, start=state)[straight])
    # A wall that only the way to rest runs into.
    wall = torch.zeros(SHAPE, dtype=torch.bool)
    wall[int((float(braking[straight, -1, 0])) // CELL) + 1 - int(LOW[0])] = True
    assert bool(feasible(rollout, rollout[:, -1:], known(wall), start=state)[straight])
    assert not bool(feasible(rollout, braking, known(wall), start=state)[straight])
    # And the way to the first state, if the start is known.
    first = local_map.passable.clone()
    first[int((-1.0 + 0.12) // CELL) - int(LOW[0])] = False
    assert bool(local_map.is_passable(state[:3]))
    ahead = LocalMap(LOW, CELL, local_map.occupancy, local_map.observed, local_map.free, first)
    assert not bool(feasible(rollout, braking, ahead, start=state)[straight])


@given(seed=st.integers(0, 10**6), n=st.integers(1, 5))
def test_escaping_robot_comes_no_closer_to_obstacles(seed, n):
    generator = seeded(seed)
    blocked = torch.zeros(SHAPE, dtype=torch.bool)
    offset = torch.randint(-3, 4, (n, 3), generator=generator)
    blocked[(offset + torch.tensor([24, 24, 12])).unbind(1)] = True
    blocked[24, 24, 12] = False
    state = torch.zeros(7, dtype=torch.float64)
    state[:3] = torch.rand(3, generator=generator, dtype=torch.float64) * CELL
    state[3] = float(torch.rand((), generator=generator)) * 6
    rollout, braking, whole = with_start(state)
    good = feasible(rollout, braking, known(blocked), start=state, radius=RADIUS)
    cells = blocked.nonzero() + LOW
    if len(cells) == 0:
        return
    share = torch.linspace(0, 1, 4, dtype=torch.float64)
    surface = (cells[:, None] + torch.cartesian_prod(share, share, share)).flatten(0, 1) * CELL
    points = fine_path(whole[good], 10).flatten(0, 1)
    now = torch.cdist(points, surface)
    before = torch.cdist(state[None, :3], surface).clamp_max(RADIUS)
    assert bool((now >= before - 1e-4).all())


def test_feasible_paths_keep_clear_of_peers():
    local_map = known(torch.zeros(SHAPE, dtype=torch.bool))
    state = torch.zeros(7, dtype=torch.float64)
    rollout, braking, whole = with_start(state)
    parked = torch.tensor([2.0, 0.0, 0.0], dtype=torch.float64)
    good = feasible(rollout, braking, local_map, PeerTrajectories.of([parked[None]]), start=state)
    nearest = (fine_path(whole) - parked).norm(dim=-1).amin(1)
    assert bool((nearest[good] >= 0.7).all())
    assert not bool(good[0])
    assert bool(good[1:].any())


def test_feasible_rejects_steps_too_long_for_the_cells():
    state = torch.tensor([0, 0, 0, 0, 1.5, 0, 1.2], dtype=torch.float64)
    rollout, braking, _ = with_start(state)
    fine = known(torch.zeros(8, 8, 8, dtype=torch.bool), torch.zeros(3, dtype=torch.int64), 0.01, 0.01)
    with pytest.raises(InvalidArgumentError, match="shorter step"):
        feasible(rollout, braking, fine, start=state)


def test_feasible_of_no_paths_is_empty():
    local_map = known(torch.zeros(SHAPE, dtype=torch.bool))
    none = torch.zeros(0, 7, dtype=torch.float64)
    rollout = LIBRARY.rollout(none)
    braking = LIBRARY.braking(rollout[..., -1, :])
    assert feasible(rollout, braking, local_map, start=none[:, None], radius=RADIUS).shape == (0, 25)
