"""Each reader on small files: values, order, invalid readings, and error messages for damaged files."""

from __future__ import annotations

import gzip
import math

import numpy as np
import pytest
import torch
from scan_files import TURN_LEFT, flaser, kitti, pcd, ply, scan_folder

from gmmtorch.datasets import load
from gmmtorch.datasets.scan_logs import beam_angles
from gmmtorch.errors import DataError

NAN_POINT = (math.nan,) * 3


# CARMEN logs


@pytest.mark.parametrize(
    ("n", "first", "last"),
    [(180, -90, 89), (360, -90, 89.5), (181, -90, 90), (361, -90, 90), (3, -90, 90)],
)
def test_carmen_beam_angles(n, first, last):
    angles = beam_angles(n)
    assert angles.shape == (n,)
    assert float(angles[0].rad2deg()) == pytest.approx(first)
    assert float(angles[-1].rad2deg()) == pytest.approx(last)


@pytest.mark.parametrize("compressed", [False, True])
def test_carmen_beam_ends_follow_pose_and_ranges(tmp_path, compressed):
    text = "# a comment\nODOM 1 2 3\n" + flaser([1.0, 2.0, 3.0], (10.0, 20.0, math.pi / 2))
    path = tmp_path / "room.log"
    path.write_bytes(gzip.compress(text.encode()) if compressed else text.encode())
    dataset = load("carmen", path)
    assert dataset.name == "room"
    (scan,) = dataset
    assert scan.origin.tolist() == [10.0, 20.0]
    expected = [[11.0, 20.0], [10.0, 22.0], [7.0, 20.0]]  # the robot faces +y: right, ahead, left
    torch.testing.assert_close(scan.points, torch.tensor(expected, dtype=torch.float64))


def test_carmen_separates_no_return_and_invalid_readings(tmp_path):
    path = tmp_path / "a.log"
    path.write_text(flaser([0.0, -1.0, 1.0, 81.83, 50.0, math.nan, math.inf]))
    scan = load("carmen", path)[0]
    assert scan.points.shape == (1, 2)
    assert scan.no_return.norm(dim=1).tolist() == pytest.approx([8.0, 8.0, 8.0])
    assert load("carmen", path, no_return_range=0)[0].no_return.shape == (0, 2)
    unlimited = load("carmen", path, max_range=math.inf)[0]
    assert unlimited.points.norm(dim=1).tolist() == pytest.approx([1.0, 81.83, 50.0])
    path.write_text(flaser([81.83] * 180))
    scan = load("carmen", path)[0]
    assert (scan.points.shape, scan.no_return.shape) == ((0, 2), (180, 2))
    assert load("carmen", path, no_return_range=0)[0].n_beams == 0


def stamped(stamp: object, x: float = 0.0) -> str:
    return flaser([1.0, 2.0], (x, 2.0, math.pi / 2)).replace(" 0.0 host", f" {stamp} host")


def test_carmen_poses_and_times_follow_the_stride(tmp_path):
    path = tmp_path / "a.log"
    path.write_text("".join(stamped(10.0 + i, float(i)) for i in range(5)))
    dataset = load("carmen", path, stride=2)
    assert dataset.times.tolist() == [10.0, 12.0, 14.0]
    pose = dataset.pose(-1)
    torch.testing.assert_close(pose[:2, :2], torch.tensor([[0.0, -1.0], [1.0, 0.0]], dtype=torch.float64))
    assert pose[:2, 2].tolist() == dataset[2].origin.tolist() == [4.0, 2.0]
    assert dataset.skipped == {}
    with pytest.raises(IndexError):
        dataset.pose(3)


@pytest.mark.parametrize("stamps", [(1.0, 1.0), (2.0, 1.0), (1.0, "nan"), (1.0, "host")])
def test_carmen_stamps_that_do_not_increase_are_not_used(tmp_path, stamps):
    path = tmp_path / "a.log"
    path.write_text("".join(stamped(stamp) for stamp in stamps))
    assert load("carmen", path).times is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"hello\n", "no FLASER line"),
        (b"", "no FLASER line"),
        (b"\x89PNG\r\n\x1a\n\x00\xff", "no FLASER line"),
        (b"FLASER 3 1.0 2.0\n", "line 1.*ends early"),
        (b"FLASER x 1.0\n", "line 1: FLASER announces x beams"),
        (b"FLASER \n", "line 1: FLASER announces no beams"),
        (b"FLASER 1_0 1.0\n", "line 1: FLASER announces 1_0 beams"),
        (b"FLASER 1 abc 0 0 0\n", "line 1: 'abc' is not a number"),
        (b"FLASER 1 1,5 0 0 0\n", "line 1: '1,5' is not a number; write decimals with a point"),
        (b"FLASER 999999999 1 2 3 4\n", "line 1.*announces 999999999 beams"),
        (b"FLASER -1 0 0 0\n", "line 1.*announces -1 beams"),
        (flaser([1.0], (math.nan, 0.0, 0.0)).encode(), "line 1.*pose.*not finite"),
        (gzip.compress(flaser([1.0] * 50).encode() * 50)[:-20], "not a complete gzip file"),
        (b"\x1f\x8b\x08garbage that is not gzip at all", "not a complete gzip file"),
    ],
)
def test_carmen_rejects_damaged_files(tmp_path, content, message):
    path = tmp_path / "bad.log"
    path.write_bytes(content)
    with pytest.raises(DataError, match=rf"bad\.log.*{message}"):
        load("carmen", path)


