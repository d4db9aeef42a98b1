"""Cells in others' formats, read back by those others where they can be had."""

from __future__ import annotations

import builtins
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from gmmtorch.errors import (
    DataError,
    GmmTorchError,
    InvalidArgumentError,
    MemoryLimitError,
    MissingDataError,
)
from gmmtorch.export.map_server import highest_in_band, read_map_server, write_map_server
from gmmtorch.export.octomap import write_octomap
from gmmtorch.export.point_cloud import CellCloud, write_pcd, write_ply
from gmmtorch.occupancy.evidence import CellClass, Thresholds
from gmmtorch.occupancy.grid import VoxelGrid, rasterize
from gmmtorch.occupancy.voxels.blocks import BlockEvidence

pyoctomap = pytest.importorskip("pyoctomap")
open3d = pytest.importorskip("open3d")


def probabilities(shape: tuple[int, ...], seed: int = 0) -> torch.Tensor:
    """Of any value, and of exactly 0, ½ and 1."""
    generator = torch.Generator().manual_seed(seed)
    theta = torch.rand(shape, dtype=torch.float64, generator=generator)
    special = torch.randint(0, 8, shape, generator=generator)
    for value, number in ((0.5, 1), (0.0, 2), (1.0, 3)):
        theta[special == number] = value
    return theta


def grid_of(shape: tuple[int, ...], resolution: float = 0.1) -> VoxelGrid:
    first = (-3, 7, -2)[: len(shape)]
    return VoxelGrid(tuple(i * resolution for i in first), resolution, shape)


# -- thresholds -----------------------------------------------------------------------------------


def test_three_classes():
    theta = torch.tensor([0.0, 0.196, 0.5, 0.65, 0.651, 1.0], dtype=torch.float64)
    assert Thresholds().classify(theta).tolist() == [0, -1, -1, -1, 1, 1]


@pytest.mark.parametrize(("free", "occupied"), [(0.7, 0.6), (-0.1, 0.5), (0.1, 1.1), (math.nan, 0.5)])
def test_thresholds_are_checked(free, occupied):
    with pytest.raises(InvalidArgumentError, match="free_thresh="):
        Thresholds(free, occupied)


# -- cells ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(5, 4), (3, 4, 5)])
def test_cells_of_a_grid_are_those_not_one_half(shape):
    grid, theta = grid_of(shape), probabilities(shape)
    cells = CellCloud.of_grid(grid, theta)
    expected = theta.flatten() != 0.5
    torch.testing.assert_close(cells.centers, grid.centers()[expected], rtol=0, atol=1e-12)
    assert torch.equal(cells.probability, theta.flatten()[expected])


@pytest.mark.parametrize("dim", [2, 3])
def test_cells_of_blocks_are_where_the_evidence_is(dim, generator):
    blocks = BlockEvidence(0.25, dim)
    origins = torch.randn(20, dim, generator=generator, dtype=torch.float64) - 40
    ends = origins + 3 * torch.randn(20, dim, generator=generator, dtype=torch.float64)
    blocks.add_rays(origins, ends)
    blocks.add_rays(ends + 100, origins + 100)  # and far from the first blocks
    cells = CellCloud.of_blocks(blocks, prior=0.5)
    torch.testing.assert_close(cells.probability, blocks.lookup(cells.centers, 0.5), rtol=0, atol=0)
    units = cells.centers / 0.25 - 0.5
    torch.testing.assert_close(units, units.round(), rtol=0, atol=1e-9)
    assert len(torch.unique(units.round(), dim=0)) == len(cells)
    hits, misses = blocks.evidence_at(cells.centers)
    assert float(hits.sum()) == float(blocks.hits.sum()) == 40
    assert float(misses.sum()) == float(blocks.misses.sum())


def test_no_evidence_is_no_cells():
    assert len(CellCloud.of_blocks(BlockEvidence(0.1, 3))) == 0


