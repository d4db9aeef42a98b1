"""The readers on real logs from $GMMTORCH_DATA."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from gmmtorch.datasets import Dataset, load

pytestmark = pytest.mark.real_data


def real(name: str, relative: str, **options) -> Dataset:
    root = os.environ.get("GMMTORCH_DATA")
    if not root:
        pytest.skip("GMMTORCH_DATA is not set")
    path = Path(root) / relative
    if not path.exists():
        pytest.skip(f"{path} does not exist")
    return load(name, path, **options)


def span(scans: list, share: float = 1.0) -> list[float]:
    """Extent (m) along each axis of the middle `share` of the points."""
    points = torch.cat([scan.points for scan in scans]).numpy()
    tail = (1 - share) / 2
    return list(np.quantile(points, 1 - tail, axis=0) - np.quantile(points, tail, axis=0))


def disagreement(scans: list) -> float:
    """Median distance (m) from every 5th scan's points to the other scans; large if poses are wrong."""
    tested = torch.cat([scan.points for scan in scans[::5]])[::20]
    rest = torch.cat([scan.points for i, scan in enumerate(scans) if i % 5])
    return float(np.median(cKDTree(rest.numpy()).query(tested.numpy())[0]))


@pytest.mark.parametrize(
    ("log", "n_scans", "n_beams", "size"),
    [
        ("intel", 910, 180, (39, 36)),
        ("aces", 440, 180, (57, 57)),
        ("freiburg-101", 292, 360, None),
    ],
)
def test_carmen_reads_consistent_scans_from_real_logs(log, n_scans, n_beams, size):
    scans = list(real("carmen", f"laser2d/{log}.log.gz"))
    assert len(scans) == n_scans
    assert all(scan.n_beams <= n_beams for scan in scans)
    assert sum(scan.n_beams for scan in scans) > 0.98 * n_scans * n_beams
    assert all(bool(((scan.points - scan.origin).norm(dim=1) < 49.99).all()) for scan in scans)
    assert any(len(scan.no_return) for scan in scans)
    assert all(bool(((scan.no_return - scan.origin).norm(dim=1) < 8.001).all()) for scan in scans)
    assert disagreement(scans) < 0.05
    if size is not None:
        assert span(scans) == pytest.approx(size, abs=0.6)


@pytest.mark.parametrize(
    ("folder", "n_scans", "n_points"), [("hall", 45, 1.14e6), ("courtyard", 157, 0.80e6)]
)
def test_scan_folder_reads_consistent_scans_from_real_data(folder, n_scans, n_points):
    scans = list(real("scan_folder", folder))
    assert len(scans) == n_scans
    assert sum(scan.n_beams for scan in scans) == pytest.approx(n_points, rel=0.01)
    assert all(len(scan.no_return) == 0 for scan in scans)
    assert disagreement(scans) < 0.05
    if folder == "hall":  # some beams leave through its windows
        assert span(scans, 0.99) == pytest.approx([29, 35, 11], abs=0.5)


def test_depth_frames_reads_real_images():
    dataset = real("depth_frames", "kinect", pixel_stride=4)
    assert len(dataset) == 140
    scan = dataset[70]
    assert 5_000 < scan.points.shape[0] <= 640 * 480 / 16
    assert float((scan.points - scan.origin).norm(dim=1).max()) < 10


@pytest.mark.parametrize("folder", ["sim_structured", "sim_unstructured"])
def test_pcd_viewpoint_reads_real_scans(folder):
    dataset = real("pcd_viewpoint", f"la3dm/{folder}", max_range=8.0, no_return_range=8.0)
    assert len(dataset) == 12
    for scan in dataset:
        assert scan.n_beams == pytest.approx(3500, rel=0.15)
        assert float((scan.points - scan.origin).norm(dim=1).max()) < 8
    assert sum(len(scan.no_return) for scan in dataset) > 0
