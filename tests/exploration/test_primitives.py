"""Motion primitives: against closed forms, a differential equation solver, and the limits they promise."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.team.exploration.planning.primitives import Dynamics, Primitives, _limits

LIBRARY = Primitives(Dynamics())
LIMITS = torch.tensor([1.5, 0.75, 1.2], dtype=torch.float64)


def random_states(n: int, seed: int, dynamics: Dynamics | None = None) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    unit = torch.rand(n, 7, generator=generator, dtype=torch.float64) * 2 - 1
    limits = LIMITS if dynamics is None else _limits(dynamics)
    return torch.cat([unit[:, :4] * torch.tensor([30.0, 30, 5, 4]), unit[:, 4:] * limits], 1)


def ramp(now: float, command: float, acceleration: float, step: float, t: float) -> float:
    """A velocity that changes evenly, over whole steps, as fast as it may."""
    steps = math.ceil(abs(command - now) / (acceleration * step) - 1e-9)
    return command if t >= steps * step else now + (command - now) * t / (steps * step)


def flown(state: Tensor, command: Tensor, dynamics: Dynamics, duration: float) -> np.ndarray:
    """x, y, z, yaw after every step, by solve_ivp, restarted at every step."""
    rates = (dynamics.acceleration, dynamics.acceleration, dynamics.yaw_acceleration)

    def velocity(t: float, axis: int) -> float:
        return ramp(float(state[4 + axis]), float(command[axis]), rates[axis], dynamics.step, t)

    def slope(t: float, at: np.ndarray) -> list[float]:
        v = velocity(t, 0)
        return [v * math.cos(at[3]), v * math.sin(at[3]), velocity(t, 1), velocity(t, 2)]

    here, found = state[:4].numpy(), []
    for i in range(round(duration / dynamics.step)):
        span = (i * dynamics.step, (i + 1) * dynamics.step)
        here = solve_ivp(slope, span, here, rtol=1e-10, atol=1e-11).y[:, -1]
        found.append(here)
    return np.stack(found)


def test_primitives_contain_arcs_turns_climbs_and_stop():
    commands = [tuple(row) for row in LIBRARY.commands.tolist()]
    assert len(set(commands)) == len(LIBRARY) == 25
    assert bool((LIBRARY.commands.abs() <= LIMITS).all())
    assert commands[LIBRARY.stop] == (0, 0, 0)
    assert {(v, up, -turn) for v, up, turn in commands} == set(commands)
    kinds = Counter((v, up != 0, v != 0 or turn != 0) for v, up, turn in commands)
    arcs = {(1.5, False, True): 5, (1.5, True, True): 10, (0.75, False, True): 3}
    assert kinds == {**arcs, (0, False, True): 4, (0, True, False): 2, (0, False, False): 1}


@pytest.mark.parametrize("seed", range(3))
def test_rollout_of_ramps_equals_an_ode_solver(seed):
    dynamics = Dynamics(acceleration=0.9, yaw_acceleration=1.7)
    library = Primitives(dynamics)
    states = random_states(2, seed)
    paths = library.rollout(states)
    for n in range(2):
        for p in range(seed, len(library), 5):
            exact = flown(states[n], library.commands[p], dynamics, 2.0)
            np.testing.assert_allclose(paths[n, p, :, :4].numpy(), exact, atol=2e-7)


def test_braking_equals_an_ode_solver():
    states = random_states(4, 9)
    paths = LIBRARY.braking(states)
    at_rest = torch.zeros(3)
    for state, path in zip(states, paths, strict=True):
        exact = flown(state, at_rest, LIBRARY.dynamics, 0.2 * path.shape[0])
        np.testing.assert_allclose(path[:, :4].numpy(), exact, atol=2e-7)


def test_cached_rollouts_equal_computed_ones():
    paths = LIBRARY.rollout(random_states(4, 1))
    ends = paths[:, :, -1]
    one = random_states(1, 2)  # in its company none is looked up
    among_others = torch.cat([ends[0], one])
    torch.testing.assert_close(
        LIBRARY.rollout(ends[0]), LIBRARY.rollout(among_others)[:-1], rtol=0, atol=1e-9
    )
    torch.testing.assert_close(
        LIBRARY.braking(ends[0]), LIBRARY.braking(among_others)[:-1], rtol=0, atol=1e-9
    )
    n_steps = len(LIBRARY.braking(ends[0, 0]))
    assert LIBRARY.braking(ends).shape == (*ends.shape[:2], n_steps, 7)
    assert bool((LIBRARY.braking(ends)[..., -1, 4:] == 0).all())


@given(
    seed=st.integers(0, 10**6),
    speed=st.floats(0.1, 5),
    acceleration=st.floats(0.2, 6),
    yaw_acceleration=st.floats(0.3, 9),
    step=st.sampled_from([0.05, 0.1, 0.2, 0.5, 1.0]),
)
def test_limits_hold_at_every_step_and_braking_reaches_rest(
    seed, speed, acceleration, yaw_acceleration, step
):
    dynamics = Dynamics(speed=speed, acceleration=acceleration, yaw_acceleration=yaw_acceleration, step=step)
    library = Primitives(dynamics)
    limits = torch.tensor([speed, 0.75, 1.2], dtype=torch.float64)
    states = random_states(3, seed, dynamics)
    paths = library.rollout(states)
    braking = library.braking(paths[..., -1, :])
    assert paths.shape == (3, 25, round(2 / step), 7)
    begin = states[:, None, None].expand(3, 25, 1, 7)
    whole = torch.cat([begin, paths, braking], 2)
    velocity = whole[..., 4:]
    assert bool((velocity.abs() <= limits * (1 + 1e-9)).all())
    most = torch.tensor([acceleration, acceleration, yaw_acceleration], dtype=torch.float64) * step
    assert bool(((velocity[..., 1:, :] - velocity[..., :-1, :]).abs() <= most * (1 + 1e-6)).all())
    moved = (whole[..., 1:, :3] - whole[..., :-1, :3]).norm(dim=-1)
    assert float(moved.max()) <= math.hypot(speed, 0.75) * step * (1 + 1e-9)
    assert torch.equal(braking[..., -1, 4:], torch.zeros(3, 25, 3, dtype=torch.float64))
    assert bool(torch.isfinite(whole).all())


@pytest.mark.parametrize("velocity", [(1.6, 0, 0), (0, -0.8, 0), (0, 0, 1.3), (math.nan, 0, 0)])
def test_rollout_rejects_states_beyond_the_limits(velocity):
    state = torch.tensor([[0, 0, 0, 0, *velocity]], dtype=torch.float64)
    for fly in (LIBRARY.rollout, LIBRARY.braking):
        with pytest.raises(InvalidArgumentError, match="velocities"):
            fly(state)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"speed": 0.0}, "speed="),
        ({"acceleration": math.inf}, "acceleration="),
        ({"yaw_rate": math.nan}, "yaw_rate="),
        ({"radius": -0.3}, "radius="),
        ({"step": 0.3}, "does not divide"),
        ({"step": 5.0}, "does not divide"),
    ],
)
def test_dynamics_reject_bad_values(bad, message):
    with pytest.raises(InvalidArgumentError, match=message):
        Dynamics(**bad)
