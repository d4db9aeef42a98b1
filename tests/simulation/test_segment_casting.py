"""Rays against segments: analytic cases, a linear solver, and shared ends."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.simulation import buildings
from gmmtorch.simulation.buildings import ray_segments
from gmmtorch.simulation.furniture import circle, prism

DTYPE = torch.float64


def tensor(values) -> Tensor:
    return torch.tensor(values, dtype=DTYPE)


def random(shape: tuple[int, ...], seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DTYPE)


def solve_all_pairs(origins: Tensor, directions: Tensor, segments: Tensor) -> Tensor:
    """Distances (N,) from a linear system per pair: o + t d = a + s e, 0 ≤ s ≤ 1, t > 0."""
    edges = segments[:, 1] - segments[:, 0]
    columns = torch.stack(torch.broadcast_tensors(-directions[:, None], edges), -1)
    right = origins.expand_as(directions)[:, None] - segments[:, 0]
    t, weight = torch.linalg.solve(columns, right[..., None])[..., 0].unbind(-1)
    return torch.where((weight >= 0) & (weight <= 1) & (t > 0), t, torch.inf).amin(1)


@pytest.mark.parametrize("one_origin", [True, False])
def test_distances_agree_with_a_linear_solver(one_origin):
    segments = random((4, 2, 2), 0)
    origins = random((2,), 1) if one_origin else random((500, 2), 1)
    directions = random((500, 2), 2)
    found, expected = (
        ray_segments(origins, directions, segments),
        solve_all_pairs(origins, directions, segments),
    )
    assert 0.2 < float(torch.isfinite(expected).double().mean()) < 0.999
    torch.testing.assert_close(found, expected)


def test_chunk_sizes_do_not_change_the_distances(monkeypatch):
    segments, directions = random((30, 2, 2), 0), random((200, 2), 1)
    whole = ray_segments(torch.zeros(2), directions, segments)
    monkeypatch.setattr(buildings, "_CHUNK_PAIRS", 64)
    torch.testing.assert_close(ray_segments(torch.zeros(2), directions, segments), whole)


def test_distances_to_a_segment_are_multiples_of_the_direction():
    wall = tensor([[[2.0, -1.0], [2.0, 1.0]]])
    directions = tensor([[1, 0], [-1, 0], [2, 0], [1, 0.5], [1, 0.6], [0, 1]])
    found = ray_segments(tensor([0.0, 0.0]), directions, wall)
    assert found.tolist() == [2.0, math.inf, 1.0, 2.0, math.inf, math.inf]


def test_a_ray_parallel_to_a_segment_does_not_hit_it():
    found = ray_segments(tensor([0.0, 0.0]), tensor([[1.0, 0.0]]), tensor([[[1.0, 0], [2, 0]]]))
    assert found.tolist() == [math.inf]


def test_rays_at_shared_ends_hit():
    ring = circle(1.0, 360)
    segments = torch.stack([ring, ring.roll(-1, 0)], 1)
    distance = ray_segments(tensor([0.1, 0.2]), ring - tensor([0.1, 0.2]), segments)
    torch.testing.assert_close(distance, torch.ones_like(distance))


def test_prism_has_the_exact_volume():
    drum = prism(circle(0.5, 24), 1.0, 3.0)
    volume = float((drum[:, 0] * torch.linalg.cross(drum[:, 1], drum[:, 2])).sum() / 6)
    assert volume == pytest.approx(2.0 * 12 * 0.25 * math.sin(2 * math.pi / 24))


def test_no_segments_give_infinity_and_no_rays_give_nothing():
    assert torch.isinf(ray_segments(torch.zeros(2), torch.ones(3, 2), torch.empty(0, 2, 2))).all()
    assert ray_segments(torch.zeros(2), torch.empty(0, 2), torch.ones(4, 2, 2)).shape == (0,)


@pytest.mark.parametrize(
    ("origins", "directions", "segments", "message"),
    [
        ((3,), (5, 2), (1, 2, 2), "origins has"),
        ((4, 2), (5, 2), (1, 2, 2), "origins has"),
        ((2,), (5, 3), (1, 2, 2), "directions"),
        ((2,), (2,), (1, 2, 2), "directions"),
        ((2,), (5, 2), (1, 3, 2), "segments"),
    ],
)
def test_ray_segments_rejects_shapes_that_do_not_match(origins, directions, segments, message):
    with pytest.raises(InvalidArgumentError, match=message):
        ray_segments(torch.zeros(origins), torch.ones(directions), torch.zeros(segments))
