"""Ellipsoid meshes lie where the Mahalanobis distance says, and are closed and outward."""

from __future__ import annotations

import pytest
import torch

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report.maps.mesh_figures import ellipsoid_mesh, unit_sphere


def components(k: int, dim: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    means = torch.randn(k, dim, dtype=torch.float64, generator=generator) * 5
    factors = torch.randn(k, dim, dim, dtype=torch.float64, generator=generator)
    return means, factors @ factors.mT + 0.01 * torch.eye(dim)


@pytest.mark.parametrize("n_sigma", [0.5, 2.0])
@pytest.mark.parametrize("subdivisions", [0, 1, 3])
def test_vertices_have_mahalanobis_distance_n_sigma(n_sigma, subdivisions):
    means, covariances = components(4, 3)
    mesh = ellipsoid_mesh(means, covariances, n_sigma, subdivisions)
    offset = mesh.vertices.reshape(4, -1, 3) - means[:, None]
    squared = torch.einsum("kvi,kij,kvj->kv", offset, torch.linalg.inv(covariances), offset)
    torch.testing.assert_close(squared, torch.full_like(squared, n_sigma**2))
    assert mesh.vertices.shape == (4 * (10 * 4**subdivisions + 2), 3)
    assert mesh.faces.shape == (4 * 20 * 4**subdivisions, 3)
    assert mesh.colors.shape == mesh.vertices.shape
    assert mesh.colors.dtype == torch.uint8


def test_flat_components_are_ellipses_seen_from_above():
    means, covariances = components(3, 2)
    mesh = ellipsoid_mesh(means, covariances, 2.0, 2)
    offset = mesh.vertices.reshape(3, -1, 3)[..., :2] - means[:, None]
    squared = torch.einsum("kvi,kij,kvj->kv", offset, torch.linalg.inv(covariances), offset)
    assert squared.max() < 4 + 1e-9
    assert squared.max() > 3.9
    minor = torch.linalg.eigvalsh(covariances)[:, 0].sqrt()
    thickness = mesh.vertices.reshape(3, -1, 3)[..., 2].abs().amax(1)
    assert (thickness <= 2 * minor * 0.1 + 1e-12).all()
    assert (thickness > 0).all()


def test_meshes_are_closed_and_face_outwards():
    means, covariances = components(5, 3)
    mesh = ellipsoid_mesh(means, covariances, 2.0, 3)
    a, b, c = (mesh.vertices[mesh.faces].reshape(5, -1, 3, 3) - means[:, None, None]).unbind(2)
    volume = (a * torch.linalg.cross(b, c)).sum(-1).sum(1) / 6
    exact = 4 / 3 * torch.pi * 8 * torch.linalg.det(covariances).sqrt()
    torch.testing.assert_close(volume, exact, rtol=0.03, atol=0)
    _, faces = unit_sphere(1)
    directed = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()
    edges = {tuple(edge) for edge in directed}
    assert len(edges) == len(directed)
    assert all((b, a) in edges for a, b in edges)


def test_colours_follow_height_or_the_values_given():
    means = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [5.0, 0.0, 0.0]])
    eye = torch.eye(3).expand(3, 3, 3)
    low, high, same = ellipsoid_mesh(means, eye, 2.0, 0).colors.reshape(3, -1, 3)[:, 0]
    assert (low == same).all()
    assert (low != high).any()
    by_value = ellipsoid_mesh(means, eye, 2.0, 0, values=[0.0, 0.0, 1.0]).colors.reshape(3, -1, 3)[:, 0]
    assert (by_value[0] == by_value[1]).all()
    assert (by_value[0] != by_value[2]).any()


@pytest.mark.parametrize("dim", [2, 3])
def test_no_components_and_singular_ones(dim):
    empty = ellipsoid_mesh(torch.empty(0, dim), torch.empty(0, dim, dim))
    assert empty.vertices.shape == (0, 3)
    assert empty.faces.shape == (0, 3)
    point = ellipsoid_mesh(torch.ones(1, dim), torch.zeros(1, dim, dim))
    assert (point.vertices[:, :dim] == 1).all()


def test_says_what_is_wrong():
    means, covariances = components(2, 3)
    with pytest.raises(InvalidArgumentError, match="n_sigma=0"):
        ellipsoid_mesh(means, covariances, 0)
    with pytest.raises(InvalidArgumentError, match="subdivisions=9"):
        ellipsoid_mesh(means, covariances, subdivisions=9)
    with pytest.raises(InvalidArgumentError, match="expected"):
        ellipsoid_mesh(means, covariances[:1])
    with pytest.raises(InvalidArgumentError, match="NaN"):
        ellipsoid_mesh(means * torch.nan, covariances)
    with pytest.raises(InvalidArgumentError, match="values has shape"):
        ellipsoid_mesh(means, covariances, values=torch.zeros(3))
