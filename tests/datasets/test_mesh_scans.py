"""Scans on a path through a mesh: points on its surfaces, reproducibility, and invalid input."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from gmmtorch.datasets import load
from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError
from gmmtorch.scan import Scan


@pytest.fixture(scope="module")
def hall(tmp_path_factory) -> Path:
    """A box of 20 × 6 × 3 m as PLY."""
    import open3d

    path = tmp_path_factory.mktemp("mesh") / "hall.ply"
    assert open3d.io.write_triangle_mesh(str(path), open3d.geometry.TriangleMesh.create_box(20, 6, 3))
    return path


@pytest.mark.parametrize("sensor", ["lidar", "depth_camera"])
def test_mesh_scan_points_lie_on_the_surfaces_within_noise(hall, sensor):
    dataset = load("mesh_scans", hall, n_scans=4, sensor=sensor)
    assert len(dataset) == 4
    size = torch.tensor([20.0, 6.0, 3.0], dtype=torch.float64)
    for scan in dataset:
        points = scan.points.double()
        assert len(points) > 1000
        distance = torch.minimum(points.abs(), (points - size).abs()).amin(1)
        assert float(distance.max()) < 0.06  # noise of 1 cm along the beam
        assert bool(((scan.origin > 0) & (scan.origin < size)).all())


def test_mesh_scan_depends_only_on_seed_and_index(hall):
    def scan(index: int, seed: int) -> Scan:
        return load("mesh_scans", hall, n_scans=4, seed=seed)[index]

    first = load("mesh_scans", hall, n_scans=4, seed=3)
    _ = first[0]
    assert torch.equal(first[2].points, scan(2, 3).points)
    assert not torch.equal(scan(2, 4).points, scan(2, 3).points)


def test_mesh_scan_no_return_beams_have_no_return_range(hall):
    near = load("mesh_scans", hall, n_scans=2, max_range=2.0, no_return_range=1.5)[0]
    assert len(near.no_return) > 0
    assert float((near.points - near.origin).norm(dim=1).max()) < 2
    assert torch.allclose(
        (near.no_return - near.origin).norm(dim=1),
        torch.full((len(near.no_return),), 1.5, dtype=near.no_return.dtype),
    )


def test_mesh_scans_reject_invalid_input(hall, tmp_path):
    with pytest.raises(MissingDataError, match=r"nowhere\.ply"):
        load("mesh_scans", tmp_path / "nowhere.ply")
    for option, value in (("sensor", "radar"), ("n_scans", 0), ("seed", 2**60)):
        with pytest.raises(InvalidArgumentError, match=f"{option}={value!r}"):
            load("mesh_scans", hall, **{option: value})
    bad = tmp_path / "bad.ply"
    bad.write_text("not a mesh")
    with pytest.raises(DataError, match=r"bad\.ply"):
        load("mesh_scans", bad, n_scans=2)[0]


@pytest.mark.real_data
def test_mesh_scans_of_a_real_mine_cover_a_long_path(real_data):
    dataset = load("mesh_scans", real_data / "meshes" / "edgar_mine.ply", n_scans=50)
    scan = dataset[25]
    assert len(scan.points) > 2000
    travelled = (dataset.poses[-1, :3, 3] - dataset.poses[0, :3, 3]).norm()
    assert float(travelled) > 40
