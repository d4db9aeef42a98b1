"""Motions that stay clear: the fused kernel against the twin, which lists every point."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.kernels.compiler import compiler_failure
from gmmtorch.team.exploration.planning.collision_checking import (
    PeerTrajectories,
    feasible,
    feasible_motions,
    local_map_of,
)
from gmmtorch.team.exploration.planning.primitives import Dynamics, Primitives

pytestmark = [
    pytest.mark.cpu_only,
    pytest.mark.skipif(compiler_failure() is not None, reason="the kernel compiler does not work"),
]

LIBRARY = Primitives(Dynamics())
CELL = 0.2


@given(
    seed=st.integers(0, 2**32 - 1),
    n_peers=st.integers(0, 3),
    length=st.integers(1, 40),
    after=st.integers(0, 4),
    share=st.sampled_from([0.0, 0.0005, 0.003]),
)
def test_motions_are_clear_where_the_twin_says_so(seed, n_peers, length, after, share):
    generator = torch.Generator().manual_seed(seed)
    blocked = torch.rand(40, 40, 20, generator=generator) < share
    there = local_map_of(
        torch.tensor([-20, -20, -10]),
        CELL,
        100.0 * blocked,
        100.0 * ~blocked,
        prior=1.0,
        planning_prior=0.125,
        free_below=0.25,
        radius=0.3,
    )
    n = 12
    room = torch.tensor([7.0, 7.0, 3.0, 6.3], dtype=torch.float64)  # some states are outside
    poses = (torch.rand(n, 4, generator=generator, dtype=torch.float64) - 0.5) * room
    poses[::3] = (poses[::3] / CELL).round() * CELL  # on the edges of cells
    commands = LIBRARY.commands[torch.randint(len(LIBRARY), (n,), generator=generator)]
    states = torch.cat([poses, commands], 1)
    states[0, 4:] = 0
    way = torch.randn(n_peers, length, 3, generator=generator, dtype=torch.float64).cumsum(1) * 0.2
    if n_peers:
        way[0] = states[1, :3]  # a teammate that is already too close, and rests
    peers = PeerTrajectories(way)
    steps = after * LIBRARY.dynamics.n_steps

    follows = LIBRARY.follows(states)
    assert follows is not None
    paths = LIBRARY.rollout(states)
    found = feasible_motions(LIBRARY, follows, states, paths[:, :, -1], there, peers, steps)

    braking = LIBRARY.braking(paths[:, :, -1])
    expected = feasible(paths, braking, there, peers.later(steps), start=states[:, None])
    assert torch.equal(found, expected)


def test_only_the_ends_of_primitives_follow_one():
    state = torch.zeros(1, 7, dtype=torch.float64)
    state[0, 4] = 0.1
    assert LIBRARY.follows(state) is None
