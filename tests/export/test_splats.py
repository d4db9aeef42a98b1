"""Gaussian splats: files of components for viewers, and such files as maps."""

from __future__ import annotations

import gzip
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from mapping.random_components import random_components
from scipy.spatial.transform import Rotation
from torch import Tensor

import gmmtorch as gt
from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError
from gmmtorch.export import Splats, map_of_splats, read_splats, write_splats
from gmmtorch.mapping import Attributes, Components, Numbers
from gmmtorch.scan import display_colours

C0 = 0.28209479177387814


def coloured(k: int = 30) -> Components:
    c = random_components(3, k=k, seed=2, center=0.0, extent=4.0, deviations=(0.02, 0.5))
    colour = torch.rand(k, 3, generator=torch.Generator().manual_seed(1)).double()
    none = torch.zeros(k, 3, 3).double()
    own = Numbers(torch.ones(k).double(), colour, none, none)
    return replace(c, max_range=torch.zeros(k, dtype=torch.bool), attributes=Attributes({"colour": own}))


def covariances(splats: Splats) -> Tensor:
    root = splats.rotations * splats.deviations[:, None]
    return root @ root.mT


@pytest.mark.parametrize("suffix", [".ply", ".spz"])
def test_splats_come_back_in_the_frame_of_the_map(tmp_path, suffix):
    c = coloured()
    path = write_splats(tmp_path / f"map{suffix}", Splats.of(c))
    found, is_exact = read_splats(path), suffix == ".ply"
    torch.testing.assert_close(found.means, c.means, rtol=0, atol=1e-6 if is_exact else 2**-13)
    seen = display_colours(c.attributes.channels["colour"].mean)
    torch.testing.assert_close(
        found.colours, seen, rtol=0, atol=1e-6 if is_exact else 0.5 / 255 / 0.15 * C0 + 1e-6
    )
    torch.testing.assert_close(found.opacity, torch.full((30,), 0.95).double(), rtol=0, atol=0.003)
    deviations = torch.linalg.eigvalsh(covariances(found)).sqrt()
    wanted = torch.linalg.eigvalsh(c.covariances).sqrt()
    torch.testing.assert_close(deviations, wanted, rtol=1e-5 if is_exact else 0.033, atol=1e-6)
    if is_exact:
        torch.testing.assert_close(covariances(found), c.covariances, rtol=1e-4, atol=1e-7)
    else:  # the turn is off by at most a step of 9 bits on each of three components
        error = (covariances(found) - c.covariances).flatten(1).norm(dim=1)
        assert bool((error < 0.08 * c.covariances.flatten(1).norm(dim=1)).all())


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".glb"])
def test_far_maps_are_written_with_a_warning(tmp_path, suffix):
    splats = Splats.of(coloured())
    far = splats._replace(means=splats.means + torch.tensor([5e5, 3e6, 0]).double())
    with pytest.warns(UserWarning, match="rounded"):
        path = write_splats(tmp_path / f"map{suffix}", far)
    if suffix != ".glb":
        torch.testing.assert_close(read_splats(path).means, far.means, rtol=0, atol=0.51)