@pytest.mark.parametrize(
    ("centers", "probability", "says"),
    [
        (torch.zeros(3, 4), torch.zeros(3), "centers has shape"),
        (torch.zeros(3, 2), torch.zeros(2), "centers has shape"),
        (torch.full((1, 2), math.inf), torch.zeros(1), "NaN or infinite"),
        (torch.zeros(1, 2), torch.tensor([math.nan]), r"outside \[0, 1\]"),
        (torch.zeros(1, 2), torch.tensor([1.1]), r"outside \[0, 1\]"),
    ],
)
def test_what_are_no_cells_is_refused(centers, probability, says):
    with pytest.raises(InvalidArgumentError, match=says):
        CellCloud(centers, probability, 0.1)


@pytest.mark.parametrize("shape", [(500, 300), (70, 40, 50)])
def test_every_cell_is_asked_once_and_in_its_place(shape):
    grid = grid_of(shape)
    told: list[int] = []
    found = rasterize(lambda x: (x * 0.1).sum(1), grid, lambda stage, done, total: told.append(done))
    torch.testing.assert_close(found.flatten(), (grid.centers() * 0.1).sum(1), rtol=0, atol=0)
    assert told == sorted(told)
    assert told[-1] == grid.n_cells


# -- PLY and PCD ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("write", "tolerance"), [(write_ply, 0), (write_pcd, 1e-6)])
@pytest.mark.parametrize("shape", [(5, 4), (3, 4, 5)])
def test_open3d_reads_occupied_cells_with_their_probability(write, tolerance, shape, tmp_path):
    cells = CellCloud.of_grid(grid_of(shape), probabilities(shape)).above(0.65)
    path = write(tmp_path / f"cells.{write.__name__[-3:]}", cells)
    cloud = open3d.t.io.read_point_cloud(str(path))
    np.testing.assert_allclose(cloud.point.positions.numpy(), cells.positions(), rtol=0, atol=tolerance)
    intensity = cloud.point.intensity.numpy()[:, 0]
    np.testing.assert_array_equal(intensity, cells.probability.numpy().astype(np.float32))
    if len(shape) == 2:
        assert not cells.positions()[:, 2].any()


@pytest.mark.parametrize("write", [write_ply, write_pcd])
def test_no_cells_are_a_file_without_points(write, tmp_path):
    cells = CellCloud(torch.zeros(0, 3), torch.zeros(0), 0.1)
    path = write(tmp_path / "none", cells)
    assert path.read_bytes().endswith((b"end_header\n", b"DATA binary\n"))


def test_far_from_the_origin_ply_is_exact_and_pcd_refuses_what_it_would_blur(tmp_path):
    cells = CellCloud(torch.tensor([[5e5 + 0.05, 0.05, 0.05]], dtype=torch.float64), torch.ones(1), 0.1)
    cloud = open3d.t.io.read_point_cloud(str(write_ply(tmp_path / "far.ply", cells)))
    assert cloud.point.positions.numpy()[0, 0] == 5e5 + 0.05
    with pytest.raises(InvalidArgumentError, match="write PLY, which has doubles"):
        write_pcd(tmp_path / "far.pcd", cells)
    assert not (tmp_path / "far.pcd").exists()


# -- OctoMap --------------------------------------------------------------------------------------


def searched(path: Path, centers: torch.Tensor) -> list[float | None]:
    """What OctoMap says of each cell; None where it has none."""
    tree = pyoctomap.OcTree(0.5)
    if path.suffix == ".bt":
        assert tree.readBinary(str(path))
    else:
        tree = tree.read(str(path))
    found = []
    for center in centers.numpy():
        node = tree.search(center)
        found.append(None if node is None else node.getOccupancy())
    return found


