"""Poses of bags: the tree of transforms, and clouds whose points are in a fixed frame already."""

from __future__ import annotations

import bisect
import itertools
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sensor_bags import BagWriter, moved
from test_rosbag import POINTS

from gmmtorch.datasets import TransformTree, load
from gmmtorch.errors import DataError, InvalidArgumentError

Sample = tuple[int, np.ndarray, np.ndarray]


def message(parent: str, child: str, sample: Sample) -> dict[str, Any]:
    time, position, turn = sample
    transform = {"translation": dict(zip("xyz", position, strict=True))}
    transform["rotation"] = dict(zip("xyzw", turn, strict=True))
    header = {"frame_id": parent, "stamp": {"sec": time // 10**9, "nanosec": time % 10**9}}
    return {"transforms": [{"header": header, "child_frame_id": child, "transform": transform}]}


def random_samples(seed: int, n: int) -> list[Sample]:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.integers(1, 10**8, n)) + 10**9
    turns = rng.normal(size=(n, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return [(int(t), p, q) for t, p, q in zip(times, rng.normal(size=(n, 3)), turns, strict=True)]


def rotated(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    u, w = q[:3], q[3]
    return v + 2 * np.cross(u, np.cross(u, v) + w * v)


def by_hand(samples: list[Sample], time: int, point: np.ndarray) -> np.ndarray:
    """A point of the child in the parent, by spherical interpolation of quaternions (Shoemake 1985)."""
    after = bisect.bisect_left([t for t, _, _ in samples], time)
    (t0, p0, q0), (t1, p1, q1) = samples[after - 1], samples[after]
    share = (time - t0) / (t1 - t0)
    cosine = float(q0 @ q1)
    q1, cosine = (q1, cosine) if cosine >= 0 else (-q1, -cosine)
    angle = math.acos(min(cosine, 1.0))
    q = (math.sin((1 - share) * angle) * q0 + math.sin(share * angle) * q1) / math.sin(angle)
    return rotated(q, point) + p0 + share * (p1 - p0)


@pytest.mark.parametrize("keep", [None, 1000.0])
def test_a_chain_equals_interpolation_by_hand(keep):
    upper, lower = random_samples(0, 40), random_samples(1, 40)
    tree = TransformTree(keep)
    for sample in upper:
        tree.add(message("odom", "base", sample), static=False)
    for sample in lower:
        tree.add(message("base", "/lidar", sample), static=False)
    low, high = max(upper[0][0], lower[0][0]), min(upper[-1][0], lower[-1][0])
    times = np.random.default_rng(2).integers(low + 1, high, 60)
    poses = tree.lookup(tree.chain("lidar"), times, np.inf)
    assert poses.known.all()
    point = np.array([1.0, -2.0, 3.0])
    for time, matrix in zip(times.tolist(), poses.poses.matrix.numpy(), strict=True):
        expected = by_hand(upper, time, by_hand(lower, time, point))
        assert np.allclose(matrix[:3, :3] @ point + matrix[:3, 3], expected, atol=1e-9)


def test_a_growing_tree_answers_as_a_complete_one():
    """To the bit: a live map equals that of a recording."""
    samples = random_samples(3, 30)
    whole, growing = TransformTree(), TransformTree(keep=1000.0)
    for sample in samples:
        whole.add(message("odom", "base", sample), static=False)
    for before, sample in itertools.pairwise(samples):
        growing.add(message("odom", "base", before), static=False)
        time = np.array([(before[0] + sample[0]) // 2])
        assert not growing.lookup(["base", "odom"], time, np.inf).known[0]
        growing.add(message("odom", "base", sample), static=False)
        found = growing.lookup(["base", "odom"], time, np.inf)
        assert torch.equal(found.poses.matrix, whole.lookup(["base", "odom"], time, np.inf).poses.matrix)


def test_old_transforms_are_forgotten_and_memory_is_bounded():
    tree = TransformTree(keep=1.0)
    for i in range(5000):
        tree.add(
            message("odom", "base", (10**9 + i * 10**7, np.zeros(3), np.array([0, 0, 0, 1.0]))), static=False
        )
    times, numbers = tree._samples["base"]
    assert 100 <= len(times) <= 203
    assert len(numbers) == 7 * len(times)
    newest = times[-1]
    known = tree.lookup(["base", "odom"], np.array([newest - 10**9, newest - 10**10]), np.inf).known
    assert known.tolist() == [True, False]


def test_a_clock_that_is_set_back_starts_again():
    tree = TransformTree(keep=1.0)
    for time in (50 * 10**9, 51 * 10**9, 10**9, 10**9 + 10):
        tree.add(message("odom", "base", (time, np.ones(3), np.array([0, 0, 0, 1.0]))), static=False)
    assert list(tree._samples["base"][0]) == [10**9, 10**9 + 10]


# -- registered clouds -------------------------------------------------------------------------------


pytest.importorskip("rosbags")


TIMES = (0.0, 0.5, 1.0)
ROOM = np.random.default_rng(0).uniform(-5, 5, (40, 3)).astype(np.float32)


def slam(
    path: Path,
    edges: dict[tuple[str, str], float],
    world: str = "camera_init",
    body: str = "body",
    odometry: str = "/Odometry",
) -> Path:
    """A drive of 4 m along x: clouds in the frame `world`, odometry, and TF.

    edges: (parent, child) → share of the drive that the child moves in its parent.
    """
    with BagWriter(path) as bag:
        bag.transforms(0.0, {(body, "lidar"): moved(0, 0, 0.5)}, static=True)
        for time in TIMES:
            if edges:
                bag.transforms(time, {edge: moved(4 * share * time) for edge, share in edges.items()})
            bag.odometry(odometry, time, world, body, moved(4 * time, yaw=time))
            bag.cloud("/cloud_registered", time, world, ROOM)
    return path


def origins(dataset) -> list[list[float]]:
    assert all(torch.equal(scan.points, torch.from_numpy(ROOM).double()) for scan in dataset)
    assert all(torch.equal(dataset[i].origin, dataset.pose(i)[:3, 3]) for i in range(3))
    return [scan.origin.tolist() for scan in dataset]


PATH = [[0, 0, 0], [2, 0, 0], [4, 0, 0]]


@pytest.mark.parametrize(
    ("world", "body", "edges"),
    [
        ("camera_init", "body", {("camera_init", "body"): 1}),  # FAST-LIO
        ("/camera_init", "/aft_mapped", {("/camera_init", "/aft_mapped"): 1}),  # LOAM
        ("odom", "base", {("map", "odom"): 0, ("odom", "base"): 1}),  # LIO-SAM
        ("map", "base", {("map", "odom"): 0, ("odom", "base"): 1}),
        ("odom", "base", {("map", "odom"): 0.1, ("odom", "base"): 1}),
        ("odom", "base", {("odom", "base"): 1, ("base", "wheel"): 0, ("base", "mast"): 0.2}),
    ],
)
@pytest.mark.parametrize("options", [{}, {"poses": "tf"}])
def test_clouds_in_a_fixed_frame_of_tf_are_seen_from_the_frame_that_travels(
    tmp_path, caplog, world, body, edges, options
):
    dataset = load("rosbag", slam(tmp_path / "a.mcap", edges, world, body), **options)
    assert origins(dataset) == PATH
    assert f"in the fixed frame {world.strip('/')} already, and seen from {body.strip('/')}" in caplog.text


def test_corrections_of_odometry_are_part_of_the_path(tmp_path):
    path = slam(tmp_path / "a.mcap", {("map", "odom"): 0.1, ("odom", "base"): 1}, "map", "base")
    assert origins(load("rosbag", path))[2] == pytest.approx([4.4, 0, 0])


@pytest.mark.parametrize("edges", [{}, {("camera_init", "body"): 1}, {("odom", "base"): 1}])
def test_clouds_in_the_frame_of_a_topic_of_poses_are_seen_from_its_body(tmp_path, caplog, edges):
    path = slam(tmp_path / "a.mcap", edges)
    assert origins(load("rosbag", path, poses="/Odometry")) == PATH
    assert "points are in the fixed frame camera_init already, and seen from body" in caplog.text
    caplog.clear()
    at_lidar = load("rosbag", path, poses="/Odometry", sensor_frame="lidar")
    assert origins(at_lidar) == [[x, 0, 0.5] for x, _, _ in PATH]
    raised = load("rosbag", path, poses="/Odometry", extrinsic=[0, 0, 2, 0, 0, 0, 1])
    assert origins(raised) == [[x, 0, 2] for x, _, _ in PATH]


def test_the_frame_of_the_sensor_can_be_stated(tmp_path, caplog):
    path = slam(tmp_path / "a.mcap", {("camera_init", "body"): 1})
    assert origins(load("rosbag", path, sensor_frame="lidar")) == [[x, 0, 0.5] for x, _, _ in PATH]
    assert caplog.records == []
    as_sensor = load("rosbag", path, poses="tf", sensor_frame="camera_init")
    assert origins(as_sensor) == [[0, 0, 0]] * 3


def test_clouds_of_a_fixed_frame_follow_it_into_the_one_that_is_chosen(tmp_path):
    path = slam(tmp_path / "a.mcap", {("map", "odom"): 0.1, ("odom", "base"): 1}, "odom", "base")
    scan = load("rosbag", path, frame="map")[2]
    np.testing.assert_allclose(scan.points.numpy(), ROOM + np.float64([0.4, 0, 0]), atol=1e-12)
    np.testing.assert_allclose(scan.origin.numpy(), [4.4, 0, 0])


def test_several_frames_that_travel_ask_for_the_one_of_the_sensor(tmp_path):
    edges = {("camera_init", "body"): 1, ("camera_init", "other"): 2}
    path = slam(tmp_path / "a.mcap", edges)
    with pytest.raises(DataError, match=r"only static transforms.*sensor_frame=NAME"):
        load("rosbag", path)
    assert origins(load("rosbag", path, sensor_frame="body")) == PATH
    assert origins(load("rosbag", path, sensor_frame="other"))[2] == [8, 0, 0]
    with pytest.raises(
        InvalidArgumentError, match=r"sensor_frame=rear is not a frame.*camera_init \(3 scans"
    ):
        load("rosbag", path, sensor_frame="rear")


def test_a_file_of_poses_does_not_move_registered_points_again(tmp_path):
    path = slam(tmp_path / "a.mcap", {("camera_init", "body"): 1})
    (tmp_path / "t.txt").write_text("0 0 0 0 0 0 0 1\n1 4 0 0 0 0 0 1\n")
    with pytest.raises(InvalidArgumentError, match=r"move the points of .* again.*poses=tf"):
        load("rosbag", path, poses=str(tmp_path / "t.txt"))


@pytest.mark.parametrize("mast", [0.0, 0.2])
def test_clouds_in_the_frame_of_a_body_with_joints_are_moved_with_it(tmp_path, caplog, mast):
    with BagWriter(tmp_path / "a.mcap") as bag:
        for time in TIMES:
            edges = {("odom", "base"): moved(time), ("base", "wheel"): moved(0, yaw=9 * time)}
            bag.transforms(time, {**edges, ("base", "mast"): moved(0, 0, mast * time)})
            bag.cloud("/points", time, "base", POINTS)
    dataset = load("rosbag", tmp_path / "a.mcap")
    np.testing.assert_array_equal(dataset[2].points.numpy(), POINTS + np.float64([1, 0, 0]))
    assert dataset[2].origin.tolist() == [1, 0, 0]
    assert [r for r in caplog.records if r.levelno >= logging.WARNING] == []


def test_stating_a_frame_below_a_body_that_moves_moves_its_points_with_the_body(tmp_path):
    """A camera on an arm, whose points the driver has put into the frame of the body."""
    with BagWriter(tmp_path / "a.mcap") as bag:
        bag.transforms(0.0, {("base", "mast"): moved(0, 0, 1)}, static=True)
        for time in TIMES:
            bag.transforms(time, {("odom", "base"): moved(time), ("base", "arm"): moved(0, time)})
            bag.cloud("/points", time, "base", POINTS)
    scan = load("rosbag", tmp_path / "a.mcap", sensor_frame="arm")[2]
    np.testing.assert_array_equal(scan.points.numpy(), POINTS + np.float64([1, 0, 0]))
    assert scan.origin.tolist() == [1, 1, 0]
    with pytest.raises(InvalidArgumentError, match=r"sensor_frame=mast is not a frame .*sensor_frame=base"):
        load("rosbag", tmp_path / "a.mcap", sensor_frame="mast")
