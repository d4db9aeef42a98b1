"""map_server files, checked with an independent reader."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import yaml
from export.map_examples import example_grid, random_probabilities, read_map_image
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.export.navigation import highest_in_band, write_map_server
from gmmtorch.occupancy.evidence import Thresholds
from gmmtorch.occupancy.grid import VoxelGrid


@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 99), st.sampled_from([1e-5, 0.05, 12.0]))
def test_map_server_round_trip_keeps_classes_and_probabilities_to_a_255th(
    tmp_path, width, height, seed, resolution
):
    grid, theta = example_grid((width, height), resolution), random_probabilities((width, height), seed)
    path, image = write_map_server(tmp_path / "floor", grid, theta)
    assert (path.name, image.name) == ("floor.yaml", "floor.pgm")
    found = read_map_image(path)
    assert found.grid == grid
    assert float((found.probability - theta).abs().max()) <= 1 / 255
    assert torch.equal(found.thresholds.classify(found.probability), Thresholds().classify(theta))


def test_map_server_rounding_never_changes_a_class(tmp_path):
    theta = torch.linspace(0, 1, 20_001, dtype=torch.float64)[:, None]
    rule = Thresholds(0.25, 0.6501)
    path, _ = write_map_server(tmp_path / "fine.yaml", VoxelGrid((0, 0), 1, (20_001, 1)), theta, rule)
    found = read_map_image(path)
    assert found.thresholds == rule
    assert torch.equal(rule.classify(found.probability), rule.classify(theta))
    assert float((found.probability - theta).abs().max()) <= 1 / 255


def test_map_server_image_has_the_highest_y_in_the_first_row(tmp_path):
    theta = torch.full((3, 2), 0.0, dtype=torch.float64)
    theta[0, 1] = 1.0  # lowest x, highest y: the upper left corner
    _, image = write_map_server(tmp_path / "up.yaml", example_grid((3, 2)), theta)
    assert np.asarray(Image.open(image)).tolist() == [[0, 255, 255], [255, 255, 255]]


def test_map_server_yaml_has_the_expected_keys(tmp_path):
    path, _ = write_map_server(tmp_path / 'a "b".pgm', example_grid((3, 2), 1e-5), torch.zeros(3, 2))
    assert yaml.safe_load(path.read_text()) == {
        "image": 'a "b".pgm',
        "mode": "trinary",
        "resolution": 1e-5,
        "origin": [pytest.approx(-3e-5), pytest.approx(7e-5), 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }


@pytest.mark.parametrize("theta", [torch.zeros(2, 3), torch.full((3, 2), 1.5), torch.full((3, 2), math.nan)])
def test_map_server_writer_rejects_other_shapes_and_values(theta, tmp_path):
    with pytest.raises(InvalidArgumentError, match="probability"):
        write_map_server(tmp_path / "no", example_grid((3, 2)), theta)
    assert not list(tmp_path.iterdir())


def test_highest_in_band_is_the_maximum_of_each_column():
    grid = VoxelGrid((0, 0, -1.0), 0.5, (4, 3, 6))  # z from −1 to 2
    theta = random_probabilities((4, 3, 6))
    flat, found = highest_in_band(grid, theta, 0.1, 0.9)  # the cells 0 … 0.5 and 0.5 … 1
    assert flat == VoxelGrid((0, 0), 0.5, (4, 3))
    expected = [[max(theta[i, j, 2:4].tolist()) for j in range(3)] for i in range(4)]
    assert found.tolist() == expected
    assert torch.equal(highest_in_band(grid, theta)[1], theta.amax(2))
    with pytest.raises(InvalidArgumentError, match=r"z_min=3.*reaches from -1 to 2 m"):
        highest_in_band(grid, theta, 3, 4)
    with pytest.raises(InvalidArgumentError, match="needs a 3D map"):
        highest_in_band(example_grid((4, 3)), theta[..., 0])
