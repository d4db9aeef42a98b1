"""The readers on real logs, as far as $GMMTORCH_DATA holds them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gmmtorch.datasets import Dataset, load

pytestmark = pytest.mark.real_data


def real(name: str, relative: str, **options) -> Dataset:
    root = os.environ.get("GMMTORCH_DATA")
    if not root:
        pytest.skip("GMMTORCH_DATA is not set")
    path = Path(root) / relative
    if not path.exists():
        pytest.skip(f"{path} is not there")
    if name in ("scan_folder", "pcd_viewpoint"):
        pytest.importorskip("open3d", exc_type=ImportError)
    return load(name, path, **options)


def span(scans: list, axis: int) -> float:
    """Extent (m) of the sensor's positions and the points that it saw, along one axis."""
    low = min(float(s.points[:, axis].min()) for s in scans if len(s.points))
    return max(float(s.points[:, axis].max()) for s in scans if len(s.points)) - low


@pytest.mark.parametrize(
    ("log", "n_scans", "n_beams", "size"),
    [
        ("intel", 910, 180, (39, 36)),
        ("aces", 440, 180, (57, 57)),
        ("freiburg-101", 292, 360, (86, 40)),
    ],
)
def test_carmen_logs(log, n_scans, n_beams, size):
    scans = list(real("carmen", f"laser2d/{log}.log.gz"))
    assert len(scans) == n_scans
    assert all(scan.n_beams <= n_beams for scan in scans)
    assert sum(scan.n_beams for scan in scans) > 0.98 * n_scans * n_beams
    assert all(bool(((scan.points - scan.origin).norm(dim=1) < 49.99).all()) for scan in scans)
    assert any(len(scan.no_return) for scan in scans)
    assert all(bool(((scan.no_return - scan.origin).norm(dim=1) < 8.001).all()) for scan in scans)
    for axis in range(2):
        assert span(scans, axis) == pytest.approx(size[axis], rel=0.25)


@pytest.mark.parametrize(
    ("folder", "n_scans", "n_points"), [("hall", 45, 1.14e6), ("courtyard", 157, 0.80e6)]
)
def test_scan_folders(folder, n_scans, n_points):
    scans = list(real("scan_folder", folder))
    assert len(scans) == n_scans
    assert sum(scan.n_beams for scan in scans) == pytest.approx(n_points, rel=0.01)
    assert all(len(scan.no_return) == 0 for scan in scans)
    if folder == "hall":
        assert sorted(round(span(scans, axis)) for axis in range(2)) == [29, 35]


def test_depth_frames():
    dataset = real("depth_frames", "kinect", pixel_stride=4)
    assert len(dataset) == 140
    scan = dataset[70]
    assert 5_000 < scan.points.shape[0] <= 640 * 480 / 16
    assert float((scan.points - scan.origin).norm(dim=1).max()) < 10


@pytest.mark.parametrize("folder", ["sim_structured", "sim_unstructured"])
def test_pcd_viewpoint(folder):
    dataset = real("pcd_viewpoint", f"la3dm/{folder}", max_range=8.0, no_return_range=8.0)
    assert len(dataset) == 12
    for scan in dataset:
        assert scan.n_beams == pytest.approx(3500, rel=0.15)
        assert float((scan.points - scan.origin).norm(dim=1).max()) < 8
    assert sum(len(scan.no_return) for scan in dataset) > 0