def test_a_binary_octree_has_the_same_classes(tmp_path):
    shape = (9, 10, 11)
    grid, theta = grid_of(shape), probabilities(shape)
    theta[:4, :4, :4] = 0.01  # so that some cells become one
    path = write_octomap(tmp_path / "map.bt", CellCloud.of_grid(grid, theta))
    expected = Thresholds().classify(theta).flatten().tolist()
    called = [
        CellClass.UNKNOWN if p is None else CellClass.OCCUPIED if p > 0.5 else CellClass.FREE
        for p in searched(path, grid.centers())
    ]
    assert called == expected
    assert set(called) == {-1, 0, 1}


def test_a_full_octree_has_the_same_probabilities(tmp_path):
    shape = (9, 10, 11)
    grid, theta = grid_of(shape), probabilities(shape)
    path = write_octomap(tmp_path / "map.ot", CellCloud.of_grid(grid, theta))
    for found, expected in zip(searched(path, grid.centers()), theta.flatten().tolist(), strict=True):
        if expected == 0.5:
            assert found is None
        else:
            assert found == pytest.approx(expected, abs=2e-6)  # 0 and 1 are kept that far away


def test_blocks_and_flat_maps_become_octrees_too(tmp_path, generator):
    blocks = BlockEvidence(0.25, 2)
    blocks.add_rays(torch.zeros(50, 2), 3 * torch.randn(50, 2, generator=generator, dtype=torch.float64))
    cells = CellCloud.of_blocks(blocks)
    path = write_octomap(tmp_path / "flat.ot", cells)
    layer = torch.cat([cells.centers, torch.full_like(cells.centers[:, :1], 0.125)], 1)
    known = cells.probability != 0.5
    found = [p for p, k in zip(searched(path, layer), known.tolist(), strict=True) if k]
    np.testing.assert_allclose(found, cells.probability[known], atol=1e-6)


def test_an_octree_reaches_as_far_as_its_keys(tmp_path):
    edge = torch.tensor([[32767.5, -32767.5, 0.5]], dtype=torch.float64)
    path = write_octomap(tmp_path / "edge.ot", CellCloud(edge * 0.1, torch.tensor([0.9]), 0.1))
    assert searched(path, edge * 0.1) == [pytest.approx(0.9, abs=1e-6)]
    far = CellCloud((edge + 1) * 0.1, torch.tensor([0.9]), 0.1)
    with pytest.raises(InvalidArgumentError, match=r"OctoMap reaches 3276\.8 m"):
        write_octomap(tmp_path / "far.ot", far)


def test_what_octomap_cannot_hold_is_refused(tmp_path, monkeypatch):
    cells = CellCloud(torch.full((1, 3), 0.05, dtype=torch.float64), torch.ones(1), 0.1)
    with pytest.raises(InvalidArgumentError, match=r"must end in \.bt .* or \.ot"):
        write_octomap(tmp_path / "map.octomap", cells)
    with pytest.raises(InvalidArgumentError, match=r"VoxelGrid\.covering"):
        write_octomap(tmp_path / "map.bt", CellCloud(cells.centers + 0.03, torch.ones(1), 0.1))
    load = builtins.__import__

    def without(name, *rest, **more):
        if name == "pyoctomap":
            raise ImportError("No module named 'pyoctomap'")
        return load(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(GmmTorchError, match=r"pip install 'gmmtorch\[baselines\]'"):
        write_octomap(tmp_path / "map.bt", cells)
    assert not list(tmp_path.iterdir())


# -- map_server -----------------------------------------------------------------------------------


@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 99), st.sampled_from([1e-5, 0.05, 12.0]))
def test_a_map_comes_back_to_a_255th_and_in_its_classes(tmp_path, width, height, seed, resolution):
    grid, theta = grid_of((width, height), resolution), probabilities((width, height), seed)
    path, image = write_map_server(tmp_path / "floor", grid, theta)
    assert (path.name, image.name) == ("floor.yaml", "floor.pgm")
    found = read_map_server(path)
    assert found.grid == grid
    assert float((found.probability - theta).abs().max()) <= 1 / 255
    assert torch.equal(found.classify(), Thresholds().classify(theta))


