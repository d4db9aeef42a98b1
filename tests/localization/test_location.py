"""Locations: the uncertainty of one that follows another."""

from __future__ import annotations

import pytest
import torch

from gmmtorch.localization.location import Location, composed
from gmmtorch.pose import Pose


def drawn(location: Location, n: int, generator: torch.Generator) -> torch.Tensor:
    """Poses (n, D+1, D+1) with errors of the covariance of a location."""
    dim = len(location.pose) - 1
    root = torch.linalg.cholesky(location.covariance)
    errors = torch.randn(n, len(root), dtype=torch.float64, generator=generator) @ root.T
    poses = location.pose.repeat(n, 1, 1)
    poses[:, :dim, :dim] = Pose.from_turn(errors[:, dim:]).rotation @ location.pose[:dim, :dim]
    poses[:, :dim, dim] += errors[:, :dim]
    return poses


@pytest.mark.parametrize("dim", [2, 3])
def test_errors_of_a_composed_location_have_its_covariance(dim):
    generator = torch.Generator().manual_seed(dim)
    free, n = dim * (dim + 1) // 2, 200_000
    locations = []
    for _ in range(2):
        pose = torch.eye(dim + 1, dtype=torch.float64)
        angles = torch.randn(1, free - dim, dtype=torch.float64, generator=generator)
        pose[:dim, :dim] = Pose.from_turn(angles[0]).rotation
        pose[:dim, dim] = 5 * torch.randn(dim, dtype=torch.float64, generator=generator)
        root = 0.01 * torch.randn(free, free, dtype=torch.float64, generator=generator)
        locations.append(Location(pose, root @ root.T, 0.9, ()))
    found = composed(*locations)
    first, then = (drawn(location, n, generator) for location in locations)
    poses = first @ then
    assert torch.allclose(found.pose, locations[0].pose @ locations[1].pose)
    turned = poses[:, :dim, :dim] @ found.pose[:dim, :dim].T
    turns_about = {2: [(1, 0)], 3: [(2, 1), (0, 2), (1, 0)]}[dim]
    angles = torch.stack([(turned[:, i, j] - turned[:, j, i]) / 2 for i, j in turns_about], 1)
    errors = torch.cat([poses[:, :dim, dim] - found.pose[:dim, dim], angles], 1)
    second_moment = errors.T @ errors / n
    scale = found.covariance.diagonal().sqrt()
    assert ((second_moment - found.covariance).abs() < 0.02 * scale[:, None] * scale).all()
