"""Channels of points in files, bags and images: colour, intensity and class."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from datasets.scan_files import depth_folder, kitti, pcd_of, ply_of
from PIL import Image
from sensor_bags import BagWriter

from gmmtorch.datasets import load, read_channels
from gmmtorch.datasets.point_files.channels import channel_of
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.scan import linear_colours

COLOURS = np.array([[255, 0, 0], [0, 128, 0], [10, 20, 255]], np.uint8)
LINEAR = linear_colours(torch.from_numpy(COLOURS).float() / 255)
PLACES = np.array([[1.0, 0, 0], [2, 1, 0], [3, 1, 1]], np.float32)
IDENTITY = kitti(np.eye(3), [0, 0, 0])


def packed(alpha: int = 0) -> np.ndarray:
    red, green, blue = COLOURS.astype(np.uint32).T
    return (np.uint32(alpha) << 24) | (red << 16) | (green << 8) | blue


def table_of(**columns: np.ndarray) -> np.ndarray:
    whole = {**dict(zip("xyz", PLACES.T, strict=True)), **columns}
    table = np.empty(len(PLACES), [(name, value.dtype) for name, value in whole.items()])
    for name, value in whole.items():
        table[name] = value
    return table


@pytest.mark.parametrize("alpha", [0, 255])
@pytest.mark.parametrize("kind", ["F", "U"])
@pytest.mark.parametrize("name", ["rgb", "rgba"])
def test_packed_colours_of_pcd_files_are_bits_also_if_they_are_called_floats(tmp_path, alpha, kind, name):
    path = tmp_path / "scan.pcd"
    path.write_bytes(pcd_of(table_of(**{name: packed(alpha)}), f"FFF{kind}"))
    assert torch.equal(read_channels(path, ["colour"])["colour"], LINEAR)


@pytest.mark.parametrize("as_float", [True, False])
def test_packed_colours_of_ascii_pcd_files(tmp_path, as_float):
    path = tmp_path / "scan.pcd"
    colours = packed().view(np.float32) if as_float else packed()
    path.write_bytes(pcd_of(table_of(rgb=colours), "FFFF" if as_float else "FFFU", "ascii"))
    torch.testing.assert_close(read_channels(path, ["colour"])["colour"], LINEAR)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("scale", ["u1", "u2", "0 to 1", "0 to 255"])
def test_colours_of_ply_files_of_every_scale(tmp_path, form, scale):
    values = {
        "u1": COLOURS,
        "u2": COLOURS.astype(np.uint16) * 257,
        "0 to 1": COLOURS.astype(np.float32) / 255,
        "0 to 255": COLOURS.astype(np.float32),
    }[scale]
    path = tmp_path / "scan.ply"
    path.write_bytes(ply_of(table_of(red=values[:, 0], green=values[:, 1], blue=values[:, 2]), form))
    torch.testing.assert_close(read_channels(path, ["colour"])["colour"], LINEAR)


def test_fields_by_their_usual_names_and_by_their_own(tmp_path):
    table = table_of(
        reflectivity=np.array([1.5, np.nan, np.inf], np.float32),
        label=np.array([3, 0, 9], np.uint16),
        ring=np.array([7, 8, 9], np.uint8),
    )
    path = tmp_path / "scan.pcd"
    path.write_bytes(pcd_of(table, "FFFFUU"))
    found = read_channels(path, ["intensity", "class", "ring", "colour"])
    assert found.keys() == {"intensity", "class", "ring"}
    assert found["intensity"].tolist()[0] == 1.5
    assert found["intensity"][1:].isnan().all()
    assert found["class"].tolist() == [3, 0, 9]
    assert found["ring"].tolist() == [7.0, 8.0, 9.0]


def test_channels_of_las_files(tmp_path):
    laspy = pytest.importorskip("laspy")
    cloud = laspy.create(point_format=3, file_version="1.2")
    cloud.x, cloud.y, cloud.z = PLACES.T
    cloud.red, cloud.green, cloud.blue = COLOURS.T.astype(np.uint16) * 257
    cloud.intensity, cloud.classification = np.array([5, 6, 7]), np.array([2, 6, 2])
    cloud.write(tmp_path / "scan.las")
    found = read_channels(tmp_path / "scan.las", ["colour", "intensity", "class"])
    torch.testing.assert_close(found["colour"], LINEAR)
    assert found["intensity"].tolist() == [5.0, 6.0, 7.0]
    assert found["class"].tolist() == [2, 6, 2]


@pytest.mark.parametrize(
    ("name", "values", "reason"),
    [
        ("colour", [0.0, 300.0], "colours from 0 to 300"),
        ("colour", [-0.1, 0.5], "colours from -0.1"),
        ("class", [1.0, 70000.0], "the label 70000"),
        ("class", [1.0, 2.5], "the label 2.5"),
    ],
)
def test_values_out_of_range_are_refused(name, values, reason):
    columns = [np.array(values)] * (3 if name == "colour" else 1)
    with pytest.raises(DataError, match=reason):
        channel_of(name, columns, [np.dtype("f8")] * len(columns), "it")


@pytest.mark.parametrize("wanted", ["colour", ["colour", "colour"], [""], [3]])
def test_a_bad_list_of_channels_is_refused(tmp_path, wanted):
    with pytest.raises(InvalidArgumentError, match="attributes="):
        read_channels(tmp_path / "scan.pcd", wanted)


def test_a_scan_folder_keeps_channels_with_their_points_and_counts_scans_without(tmp_path):
    (tmp_path / "scans").mkdir()
    (tmp_path / "poses.txt").write_text(2 * IDENTITY)
    far = table_of(intensity=np.array([1, 2, 3], np.float32))
    far["x"][1] = np.nan
    (tmp_path / "scans" / "0.pcd").write_bytes(pcd_of(far, "FFFF"))
    (tmp_path / "scans" / "1.pcd").write_bytes(pcd_of(table_of(), "FFF"))
    data = load("scan_folder", tmp_path, max_range=3.2, no_return_range=1.0, attributes=["intensity"])
    assert data[0].attributes["intensity"].flatten().tolist() == [1.0]  # NaN is dropped, 3.3 m is no return
    assert data[1].attributes == {}
    assert data.skipped == {"read without intensity, which they lack": 1}


def test_kitti_has_reflectance_and_the_labels_of_semantic_kitti(tmp_path):
    for folder in ("velodyne", "labels"):
        (tmp_path / folder).mkdir()
    (tmp_path / "poses.txt").write_text(IDENTITY)
    (tmp_path / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    rows = np.column_stack([PLACES, [0.1, 0.2, 0.3]]).astype("<f4")
    rows[1, :3] = 0  # invalid
    rows.tofile(tmp_path / "velodyne" / "000000.bin")
    labels = np.array([40 | 7 << 16, 10, 0], "<u4")  # the upper 16 bits number the objects
    labels.tofile(tmp_path / "labels" / "000000.label")
    scan = load("kitti", tmp_path, attributes=["intensity", "class"])[0]
    torch.testing.assert_close(scan.attributes["intensity"].flatten(), torch.tensor([0.1, 0.3]))
    assert scan.attributes["class"].tolist() == [40, -1]
    (tmp_path / "labels" / "000000.label").write_bytes(b"\0" * 8)
    with pytest.raises(DataError, match="not 4 for each of 3 points"):
        load("kitti", tmp_path, attributes=["class"])[0]
    with pytest.raises(InvalidArgumentError, match="scans of KITTI have"):
        load("kitti", tmp_path, attributes=["colour"])


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
def test_point_clouds_of_bags_have_channels(tmp_path, suffix):
    path = tmp_path / f"run{suffix}"
    table = table_of(rgb=packed(255).view(np.float32), intensity=np.array([4, 5, 6], np.float32))
    with BagWriter(path) as bag:
        for time in (0.0, 0.1):
            bag.cloud_table("/points", time, "lidar", table)
    data = load("rosbag", path, poses="standing", attributes=["colour", "intensity", "class"])
    torch.testing.assert_close(data[0].attributes["colour"], LINEAR)
    assert data[0].attributes["intensity"].flatten().tolist() == [4.0, 5.0, 6.0]
    assert data.skipped == {"read without class, which they lack": 1}


# -- images ----------------------------------------------------------------------------------------------


def colour_folder(path: Path, shape: tuple[int, int] = (4, 6), scale: int = 1) -> np.ndarray:
    """A folder with a depth image 2 m away, and a colour image with another colour in each pixel."""
    depth_folder(path, [(np.full(shape, 2000, np.uint16), np.eye(4))])
    height, width = (scale * n for n in shape)
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0], image[..., 1] = np.meshgrid(np.arange(width) * 9, np.arange(height) * 9)
    Image.fromarray(image).save(path / "frame-000000.color.png")
    return image


def test_registered_images_colour_their_pixels(tmp_path):
    image = colour_folder(tmp_path)
    scan = load("depth_frames", tmp_path, attributes=["colour"])[0]
    expected = linear_colours(torch.from_numpy(image).float().flatten(0, 1) / 255)
    torch.testing.assert_close(scan.attributes["colour"], expected)
    assert load("depth_frames", tmp_path)[0].attributes == {}


def test_a_camera_beside_the_depth_camera_sees_each_point_elsewhere(tmp_path):
    image = colour_folder(tmp_path, scale=2)
    center = (2 * 6 - 1) / 2, (2 * 4 - 1) / 2
    (tmp_path / "color-intrinsics.txt").write_text(f"200 0 {center[0]}\n0 400 {center[1]}\n0 0 1\n")
    pose = np.eye(4)
    pose[0, 3] = 0.04  # 200 · 0.04 / 2 = 4 pixels
    np.savetxt(tmp_path / "color-pose.txt", pose)
    found = load("depth_frames", tmp_path, attributes=["colour"])[0].attributes["colour"]
    u, v = np.meshgrid(np.arange(6), np.arange(4))
    column = np.round(2 * (u - 2.5) + center[0] + 4).astype(int)
    row = np.round(2 * (v - 1.5) + center[1]).astype(int)
    inside = torch.from_numpy((column < 12).ravel())
    expected = torch.from_numpy(image[row.ravel(), column.ravel().clip(0, 11)]).float() / 255
    torch.testing.assert_close(found[inside], linear_colours(expected)[inside])
    assert found[~inside].isnan().all()


def test_points_that_others_hide_from_the_colour_camera_are_unknown(tmp_path):
    colour_folder(tmp_path)
    depth = np.full((4, 6), 2000, np.uint16)
    depth[:, :3] = 500
    Image.fromarray(depth).save(tmp_path / "frame-000000.depth.png")
    (tmp_path / "color-intrinsics.txt").write_text("100 0 2.5\n0 200 1.5\n0 0 1\n")
    np.savetxt(tmp_path / "color-pose.txt", np.eye(4))
    found = load("depth_frames", tmp_path, attributes=["colour"])[0].attributes["colour"]
    hidden = found.isnan().all(1).view(4, 6)
    assert hidden[:, 3].all()  # in the block of pixels of a nearer point
    assert not hidden[:, :3].any()


def test_an_image_of_another_size_is_refused_with_the_remedy(tmp_path):
    colour_folder(tmp_path, scale=2)
    with pytest.raises(DataError, match=r"12×8 pixels, but the depth image 6×4; write color-intrinsics\.txt"):
        load("depth_frames", tmp_path, attributes=["colour"])[0]


def test_a_missing_image_is_counted_and_a_damaged_one_is_refused(tmp_path):
    colour_folder(tmp_path)
    path = tmp_path / "frame-000000.color.png"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(DataError, match="not a complete JPEG or PNG"):
        load("depth_frames", tmp_path, attributes=["colour"])[0]
    path.unlink()
    data = load("depth_frames", tmp_path, attributes=["colour"])
    assert data[0].attributes == {}
    assert data.skipped == {"read without colour, which they lack": 1}
    with pytest.raises(InvalidArgumentError, match="depth images have the channel colour only"):
        load("depth_frames", tmp_path, attributes=["class"])


def test_tum_takes_the_nearest_image_in_time(tmp_path):
    (tmp_path / "depth").mkdir()
    (tmp_path / "rgb").mkdir()
    for name, value in (("a", 10), ("b", 200)):
        Image.new("RGB", (640, 480), (value, 0, 0)).save(tmp_path / "rgb" / f"{name}.png")
    for name in ("1", "2"):
        Image.fromarray(np.full((480, 640), 5000, np.uint16)).save(tmp_path / "depth" / f"{name}.png")
    (tmp_path / "depth.txt").write_text("1.0 depth/1.png\n2.0 depth/2.png\n")
    (tmp_path / "rgb.txt").write_text("0.99 rgb/a.png\n1.015 rgb/b.png\n")
    rows = "".join(f"{t} 0 0 0 0 0 0 1\n" for t in (0.9, 1.2, 1.4, 1.6, 1.8, 2.1))
    (tmp_path / "groundtruth.txt").write_text(rows)
    data = load("tum", tmp_path, pixel_stride=40, attributes=["colour"])
    torch.testing.assert_close(data[0].attributes["colour"][0, 0], linear_colours(torch.tensor(10 / 255)))
    assert data[1].attributes == {}
    assert data.skipped == {"read without colour, which they lack": 1}