# Scan folders


@pytest.mark.parametrize(
    "write", [pcd, lambda p: pcd(p, binary=False), ply], ids=["binary.pcd", "ascii.pcd", "ascii.ply"]
)
def test_scan_folder_transforms_points_by_the_pose(tmp_path, write):
    suffix = "ply" if write is ply else "pcd"
    clouds = {f"{i:06d}.{suffix}": write([(1.0, 0.0, 0.0), (0.0, 2.0, float(i))]) for i in range(2)}
    poses = kitti(np.eye(3), [0.0, 0.0, 0.0]) + kitti(TURN_LEFT, [5.0, 0.0, 1.0])
    first, second = dataset = load("scan_folder", scan_folder(tmp_path, clouds, poses))
    assert dataset.pose(1).tolist() == [[0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]]
    assert first.points.tolist() == [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]
    assert second.origin.tolist() == [5.0, 0.0, 1.0]
    assert second.points.tolist() == [[5.0, 1.0, 1.0], [3.0, 0.0, 2.0]]


def test_scan_folder_separates_no_return_and_invalid_points(tmp_path):
    points = [(1.0, 0.0, 0.0), NAN_POINT, (0.0, 0.0, 0.0), (math.inf, 0.0, 0.0), (0.0, 30.0, 0.0)]
    folder = scan_folder(tmp_path, {"0.pcd": pcd(points)}, kitti(np.eye(3), [0.0, 0.0, 0.0]))
    (scan,) = load("scan_folder", folder, max_range=20.0, no_return_range=5.0)
    assert scan.points.tolist() == [[1.0, 0.0, 0.0]]
    assert scan.no_return.tolist() == [[0.0, 5.0, 0.0]]
    (scan,) = load("scan_folder", folder)
    assert scan.points.shape == (2, 3)


@pytest.mark.parametrize("points", [[], [NAN_POINT]])
def test_scan_folder_reads_a_scan_without_points(tmp_path, points):
    folder = scan_folder(tmp_path, {"0.pcd": pcd(points)}, kitti(np.eye(3), [1.0, 2.0, 3.0]))
    (scan,) = load("scan_folder", folder)
    assert scan.n_beams == 0
    assert scan.origin.tolist() == [1.0, 2.0, 3.0]


IDENTITY = kitti(np.eye(3), [0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        (IDENTITY * 2, r"2 rows, but there are 1 scans.*one pose for each"),
        ("", "contains no row"),
        ("1 0 0 0 0 1 0 0\n", "8 numbers per row; a KITTI pose has 12"),
        ("one two three\n", "row 1: 'one' is not a number"),
        (kitti(np.eye(3), [math.nan, 0.0, 0.0]), "row 1 is not a rigid pose"),
        (kitti(2 * np.eye(3), [0.0, 0.0, 0.0]), "row 1 is not a rigid pose"),
        (kitti(np.diag([1.0, 1.0, -1.0]), [0.0, 0.0, 0.0]), "row 1 is not a rigid pose"),
    ],
)
def test_scan_folder_rejects_invalid_poses(tmp_path, poses, message):
    with pytest.raises(DataError, match=rf"poses\.txt.*{message}"):
        load("scan_folder", scan_folder(tmp_path, {"0.pcd": pcd([])}, poses))


def test_folders_without_files_are_reported(tmp_path):
    with pytest.raises(DataError, match=r"scans.*contains no \.pcd"):
        load("scan_folder", tmp_path)
    with pytest.raises(DataError, match=r"contains no \.pcd file"):
        load("pcd_viewpoint", tmp_path)
    scan_folder(tmp_path, {"0.pcd": pcd([])}, IDENTITY)
    (tmp_path / "poses.txt").unlink()
    with pytest.raises(DataError, match=r"poses\.txt is missing"):
        load("scan_folder", tmp_path)


# PCD files in the world frame


def test_pcd_viewpoint_reads_origins_order_and_no_return(tmp_path):
    for i in (10, 2, 1):
        content = pcd([(float(i), 0.0, 1.0), (float(i), 10.0, 1.0)], viewpoint=f"{i} 0 0 1 0 0 0")
        (tmp_path / f"scan_{i}.pcd").write_bytes(content)
    scans = load("pcd_viewpoint", tmp_path, max_range=8.0, no_return_range=4.0)
    assert [scan.origin.tolist() for scan in scans] == [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [10.0, 0.0, 0.0]]
    assert scans.pose(2)[:3, 3].tolist() == [10.0, 0.0, 0.0]
    assert scans[0].points.tolist() == [[1.0, 0.0, 1.0]]
    assert float((scans[0].no_return - scans[0].origin).norm()) == pytest.approx(4.0)
    assert load("pcd_viewpoint", tmp_path)[0].points.shape == (2, 3)


@pytest.mark.parametrize("viewpoint", ["", "0 0", "a b c", "nan 0 0 1 0 0 0"])
def test_pcd_viewpoint_rejects_a_viewpoint_without_position(tmp_path, viewpoint):
    (tmp_path / "0.pcd").write_bytes(pcd([(1.0, 2.0, 3.0)], viewpoint))
    with pytest.raises(DataError, match=r"0\.pcd: VIEWPOINT"):
        load("pcd_viewpoint", tmp_path)[0]
