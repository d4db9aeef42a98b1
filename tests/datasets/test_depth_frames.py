"""Depth frames: points, units, size and orientation of images, and error messages for damaged folders."""

from __future__ import annotations

import io
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from PIL import Image
from scan_files import TURN_LEFT, depth_folder

from gmmtorch.datasets import load
from gmmtorch.errors import DataError, InvalidArgumentError


def test_depth_frames_back_project_and_transform_pixels(tmp_path):
    depth = np.array([[1000, 0, 65535], [0, 2000, 0], [0, 0, 4000]], dtype=np.uint16)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = TURN_LEFT, [1.0, 2.0, 3.0]
    dataset = load("depth_frames", depth_folder(tmp_path, [(depth, np.eye(4)), (depth, pose)]))
    first, second = dataset
    expected = torch.tensor([[-0.01, -0.005, 1.0], [0.0, 0.0, 2.0], [0.04, 0.02, 4.0]], dtype=torch.float64)
    torch.testing.assert_close(first.points, expected)
    assert second.origin.tolist() == [1.0, 2.0, 3.0]
    assert torch.equal(dataset.pose(1), torch.from_numpy(pose))
    moved = expected @ torch.from_numpy(TURN_LEFT).T + second.origin
    torch.testing.assert_close(second.points, moved)


def test_depth_frames_apply_max_range_and_pixel_stride(tmp_path):
    folder = depth_folder(tmp_path, [(np.full((4, 6), 3000, dtype=np.uint16), np.eye(4))])
    assert load("depth_frames", folder, pixel_stride=2)[0].points.shape == (6, 3)
    scan = load("depth_frames", folder, max_range=3.0, no_return_range=2.0)[0]
    assert scan.points.shape == (0, 3)
    assert scan.no_return.shape == (24, 3)
    with pytest.raises(InvalidArgumentError, match="pixel_stride=0"):
        load("depth_frames", folder, pixel_stride=0)


@pytest.mark.parametrize("up", ["x", "-x", "y", "-y", "z", "-z"])
def test_depth_frames_are_turned_so_that_up_is_z(tmp_path, up):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = TURN_LEFT, [1.0, 2.0, 3.0]
    folder = depth_folder(tmp_path, [(np.full((4, 6), 2000, dtype=np.uint16), pose)])
    axis = torch.zeros(3, dtype=torch.float64)
    axis["xyz".index(up[-1])] = -1.0 if up[0] == "-" else 1.0
    given, turned = load("depth_frames", folder), load("depth_frames", folder, up=up)
    torch.testing.assert_close(turned[0].points[:, 2], given[0].points @ axis)
    motion = turned.image(0)[1] @ torch.linalg.inv(given.image(0)[1])
    assert float(torch.linalg.det(motion[:3, :3])) == pytest.approx(1)
    torch.testing.assert_close(given[0].transformed(motion).points, turned[0].points)
    with pytest.raises(InvalidArgumentError, match=r"up='w' is not one of z, -z"):
        load("depth_frames", folder, up="w")


def test_depth_frames_scale_their_units_and_may_have_no_valid_pixel(tmp_path):
    folder = depth_folder(tmp_path, [(np.full((4, 6), 5000, dtype=np.uint16), np.eye(4))])
    assert load("depth_frames", folder).image(0)[0].unique().tolist() == [5.0]
    assert load("depth_frames", folder, depth_scale=0.0002).image(0)[0].unique().tolist() == [1.0]
    with pytest.raises(InvalidArgumentError, match="depth_scale=0"):
        load("depth_frames", folder, depth_scale=0)
    Image.fromarray(np.zeros((4, 6), np.uint16)).save(folder / "frame-000000.depth.png")
    assert load("depth_frames", folder)[0].n_beams == 0


@pytest.mark.parametrize("factor", [0.5, 2])
def test_depth_frames_refuse_images_of_another_size_than_the_intrinsics(tmp_path, factor):
    folder = depth_folder(tmp_path, [(np.full((48, 64), 3000, dtype=np.uint16), np.eye(4))])
    assert load("depth_frames", folder)[0].n_beams == 48 * 64
    other = np.full((int(48 * factor), int(64 * factor)), 3000, dtype=np.uint16)
    Image.fromarray(other).save(folder / "frame-000000.depth.png")
    for read in (load("depth_frames", folder).__getitem__, load("depth_frames", folder).image):
        with pytest.raises(DataError, match=r"depth\.png has .* pixels, but camera-intrinsics\.txt is for"):
            read(0)


def test_depth_frames_refuse_transposed_intrinsics(tmp_path):
    folder = depth_folder(tmp_path, [(np.full((4, 6), 3000, dtype=np.uint16), np.eye(4))])
    np.savetxt(folder / "camera-intrinsics.txt", np.loadtxt(folder / "camera-intrinsics.txt").T)
    with pytest.raises(
        DataError, match=r"camera-intrinsics\.txt: .*last row must be 0 0 1\. It looks transp"
    ):
        load("depth_frames", folder)


def saved(write: Callable[..., object], content: object) -> bytes:
    file = io.BytesIO()
    write(file, content)
    return file.getvalue()


NOISE = np.random.default_rng(0).integers(1, 9999, (40, 60)).astype(np.uint16)
PNG = saved(lambda file, image: Image.fromarray(image).save(file, "PNG"), NOISE)
COLOURED = saved(lambda file, image: Image.fromarray(image).save(file, "PNG"), np.zeros((4, 6, 3), np.uint8))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("depth.png", PNG[:-40], "is not a complete PNG"),
        ("depth.png", b"not an image", "is not a complete PNG"),
        ("depth.png", COLOURED, "is uint8.*expected one 16-bit channel"),
        ("pose.txt", saved(np.savetxt, np.full((4, 4), math.nan)), ".*finite 4×4"),
        ("pose.txt", saved(np.savetxt, np.eye(3)), ".*finite 4×4"),
        ("pose.txt", saved(np.savetxt, 3 * np.eye(4)), "is not a rigid pose"),
        ("pose.txt", b"lost", "is not a matrix of numbers"),
    ],
)
def test_depth_frames_reject_damaged_files(tmp_path, name, content, message):
    dataset = load("depth_frames", depth_folder(tmp_path, [(NOISE, np.eye(4))]))
    (tmp_path / f"frame-000000.{name}").write_bytes(content)
    with pytest.raises(DataError, match=rf"000000\.{name}.*{message}"):
        dataset[0]


def test_depth_frames_report_missing_files(tmp_path):
    with pytest.raises(DataError, match="holds no frame-"):
        load("depth_frames", tmp_path)
    depth_folder(tmp_path, [(np.ones((2, 2), dtype=np.uint16), np.eye(4))] * 2)
    (tmp_path / "frame-000001.pose.txt").unlink()
    with pytest.raises(DataError, match="2 depth images, but 1 poses"):
        load("depth_frames", tmp_path)
    np.savetxt(tmp_path / "frame-000007.pose.txt", np.eye(4))
    with pytest.raises(DataError, match=r"000001\.pose\.txt is missing"):
        load("depth_frames", tmp_path)[1]
    (tmp_path / "camera-intrinsics.txt").unlink()
    with pytest.raises(DataError, match=r"camera-intrinsics\.txt is missing"):
        load("depth_frames", tmp_path)
