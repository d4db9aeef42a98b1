"""Meshes of planes, spheres and boxes of known geometry, and their files as other programs read them."""

from __future__ import annotations

import json
import math
import struct

import numpy as np
import pytest
import torch

from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.export.mesh import TriangleMesh, surface_mesh, write_mesh
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.scan import display_colours


def components_at(means, normals, spread, thickness, origin, flags=None):
    """Discs with these means (K, 3) and normals (K, 3), seen from one origin."""
    mean, normal = (
        torch.as_tensor(means).double(),
        torch.nn.functional.normalize(torch.as_tensor(normals).double()),
    )
    outer = normal[:, :, None] * normal[:, None]
    covariance = spread**2 * (torch.eye(3) - outer) + thickness**2 * outer
    origins = torch.as_tensor(origin).double().expand(len(mean), 3)
    support = torch.full((len(mean),), 50.0)
    return GaussianMap.from_components(mean, covariance, support, origins, flags).components()


def plane(origin=(0.0, 0.0, 2.0)):
    """The square |x|, |y| < 1.2 at z = 0.33, of tiles that are 0.4 m wide."""
    steps = torch.arange(-5, 6) * 0.2
    xy = torch.cartesian_prod(steps, steps)
    means = torch.cat([xy, torch.full((len(xy), 1), 0.33)], 1)
    return components_at(means, torch.tensor([[0.0, 0.0, 1.0]]).expand(len(xy), 3), 0.12, 0.003, origin)


def areas(mesh: TriangleMesh) -> torch.Tensor:
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    return torch.linalg.cross(b - a, c - a) / 2


@pytest.mark.parametrize("side", [0.05, 0.1])
@pytest.mark.parametrize("above", [True, False])
def test_a_plane_is_exact_and_faces_the_sensor(side, above):
    mesh = surface_mesh(plane((0.0, 0.0, 2.0 if above else -2.0)), side)
    torch.testing.assert_close(mesh.vertices[:, 2], torch.full((len(mesh.vertices),), 0.33).double())
    up = 1.0 if above else -1.0
    assert torch.allclose(mesh.normals[:, 2], torch.full((len(mesh.normals),), up).double())
    area = areas(mesh)[:, 2]
    assert bool((area * up > 0).all())
    width = math.sqrt(abs(float(area.sum())))
    assert 2.2 < width < 2.5  # the outer tiles reach 1 + 2 · 0.12 m, less at their corners


