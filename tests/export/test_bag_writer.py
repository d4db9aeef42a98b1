"""Bags that gmmtorch writes: read by rosbags itself, and refused input."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gmmtorch.datasets import load
from gmmtorch.errors import InvalidArgumentError, OutputError
from gmmtorch.scan import Scan

pytest.importorskip("rosbags")

from sensor_bags import BagWriter

from gmmtorch.export.bag import write_bag

SCAN = Scan(torch.tensor([[3.0, 5.0, 1.0], [2.0, 7.0, 1.5]], dtype=torch.float64), [2.0, 5.0, 1.0])
POSE = np.array([[0.0, -1, 0, 2], [1, 0, 0, 5], [0, 0, 1, 1], [0, 0, 0, 1]])


@pytest.mark.parametrize("suffix", ["mcap", "db3", "bag"])
def test_rosbags_reads_what_is_written(tmp_path, suffix):
    from rosbags.highlevel import AnyReader

    path = write_bag(tmp_path / f"a.{suffix}", [SCAN], [POSE], [2.5])
    assert [file.name for file in tmp_path.iterdir()] == [f"a.{suffix}"]
    with AnyReader([path]) as reader:
        messages = {
            connection.topic: (time, reader.deserialize(data, connection.msgtype))
            for connection, time, data in reader.messages()
        }
    time, cloud = messages["/points"]
    assert (time, cloud.header.stamp.sec, cloud.header.stamp.nanosec) == (2_500_000_000, 2, 500_000_000)
    assert (cloud.header.frame_id, cloud.width, cloud.height) == ("lidar", 2, 1)
    points = cloud.data.view(np.float32).reshape(2, 3)
    np.testing.assert_allclose(points, [[0, -1, 0], [2, 0, 0.5]], atol=1e-6)
    (transform,) = messages["/tf"][1].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "lidar")
    turn, place = transform.transform.rotation, transform.transform.translation
    assert (place.x, place.y, place.z) == (2, 5, 1)
    assert abs(turn.z) == pytest.approx(0.5**0.5)
    assert turn.z == pytest.approx(turn.w)


def test_scans_in_2d_are_read_back_in_2d(tmp_path):
    points = torch.from_numpy(np.random.default_rng(0).uniform(-9, 9, (40, 2)))
    turned = np.array([[0.0, -1, 2], [1, 0, 5], [0, 0, 1]])
    path = write_bag(tmp_path / "a.mcap", [Scan(points, [2.0, 5.0])] * 2, [turned] * 2)
    dataset = load("rosbag", path)
    assert torch.allclose(dataset[1].points, points, rtol=0, atol=2e-6)
    assert dataset[1].origin.tolist() == [2.0, 5.0]
    np.testing.assert_allclose(dataset.pose(1).numpy(), turned, atol=1e-12)


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    path = write_bag(tmp_path / "a.mcap", [SCAN], [POSE])
    before = path.read_bytes()
    with pytest.raises(InvalidArgumentError, match=r"shape \(3, 3\); scans in 3D need \(4, 4\)"):
        write_bag(path, [SCAN], [np.eye(3)])
    with pytest.raises(InvalidArgumentError, match="1 scans, 2 poses and 1 times"):
        write_bag(path, [SCAN], [POSE, POSE])
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_unusable_paths_are_refused(tmp_path):
    with pytest.raises(InvalidArgumentError, match=r"must end in \.mcap"):
        BagWriter(tmp_path / "a.txt")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        BagWriter(tmp_path / "file" / "a.mcap")


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (np.zeros(3, [("x", "<f4"), ("stamp", "<u8"), ("on", "?")]), "fields stamp uint64, on bool cannot"),
        (np.zeros(3, [("x", "<f4", (3,))]), r"fields x \('<f4', \(3,\)\) cannot"),
        (np.zeros((3, 3), "<f4"), r"shape \(3, 3\) with fields none cannot"),
        (np.zeros((1, 2, 3), [("x", "<f4")]), r"shape \(1, 2, 3\) with fields x cannot"),
    ],
)
def test_tables_that_a_point_cloud_cannot_store_are_refused(tmp_path, table, message):
    with (
        BagWriter(tmp_path / "a.mcap") as bag,
        pytest.raises(InvalidArgumentError, match=message + r".*PointCloud2; give .*float32"),
    ):
        bag.cloud_table("/points", 0.0, "lidar", table)


def test_fields_of_both_byte_orders_are_written_in_one(tmp_path):
    table = np.zeros(2, [("x", ">f4"), ("y", "<f4"), ("z", "<f8")])
    table["x"], table["y"], table["z"] = [1, 2], [3, 4], [5, 6]
    with BagWriter(tmp_path / "a.mcap") as bag:
        bag.cloud_table("/points", 0.0, "lidar", table)
    assert load("rosbag", tmp_path / "a.mcap", poses="standing")[0].points.tolist() == [[1, 3, 5], [2, 4, 6]]
