"""load: names, defaults and options."""

from __future__ import annotations

import subprocess
import sys

import pytest

from gmmtorch.datasets import load
from gmmtorch.errors import InvalidArgumentError, MissingDataError


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(InvalidArgumentError, match="intel") as caught:
        load("intel")
    for name in (
        "carmen",
        "scan_folder",
        "pcd_viewpoint",
        "depth_frames",
        "octomap_log",
        "synthetic_building_2d",
    ):
        assert name in str(caught.value)


@pytest.mark.parametrize(
    "name", ["carmen", "scan_folder", "pcd_viewpoint", "depth_frames", "octomap_log", "mesh"]
)
def test_a_missing_path_says_what_was_looked_for(name, tmp_path):
    with pytest.raises(MissingDataError, match="nowhere") as caught:
        load(name, tmp_path / "nowhere")
    assert "looked for" in str(caught.value)
    assert isinstance(caught.value, FileNotFoundError)


@pytest.mark.parametrize("path", [None, ""])
def test_a_path_that_was_not_given_is_asked_for(path):
    with pytest.raises(InvalidArgumentError, match=r"dataset\.path is not set"):
        load("carmen", path)


def test_a_folder_where_a_file_is_expected(tmp_path):
    with pytest.raises(MissingDataError, match="not a file"):
        load("carmen", tmp_path)


def test_an_unknown_option_lists_the_known_ones(tmp_path):
    with pytest.raises(InvalidArgumentError, match=r"sensr='lidar'.*n_scans, seed, sensor"):
        load("synthetic_building", sensr="lidar")
    with pytest.raises(InvalidArgumentError, match="takes no further options"):
        load("carmen", tmp_path, seed=1)


def test_a_path_for_a_simulated_set_is_refused(tmp_path):
    with pytest.raises(InvalidArgumentError, match="is simulated"):
        load("synthetic_building", tmp_path)


def test_defaults_of_the_ranges(tmp_path):
    log = tmp_path / "a.log"
    log.write_text("FLASER 1 1.0 0 0 0 0 0 0 0 host 0\n")
    carmen = load("carmen", log)
    assert (carmen.ranges.max_range, carmen.ranges.no_return_range) == (50.0, 8.0)
    assert load("carmen", log, max_range=20.0, no_return_range=0).ranges.max_range == 20.0
    assert load("carmen", log, no_return_range=0).ranges.no_return_range == 0.0
    synthetic = load("synthetic_building_2d", n_scans=1)
    assert (synthetic.ranges.max_range, synthetic.ranges.no_return_range) == (None, 8.0)


def test_importing_the_room_is_light():
    code = (
        "import sys, gmmtorch.datasets\n"
        "late = [m for m in ('open3d', 'PIL', 'gmmtorch.simulation', 'gmmtorch.datasets.carmen')"
        " if m in sys.modules]\n"
        "sys.exit(', '.join(late) or 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