def test_a_sphere_is_closed_round_and_facing_inwards():
    index = torch.arange(400) + 0.5
    z, angle = 1 - index / 200, index * math.pi * (3 - math.sqrt(5))
    unit = torch.stack([(1 - z**2).sqrt() * angle.cos(), (1 - z**2).sqrt() * angle.sin(), z], 1)
    mesh = surface_mesh(components_at(2 * unit, unit, 0.2, 0.005, (0.1, 0.2, 0.0)), 0.1)
    radius = mesh.vertices.norm(dim=1)
    assert float((radius - 2).abs().max()) < 0.03
    assert float((mesh.normals * mesh.vertices).sum(1).max()) < -1.9
    edges = torch.cat([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    key = edges[:, 0] * len(radius) + edges[:, 1]
    back = edges[:, 1] * len(radius) + edges[:, 0]
    assert torch.equal(key.sort().values, back.sort().values), "each edge has a face on both sides"
    volume = (torch.linalg.det(mesh.vertices[mesh.faces]) / 6).sum()
    assert float(-volume) == pytest.approx(4 / 3 * math.pi * 8, rel=0.02)


def test_a_large_oblique_sheet_needs_no_more_memory_than_its_surface():
    normal = torch.tensor([[1.0, 1.0, 1.0]])
    one = components_at([[0.0, 0.0, 0.0]], normal, 5.0, 0.01, (9.0, 9.0, 9.0))
    mesh = surface_mesh(one, 0.1, memory_limit=100 << 20)  # the box around it has 6 million cells
    assert float((mesh.vertices.sum(1)).abs().max()) < 1e-5
    assert float(areas(mesh).norm(dim=1).sum()) == pytest.approx(math.pi * 10**2, rel=0.03)
    assert len(torch.unique(mesh.vertices, dim=0)) == len(mesh.vertices)


def test_both_sides_of_a_thin_wall_have_a_sheet_each():
    steps = torch.arange(-4, 5) * 0.2
    yz = torch.cartesian_prod(steps, steps)
    means, normals, origins = [], [], []
    for x in (0.0, 0.1):
        means.append(torch.cat([torch.full((len(yz), 1), x), yz], 1))
        normals.append(torch.tensor([[1.0, 0, 0]]).expand(len(yz), 3))
        origins.append(torch.tensor([[-3.0 if x == 0 else 3.0, 0, 0]]).expand(len(yz), 3))
    mesh = surface_mesh(
        components_at(torch.cat(means), torch.cat(normals), 0.12, 0.003, torch.cat(origins)), 0.05
    )
    front = mesh.normals[:, 0] < 0
    assert bool(front.any())
    assert bool((~front).any())
    assert float(mesh.vertices[front, 0].abs().max()) < 0.02
    assert float((mesh.vertices[~front, 0] - 0.1).abs().max()) < 0.02


def test_ends_of_beams_without_return_are_no_surface():
    whole = plane()
    right = whole.means[:, 0] > 0.05
    parts = (whole.means, whole.covariances, whole.support, whole.origins, right)
    left = surface_mesh(GaussianMap.from_components(*parts).components(), 0.05)
    assert float(left.vertices[:, 0].max()) < 0.3
    assert float(left.vertices[:, 0].min()) < -1.1


def test_bad_arguments_name_the_remedy():
    flat = GaussianMap.from_components([[0.0, 0.0]], torch.eye(2)[None], [5.0], torch.ones(1, 2))
    with pytest.raises(InvalidArgumentError, match="needs a 3D map"):
        surface_mesh(flat.components(), 0.1)
    with pytest.raises(MemoryLimitError, match="use larger cells"):
        surface_mesh(plane(), 0.005, memory_limit=100_000)
    far = components_at([[1e6, 0, 0]], [[0.0, 0, 1]], 0.3, 0.01, (1e6, 0, 3))
    with pytest.raises(InvalidArgumentError, match="use at least"):
        surface_mesh(far, 0.01)


def test_a_map_without_surfaces_has_an_empty_mesh_that_is_not_written(tmp_path):
    whole = plane()
    mesh = surface_mesh(whole.selected(torch.arange(0)), 0.1)
    assert mesh.faces.shape == (0, 3)
    with pytest.raises(InvalidArgumentError, match="no triangle"):
        write_mesh(tmp_path / "a.ply", mesh)
    with pytest.raises(InvalidArgumentError, match="must end in"):
        write_mesh(tmp_path / "a.stl", surface_mesh(whole, 0.1))


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_files_are_read_by_open3d(suffix, tmp_path):
    open3d = pytest.importorskip("open3d")
    mesh = surface_mesh(plane(), 0.1)
    path = write_mesh(tmp_path / f"a{suffix}", mesh)
    found = open3d.io.read_triangle_mesh(str(path))
    corners = np.asarray(found.vertices)[np.asarray(found.triangles)]
    np.testing.assert_allclose(corners, mesh.vertices[mesh.faces].numpy(), atol=1e-6)
    normals = np.asarray(found.vertex_normals)[np.asarray(found.triangles)]
    np.testing.assert_allclose(normals, mesh.normals[mesh.faces].numpy(), atol=1e-4)


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_colours_of_vertices_are_read_by_trimesh(suffix, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    mesh = surface_mesh(plane(), 0.1)
    colours = torch.rand(len(mesh.vertices), 3, generator=torch.Generator().manual_seed(0)).double()
    path = write_mesh(tmp_path / f"a{suffix}", mesh, colours)
    found = trimesh.load(path, process=False)
    shades = found.visual.vertex_colors[found.faces][:, :, :3]
    expected = 255 * display_colours(colours)[mesh.faces].numpy()
    np.testing.assert_allclose(shades, expected, atol=1.01)


def test_glb_has_the_structure_of_gltf_and_the_mesh_far_from_the_origin(tmp_path):
    near = surface_mesh(plane(), 0.1)
    far = near._replace(vertices=near.vertices + torch.tensor([4e5, 5e6, 100.0]).double())
    colours = torch.rand(len(near.vertices), 3, generator=torch.Generator().manual_seed(0)).double()
    plain = write_mesh(tmp_path / "a.glb", far).read_bytes()
    data = write_mesh(tmp_path / "a.glb", far, colours).read_bytes()
    assert b'"baseColorFactor":[0.75' in plain
    assert b"COLOR_0" not in plain
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    content = json.loads(data[20 : 20 + size])
    n_bytes, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0"
    binary = data[28 + size :]
    assert len(binary) == n_bytes == content["buffers"][0]["byteLength"]

    def array(number: int, dtype: str, width: int) -> np.ndarray:
        view = content["bufferViews"][content["accessors"][number]["bufferView"]]
        part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        return np.frombuffer(part, dtype).reshape(-1, width)

    (primitive,) = content["meshes"][0]["primitives"]
    places = primitive["attributes"]
    np.testing.assert_allclose(array(places["COLOR_0"], "<f4", 3), colours.numpy(), atol=1e-6)
    np.testing.assert_allclose(array(places["NORMAL"], "<f4", 3), far.normals.numpy(), atol=1e-6)
    assert content["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] == [1.0] * 4
    local = array(places["POSITION"], "<f4", 3).astype(float)
    faces = array(primitive["indices"], "<u4", 1).reshape(-1, 3)
    assert np.array_equal(faces, far.faces.numpy())
    assert content["accessors"][0]["min"] == local.min(0).tolist()
    node = content["nodes"][0]
    x, y, z, w = node["rotation"]
    axis, angle = np.array([x, y, z]) / np.linalg.norm([x, y, z]), 2 * math.acos(w)
    cross = np.cross(np.eye(3), axis)  # the matrix of axis × v
    turn = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    turned = local @ turn.T + node["translation"]
    expected = far.vertices.numpy()[:, [0, 2, 1]] * [1, 1, -1]  # y up: (x, z, −y)
    np.testing.assert_allclose(turned, expected, atol=1e-5, rtol=0)


def test_the_part_inside_a_box():
    mesh = surface_mesh(plane(), 0.05)
    part = mesh.inside((-0.5, -0.5, 0.0), (0.5, 0.5, 1.0))
    assert float(part.vertices[:, :2].abs().max()) <= 0.5
    assert float(areas(part)[:, 2].sum()) == pytest.approx(0.9, abs=0.12)
