"""OctoMap logs: points, rotations, and error messages for damaged logs."""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import pytest
import torch

from gmmtorch.datasets import Dataset, load
from gmmtorch.datasets.octomap_log import rotation
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
        ("NODE 0 0 0\n1 2 3\n", "NODE line: expected 6 numbers"),
        ("NODE\n1 2 3\n", "NODE line: expected 6 numbers"),
        ("NODE 0 0 0 0 0 nan\n1 2 3\n", "pose.*not finite"),
        ("NODE 0 0 0 0 0 0\n1 2\n", "scan 0: expected 3 numbers per line, found 2"),
        ("NODE 0 0 0 0 0 0\n1 2 3\n1 2\n", "scan 0: expected 3 numbers per line"),
        ("NODE 0 0 0 0 0 0\nx y z\n", "scan 0: expected 3 numbers per line"),
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
