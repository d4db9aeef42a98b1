"""One belief: whatever shows a map's probabilities gets them from its evidence by one formula.

The tests of gmmtorch-export compare what it writes with the answers of the map.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from gmmtorch.datasets import load
from gmmtorch.live import MapPublisher, viewer_scene
from gmmtorch.mapping import GaussianMap, TiledMap, tile_files
from gmmtorch.occupancy import Calibration, Thresholds, VoxelGrid
from gmmtorch.report import MapPanel, map_images

SIDE = 0.25
UNUSUAL = Calibration.of_bytes(np.array([1, 8, 1, 0, 0, -1, 0, 0, -0.5, 0, 0, 0.5, 0, 0], "<f2").tobytes())
"""A calibration far from the sensor model's, so that a consumer that ignores it shows."""


@pytest.fixture(scope="module", params=[2, 3])
def built(request: pytest.FixtureRequest) -> GaussianMap:
    torch.set_num_threads(1)
    dataset = load("synthetic_building_2d" if request.param == 2 else "synthetic_building", n_scans=4)
    made = GaussianMap(resolution=SIDE)
    for i in range(4):
        scan = dataset[i]
        made.insert(scan.select(torch.arange(scan.n_beams) % (1 if request.param == 2 else 5) == 0))
    made.finish()
    return made.snapshot(calibration=UNUSUAL, codec="quantized")


@pytest.fixture
def file(built: GaussianMap, tmp_path: Path) -> Path:
    built.save(tmp_path / "map.safetensors")
    return tmp_path / "map.safetensors"


def believed(built: GaussianMap, grid: VoxelGrid) -> Tensor:
    """The probabilities of a grid, from its hits and misses by the formula of `occupancy.calibrator`."""
    evidence = GaussianMap.of(built.components(), prior=1.0).evidence(grid)
    return UNUSUAL.probability(evidence.hits, evidence.misses, grid.resolution, grid.dim)


def around(built: GaussianMap) -> VoxelGrid:
    """A grid of about a thousand cells around surfaces."""
    middle = built.components().means.median(0).values
    size = 24 if built.dim == 2 else 10
    corner = ((middle / SIDE).round() - size / 2) * SIDE
    return VoxelGrid(tuple(corner.tolist()), SIDE, (size,) * len(corner))


def test_the_calibration_makes_a_difference(built):
    theta = believed(built, around(built))
    usual = torch.as_tensor(built.snapshot(calibration=None).evidence(around(built)).probability())
    assert float((theta - usual).abs().max()) > 0.05
    assert set(Thresholds().classify(theta).flatten().tolist()) == {-1, 0, 1}


def test_answers_of_a_map_its_file_and_its_tiles(built, file, tmp_path):
    grid = around(built)
    theta, points = believed(built, grid).flatten(), grid.centers()
    for name, data in tile_files(built.components(), built.settings, 8.0).items():
        (tmp_path / name).write_bytes(data)
    for answers in (built, GaussianMap.load(file), TiledMap(tmp_path)):
        found = torch.as_tensor(answers.occupancy(points, SIDE))
        torch.testing.assert_close(found, theta, rtol=0, atol=1e-6)
    torch.testing.assert_close(built.evidence(grid).probability().flatten(), theta, rtol=0, atol=1e-6)


def test_the_viewer(built, monkeypatch):
    middle = around(built).centers()[:40]
    for point in middle:
        cell = VoxelGrid(tuple((point - SIDE / 2).tolist()), SIDE, (1,) * len(point))
        assert viewer_scene.place_at(built, point, SIDE)[0] == pytest.approx(
            float(believed(built, cell)), abs=1e-6
        )
    asked: list[MapPanel] = []

    def slice_image(panel: MapPanel, *options: Any) -> Any:
        asked.append(panel)
        return map_images.slice_image(panel, *options)

    monkeypatch.setattr(viewer_scene, "slice_image", slice_image)
    viewer_scene.occupancy_slice(built, SIDE, 1.0, viewer_scene.frame(built.components(), []))
    grid = around(built)
    found = asked[0].occupancy(grid.centers())
    torch.testing.assert_close(found, believed(built, grid).flatten(), rtol=0, atol=1e-6)


def test_the_grid_of_a_live_map(built):
    class Recorder:
        def publisher(self, *_: Any) -> Any:
            return lambda *_: None

        def warn(self, *_: Any) -> None:
            raise AssertionError

    band = (0.25, 0.75) if built.dim == 3 else (None, None)
    publisher = MapPublisher(Recorder(), SIDE, *band, cloud="none", ellipsoids=False)  # type: ignore[arg-type]
    grid, theta = publisher._probabilities(built)
    assert grid is not None
    torch.testing.assert_close(theta.flatten(), believed(built, grid).flatten(), rtol=0, atol=1e-6)
