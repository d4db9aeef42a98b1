"""Cells as point clouds; Open3D reads the PLY and PCD files back."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from export.map_examples import example_grid, random_probabilities

from gmmtorch.datasets import read_channels
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.export.point_cloud import CellCloud, write_pcd, write_ply
from gmmtorch.occupancy.voxels.sparse_evidence import SparseEvidence

open3d = pytest.importorskip("open3d")


@pytest.mark.parametrize("shape", [(5, 4), (3, 4, 5)])
def test_cell_cloud_of_a_grid_has_all_cells_except_one_half(shape):
    grid, theta = example_grid(shape), random_probabilities(shape)
    cells = CellCloud.of_grid(grid, theta)
    expected = theta.flatten() != 0.5
    torch.testing.assert_close(cells.centers, grid.centers()[expected], rtol=0, atol=1e-12)
    assert torch.equal(cells.probability, theta.flatten()[expected])


@pytest.mark.parametrize("dim", [2, 3])
def test_cell_cloud_of_blocks_has_all_evidence_at_its_cells(dim, generator):
    blocks = SparseEvidence(0.25, dim)
    assert len(CellCloud.of_blocks(blocks)) == 0
    origins = torch.randn(20, dim, generator=generator, dtype=torch.float64) - 40
    ends = origins + 3 * torch.randn(20, dim, generator=generator, dtype=torch.float64)
    blocks.add_rays(origins, ends)
    blocks.add_rays(ends + 100, origins + 100)  # far from the first blocks
    cells = CellCloud.of_blocks(blocks, prior=0.5)
    torch.testing.assert_close(cells.probability, blocks.lookup(cells.centers, 0.5), rtol=0, atol=0)
    units = cells.centers / 0.25 - 0.5
    torch.testing.assert_close(units, units.round(), rtol=0, atol=1e-9)
    assert len(torch.unique(units.round(), dim=0)) == len(cells)
    hits, misses = blocks.at_points(cells.centers)
    assert float(hits.sum()) == float(blocks.cells().hits.sum()) == 40
    assert float(misses.sum()) == float(blocks.cells().misses.sum())


@pytest.mark.parametrize(
    ("centers", "probability", "message"),
    [
        (torch.zeros(3, 4), torch.zeros(3), "centers has shape"),
        (torch.zeros(3, 2), torch.zeros(2), "centers has shape"),
        (torch.full((1, 2), math.inf), torch.zeros(1), "NaN or infinite"),
        (torch.zeros(1, 2), torch.tensor([math.nan]), r"outside \[0, 1\]"),
        (torch.zeros(1, 2), torch.tensor([1.1]), r"outside \[0, 1\]"),
    ],
)
def test_cell_cloud_rejects_invalid_shapes_and_values(centers, probability, message):
    with pytest.raises(InvalidArgumentError, match=message):
        CellCloud(centers, probability, 0.1)


@pytest.mark.parametrize(("write", "tolerance"), [(write_ply, 0), (write_pcd, 1e-6)])
@pytest.mark.parametrize("shape", [(5, 4), (3, 4, 5)])
def test_open3d_reads_the_exported_cells_and_probabilities(write, tolerance, shape, tmp_path):
    cells = CellCloud.of_grid(example_grid(shape), random_probabilities(shape)).above(0.65)
    path = write(tmp_path / f"cells.{write.__name__[-3:]}", cells)
    cloud = open3d.t.io.read_point_cloud(str(path))
    np.testing.assert_allclose(cloud.point.positions.numpy(), cells.positions(), rtol=0, atol=tolerance)
    intensity = cloud.point.intensity.numpy()[:, 0]
    np.testing.assert_array_equal(intensity, cells.probability.numpy().astype(np.float32))
    if len(shape) == 2:
        assert not cells.positions()[:, 2].any()


@pytest.mark.parametrize("write", [write_ply, write_pcd])
def test_an_empty_cell_cloud_is_written_as_a_header(write, tmp_path):
    path = write(tmp_path / "none", CellCloud(torch.zeros(0, 3), torch.zeros(0), 0.1))
    assert path.read_bytes().endswith((b"end_header\n", b"DATA binary\n"))


def test_far_from_the_origin_ply_is_exact_and_pcd_is_rejected(tmp_path):
    cells = CellCloud(torch.tensor([[5e5 + 0.05, 0.05, 0.05]], dtype=torch.float64), torch.ones(1), 0.1)
    cloud = open3d.t.io.read_point_cloud(str(write_ply(tmp_path / "far.ply", cells)))
    assert cloud.point.positions.numpy()[0, 0] == 5e5 + 0.05
    with pytest.raises(InvalidArgumentError, match="write PLY, which has doubles"):
        write_pcd(tmp_path / "far.pcd", cells)
    assert not (tmp_path / "far.pcd").exists()


def test_ply_clouds_have_colours_as_srgb_bytes(tmp_path):
    cells = CellCloud(torch.eye(3).double(), torch.ones(3).double(), 0.1)
    linear = torch.tensor([[1.0, 0, 0], [0, 0.2158605, 0], [0, 0, 2.0]]).double()  # sRGB 128; clamped
    path = write_ply(tmp_path / "cells.ply", cells, linear)
    torch.testing.assert_close(read_channels(path, ["colour"])["colour"][0], torch.tensor([1.0, 0, 0]))
    body = path.read_bytes().split(b"end_header\n", 1)[1]
    table = np.frombuffer(body, [("p", "<f8", 3), ("intensity", "<f4"), ("rgb", "u1", 3)])
    assert table["rgb"].tolist() == [[255, 0, 0], [0, 128, 0], [0, 0, 255]]
    np.testing.assert_array_equal(table["p"], np.eye(3))