@pytest.mark.slow
def test_a_million_splats_become_a_map(tmp_path):
    n, generator = 1_000_000, torch.Generator().manual_seed(0)
    places = 100 * torch.rand(n, 3, generator=generator).double()
    turn = torch.eye(3).double().expand(n, 3, 3)
    splats = Splats(places, torch.full_like(places, 0.05), turn, places / 100, torch.full((n,), 0.9).double())
    found = read_splats(write_splats(tmp_path / "many.spz", splats))
    assert len(found.means) == n
    made = map_of_splats(found)
    assert len(made.components()) == n
    torch.testing.assert_close(made.components().means, places, rtol=0, atol=2**-13)


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".glb"])
def test_other_readers_find_the_places_and_colours(tmp_path, suffix):
    c = coloured()
    path, seen = write_splats(tmp_path / f"map{suffix}", Splats.of(c)), c.means.numpy()
    shades = display_colours(c.attributes.channels["colour"].mean).numpy()
    if suffix == ".glb":
        trimesh = pytest.importorskip("trimesh")
        (cloud,) = trimesh.load(path).geometry.values()
        np.testing.assert_allclose(cloud.vertices, seen[:, [0, 2, 1]] * [1, 1, -1], atol=1e-5)
        return
    open3d = pytest.importorskip("open3d")
    cloud = open3d.t.io.read_point_cloud(str(path)).point
    y_up = seen if suffix == ".ply" else seen[:, [0, 2, 1]] * [1, 1, -1]
    np.testing.assert_allclose(cloud.positions.numpy(), y_up, atol=2**-13)
    atol = 1e-5 if suffix == ".ply" else 0.5 / 255 / 0.15 * C0 + 1e-5
    np.testing.assert_allclose(0.5 + C0 * cloud.f_dc.numpy(), shades, atol=atol)
    np.testing.assert_allclose(cloud.opacity.numpy()[:, 0], np.log(0.95 / 0.05), atol=0.03)


def test_plyfile_reads_every_property_of_splats(tmp_path):
    plyfile = pytest.importorskip("plyfile")
    c = coloured()
    file = plyfile.PlyData.read(write_splats(tmp_path / "map.ply", Splats.of(c)))
    (table,) = file.elements
    assert (table.name, table.count, file.byte_order, file.text) == ("vertex", 30, "<", False)

    def columns(*names: str) -> np.ndarray:
        return np.stack([table[name].astype(np.float64) for name in names], 1)

    np.testing.assert_allclose(columns("x", "y", "z"), c.means, atol=1e-6)
    shades = display_colours(c.attributes.channels["colour"].mean)
    np.testing.assert_allclose(0.5 + C0 * columns("f_dc_0", "f_dc_1", "f_dc_2"), shades, atol=1e-6)
    deviations = np.exp(columns("scale_0", "scale_1", "scale_2"))
    turn = Rotation.from_quat(columns("rot_1", "rot_2", "rot_3", "rot_0")).as_matrix()
    root = turn * deviations[:, None]
    np.testing.assert_allclose(root @ root.transpose(0, 2, 1), c.covariances, rtol=1e-4, atol=1e-6)


def test_a_map_without_surfaces_is_written_where_the_format_allows_it(tmp_path):
    nothing = Splats.of(Components.empty(3))
    for suffix in (".ply", ".spz"):
        assert len(read_splats(write_splats(tmp_path / f"none{suffix}", nothing)).means) == 0
    with pytest.raises(InvalidArgumentError, match="No surface"):
        write_splats(tmp_path / "none.glb", nothing)


def test_a_ply_file_has_the_common_layout(tmp_path):
    """Read without our reader: float32 properties in the usual order, logits, logarithms, w first."""
    c = coloured(3)
    data = write_splats(tmp_path / "map.ply", Splats.of(c)).read_bytes()
    header, body = data.split(b"end_header\n", 1)
    names = [line.split()[-1] for line in header.decode().splitlines() if line.startswith("property float")]
    expected = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert names == expected.split()
    table = np.frombuffer(body, "<f4").reshape(3, 17).astype(np.float64)
    np.testing.assert_allclose(1 / (1 + np.exp(-table[:, 9])), 0.95, rtol=1e-5)
    w, x, y, z = table[:, 13:].T
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    root = turn * np.exp(table[:, None, 10:13])
    np.testing.assert_allclose(root @ root.transpose(0, 2, 1), c.covariances.numpy(), rtol=1e-4, atol=1e-6)


