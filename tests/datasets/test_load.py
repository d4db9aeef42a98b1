"""datasets.load: names, paths, options and defaults."""

from __future__ import annotations

import subprocess
import sys

import pytest

from gmmtorch.datasets import load
from gmmtorch.errors import InvalidArgumentError, MissingDataError

WITH_PATH = ["carmen", "scan_folder", "pcd_viewpoint", "depth_frames", "octomap_log", "mesh", "mesh_scans"]
WITH_PATH += ["rosbag", "kitti", "tum"]


def test_load_lists_the_names_when_the_name_is_unknown():
    with pytest.raises(InvalidArgumentError, match="intel") as caught:
        load("intel")
    for name in (*WITH_PATH, "synthetic_building_2d"):
        assert name in str(caught.value)


@pytest.mark.parametrize("name", WITH_PATH)
def test_load_states_the_expected_content_of_a_missing_path(name, tmp_path):
    with pytest.raises(MissingDataError, match="nowhere") as caught:
        load(name, tmp_path / "nowhere")
    assert "looked for" in str(caught.value)
    assert isinstance(caught.value, FileNotFoundError)


@pytest.mark.parametrize("path", [None, ""])
def test_load_requires_a_path(path):
    with pytest.raises(InvalidArgumentError, match=r"path is not set"):
        load("carmen", path)


def test_load_rejects_a_folder_in_place_of_a_file(tmp_path):
    with pytest.raises(MissingDataError, match="not a file"):
        load("carmen", tmp_path)


def test_load_lists_the_options_when_an_option_is_unknown(tmp_path):
    with pytest.raises(InvalidArgumentError, match=r"sensr='lidar'.*n_scans, seed, sensor"):
        load("synthetic_building", sensr="lidar")
    with pytest.raises(InvalidArgumentError, match="takes no further options"):
        load("carmen", tmp_path, seed=1)


def test_load_rejects_a_path_for_a_simulated_data_set(tmp_path):
    with pytest.raises(InvalidArgumentError, match="is simulated"):
        load("synthetic_building", tmp_path)


def test_load_applies_the_default_ranges_of_each_data_set(tmp_path):
    log = tmp_path / "a.log"
    log.write_text("FLASER 1 1.0 0 0 0 0 0 0 0 host 0\n")
    carmen = load("carmen", log)
    assert (carmen.ranges.max_range, carmen.ranges.no_return_range) == (50.0, 8.0)
    changed = load("carmen", log, max_range=20.0, no_return_range=0).ranges
    assert (changed.max_range, changed.no_return_range) == (20.0, 0.0)
    synthetic = load("synthetic_building_2d", n_scans=1)
    assert (synthetic.ranges.max_range, synthetic.ranges.no_return_range) == (None, 8.0)


@pytest.mark.slow
def test_importing_datasets_loads_no_reader():
    code = (
        "import sys, gmmtorch.datasets\n"
        "late = [m for m in ('open3d', 'PIL', 'gmmtorch.simulation', 'gmmtorch.datasets.carmen')"
        " if m in sys.modules]\n"
        "sys.exit(', '.join(late) or 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
