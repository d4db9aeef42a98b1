"""Example grids and probabilities, and an independent reader of map_server files."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import yaml
from PIL import Image

from gmmtorch.occupancy import Thresholds, VoxelGrid


def random_probabilities(shape: tuple[int, ...], seed: int = 0) -> torch.Tensor:
    """Random values in [0, 1], with some exactly 0, ½ and 1."""
    generator = torch.Generator().manual_seed(seed)
    theta = torch.rand(shape, dtype=torch.float64, generator=generator)
    special = torch.randint(0, 8, shape, generator=generator)
    for value, number in ((0.5, 1), (0.0, 2), (1.0, 3)):
        theta[special == number] = value
    return theta


def example_grid(shape: tuple[int, ...], resolution: float = 0.1) -> VoxelGrid:
    first = (-3, 7, -2)[: len(shape)]
    return VoxelGrid(tuple(i * resolution for i in first), resolution, shape)


class MapImage(NamedTuple):
    """Content of a map_server YAML file and its image."""

    grid: VoxelGrid
    probability: torch.Tensor
    thresholds: Thresholds


def read_map_image(path: Path) -> MapImage:
    """Reads a map as map_server does: p = (255 − pixel)/255, first image row at the highest y."""
    facts = yaml.safe_load(path.read_text())
    assert (facts["mode"], facts["negate"], facts["origin"][2]) == ("trinary", 0, 0.0)
    pixels = np.asarray(Image.open(path.parent / facts["image"]), dtype=np.float64)
    probability = torch.from_numpy((255 - pixels[::-1].T) / 255)
    grid = VoxelGrid(tuple(facts["origin"][:2]), facts["resolution"], tuple(probability.shape))
    return MapImage(grid, probability, Thresholds(facts["free_thresh"], facts["occupied_thresh"]))