def test_a_glb_file_has_the_extension_and_y_up(tmp_path):
    c = coloured(4)
    data = write_splats(tmp_path / "map.glb", Splats.of(c)).read_bytes()
    magic, version, length, n_text, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    text = json.loads(data[20 : 20 + n_text])
    primitive = text["meshes"][0]["primitives"][0]
    name = "KHR_gaussian_splatting"
    assert text["extensionsUsed"] == [name]
    assert primitive["mode"] == 0
    assert primitive["extensions"][name] == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    start = 20 + n_text + 8

    def column(key: str, width: int) -> np.ndarray:
        accessor = text["accessors"][primitive["attributes"][key]]
        view = text["bufferViews"][accessor["bufferView"]]
        assert accessor["count"] == 4
        found = np.frombuffer(data, "<f4", 4 * width, start + view["byteOffset"])
        return found.reshape(4, width)

    place = column("POSITION", 3)
    np.testing.assert_allclose(place, c.means.numpy()[:, [0, 2, 1]] * [1, 1, -1], rtol=1e-6)
    np.testing.assert_allclose(text["accessors"][0]["max"], place.max(0))
    np.testing.assert_allclose(np.linalg.norm(column(f"{name}:ROTATION", 4), axis=1), 1, rtol=1e-6)
    deviations = np.sqrt(np.linalg.eigvalsh(c.covariances.numpy()))
    np.testing.assert_allclose(np.sort(column(f"{name}:SCALE", 3), 1), deviations, rtol=1e-4)
    np.testing.assert_allclose(column(f"{name}:OPACITY", 1), 0.95, rtol=1e-6)
    seen = display_colours(c.attributes.channels["colour"].mean).numpy()
    np.testing.assert_allclose(0.5 + C0 * column(f"{name}:SH_DEGREE_0_COEF_0", 3), seen, atol=1e-6)


def spz(version: int, turn: bytes, degree: int = 0, n: int = 1) -> bytes:
    """One splat at x = 1, y = 2, z = −3, written by hand: 8 fractional bits, deviations e^0, e^−1, e^−2."""
    header = struct.pack("<IIIBBBB", 0x5053474E, version, n, degree, 8, 0, 0)
    place = b"".join((256 * x & 0xFFFFFF).to_bytes(3, "little") for x in (1, 2, -3))
    harmonics = bytes(3 * (0, 3, 8, 15)[degree])
    return gzip.compress(
        header + place + bytes([255, 128, 255, 0, 160, 144, 128]) + turn + harmonics, mtime=0
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize(
    ("version", "turn"),
    [
        (2, bytes([128, 128, 128])),  # x = y = z = 0.004, w = 1
        (3, struct.pack("<I", 3 << 30)),  # the largest one is w, the others are 0
    ],
)
def test_spz_of_both_versions_and_any_degree(tmp_path, version, turn, degree):
    (tmp_path / "a.spz").write_bytes(spz(version, turn, degree))
    found = read_splats(tmp_path / "a.spz")
    assert found.means.tolist() == [[1.0, 3.0, 2.0]]  # y is up in the file, z in the map
    assert found.opacity.tolist() == [1.0]
    red, green, blue = (found.colours[0] - 0.5).tolist()
    assert green == pytest.approx(0.5)  # clamped
    assert blue == pytest.approx(-0.5)
    assert red == pytest.approx((128 / 255 - 0.5) / 0.15 * C0)
    wanted = torch.tensor([1.0, np.exp(-4), np.exp(-2)]).double()
    torch.testing.assert_close(covariances(found)[0].diagonal(), wanted, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "not SPZ"),
        (b"hello, I am no splat", "not SPZ"),
        (b"NGSP" + bytes(28), "SPZ of version 4"),
        (spz(1, bytes(3)), "version 1"),
        (spz(3, bytes(4), n=1000), "1,000 splats, but is shorter"),
        (spz(3, bytes(4), n=1 << 31), "it is damaged"),
        (spz(3, bytes(4))[:30], "not SPZ|truncated"),
    ],
)
def test_damaged_spz_is_refused(tmp_path, content, reason):
    (tmp_path / "a.spz").write_bytes(content)
    with pytest.raises(DataError, match=reason):
        read_splats(tmp_path / "a.spz")


