"""OctoMap files; pyoctomap reads them back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from export.map_examples import example_grid, random_probabilities

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.export.point_cloud import CellCloud, write_octomap
from gmmtorch.occupancy import CellClass, SparseEvidence, Thresholds

pyoctomap = pytest.importorskip("pyoctomap")


def read_probabilities(path: Path, centers: torch.Tensor) -> list[float | None]:
    """OctoMap's probability of each cell; None for a cell without a node."""
    tree = pyoctomap.OcTree(0.5)
    if path.suffix == ".bt":
        assert tree.readBinary(str(path))
    else:
        tree = tree.read(str(path))
    nodes = [tree.search(center) for center in centers.numpy()]
    return [None if node is None else node.getOccupancy() for node in nodes]


def test_binary_octree_has_the_same_classes(tmp_path):
    shape = (9, 10, 11)
    grid, theta = example_grid(shape), random_probabilities(shape)
    theta[:4, :4, :4] = 0.01  # equal siblings are merged
    path = write_octomap(tmp_path / "map.bt", CellCloud.of_grid(grid, theta))
    found = [
        CellClass.UNKNOWN if p is None else CellClass.OCCUPIED if p > 0.5 else CellClass.FREE
        for p in read_probabilities(path, grid.centers())
    ]
    assert found == Thresholds().classify(theta).flatten().tolist()
    assert set(found) == {-1, 0, 1}


def test_full_octree_has_the_same_probabilities(tmp_path):
    shape = (9, 10, 11)
    grid, theta = example_grid(shape), random_probabilities(shape)
    path = write_octomap(tmp_path / "map.ot", CellCloud.of_grid(grid, theta))
    found = read_probabilities(path, grid.centers())
    for value, expected in zip(found, theta.flatten().tolist(), strict=True):
        if expected == 0.5:
            assert value is None
        else:
            assert value == pytest.approx(expected, abs=2e-6)  # 0 and 1 are clamped


def test_octree_of_a_2d_map_is_the_layer_above_zero(tmp_path, generator):
    blocks = SparseEvidence(0.25, 2)
    blocks.add_rays(torch.zeros(50, 2), 3 * torch.randn(50, 2, generator=generator, dtype=torch.float64))
    cells = CellCloud.of_blocks(blocks)
    path = write_octomap(tmp_path / "flat.ot", cells)
    layer = torch.cat([cells.centers, torch.full_like(cells.centers[:, :1], 0.125)], 1)
    known = cells.probability != 0.5
    found = [p for p, k in zip(read_probabilities(path, layer), known.tolist(), strict=True) if k]
    np.testing.assert_allclose(found, cells.probability[known], atol=1e-6)


def test_octree_accepts_cells_up_to_the_range_of_its_keys(tmp_path):
    edge = torch.tensor([[32767.5, -32767.5, 0.5]], dtype=torch.float64)
    path = write_octomap(tmp_path / "edge.ot", CellCloud(edge * 0.1, torch.tensor([0.9]), 0.1))
    assert read_probabilities(path, edge * 0.1) == [pytest.approx(0.9, abs=1e-6)]
    far = CellCloud((edge + 1) * 0.1, torch.tensor([0.9]), 0.1)
    with pytest.raises(InvalidArgumentError, match=r"OctoMap reaches 3276\.8 m"):
        write_octomap(tmp_path / "far.ot", far)


def test_octomap_writer_rejects_other_suffixes_and_unaligned_cells(tmp_path):
    cells = CellCloud(torch.full((1, 3), 0.05, dtype=torch.float64), torch.ones(1), 0.1)
    with pytest.raises(InvalidArgumentError, match=r"must end in \.bt .* or \.ot"):
        write_octomap(tmp_path / "map.octomap", cells)
    with pytest.raises(InvalidArgumentError, match=r"VoxelGrid\.covering"):
        write_octomap(tmp_path / "map.bt", CellCloud(cells.centers + 0.03, torch.ones(1), 0.1))
    assert not list(tmp_path.iterdir())


def test_a_coloured_octree_has_the_colour_of_each_cell(tmp_path, generator):
    shape = (5, 6, 7)
    grid, theta = example_grid(shape), random_probabilities(shape)
    cells = CellCloud.of_grid(grid, theta)
    colours = torch.rand(len(cells), 3, generator=generator).double()
    path = write_octomap(tmp_path / "map.ot", cells, colours=colours)
    tree = pyoctomap.ColorOcTree(0.5).read(str(path))
    assert tree.getTreeType() == "ColorOcTree"
    expected = np.where(colours <= 0.0031308, 12.92 * colours, 1.055 * colours ** (1 / 2.4) - 0.055)
    for center, theta_of, shade in zip(cells.centers.numpy(), cells.probability, expected, strict=True):
        node = tree.search(center)
        assert node.getOccupancy() == pytest.approx(float(theta_of.clamp(1e-6, 1 - 1e-6)), abs=2e-6)
        np.testing.assert_allclose(node.getColor(), 255 * shade, atol=0.51)
