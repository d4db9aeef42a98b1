"""Cameras of recorded depth images: size, binning, region, K or P, distortion, and the unit of depths."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gmmtorch.datasets import load
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.pinhole import back_project

pytest.importorskip("rosbags")

from sensor_bags import BagWriter

SHAPE = 48, 64
OWN = [60.0, 55.0, 30.0, 25.0]
"""fx, fy, cx, cy of the images."""
TO_WORLD = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
WALLS = np.array([6.0, 4.0, 1.5])
TOPIC = "/camera/depth/image_rect_raw"
RAW = "/camera/depth/image_raw"


def pinhole(values: list[float], last: float = 1.0) -> np.ndarray:
    fx, fy, cx, cy = values
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, last]])


def camera(values: list[float] = OWN, p: list[float] | None = None, **fields: Any) -> dict[str, Any]:
    """A CameraInfo with K of fx, fy, cx, cy, and P of others, K by default."""
    projection = np.pad(pinhole(p or values), ((0, 0), (0, 1)))
    size = {"height": SHAPE[0], "width": SHAPE[1]}
    return {**size, "k": pinhole(values).ravel(), "p": projection.ravel(), **fields}


def times(factor: float, values: list[float] = OWN) -> list[float]:
    return [factor * value for value in values]


def rays(shape: tuple[int, int] = SHAPE) -> np.ndarray:
    fx, fy, cx, cy = OWN
    v, u = np.mgrid[: shape[0], : shape[1]]
    return np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(shape)], -1)


def box() -> np.ndarray:
    """Depths (H, W) of a camera in the middle of a box, that looks along x."""
    with np.errstate(divide="ignore"):
        return (WALLS / np.abs(rays() @ TO_WORLD.T)).min(-1)


def off_the_walls(points: torch.Tensor) -> float:
    return float(np.abs(np.abs(points.numpy()) - WALLS).min(1).max())


def recorded(
    path: Path,
    *infos: dict[str, Any],
    topic: str = TOPIC,
    depth: np.ndarray | None = None,
    encoding: str = "32FC1",
) -> Path:
    image = np.asarray(box() if depth is None else depth, {"32FC1": "<f4", "16UC1": "<u2"}[encoding])
    pose = np.eye(4)
    pose[:3, :3] = TO_WORLD
    with BagWriter(path) as bag:
        for time, info in enumerate(infos or (None,)):
            bag.transforms(time, {("odom", "camera"): pose})
            if info is not None:
                bag.message("/camera/depth/camera_info", "sensor_msgs/msg/CameraInfo", time, info)
            content = {"header": {"frame_id": "camera"}, "height": image.shape[0], "width": image.shape[1]}
            content |= {"encoding": encoding, "step": image.strides[0]}
            content["data"] = np.frombuffer(image.tobytes(), np.uint8)
            bag.message(topic, "sensor_msgs/msg/Image", time, content)
    return path


def region(x: int, y: int, width: int, height: int) -> dict[str, int]:
    return {"x_offset": x, "y_offset": y, "width": width, "height": height}


def shifted(values: list[float], x: float, y: float) -> list[float]:
    return [*values[:2], values[2] + x, values[3] + y]


FULL = {"width": 128, "height": 96}
OTHER = [80.0, 80.0, 33.0, 22.0]


@pytest.mark.parametrize(
    ("info", "topic"),
    [
        (camera(), TOPIC),
        (camera(times(2), **FULL), TOPIC),
        (camera(times(2), **FULL, binning_x=2, binning_y=2), TOPIC),
        (camera(times(2), width=129, height=97, binning_x=2, binning_y=2), TOPIC),
        (camera(times(0.5), width=32, height=24), TOPIC),
        ({**camera(times(2), **FULL), "k": 2 * pinhole(OWN).ravel(), "p": np.zeros(12)}, TOPIC),
        (camera(shifted(OWN, 20, 30), **FULL, roi=region(20, 30, 64, 48)), TOPIC),
        (
            camera(
                shifted(times(2), 40, 60), width=256, height=192, binning_x=2, binning_y=2,
                roi=region(40, 60, 128, 96),
            ),
            TOPIC,
        ),
        (camera(width=0, height=0), TOPIC),
        (camera(OTHER, OWN, d=np.array([0.3, -0.2, 0, 0, 0.1]), distortion_model="plumb_bob"), TOPIC),
        (camera(OTHER, OWN, d=np.ones(5)), "/camera/depth_registered/image_rect"),
        (camera(OTHER, OWN, d=np.ones(9), distortion_model="odd"), "/camera/depth/rectified/image"),
        (camera(OTHER, OWN), "/camera/aligned_depth_to_color/image_raw"),
        (camera(OWN, OTHER), RAW),
        (camera(OWN, OTHER), "/camera/direct/image"),
        ({**camera(OTHER), "k": pinhole(OWN).ravel(), "p": np.zeros(12)}, TOPIC),
    ],
)  # fmt: skip
def test_points_lie_on_the_walls_whatever_the_camera_info_describes(tmp_path, info, topic):
    scan = load("rosbag", recorded(tmp_path / "a.mcap", info, topic=topic))[0]
    assert len(scan.points) == 48 * 64
    assert off_the_walls(scan.points) < 1e-5


def test_intrinsics_are_scaled_to_the_image_with_one_warning(tmp_path, caplog):
    info = camera(times(2), **FULL)
    dataset = load("rosbag", recorded(tmp_path / "a.mcap", info, info), pixel_stride=2)
    assert [len(scan.points) for scan in dataset] == [24 * 32] * 2
    assert dataset.intrinsics.tolist() == pinhole(OWN).tolist()
    (record,) = caplog.records
    assert "scaled to the image, because the camera info is for 128×96 pixels" in record.getMessage()


REFUSED = {
    "a column too few": camera(width=65),
    "another field of view": camera(times(2), width=128, height=72),
    "turned": camera(width=48, height=64),
    "K of other images": camera(times(2)),
    "binning that is not applied": camera(binning_x=2, binning_y=2),
    "a region that is not applied": camera(roi=region(8, 8, 32, 24)),
    "a region outside the image": camera(roi=region(32, 0, 64, 48)),
    "a region without a size": camera(roi={"x_offset": 5}),
    "an unknown lens": camera(d=np.full(4, 0.1), distortion_model="double_sphere"),
    "a lens with too many numbers": camera(d=np.full(12, 0.1), distortion_model="rational_polynomial"),
    "a lens without a name": camera(d=np.full(5, 0.1)),
    "a lens of NaN": camera(d=np.full(5, np.nan), distortion_model="plumb_bob"),
    "not calibrated": camera([0.0] * 4),
    "infinite": camera([np.inf, 1, 30, 25]),
    "skew": {**camera(), "k": np.array([60.0, 5, 30, 0, 55, 25, 0, 0, 1])},
    "transposed": {**camera(), "k": pinhole(OWN).T.ravel()},
}


@pytest.mark.parametrize("info", REFUSED.values(), ids=REFUSED)
def test_a_camera_info_that_cannot_describe_the_images_is_refused_with_a_remedy_that_works(tmp_path, info):
    path = recorded(tmp_path / "a.mcap", info, topic=RAW)
    with pytest.raises(DataError, match=r"camera info cannot be used: .*intrinsics=\[fx,fy,cx,cy\]"):
        load("rosbag", path)
    scan = load("rosbag", path, intrinsics=OWN)[0]
    assert off_the_walls(scan.points) < 1e-5


def test_a_rectified_image_whose_lens_is_known_but_not_p_is_refused(tmp_path):
    info = camera(d=np.ones(5), distortion_model="plumb_bob") | {"p": np.zeros(12)}
    with pytest.raises(DataError, match="P, which describes rectified images, is zero"):
        load("rosbag", recorded(tmp_path / "a.mcap", info))


def test_without_a_single_camera_info_the_intrinsics_are_stated(tmp_path):
    changing = recorded(tmp_path / "a.mcap", camera(), camera(times(2)))
    with pytest.raises(DataError, match=r"/camera/depth/camera_info changes.*intrinsics="):
        load("rosbag", changing)
    missing = recorded(tmp_path / "b.mcap")
    with pytest.raises(InvalidArgumentError, match=r"type CameraInfo are none.*intrinsics="):
        load("rosbag", missing)
    for path in (changing, missing):
        assert off_the_walls(load("rosbag", path, intrinsics=OWN)[0].points) < 1e-5
    for wrong in ([1, 2, 3], [0, 1, 2, 3], "abcd", [np.nan] * 4):
        with pytest.raises(InvalidArgumentError, match=r"intrinsics="):
            load("rosbag", missing, intrinsics=wrong)


LENSES = {
    "plumb_bob": [0.12, -0.2, 0.01, -0.02, 0.05],
    "plumb_bob 4": [-0.3, 0.1, 0.001, 0.002],
    "rational_polynomial": [0.6, -2.5, 0.001, -0.002, 1.5, 0.5, -2.3, 1.4],
    "equidistant": [0.1, -0.05, 0.02, -0.01],
}


def imaged(model: str, d: list[float], at: np.ndarray) -> np.ndarray:
    """Where a lens images directions (N, 2): the equations of OpenCV, a direction at a time."""
    found = []
    for x, y in at.tolist():
        r = np.hypot(x, y)
        if model == "equidistant":
            angle = np.arctan(r)
            factor = (
                angle
                * (1 + d[0] * angle**2 + d[1] * angle**4 + d[2] * angle**6 + d[3] * angle**8)
                / max(r, 1e-9)
            )
            found.append([x * factor, y * factor])
            continue
        k1, k2, p1, p2, k3, k4, k5, k6 = [*d, *[0] * (8 - len(d))]
        factor = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
        found.append(
            [
                x * factor + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
                y * factor + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
            ]
        )
    return np.array(found)


@pytest.mark.parametrize("name", LENSES)
def test_rays_of_a_raw_image_are_those_that_the_lens_images_at_its_pixels(tmp_path, name):
    model, d = name.split()[0], LENSES[name]
    info = camera(d=np.array(d), distortion_model=model)
    path = recorded(tmp_path / "a.mcap", info, topic=RAW, depth=np.full(SHAPE, 2.0))
    points = load("rosbag", path, poses="standing")[0].points.numpy()
    np.testing.assert_array_equal(points[:, 2], 2)
    assert len(points) == 48 * 64
    pixels = imaged(model, d, points[:, :2] / 2) * OWN[:2] + OWN[2:]
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    np.testing.assert_allclose(pixels, np.column_stack([u.ravel(), v.ravel()]), atol=1e-6)

    slope = 3 / (1 - 0.2 * points[:, 0] / 2).reshape(SHAPE)  # the plane z = 3 + 0.2 x
    tilted = load(
        "rosbag",
        recorded(tmp_path / "b.mcap", info, topic=RAW, depth=slope),
        poses="standing",
        pixel_stride=3,
    )
    x, _, z = tilted[0].points.T
    assert len(x) == 16 * 22
    torch.testing.assert_close(z, 3 + 0.2 * x, atol=1e-5, rtol=0)
    x, _, z = back_project(tilted.image(0)[0], tilted.intrinsics).T
    assert len(x) > 2000
    assert float((z - 3 - 0.2 * x).abs().max()) < 0.02  # half a pixel, 0.025 m wide


def test_pixels_that_no_direction_reaches_have_no_points(tmp_path):
    info = camera(d=np.array([-2.0, 0, 0, 0, 0]), distortion_model="plumb_bob")  # folds at 0.41 from the axis
    path = recorded(tmp_path / "a.mcap", info, topic=RAW, depth=np.full(SHAPE, 1.0))
    points = load("rosbag", path, poses="standing")[0].points
    assert 0 < len(points) < 48 * 64
    assert float(points[:, :2].norm(dim=1).max()) < 0.41


@pytest.mark.parametrize(
    ("encoding", "unit", "scale", "is_odd"),
    [
        ("32FC1", 1.0, None, False),
        ("32FC1", 0.001, 0.001, True),
        ("16UC1", 0.001, None, False),
        ("16UC1", 0.0001, 0.0001, False),
        ("16UC1", 0.25, 0.25, True),
    ],
)
def test_depths_in_another_unit_are_scaled_and_odd_ones_warned_of(
    tmp_path, caplog, encoding, unit, scale, is_odd
):
    depth = box() / unit
    path = recorded(tmp_path / "a.mcap", camera(), depth=depth.round(), encoding=encoding)
    if encoding == "32FC1":
        path = recorded(tmp_path / "a.mcap", camera(), depth=depth)
    assert off_the_walls(load("rosbag", path, depth_scale=scale)[0].points) < max(unit, 1e-5)
    assert caplog.records == []
    with caplog.at_level(logging.WARNING):
        load("rosbag", path)
    assert [("depth_scale=" in record.getMessage()) for record in caplog.records] == [True] * is_odd
    with pytest.raises(InvalidArgumentError, match=r"depth_scale=0"):
        load("rosbag", path, depth_scale=0)