def changed_ply(path: Path, name: str, value: float) -> Path:
    data = write_splats(path / "a.ply", Splats.of(coloured(3))).read_bytes()
    header, body = data.split(b"end_header\n", 1)
    names = [line.split()[-1] for line in header.decode().splitlines() if line.startswith("property float")]
    table = np.frombuffer(body, "<f4").reshape(3, 17).copy()
    table[1, names.index(name)] = value
    (path / "a.ply").write_bytes(header + b"end_header\n" + table.tobytes())
    return path / "a.ply"


@pytest.mark.parametrize("name", ["x", "f_dc_1", "opacity", "scale_2", "rot_0"])
def test_splats_that_are_not_finite_are_refused(tmp_path, name):
    with pytest.raises(DataError, match="not finite"):
        read_splats(changed_ply(tmp_path, name, np.nan))


def test_a_splat_larger_than_the_earth_is_refused_by_the_reader(tmp_path):
    with pytest.raises(DataError, match=r"a\.ply: extent\[1\]"):
        read_splats(changed_ply(tmp_path, "scale_1", 40.0))


def test_zero_scales_zero_rotations_and_extreme_logits_are_read(tmp_path):
    for name, value in (("scale_0", -np.inf), ("opacity", 500.0), ("opacity", -np.inf)):
        found = read_splats(changed_ply(tmp_path, name, value))
        made = map_of_splats(found)
        assert len(made.components()) == (2 if value == -np.inf and name == "opacity" else 3)
        assert bool(torch.isfinite(torch.as_tensor(made.occupancy(found.means, 0.1))).all())


def test_a_ply_cloud_without_splats_and_other_files_are_refused(tmp_path):
    (tmp_path / "cloud.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "end_header\n0 0 0\n"
    )
    with pytest.raises(DataError, match="no property f_dc_0"):
        read_splats(tmp_path / "cloud.ply")
    (tmp_path / "a.splat").write_bytes(b"")
    with pytest.raises(InvalidArgumentError, match=r"must end in \.ply or \.spz"):
        read_splats(tmp_path / "a.splat")
    with pytest.raises(MissingDataError):
        read_splats(tmp_path / "none.ply")
    with pytest.raises(InvalidArgumentError, match=r"must end in \.ply, \.spz, \.glb"):
        write_splats(tmp_path / "a.obj", Splats.of(coloured(1)))
    with pytest.raises(InvalidArgumentError, match="the map is 2D"):
        Splats.of(random_components(2, k=2, seed=0))


def test_a_map_of_splats_answers_occupancy_and_colour(tmp_path):
    """A wall of splats at x = 2, around the origin of nothing else."""
    y, z = torch.meshgrid(torch.arange(-2, 2, 0.25), torch.arange(0, 2, 0.25), indexing="ij")
    k = y.numel()
    means = torch.stack([torch.full((k,), 2.0), y.flatten(), z.flatten()], 1).double()
    wall = torch.diag(torch.tensor([0.01, 0.15, 0.15]).double() ** 2).expand(k, 3, 3)
    none = torch.zeros(k, 3, 3).double()
    red = torch.tensor([1.0, 0, 0]).double().expand(k, 3)
    own = Attributes({"colour": Numbers(torch.ones(k).double(), red, none, none)})
    c = replace(Components.given(means, wall, torch.ones(k), means - 1, None, 0), attributes=own)
    made = map_of_splats(read_splats(write_splats(tmp_path / "wall.spz", Splats.of(c))))
    assert isinstance(made, gt.GaussianMap)
    points = torch.tensor([[2.0, 0.1, 1.0], [2.0, -1.0, 0.5], [-5.0, 0, 0]]).double()
    theta = made.occupancy(points, 0.1)
    assert bool((theta[:2] > 0.9).all())
    assert float(theta[2]) == 0.5
    found = made.attributes(points)["colour"]
    assert found.known.tolist() == [True, True, False]
    torch.testing.assert_close(found.mean[0], red[0], rtol=0, atol=0.02)
