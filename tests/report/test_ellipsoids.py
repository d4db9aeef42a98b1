"""Geometry of ellipsoids: principal axes, outlines and meshes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report.ellipsoids import ellipse_outlines, ellipsoid_mesh, principal_axes, unit_sphere


def components(k: int, dim: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    means = torch.randn(k, dim, dtype=torch.float64, generator=generator) * 5
    factors = torch.randn(k, dim, dim, dtype=torch.float64, generator=generator)
    return means, factors @ factors.mT + 0.01 * torch.eye(dim)


def squared_distances(points: torch.Tensor, means: torch.Tensor, covariances: torch.Tensor) -> torch.Tensor:
    """Squared Mahalanobis distances (K, V) of points (K, V, D)."""
    offset = points - means[:, None]
    return torch.einsum("kvi,kij,kvj->kv", offset, torch.linalg.inv(covariances), offset)


@pytest.mark.parametrize("dim", [2, 3])
def test_principal_axes_give_the_covariance_with_rotation_matrices(dim):
    _, covariances = components(20, dim)
    deviations, directions = principal_axes(covariances)
    torch.testing.assert_close(directions @ torch.diag_embed(deviations**2) @ directions.mT, covariances)
    torch.testing.assert_close(torch.linalg.det(directions), torch.ones(20, dtype=torch.float64))


@pytest.mark.parametrize("n_vertices", [4, 12, 162])
def test_mesh_vertices_have_mahalanobis_distance_two(n_vertices):
    means, covariances = components(4, 3)
    mesh = ellipsoid_mesh(means, covariances, n_vertices)
    squared = squared_distances(mesh.vertices.reshape(4, -1, 3), means, covariances)
    torch.testing.assert_close(squared, torch.full_like(squared, 4.0))
    assert mesh.vertices.shape == mesh.colors.shape == (4 * n_vertices, 3)
    assert mesh.faces.shape == (4 * (2 * n_vertices - 4), 3)
    assert mesh.colors.dtype == torch.uint8


def test_outlines_have_mahalanobis_distance_two():
    means, covariances = components(4, 2)
    outlines = torch.from_numpy(ellipse_outlines(means, covariances))
    squared = squared_distances(outlines, means, covariances)
    torch.testing.assert_close(squared, torch.full_like(squared, 4.0))


def test_a_mesh_of_2d_components_is_flat_and_outlines_them_from_above():
    means, covariances = components(3, 2)
    vertices = ellipsoid_mesh(means, covariances).vertices.reshape(3, -1, 3)
    squared = squared_distances(vertices[..., :2], means, covariances)
    assert 3.9 < squared.max() < 4 + 1e-9
    minor = torch.linalg.eigvalsh(covariances)[:, 0].sqrt()
    thickness = vertices[..., 2].abs().amax(1)
    assert (thickness <= 2 * minor * 0.1 + 1e-12).all()
    assert (thickness > 0).all()


def test_meshes_are_closed_and_face_outwards():
    means, covariances = components(5, 3)
    mesh = ellipsoid_mesh(means, covariances, 642)
    a, b, c = (mesh.vertices[mesh.faces].reshape(5, -1, 3, 3) - means[:, None, None]).unbind(2)
    volume = (a * torch.linalg.cross(b, c)).sum(-1).sum(1) / 6
    exact = 4 / 3 * torch.pi * 8 * torch.linalg.det(covariances).sqrt()
    torch.testing.assert_close(volume, exact, rtol=0.03, atol=0)
    _, faces = unit_sphere(42)
    directed = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()
    edges = {tuple(edge) for edge in directed}
    assert len(edges) == len(directed)
    assert all((b, a) in edges for a, b in edges)


@pytest.mark.parametrize("dim", [2, 3])
def test_no_components_and_singular_ones_have_meshes_and_outlines(dim):
    empty = ellipsoid_mesh(torch.empty(0, dim), torch.empty(0, dim, dim))
    assert empty.vertices.shape == empty.faces.shape == (0, 3)
    point = ellipsoid_mesh(torch.ones(1, dim), torch.zeros(1, dim, dim))
    assert (point.vertices[:, :dim] == 1).all()
    flat = torch.zeros(1, 2, 2, dtype=torch.float64)
    assert np.all(ellipse_outlines(torch.ones(1, 2), flat) == 1)


def test_mesh_errors_name_the_argument():
    means, covariances = components(2, 3)
    with pytest.raises(InvalidArgumentError, match="n_vertices=3"):
        ellipsoid_mesh(means, covariances, n_vertices=3)
    with pytest.raises(InvalidArgumentError, match="expected"):
        ellipsoid_mesh(means, covariances[:1])
    with pytest.raises(InvalidArgumentError, match="NaN"):
        ellipsoid_mesh(means * torch.nan, covariances)
