"""OctoMap logs: points, rotations and damaged files. Binary graphs equal the text log of the same scans."""

from __future__ import annotations

import gzip
import math
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.datasets import Dataset, load
from gmmtorch.datasets.scan_logs import rotation
from gmmtorch.errors import DataError

OCTOMAP = """NODE 1 2 3 0 0 0
1 0 0
0 1 0

NODE 0 0 0 0 0 1.5707963267948966
1 0 0
nan 0 0
0 0 0
0 30 0
NODE 5 5 5 0 0 0
"""


def octomap(path: Path, text: str, compressed: bool = False) -> Dataset:
    path.write_bytes(gzip.compress(text.encode()) if compressed else text.encode())
    return load("octomap_log", path, max_range=20.0, no_return_range=5.0)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_octomap_log_transforms_points_by_the_pose(tmp_path, compressed, newline):
    first, second, third = octomap(tmp_path / "campus.graph", OCTOMAP.replace("\n", newline), compressed)
    assert first.origin.tolist() == [1.0, 2.0, 3.0]
    assert first.points.tolist() == [[2.0, 2.0, 3.0], [1.0, 3.0, 3.0]]
    torch.testing.assert_close(second.points, torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64))
    torch.testing.assert_close(second.no_return, torch.tensor([[-5.0, 0.0, 0.0]], dtype=torch.float64))
    assert third.n_beams == 0


def test_octomap_log_rotation_is_yaw_pitch_roll():
    roll, pitch, yaw = 0.1, -0.2, 0.3

    def about(axis: int, angle: float) -> torch.Tensor:
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        matrix = torch.eye(3, dtype=torch.float64)
        matrix[i, i] = matrix[j, j] = math.cos(angle)
        matrix[i, j], matrix[j, i] = -math.sin(angle), math.sin(angle)
        return matrix

    torch.testing.assert_close(rotation(roll, pitch, yaw), about(2, yaw) @ about(1, pitch) @ about(0, roll))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("NODE 0 0 0\n1 2 3\n", "NODE line 1 has 3 numbers instead of 6"),
        ("NODE\n1 2 3\n", "NODE line 1 has 0 numbers instead of 6"),
        ("NODE 0 0 0 0 0 nan\n1 2 3\n", "pose.*not finite"),
        ("NODE 0 0 0 0 0 0\n1 2\n", "scan 0, row 1 has 2 numbers instead of 3"),
        ("NODE 0 0 0 0 0 0\n1 2 3\n1 2\n", "scan 0, row 2 has 2 numbers"),
        ("NODE 0 0 0 0 0 0\nx y z\n", "scan 0, row 1: 'x' is not a number"),
    ],
)
def test_octomap_log_rejects_damaged_scans(tmp_path, text, message):
    dataset = octomap(tmp_path / "bad.graph", text)
    with pytest.raises(DataError, match=rf"bad\.graph.*{message}"):
        dataset[0]


def test_octomap_log_rejects_other_and_truncated_files(tmp_path):
    with pytest.raises(DataError, match="no NODE line"):
        octomap(tmp_path / "a.graph", "hello\n")
    path = tmp_path / "b.graph"
    path.write_bytes(gzip.compress(OCTOMAP.encode() * 20)[:-15])
    with pytest.raises(DataError, match=r"b\.graph is not a complete gzip file"):
        load("octomap_log", path)


# -- binary graphs ---------------------------------------------------------------------------------

Pose = tuple[float, float, float, float, float, float]
"""x, y, z (m), roll, pitch, yaw (rad)."""

MOVED: Pose = (1.0, -2.0, 0.5, 0.2, -0.1, 1.3)
POINTS = [(1.0, 2.0, 3.0), (-4.0, 0.0, 0.25)]


def quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, ...]:
    """w, x, y, z of Rz(yaw) Ry(pitch) Rx(roll)."""
    (a, b, c), (r, p, y) = zip(*((math.cos(t / 2), math.sin(t / 2)) for t in (roll, pitch, yaw)), strict=True)
    return (
        a * b * c + r * p * y,
        r * b * c - a * p * y,
        a * p * c + r * b * y,
        a * b * y - r * p * c,
    )


def vector(values: Sequence[float]) -> bytes:
    return struct.pack(f"<i{len(values)}d", len(values), *values)


