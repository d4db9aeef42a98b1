"""Trajectories in TUM's form, compared with the quaternion of a rotation about a known axis."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.export.trajectory_files import write_tum


def test_tum_lines_have_time_position_and_quaternion(tmp_path):
    angle = 0.7
    flat = torch.tensor(
        [[math.cos(angle), -math.sin(angle), 3.0], [math.sin(angle), math.cos(angle), -2.0], [0, 0, 1]]
    )
    write_tum(tmp_path / "a.tum", [12.5], flat.double()[None])
    row = np.loadtxt(tmp_path / "a.tum")
    expected = [12.5, 3, -2, 0, 0, 0, math.sin(angle / 2), math.cos(angle / 2)]
    np.testing.assert_allclose(row, expected, atol=1e-7)
    roll = torch.eye(4)
    roll[1:3, 1:3] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    roll[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    write_tum(tmp_path / "b.tum", [0.0, 1.0], torch.stack([torch.eye(4), roll]))
    rows = np.loadtxt(tmp_path / "b.tum")
    half = math.sqrt(0.5)
    np.testing.assert_allclose(rows[1], [1, 1, 2, 3, half, 0, 0, half], atol=1e-7)


def test_tum_refuses_other_shapes_and_nan(tmp_path):
    with pytest.raises(InvalidArgumentError, match="expected"):
        write_tum(tmp_path / "a.tum", [0.0], torch.eye(4))
    with pytest.raises(InvalidArgumentError, match="NaN"):
        write_tum(tmp_path / "a.tum", [math.nan], torch.eye(4)[None])
    assert not (tmp_path / "a.tum").exists()
