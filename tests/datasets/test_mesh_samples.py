"""Points sampled from meshes: on the surface, uniform by area, and damaged files."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from gmmtorch.datasets import load, read_triangles
from gmmtorch.datasets.synthetic import sample_surface
from gmmtorch.errors import DataError, InvalidArgumentError

# A tetrahedron with faces of different areas.
CORNERS = [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 5.0)]
FACES = [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)]


def ply(corners=CORNERS, faces=FACES) -> str:
    head = [
        "ply", "format ascii 1.0", f"element vertex {len(corners)}",
        "property double x", "property double y", "property double z",
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    rows = [" ".join(map(repr, corner)) for corner in corners]
    rows += [" ".join(map(str, (len(face), *face))) for face in faces]
    return "\n".join([*head, *rows]) + "\n"


@pytest.fixture
def tetrahedron(tmp_path: Path) -> Path:
    path = tmp_path / "tetrahedron.ply"
    path.write_text(ply())
    return path


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def planes(triangles: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Areas (T,) and unit normals (T, 3)."""
    a, b, c = triangles.numpy().swapaxes(0, 1)
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    return length / 2, cross / length[:, None]


def test_sample_surface_covers_faces_in_proportion_to_area(tetrahedron):
    triangles = read_triangles(tetrahedron)
    assert triangles.shape == (4, 3, 3)
    areas, normals = planes(triangles)
    points = sample_surface(triangles, 40_000, generator()).numpy()
    distance = np.abs(np.einsum("ntd,td->nt", points[:, None] - triangles[:, 0].numpy(), normals))
    assert distance.min(1).max() < 1e-12
    assert (points @ [0.5, 1.0, 0.2] < 1 + 1e-12).all()  # inside the tetrahedron
    assert points.min() >= 0
    shares = np.bincount(distance.argmin(1), minlength=4) / len(points)
    np.testing.assert_allclose(shares, areas / areas.sum(), atol=0.01)  # four standard errors


def test_sample_surface_is_uniform_within_a_triangle():
    triangle = torch.tensor([[[1.0, 1.0, 0.0], [5.0, 1.0, 0.0], [2.0, 4.0, 0.0]]], dtype=torch.float64)
    points = sample_surface(triangle, 50_000, generator()).numpy()
    corners = triangle[0].numpy()
    np.testing.assert_allclose(points.mean(0), corners.mean(0), atol=0.02)
    # Covariance of a uniform triangle: Σ (corner − centre)(corner − centre)ᵀ / 12.
    offset = corners - corners.mean(0)
    np.testing.assert_allclose(np.cov(points.T), offset.T @ offset / 12, atol=0.02)


def test_sample_surface_skips_faces_without_area():
    flat = torch.tensor([[[7.0, 7.0, 7.0]] * 3, [[0.0, 0, 0], [1.0, 0, 0], [0.0, 1, 0]]]).double()
    points = sample_surface(torch.cat([flat, flat[:1]]), 1000, generator())
    assert float(points.max()) <= 1
    with pytest.raises(DataError, match="no area"):
        sample_surface(flat[:1], 10, generator())


def test_mesh_is_one_scan_from_the_centre_of_its_box(tetrahedron):
    dataset = load("mesh", tetrahedron, n_points=500)
    assert (dataset.name, len(dataset)) == ("tetrahedron", 1)
    scan = dataset[0]
    assert scan.points.shape == (500, 3)
    assert scan.no_return.shape == (0, 3)
    assert scan.origin.tolist() == [1.0, 0.5, 2.5]


def test_mesh_samples_depend_on_the_seed(tetrahedron):
    first, again, other = (load("mesh", tetrahedron, seed=seed)[0].points for seed in (3, 3, 4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_mesh_noise_has_the_given_standard_deviation(tetrahedron):
    exact = load("mesh", tetrahedron, n_points=20_000)[0].points
    noisy = load("mesh", tetrahedron, n_points=20_000, noise=0.05)[0].points
    np.testing.assert_allclose(np.cov((noisy - exact).T), 0.0025 * np.eye(3), atol=1e-4)


@pytest.mark.parametrize("suffix", ["obj", "stl"])
def test_read_triangles_accepts_obj_and_stl(suffix, tetrahedron, tmp_path):
    import open3d

    mesh = open3d.io.read_triangle_mesh(str(tetrahedron))
    mesh.compute_triangle_normals()
    path = tmp_path / f"other.{suffix}"
    assert open3d.io.write_triangle_mesh(str(path), mesh)
    areas, _ = planes(read_triangles(path))
    expected, _ = planes(read_triangles(tetrahedron))
    np.testing.assert_allclose(np.sort(areas), np.sort(expected), rtol=1e-6)


@pytest.mark.parametrize("form", ["<", ">", "ascii"])
def test_read_triangles_cuts_polygons_of_different_sizes_into_fans(form, tmp_path):
    corners = np.random.default_rng(0).normal(size=(6, 3)).round(3)
    faces = [(0, 1, 2), (2, 3, 4, 5, 0), (1, 3, 5, 4)]
    fans = [(f[0], f[i], f[i + 1]) for f in faces for i in range(1, len(f) - 1)]
    name = {"<": "binary_little_endian", ">": "binary_big_endian"}.get(form, form)
    head = ply(corners, faces).split("end_header")[0].replace("ascii", name) + "end_header\n"
    if form == "ascii":
        body = ply(corners.tolist(), faces).split("end_header\n")[1].encode()
    else:
        body = corners.astype(f"{form}f8").tobytes()
        body += b"".join(struct.pack(f"{form}B{len(f)}i", len(f), *f) for f in faces)
    path = tmp_path / "a.ply"
    path.write_bytes(head.encode() + body)
    found = {triangle.tobytes() for triangle in read_triangles(path).numpy()}
    assert found == {corners[list(fan)].tobytes() for fan in fans}


def test_read_triangles_accepts_relative_indices_and_textures(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nvt 0 0\nv 0 1 0\nv 1 1 0\nf -4 -3 -2\nf 2/1 4/1/1 3//1\n")
    triangles = read_triangles(path).tolist()
    assert triangles == [[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 0], [0, 1, 0]]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (ply(faces=[(0, 1, 9)]), "missing corner"),
        ("not a mesh", "another kind of file"),
        (ply(faces=[]), "no readable triangles"),
        (ply()[:-12], "may be truncated"),
        (ply(faces=[(0, 1, 0.5)]), "missing corner"),
        (ply() + "7\n", "more data than its header announces"),
        (ply([*CORNERS[:3], (float("nan"), 0.0, 0.0)]), "NaN or infinite"),
        (ply([(1.0, 2.0, 3.0)] * 4), "no area"),
    ],
)
def test_mesh_rejects_damaged_files(text, message, tmp_path):
    path = tmp_path / "broken.ply"
    path.write_text(text)
    with pytest.raises(DataError, match=message):
        load("mesh", path)[0]


@pytest.mark.parametrize(("option", "value"), [("n_points", 0), ("noise", -0.1), ("seed", -1)])
def test_mesh_rejects_invalid_options(option, value, tetrahedron):
    with pytest.raises(InvalidArgumentError, match=f"{option}={value}"):
        load("mesh", tetrahedron, **{option: value})


@pytest.mark.real_data
def test_mesh_reads_the_stanford_bunny(real_data):
    dataset = load("mesh", real_data / "meshes" / "bunny.ply", n_points=5000)
    points = dataset[0].points
    size = points.amax(0) - points.amin(0)
    assert dataset.name == "bunny"
    assert bool((size > 1).all() and (size < 2).all())
