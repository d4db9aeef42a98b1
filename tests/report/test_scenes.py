"""Geometry of ellipsoids, and maps in space: which cells are asked, what is drawn, what hides the inside."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.components import Components
from gmmtorch.report import scenes
from gmmtorch.report.ellipsoids import ellipse_outlines, ellipsoid_mesh, principal_axes, unit_sphere
from gmmtorch.report.scenes import OccupancyPanel, cells_near, map_scene_figure


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


def test_cells_near_points_are_those_of_a_search(generator):
    points = torch.randn(30, 3, generator=generator, dtype=torch.float64)
    centres, side = cells_near(points, 0.25)
    expected = {
        tuple(cell + np.array(offset))
        for cell in np.floor(points.numpy() / 0.25).astype(int)
        for offset in itertools.product(range(-2, 3), repeat=3)
    }
    assert side == 0.25
    assert {tuple(cell) for cell in (centres / 0.25 - 0.5).round().long().tolist()} == expected


def test_cells_are_larger_if_there_are_too_many(monkeypatch, generator):
    monkeypatch.setattr(scenes, "_MAX_CELLS", 500)
    points = 5 * torch.rand(1000, 3, generator=generator, dtype=torch.float64)
    centres, side = cells_near(points, 0.25)
    assert side in (0.5, 1.0, 2.0, 4.0)
    assert len(centres) <= 500


def room() -> tuple[torch.Tensor, Components]:
    """Points and components of the floor, the north wall and the south wall of a room of 4 m × 4 m, observed
    from its middle."""
    along = torch.arange(0.25, 4, 0.5, dtype=torch.float64)
    u, v = torch.cartesian_prod(along, along).unbind(1)
    zero = torch.zeros_like(u)
    means = torch.stack([torch.stack(m, 1) for m in ((u, v, zero), (u, zero + 4, v / 2), (u, zero, v / 2))])
    variances = torch.tensor([[4e-2, 4e-2, 1e-5], [4e-2, 1e-5, 1e-2], [4e-2, 1e-5, 1e-2]]).double()
    k = means[..., 0].numel()
    components = Components(
        means=means.flatten(0, 1),
        covariances=torch.diag_embed(variances).repeat_interleave(len(u), 0),
        support=torch.ones(k),
        max_range=torch.zeros(k, dtype=torch.bool),
        ids=torch.zeros(k, 2, dtype=torch.int64),
        origins=[[2.0, 2.0, 1.0]],
        seen_by=torch.arange(k),
        seen_from=torch.zeros(k, dtype=torch.int64),
        seen_count=torch.ones(k),
    )
    return components.means, components


def drawn(axes: Axes) -> int:
    """Number of pixels of a panel that show something."""
    return int((axes.get_images()[0].get_array()[..., 3] > 0).sum())


def test_panels_show_points_components_and_the_occupied_cells_of_each_map():
    points, components = room()
    maps = [
        OccupancyPanel("north wall", lambda at: 0.66 * (at[:, 1] > 3.9)),
        OccupancyPanel("south wall", lambda at: 0.66 * ((at[:, 1].abs() < 0.2) & (at[:, 2] > 0.4))),
        OccupancyPanel("unknown", lambda at: torch.full((len(at),), 0.5), 0.1),
        OccupancyPanel("not sure", lambda at: torch.full((len(at),), 0.64)),
    ]
    figure = map_scene_figure(points, components.origins, maps, 0.25, components, title="room")
    panels = [axes for axes in figure.axes if axes.get_images()]
    titles = ["measured: 192 points, 2.30 kB", "surfaces of the map: 192 components"]
    assert [axes.get_title() for axes in panels] == [*titles, *(one.title for one in maps)]
    pixels = [drawn(axes) for axes in panels]
    path = pixels[-1]  # cells with θ < 0.65 are not drawn
    assert pixels[-2] == path
    assert pixels[0] > path > 0
    assert pixels[2] > 10 * path  # the far wall
    assert pixels[3] == path  # the near wall, which would hide the room, is left out
    assert pixels[1] > pixels[2]


def test_maps_without_components_or_points_are_drawn():
    nothing = torch.empty(0, 3, dtype=torch.float64)
    panel = OccupancyPanel("empty", lambda at: torch.full((len(at),), 0.5))
    figure = map_scene_figure(nothing, nothing, [panel], 0.25)
    assert [axes.get_title() for axes in figure.axes if axes.get_images()] == [
        "measured: 0 points, 0 B",
        "empty",
    ]
    figure = map_scene_figure(nothing, nothing, [panel], 0.25, Components.empty(3))
    figure.canvas.draw()
