"""One wrong field of one message of a bag gives the right points, no points and a count, or an error."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gmmtorch.datasets import load
from gmmtorch.errors import GmmTorchError

pytest.importorskip("rosbags")

from sensor_bags import BagWriter

from gmmtorch.export.bag import cloud_fields

CLOUD, IMAGE, INFO = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
N_MESSAGES = 3
LAYOUTS = [
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4")],
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")],
    [("ring", "<u2"), ("line", "<u2"), ("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("intensity", "<f4")],
    [("intensity", ">f4"), ("z", ">f4"), ("x", ">f4"), ("y", ">f4"), ("tag", ">i2"), ("line", ">i2")],
]

Message = dict[str, Any]
Change = tuple[int, str, Any]
"""Number of a message, path of its field such as fields.0.count, and its wrong value."""

sizes = st.one_of(st.integers(0, 130), st.sampled_from([2**16, 2**31, 2**32 - 1]))
frames = st.sampled_from(["", "none", "/odom/lidar"])


def cloud(seed: int, layout: int, shape: tuple[int, int]) -> tuple[Message, np.ndarray]:
    """A cloud and its points."""
    rng = np.random.default_rng(seed)
    table = np.zeros(shape if shape[0] > 1 else shape[1], LAYOUTS[layout])
    for name, _ in LAYOUTS[layout]:
        table[name] = rng.uniform(1, 100, table.shape)
    return cloud_fields("lidar", table), np.stack([table[axis].ravel().astype(float) for axis in "xyz"], 1)


def image(seed: int, encoding: str, shape: tuple[int, int], padding: int) -> tuple[Message, np.ndarray]:
    """A depth image, whose rows are padded by some bytes, and its points by the matrix `pinhole`."""
    code, unit = {"16UC1": ("<u2", 1000), "32FC1": ("<f4", 1)}[encoding]
    pixels = np.random.default_rng(seed).uniform(0.5 * unit, 9 * unit, shape).astype(code)
    rows = np.pad(pixels.view(np.uint8), ((0, 0), (0, padding)))
    size = {"height": shape[0], "width": shape[1], "step": rows.shape[1]}
    message = {"header": {"frame_id": "lidar"}, **size, "encoding": encoding, "data": rows.ravel()}
    v, u = np.mgrid[: shape[0], : shape[1]]
    rays = np.linalg.inv(pinhole(shape)) @ np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
    return message, (rays * (pixels.ravel() / unit)).T


def pinhole(shape: tuple[int, int]) -> np.ndarray:
    height, width = shape
    return np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])


def changed(message: Message, path: str, value: Any) -> Message:
    """The message with another value of a field; a function is applied to the old one."""
    first, _, rest = path.partition(".")
    if isinstance(message, list):
        return [changed(m, rest, value) if str(i) == first else m for i, m in enumerate(message)]
    old = message.get(first)
    return {**message, first: changed(old, rest, value) if rest else value(old) if callable(value) else value}


def check(kind: str, given: list[tuple[Message, np.ndarray]], infos: list[Message], change: Change) -> None:
    """Reads a bag with the messages, of which one is changed, of a sensor that moves."""
    number, field, value = change
    messages = [message for message, _ in given]
    wrong = infos if field.startswith("info.") else messages
    wrong[number] = changed(wrong[number], field.removeprefix("info."), value)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        with BagWriter(path) as bag:
            for i, message in enumerate(messages):
                pose = np.eye(4)
                pose[:3, 3] = i, 2 * i, -i
                bag.transforms(float(i), {("odom", "lidar"): pose})
                for info in infos[i : i + 1]:
                    bag.message("/depth/camera_info", INFO, float(i), info)
                bag.message("/depth/image" if kind == IMAGE else "/points", kind, float(i), message)
        try:
            dataset = load("rosbag", path)
            found = list(dataset)
        except GmmTorchError:
            assert value is not None
            return
    full = [scan for scan in found if len(scan.points)]
    for scan in full:
        i = int(scan.time or 0)
        np.testing.assert_allclose(scan.points.numpy(), given[i][1] + [i, 2 * i, -i], rtol=0, atol=1e-9)
    assert len(full) + sum(dataset.skipped.values()) == len(given)
    assert value is not None or len(full) == len(given)


SAME = st.just(("header.seq", None))


def of_fields(*names: str) -> st.SearchStrategy[str]:
    return st.sampled_from([f"fields.{i}.{name}" for i in range(3) for name in names])


cloud_changes = st.one_of(
    SAME,
    st.tuples(st.sampled_from(["width", "height", "point_step", "row_step"]), sizes),
    st.tuples(of_fields("offset", "count"), sizes),
    st.tuples(of_fields("name"), st.sampled_from(["x", "y", "z", "w", ""])),
    st.tuples(of_fields("datatype"), st.sampled_from([0, 5, 6, 9, 255])),
    st.tuples(st.just("header.frame_id"), frames),
    st.tuples(st.just("data"), st.integers(0, 40).map(lambda n: lambda data: data[n:])),
    st.tuples(st.just("data"), st.integers(1, 40).map(lambda n: lambda data: np.pad(data, (0, n)))),
    st.tuples(st.just("fields"), st.integers(0, 2).map(lambda n: lambda fields: fields[:n])),
)  # fmt: skip


@given(
    st.integers(0, 99),
    st.sampled_from(range(len(LAYOUTS))),
    st.sampled_from([(1, 40), (1, 9), (4, 16), (7, 8)]),
    st.integers(0, N_MESSAGES - 1),
    cloud_changes,
)
@example(0, 1, (1, 40), 1, ("point_step", 12))
@example(0, 1, (4, 16), 0, ("point_step", 15))
@example(0, 2, (4, 16), 0, ("width", 15))
@example(0, 1, (1, 40), 2, ("fields.0.offset", 12))
def test_a_cloud_with_one_wrong_field_has_the_right_points_or_none(seed, layout, shape, number, change):
    given = [cloud(seed + i, layout, shape) for i in range(N_MESSAGES)]
    check(CLOUD, given, [], (number, *change))


image_changes = st.one_of(
    SAME,
    st.tuples(st.sampled_from(["width", "height", "step"]), sizes),
    st.tuples(st.just("encoding"), st.sampled_from(["16UC1", "32FC1", "mono16", "rgb8", "8UC1", ""])),
    st.tuples(st.just("header.frame_id"), frames),
    st.tuples(st.just("data"), st.integers(0, 40).map(lambda n: lambda data: data[n:])),
    st.tuples(st.just("data"), st.integers(1, 40).map(lambda n: lambda data: np.pad(data, (0, n)))),
    st.tuples(st.sampled_from(["info.width", "info.height", "info.binning_x", "info.binning_y"]), sizes),
    st.tuples(st.sampled_from(["info.roi.x_offset", "info.roi.width", "info.roi.height"]), sizes),
    st.tuples(st.just("info.distortion_model"), st.sampled_from(["", "fisheye"])),
)  # fmt: skip


@given(
    st.integers(0, 99),
    st.sampled_from(["16UC1", "32FC1"]),
    st.sampled_from([(6, 8), (12, 10), (9, 16)]),
    st.sampled_from([0, 4]),
    st.integers(0, N_MESSAGES - 1),
    image_changes,
)
@example(0, "32FC1", (6, 8), 0, 0, ("encoding", "16UC1"))
@example(0, "16UC1", (6, 8), 0, 0, ("width", 7))
@example(0, "16UC1", (6, 8), 4, 0, ("data", lambda data: data[24:]))
def test_a_depth_image_with_one_wrong_field_has_the_right_points_or_none(
    seed, encoding, shape, padding, number, change
):
    size = {"height": shape[0], "width": shape[1]}
    info = {"header": {"frame_id": "lidar"}, **size, "k": pinhole(shape).ravel(), "roi": {}}
    given = [image(seed + i, encoding, shape, padding) for i in range(N_MESSAGES)]
    check(IMAGE, given, [info] * N_MESSAGES, (number, *change))
