"""Scan: accepted and rejected input, selection of beams, and rigid motion."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import torch

from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.scan import Scan

POINTS = [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]


def make(points=POINTS, origin=(0.0, 0.0, 0.5), no_return=((0.0, 0.0, 3.0),)) -> Scan:
    return Scan(
        torch.tensor(points, dtype=torch.float64),
        torch.tensor(origin, dtype=torch.float64),
        torch.tensor(no_return, dtype=torch.float64),
    )


@pytest.mark.parametrize("convert", [list, np.array, torch.tensor, lambda x: tuple(map(tuple, x))])
def test_scan_accepts_lists_arrays_and_tensors_of_any_type(convert):
    scan = Scan(convert(POINTS), np.zeros(3))
    assert (scan.points.shape, scan.no_return.shape, scan.dim, scan.n_beams) == ((2, 3), (0, 3), 3, 2)
    whole = Scan(convert([[1, 2], [3, 4]]), [0, 0], np.ones((3, 2)))
    assert whole.points.dtype == whole.origin.dtype == whole.no_return.dtype == torch.float64
    assert Scan(torch.zeros(1, 2), torch.zeros(2), whole.no_return).no_return.dtype == torch.float32


@pytest.mark.parametrize("empty", [[], np.empty((0, 3)), torch.empty(0, 3)])
def test_scan_may_be_empty(empty):
    scan = Scan(empty, [0.0, 0.0, 0.0])
    ends, is_hit = scan.ends()
    assert scan.n_beams == 0
    assert ends.shape == (0, 3)
    assert is_hit.shape == (0,)


def test_ends_are_returns_first_and_select_keeps_the_marked_ones():
    ends, is_hit = make().ends()
    assert ends.tolist() == [*POINTS, [0.0, 0.0, 3.0]]
    assert is_hit.tolist() == [True, True, False]
    scan = make().select(torch.tensor([False, True, True]))
    assert scan.points.tolist() == [POINTS[1]]
    assert scan.no_return.tolist() == [[0.0, 0.0, 3.0]]


def test_transformed_moves_points_origin_and_no_returns():
    turn = torch.eye(4, dtype=torch.float64)
    turn[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    turn[:3, 3] = torch.tensor([10.0, 0.0, 1.0])
    scan = make().transformed(turn)
    torch.testing.assert_close(scan.points, torch.tensor([[10.0, 1, 1], [8, 0, 1]], dtype=torch.float64))
    assert scan.origin.tolist() == [10.0, 0.0, 1.5]
    assert scan.no_return.tolist() == [[10.0, 0.0, 4.0]]


def test_copied_shares_no_memory():
    points = torch.zeros(2, 3, dtype=torch.float64)
    copy = Scan(points, torch.zeros(3)).copied()
    points += 1
    assert copy.points.abs().max() == 0


@pytest.mark.parametrize(
    ("points", "origin", "no_return", "named"),
    [
        ([[1.0, 2.0]], [0.0, 0.0, 0.0], None, "points"),
        ([1.0, 2.0, 3.0], [0.0, 0.0, 0.0], None, "points"),
        ([[1.0, 2.0, 3.0]], [0.0], None, "origin"),
        ([[1.0, 2.0, 3.0]], [[0.0, 0.0, 0.0]], None, "origin"),
        ([[1.0, 2.0, 3.0]], [0.0, 0.0, 0.0], [[1.0, 2.0]], "no_return"),
        ([[1.0, 2.0, math.nan]], [0.0, 0.0, 0.0], None, r"points\[0\]"),
        ([[1.0, 2.0, 3.0], [math.inf, 0.0, 0.0]], [0.0, 0.0, 0.0], None, r"points\[1\]"),
        ([[1.0, 2.0, 3.0]], [0.0, math.nan, 0.0], None, "origin"),
        ([[1.0, 2.0, 3.0]], [0.0, 0.0, 0.0], [[0.0, 0.0, math.inf]], r"no_return\[0\]"),
    ],
)
def test_scan_names_the_invalid_argument(points, origin, no_return, named):
    with pytest.raises(InvalidArgumentError, match=named) as caught:
        Scan(points, origin, no_return)
    assert isinstance(caught.value, GmmTorchError)


def test_scan_warns_about_far_float32_coordinates_only():
    far = torch.full((1, 3), 5e4)
    with pytest.warns(UserWarning, match="float64"):
        Scan(far, torch.zeros(3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Scan(far.double(), torch.zeros(3))