def test_no_class_changes_for_any_probability(tmp_path):
    theta = torch.linspace(0, 1, 20_001, dtype=torch.float64)[:, None]
    rule = Thresholds(0.25, 0.6501)
    path, _ = write_map_server(tmp_path / "fine.yaml", VoxelGrid((0, 0), 1, (20_001, 1)), theta, rule)
    found = read_map_server(path)
    assert found.thresholds == rule
    assert torch.equal(found.classify(), rule.classify(theta))
    assert float((found.probability - theta).abs().max()) <= 1 / 255


def test_the_image_is_seen_from_above_with_north_up(tmp_path):
    theta = torch.full((3, 2), 0.0, dtype=torch.float64)
    theta[0, 1] = 1.0  # lowest x, highest y: the upper left corner
    _, image = write_map_server(tmp_path / "up.yaml", grid_of((3, 2)), theta)
    pixels = np.asarray(Image.open(image))
    assert pixels.tolist() == [[0, 255, 255], [255, 255, 255]]


def test_yaml_is_what_map_server_expects(tmp_path):
    import yaml

    path, _ = write_map_server(tmp_path / 'a "b".pgm', grid_of((3, 2), 1e-5), torch.zeros(3, 2))
    facts = yaml.safe_load(path.read_text())
    assert facts == {
        "image": 'a "b".pgm',
        "mode": "trinary",
        "resolution": 1e-5,
        "origin": [pytest.approx(-3e-5), pytest.approx(7e-5), 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }


def yaml_beside(folder: Path, pixels: np.ndarray, **facts: object) -> Path:
    Image.fromarray(pixels).save(folder / "m.png")
    said = {
        "image": "m.png",
        "resolution": 0.5,
        "origin": [1.0, 2.0, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
        **facts,
    }
    path = folder / "m.yaml"
    path.write_text("\n".join(f"{key}: {value}" for key, value in said.items() if value is not None))
    return path


def test_what_map_saver_writes_is_read(tmp_path):
    pixels = np.array([[254, 205, 0]], dtype=np.uint8)
    found = read_map_server(yaml_beside(tmp_path, pixels))
    assert found.classify().tolist() == [[CellClass.FREE], [CellClass.UNKNOWN], [CellClass.OCCUPIED]]
    assert found.grid == VoxelGrid((1.0, 2.0), 0.5, (3, 1))
    negated = read_map_server(yaml_beside(tmp_path, 255 - pixels, negate=1))
    assert torch.equal(negated.probability, found.probability)


def test_colours_are_averaged_and_transparent_pixels_are_unknown(tmp_path):
    pixels = np.array([[[30, 60, 90, 255], [0, 0, 0, 0]]], dtype=np.uint8)
    found = read_map_server(yaml_beside(tmp_path, pixels, mode="scale"))
    assert found.probability[:, 0].tolist() == [pytest.approx((255 - 60) / 255), 0.5]


@pytest.mark.parametrize(
    ("facts", "says"),
    [
        ({"mode": "raw"}, "mode='raw' is not one of trinary, scale"),
        ({"origin": [0, 0, 0.5]}, "yaw=0.5; a turned map"),
        ({"origin": "here"}, r"origin='here' is not \[x, y, yaw\]"),
        ({"origin": "[a, 0, 0]"}, "origin='a' is not a number"),
        ({"resolution": 0}, "resolution=0.0 is not a cell size"),
        ({"resolution": ".nan"}, "resolution=nan is not finite"),
        ({"resolution": None}, "resolution=None is not a number"),
        ({"occupied_thresh": 0.1}, "free_thresh="),
        ({"negate": 3}, "negate=3 must be 0 or 1"),
        ({"negate": "0x" + "f" * 9000}, "negate=a int must be 0 or 1"),
        ({"resolution": "0x" + "f" * 9000}, "resolution=a int is not a number"),
        ({"image": "''"}, "names no image"),
        ({"image": "[1]"}, "names no image"),
    ],
)
def test_a_broken_description_is_refused(facts, says, tmp_path):
    path = yaml_beside(tmp_path, np.zeros((2, 2), dtype=np.uint8), **facts)
    with pytest.raises(DataError, match=says) as caught:
        read_map_server(path)
    assert "m.yaml" in str(caught.value)


@pytest.mark.parametrize("text", ["", "- 1", "a: [", "\0", "!!python/object/apply:os.getcwd []", "[" * 5000])
def test_what_is_no_table_is_refused(text, tmp_path):
    path = tmp_path / "m.yaml"
    path.write_text(text)
    with pytest.raises(DataError, match=r"m\.yaml"):
        read_map_server(path)


def test_a_few_lines_that_stand_for_a_world_are_refused_in_one(tmp_path):
    path = yaml_beside(tmp_path, np.zeros((2, 2), dtype=np.uint8), origin=None)
    levels = "\n".join(f"b{i}: &a{i + 1} [{', '.join([f'*a{i}'] * 9)}]" for i in range(40))
    path.write_text(f"{path.read_text()}\na: &a0 [x]\n{levels}\norigin: *a40\n")
    with pytest.raises(DataError, match="origin=") as caught:
        read_map_server(path)
    assert len(str(caught.value)) < 1000


def test_missing_large_and_damaged_files_are_named(tmp_path):
    with pytest.raises(MissingDataError, match=r"m\.yaml does not exist"):
        read_map_server(tmp_path / "m.yaml")
    path = yaml_beside(tmp_path, np.zeros((100, 100), dtype=np.uint8))
    with pytest.raises(MemoryLimitError, match="100 × 100 pixels"):
        read_map_server(path, memory_limit=1000)
    whole = (tmp_path / "m.png").read_bytes()
    for data in (b"", whole[:40], b"P5\n99999 99999\n255\n", b"P5\n10 10\n65535\n" + bytes(200)):
        (tmp_path / "m.png").write_bytes(data)
        with pytest.raises(GmmTorchError, match=r"m\.png"):
            read_map_server(path)
    (tmp_path / "m.png").unlink()
    with pytest.raises(MissingDataError, match=r"m\.png does not exist; .*m\.yaml says"):
        read_map_server(path)
    path.write_text("a" * 100_000)
    with pytest.raises(DataError, match="more than 16,384 bytes"):
        read_map_server(path)


@pytest.mark.parametrize("theta", [torch.zeros(2, 3), torch.full((3, 2), 1.5), torch.full((3, 2), math.nan)])
def test_only_probabilities_of_the_grid_are_written(theta, tmp_path):
    with pytest.raises(InvalidArgumentError, match="probability"):
        write_map_server(tmp_path / "no", grid_of((3, 2)), theta)
    assert not list(tmp_path.iterdir())


def test_a_band_takes_the_highest_of_each_column():
    grid = VoxelGrid((0, 0, -1.0), 0.5, (4, 3, 6))  # z from −1 to 2
    theta = probabilities((4, 3, 6))
    flat, found = highest_in_band(grid, theta, 0.1, 0.9)  # the cells 0 … 0.5 and 0.5 … 1
    assert flat == VoxelGrid((0, 0), 0.5, (4, 3))
    expected = [[max(theta[i, j, 2:4].tolist()) for j in range(3)] for i in range(4)]
    assert found.tolist() == expected
    assert torch.equal(highest_in_band(grid, theta)[1], theta.amax(2))
    with pytest.raises(InvalidArgumentError, match=r"z_min=3.*reaches from -1 to 2 m"):
        highest_in_band(grid, theta, 3, 4)
    with pytest.raises(InvalidArgumentError, match="cut out of a 3D map"):
        highest_in_band(grid_of((4, 3)), theta[..., 0])
