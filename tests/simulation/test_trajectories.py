"""Paths and poses: smooth, evenly spaced, facing forward."""

from __future__ import annotations

import math

import pytest
import torch

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.simulation import poses_2d, poses_3d, smooth_path

CORNER = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]])


def test_path_keeps_its_ends_and_spacing():
    path = smooth_path(CORNER, 0.05)
    assert path[0].tolist() == [0.0, 0.0]
    torch.testing.assert_close(path[-1], CORNER[-1].double())
    steps = (path[1:] - path[:-1]).norm(dim=1)
    assert bool(((steps > 0.045) & (steps < 0.0501)).all())


def test_path_rounds_corners_without_overshoot():
    path = smooth_path(CORNER)
    heading = torch.atan2(*(path[1:] - path[:-1]).T.flip(0))
    assert float((heading[1:] - heading[:-1]).abs().max()) < 0.15
    assert bool((path[:, 0] <= 4).all())
    assert bool((path[:, 1] >= 0).all())
    assert float((path - torch.tensor([4.0, 0.0])).norm(dim=1).min()) > 0.5


def test_path_is_straight_along_collinear_waypoints():
    path = smooth_path(torch.tensor([[0.0, 1.0], [3.0, 3.0], [3.0, 4.0], [3.0, 5.0], [7.0, 5.0]]))
    middle = path[(path[:, 1] > 3.55) & (path[:, 1] < 4.45)]
    torch.testing.assert_close(middle[:, 0], torch.full_like(middle[:, 0], 3.0))


def test_poses_2d_face_forward_at_even_spacing():
    poses = poses_2d(smooth_path(CORNER), 30)
    assert poses.shape == (30, 3, 3)
    torch.testing.assert_close(poses[0], torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(
        poses[-1], torch.tensor([[0, -1, 4], [1, 0, 4], [0, 0, 1]], dtype=torch.float64), atol=1e-6, rtol=0
    )
    steps = (poses[1:, :2, 2] - poses[:-1, :2, 2]).norm(dim=1)
    assert float(steps.max() - steps.min()) < 0.02


@pytest.mark.parametrize(("pitch", "swing"), [(0.0, 0.0), (0.2, 0.0), (0.2, 1.0)])
def test_poses_3d_are_rigid_without_roll(pitch, swing):
    poses = poses_3d(smooth_path(CORNER), 20, 1.5, pitch, swing)
    rotation = poses[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64).expand(20, 3, 3))
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(20, dtype=torch.float64))
    assert bool((poses[:, 2, 3] == 1.5).all())
    torch.testing.assert_close(rotation[:, 2, 0], torch.full((20,), -math.sin(pitch), dtype=torch.float64))
    torch.testing.assert_close(rotation[:, 2, 1], torch.zeros(20, dtype=torch.float64))  # no roll


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: smooth_path(torch.zeros(1, 2)), "waypoints"),
        (lambda: smooth_path(torch.zeros(4, 3)), "waypoints"),
        (lambda: smooth_path(CORNER, 0.0), r"spacing=0\.0"),
        (lambda: poses_2d(smooth_path(CORNER), 0), "n=0"),
    ],
)
def test_paths_and_poses_reject_invalid_arguments(make, message):
    with pytest.raises(InvalidArgumentError, match=message):
        make()