def node(pose: Pose, points: Sequence[Sequence[float]], number: int = 0) -> bytes:
    cloud = struct.pack("<I", len(points)) + b"".join(map(vector, points))
    return cloud + vector(pose[:3]) + vector(quaternion(*pose[3:])) + struct.pack("<I", number)


def graph(scans: Sequence[tuple[Pose, Sequence[Sequence[float]]]], n_edges: int = 0) -> bytes:
    """A binary scan graph with these scans."""
    nodes = b"".join(node(pose, points, number) for number, (pose, points) in enumerate(scans))
    edge = struct.pack("<II", 0, 0) + vector((0, 0, 0)) + vector((1, 0, 0, 0)) + struct.pack("<d", 1.0)
    return struct.pack("<I", len(scans)) + nodes + struct.pack("<I", n_edges) + n_edges * edge


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


numbers = st.floats(-50, 50, width=32)
poses = st.tuples(numbers, numbers, numbers, *[st.floats(-3, 3)] * 3)
clouds = st.lists(st.tuples(numbers, numbers, numbers), max_size=4)


@given(scans=st.lists(st.tuples(poses, clouds), min_size=1, max_size=4), n_edges=st.integers(0, 3))
def test_a_binary_graph_has_the_scans_of_its_text_log(tmp_path_factory, scans, n_edges):
    folder = tmp_path_factory.mktemp("graph")
    lines = [" ".join(map(repr, row)) for pose, points in scans for row in (("NODE", *pose), *points)]
    text = "\n".join(lines).replace("'NODE'", "NODE")
    expected = load("octomap_log", written(folder / "a.log", text.encode()))
    found = load("octomap_log", written(folder / "a.graph", graph(scans, n_edges)))
    assert len(found) == len(expected) == len(scans)
    for i, scan in enumerate(expected):
        torch.testing.assert_close(found[i].points, scan.points, atol=1e-9, rtol=0)
        torch.testing.assert_close(found.pose(i), expected.pose(i), atol=1e-12, rtol=0)


def test_a_compressed_graph_is_read_with_stride_and_ranges(tmp_path):
    scans = [(MOVED, [(0.0, 0.0, x + 1.0), (0.0, math.nan, 1.0)]) for x in range(5)]
    path = written(tmp_path / "hall.graph.gz", gzip.compress(graph(scans, 4)))
    dataset = load("octomap_log", path, stride=2, max_range=4.0, no_return_range=2.0)
    assert (dataset.name, len(dataset)) == ("hall", 3)
    assert [(len(scan.points), len(scan.no_return)) for scan in dataset] == [(1, 0), (1, 0), (0, 1)]
    assert float((dataset[2].no_return - dataset[2].origin).norm()) == pytest.approx(2.0)
    np.testing.assert_allclose(dataset[0].origin, MOVED[:3])


WHOLE = graph([(MOVED, POINTS)] * 2, n_edges=1)


def test_a_graph_that_is_cut_off_is_refused(tmp_path):
    for length in range(1, len(WHOLE)):
        with pytest.raises(DataError, match=r"a\.graph"):
            load("octomap_log", written(tmp_path / "a.graph", WHOLE[:length]))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (graph([]), "has no scan"),
        (struct.pack("<II", 1 << 24, 7), "scan 0 announces 7 points"),
        (struct.pack("<II", 1, 2**32 - 1) + bytes(100), "announces 4294967295 points"),
        (struct.pack("<II", 1, 0) + bytes(100), "no pose where one is expected"),
        (b"\x89PNG\r\n\x1a\n" + bytes(500), "no NODE line"),
        (WHOLE + b"more", "1 edges after its 2 scans"),
    ],
)
def test_other_files_are_refused(tmp_path, content, words):
    with pytest.raises(DataError, match=words):
        load("octomap_log", written(tmp_path / "a.graph", content))


@pytest.mark.parametrize(
    ("offset", "damage", "words"),
    [
        (8, struct.pack("<i", 4), "not three numbers"),
        (8 + 28 * 2 + 28 + 4, struct.pack("<d", 3.0), "has length"),
        (8 + 28 * 2 + 4, struct.pack("<d", math.nan), "not a rigid pose"),
    ],
)
def test_damaged_scans_are_refused(tmp_path, offset, damage, words):
    content = WHOLE[:offset] + damage + WHOLE[offset + len(damage) :]
    dataset = load("octomap_log", written(tmp_path / "a.graph", content))
    assert len(dataset[1].points) == 2
    with pytest.raises(DataError, match=rf"a\.graph, scan 0.*{words}"):
        dataset[0]
