"""The moving picture of a map that grows."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from gmmtorch.datasets import load
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.report import style
from gmmtorch.report.map_figures import GrowthFrame, save_growth


def grown(n_frames: int) -> list[GrowthFrame]:
    """The map of the building after one scan, two, …"""
    scans, built, frames = load("synthetic_building_2d", n_scans=n_frames), GaussianMap(), []
    for k, scan in enumerate(scans):
        built.insert(scan)
        path = torch.stack([scans[i].origin for i in range(k + 1)])
        frames.append(GrowthFrame(k + 1, GaussianMap.of(built.components()), path, scan.points))
    return frames


def test_unknown_space_shrinks_and_the_last_frame_is_held(tmp_path):
    written = save_growth(tmp_path / "map.gif", grown(3), resolution=0.3, period=0.1)
    unknown = np.array([int(style.UNKNOWN[k : k + 2], 16) for k in (1, 3, 5)])
    path_colour = np.array([int(style.PALETTE[1][k : k + 2], 16) for k in (1, 3, 5)])
    durations, shares = [], []
    with Image.open(written) as picture:
        assert picture.n_frames == 3
        for k in range(3):
            picture.seek(k)
            durations.append(picture.info["duration"])
            pixels = np.asarray(picture.convert("RGB")).astype(int)
            shares.append((np.abs(pixels - unknown).max(-1) < 8).mean())
            assert (np.abs(pixels - path_colour).max(-1) < 16).sum() > 30  # the robot
    assert durations == [100, 100, 4000]
    assert shares[0] > shares[1] > shares[2] > 0.01


@pytest.mark.parametrize(("name", "words"), [("map.mp4", r"\.webp or \.gif"), ("map.gif", "only maps in 2D")])
def test_other_files_and_maps_are_refused(name, words, tmp_path):
    with pytest.raises(InvalidArgumentError, match=words):
        save_growth(
            tmp_path / name,
            [GrowthFrame(0, GaussianMap(), torch.zeros(1, 2), torch.zeros(0, 2))],
            resolution=0.1,
        )
