"""Data sets: ranges, sequences and shards, and `load` by name."""

from __future__ import annotations

import itertools
import math
import subprocess
import sys

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.datasets import Dataset, Ranges, load
from gmmtorch.datasets.base import SPLITS, DatasetShard, shard_indices
from gmmtorch.errors import InvalidArgumentError, MissingDataError
from gmmtorch.scan import Scan

ORIGIN = torch.zeros(2, dtype=torch.float64)
ENDS = torch.tensor([[1.0, 0.0], [0.0, 5.0], [-20.0, 0.0]], dtype=torch.float64)


@pytest.mark.parametrize(
    ("ranges", "mask", "points", "no_return"),
    [
        (Ranges(), None, ENDS.tolist(), []),
        (Ranges(5.0, 3.0), None, [[1, 0]], [[0, 3], [-3, 0]]),  # at the range or beyond: no return
        (Ranges(5.0, 0.0), None, [[1, 0]], []),
        (Ranges(6.0, 50.0), [False, True, False], [[1, 0]], [[0, 5], [-6, 0]]),  # as long as beam and range
    ],
)
def test_ends_become_hits_and_beams_without_return(ranges, mask, points, no_return):
    given = None if mask is None else torch.tensor(mask)
    invalid = torch.tensor([[math.nan, 0.0], [0.0, math.inf], [0.0, 0.0]], dtype=torch.float64)
    for ends in (ENDS, torch.cat([ENDS, invalid])):  # not finite, or at the origin
        marked = None if given is None else torch.nn.functional.pad(given, (0, len(ends) - 3))
        before = None if marked is None else marked.clone()
        scan = ranges.scan(ends, ORIGIN, no_return=marked)
        assert scan.points.tolist() == points
        assert scan.no_return.tolist() == no_return
        assert scan.no_return.shape[1] == 2
        assert marked is before or torch.equal(marked, before)


def test_ends_at_max_range_within_rounding_are_no_hits():
    angle = torch.linspace(0, 6, 1000)  # float32: half of the lengths are rounded below 50
    ends = 50 * torch.stack([angle.cos(), angle.sin()], 1)
    assert Ranges(50.0, 8.0).scan(ends, torch.zeros(2)).points.shape == (0, 2)


@pytest.mark.parametrize(
    ("option", "value"),
    [("max_range", x) for x in (0.0, -1.0, math.nan)]
    + [("no_return_range", x) for x in (-1.0, math.nan, math.inf)],
)
def test_ranges_must_be_distances(option, value):
    with pytest.raises(InvalidArgumentError, match=option):
        Ranges(**{option: value})


class _TenScans(Dataset):
    """Ten scans; scan i has one point at (i, 0)."""

    def _count(self) -> int:
        return 10

    def _read(self, index: int) -> Scan:
        return Scan([[float(index), 0.0]], [0.0, 1.0])


def _numbers(scans: list[Scan]) -> list[float]:
    return [float(scan.points[0, 0]) for scan in scans]


@pytest.mark.parametrize(
    ("stride", "expected"), [(1, list(range(10))), (3, [0, 3, 6, 9]), (4, [0, 4, 8]), (20, [0])]
)
def test_dataset_stride_selects_every_nth_scan(stride, expected):
    dataset = _TenScans("ten", Ranges(), stride)
    assert len(dataset) == len(expected)
    assert _numbers(list(dataset)) == expected


def test_dataset_supports_negative_indices_and_slices():
    dataset = _TenScans("ten", Ranges(), 2)
    assert _numbers([dataset[-1]]) == [8]
    assert _numbers(dataset[1:3]) == [2, 4]
    with pytest.raises(IndexError, match="ten"):
        dataset[5]


def test_dataset_rejects_a_stride_below_one():
    with pytest.raises(InvalidArgumentError, match="stride=0"):
        _TenScans("ten", Ranges(), 0)


@given(n_scans=st.integers(0, 200), n=st.integers(1, 20), split=st.sampled_from(SPLITS))
def test_shards_partition_the_scans_evenly(n_scans, n, split):
    shards = [list(shard_indices(n_scans, k, n, split)) for k in range(n)]
    assert sorted(itertools.chain(*shards)) == list(range(n_scans))
    assert max(map(len, shards)) - min(map(len, shards)) <= 1
    for shard in shards:
        steps = {b - a for a, b in itertools.pairwise(shard)}
        assert steps <= {n if split == "interleaved" else 1}
    if split == "consecutive":
        assert list(itertools.chain(*shards)) == list(range(n_scans))


@pytest.mark.parametrize(
    ("args", "name"),
    [
        ((-1, 0, 1), "n_scans"),
        ((5, 2, 2), "k=2"),
        ((5, -1, 2), "k"),
        ((5, 0, 0), "n="),
        ((5, 0, 1, "x"), "split"),
    ],
)
def test_shard_indices_rejects_invalid_arguments(args, name):
    with pytest.raises(InvalidArgumentError, match=name):
        shard_indices(*args)


def test_dataset_shard_reads_only_the_accessed_scans():
    read: list[int] = []

    class Scans:
        def __getitem__(self, index):
            read.append(index)
            return f"scan {index}"

    shard = DatasetShard(Scans(), shard_indices(10, 1, 3))
    assert (len(shard), shard[1], shard[-1]) == (3, "scan 4", "scan 7")
    assert list(shard[1:]) == ["scan 4", "scan 7"]
    assert list(shard) == ["scan 1", "scan 4", "scan 7"]
    assert read == [4, 7, 4, 7, 1, 4, 7]
    with pytest.raises(IndexError):
        shard[3]


# -- load --------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("name", "path", "options", "error", "message"),
    [
        ("carmen", None, {}, InvalidArgumentError, r"path is not set"),
        ("carmen", "", {}, InvalidArgumentError, r"path is not set"),
        ("carmen", "/", {}, MissingDataError, "not a file"),
        ("carmen", "/", {"seed": 1}, InvalidArgumentError, "takes no further options"),
        ("synthetic_building", "/", {}, InvalidArgumentError, "is simulated"),
        (
            "synthetic_building",
            None,
            {"sensr": "lidar"},
            InvalidArgumentError,
            "sensr=.*n_scans, seed, sensor",
        ),
    ],
)
def test_load_names_a_wrong_path_or_option(name, path, options, error, message):
    with pytest.raises(error, match=message):
        load(name, path, **options)


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
        "late = [m for m in ('open3d', 'PIL', 'gmmtorch.simulation', 'gmmtorch.datasets.scan_logs')"
        " if m in sys.modules]\n"
        "sys.exit(', '.join(late) or 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
