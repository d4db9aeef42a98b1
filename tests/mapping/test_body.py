"""A body of balls along a path, against single balls, samples and finite differences."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mapping.component_cases import random_components
from scipy.spatial.transform import Rotation

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping import Body, Components
from gmmtorch.mapping.clearance import clearance, collision_probability

dims = pytest.mark.parametrize("dim", [2, 3])


def poses(seed: int, n: int, dim: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    found = torch.eye(dim + 1, dtype=torch.float64).repeat(n, 1, 1)
    found[:, :dim, dim] = 4 * torch.rand(n, dim, generator=generator, dtype=torch.float64)
    turns = Rotation.random(n, rng=seed).as_matrix() if dim == 3 else None
    angles = torch.rand(n, generator=generator, dtype=torch.float64) * 6.28
    flat = torch.stack([angles.cos(), -angles.sin(), angles.sin(), angles.cos()], 1).view(n, 2, 2)
    found[:, :dim, :dim] = flat if turns is None else torch.from_numpy(turns)
    return found


def body(dim: int) -> Body:
    return Body(torch.eye(dim, dtype=torch.float64)[:2] * 0.5, [0.3, 0.1])


@dims
@given(st.integers(0, 50))
def test_clearance_of_a_body_is_that_of_its_nearest_ball(dim, seed):
    c, path, shape = random_components(6, dim, seed), poses(seed, 5, dim), body(dim)
    found = shape.clearance(c, path)
    for pose, value in zip(path, found, strict=True):
        gaps = [
            float(clearance(c, (pose[:dim, :dim] @ centre + pose[:dim, dim])[None])) - float(radius)
            for centre, radius in zip(shape.centres, shape.radii, strict=True)
        ]
        assert float(value) == pytest.approx(min(gaps), abs=1e-9)


@dims
def test_collision_probability_of_apart_balls_is_that_of_independent_balls(dim):
    c, path, shape = random_components(6, dim, 1), poses(1, 5, dim), body(dim)
    found = shape.collision_probability(c, path)
    clear = torch.ones(5, dtype=torch.float64)
    for centre, radius in zip(shape.centres, shape.radii, strict=True):
        places = path[:, :dim, :dim] @ centre + path[:, :dim, dim]
        clear *= 1 - collision_probability(c, places, float(radius))
    torch.testing.assert_close(found, 1 - clear)


def test_gradients_move_the_body_away_from_surfaces():
    c, path, shape = random_components(6, 3, 2), poses(2, 4, 3).requires_grad_(), body(3)
    gap = shape.clearance(c, path)
    (slope,) = torch.autograd.grad(gap.sum(), path)
    step = torch.zeros_like(slope)
    step[:, :3, 3] = 1e-4 * slope[:, :3, 3]
    gained = shape.clearance(c, path.detach() + step) - gap.detach()
    torch.testing.assert_close(gained, (slope * step).sum((1, 2)), rtol=1e-2, atol=1e-9)


def test_an_empty_map_and_an_empty_path():
    nothing, shape = Components.empty(3), body(3)
    assert shape.clearance(nothing, poses(0, 2, 3)).tolist() == [torch.inf] * 2
    assert shape.collision_probability(nothing, poses(0, 2, 3)).tolist() == [0.0] * 2
    assert shape.clearance(nothing, torch.zeros(0, 4, 4)).shape == (0,)
    assert shape.collision_probability(nothing, torch.zeros(0, 4, 4)).shape == (0,)


@pytest.mark.parametrize(
    ("centres", "radii", "words"),
    [
        (torch.zeros(0, 3), torch.zeros(0), r"centres has shape \(0, 3\)"),
        (torch.zeros(2, 4), [1.0, 1.0], r"centres has shape \(2, 4\)"),
        (torch.zeros(2, 3), [1.0], r"radii has shape \(1,\)"),
        (torch.zeros(1, 3), [0.0], "above zero"),
        (torch.full((1, 3), torch.nan), [1.0], "finite"),
    ],
)
def test_invalid_bodies_are_refused(centres, radii, words):
    with pytest.raises(InvalidArgumentError, match=words):
        Body(centres, radii)


def test_poses_of_another_dimension_are_refused():
    with pytest.raises(InvalidArgumentError, match=r"poses has shape \(1, 3, 3\); expected \(S, 4, 4\)"):
        body(3).clearance(Components.empty(3), torch.eye(3)[None])
