"""gmmtorch-map: its files, stopping and continuing, exports, and errors."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_runs import QUIET, Finished, refused, run_here, succeeded

from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.map_builder import MapBuilder

Run = Callable[..., Finished]
SMALL = ["dataset=synthetic_building_2d", "dataset.n_scans=10", "map.window=4"]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    def run_command(*options: str, folder: str = "run") -> Finished:
        return run_here(monkeypatch, "map", tmp_path / folder, *SMALL, *options)

    return run_command


def test_a_run_writes_the_map_its_trajectory_exports_and_results(run):
    done = succeeded(run(*QUIET, "export=[map_server,cloud]", "resolution=0.2"))
    row = done.results()["rows"][0]
    built = GaussianMap.load(done.folder / "map.safetensors")
    assert (row["n_scans"], row["n_skipped"], row["n_components"]) == (10, 0, built.n_components)
    assert row["nbytes"] == (done.folder / "map.safetensors").stat().st_size
    assert built.resolution == 0.2
    trajectory = np.loadtxt(done.folder / "trajectory.tum")
    assert trajectory.shape == (10, 8)
    steps = np.linalg.norm(np.diff(trajectory[:, 1:4], axis=0), axis=1)
    assert row["metres"] == pytest.approx(steps.sum(), rel=1e-6)
    assert {"navigation.yaml", "navigation.pgm", "cloud.ply"} <= done.files()
    assert "checkpoint.safetensors" not in done.files()
    assert "navigation.pgm" in done.stdout


def test_pictures_and_tensorboard(run):
    done = succeeded(run("report.progress=false"))
    assert {"above.png", "components.png"} <= done.files()
    assert any(name.startswith("tensorboard/events") for name in done.files())


def test_a_stopped_run_continues_to_the_same_map(run, monkeypatch):
    whole = succeeded(run(*QUIET, folder="whole"))
    insert, inserted = MapBuilder._insert, []

    def stop_at_six(self: MapBuilder, index: int) -> None:
        insert(self, index)
        inserted.append(index)
        if inserted == list(range(6)):
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(MapBuilder, "_insert", stop_at_six)
    handlers = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    stopped = run(*QUIET)
    assert stopped.status == 130
    assert "stopped after scan 6 of 10" in stopped.stderr
    assert "checkpoint.safetensors" in stopped.files()
    assert "map.safetensors" not in stopped.files()
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == handlers
    other = run(*QUIET, "seed=5")
    assert other.status == 1
    assert "is of another run: it has seed=0, this run has seed=5" in other.stderr
    again = succeeded(run(*QUIET))
    assert "continues after scan 6" in again.stdout
    assert inserted == list(range(10))
    for name in ("map.safetensors", "trajectory.tum"):
        assert (again.folder / name).read_bytes() == (whole.folder / name).read_bytes()


def test_a_wrong_export_is_refused_before_any_work(run):
    error = refused(run(*QUIET, "export=[mesch]"))
    assert "'mesch' is not one of map_server" in error
    assert "resolution=0" in refused(run(*QUIET, "resolution=0"))


def test_scans_of_a_bag_that_cannot_be_used_are_counted_and_printed(monkeypatch, tmp_path):
    pytest.importorskip("rosbags")
    from gmmtorch.export.bag import BagWriter

    room = np.random.default_rng(0).uniform(-4, 4, (400, 3))
    with BagWriter(tmp_path / "a.mcap") as bag:
        for time in (0.0, 1.5, 3.0):
            bag.transforms(time, {("odom", "lidar"): np.eye(4)})
        for time in (0.5, 1.0, 1.5, 2.0, 4.0):  # the last one is after the last pose
            bag.cloud("/points", time, "lidar", room if time != 1.0 else room[:0])
        for stamp in ({"sec": 2, "nanosec": 500_000_000}, {"sec": 0, "nanosec": 1}):  # one jumps back
            damaged = {
                "header": {"frame_id": "lidar", "stamp": stamp},
                "width": 9,
                "height": 1,
                "point_step": 2**31,
            }
            bag.message("/points", "sensor_msgs/msg/PointCloud2", 2.5, damaged)
    bag_options = ["dataset=rosbag", f"dataset.path={tmp_path / 'a.mcap'}"]
    done = succeeded(run_here(monkeypatch, "map", tmp_path / "run", *bag_options, *QUIET))
    row = done.results()["rows"][0]
    assert (row["n_scans"], row["n_skipped"]) == (3, 4)
    for line in (
        "1 scans: stamp out of order (the clock jumped)",
        "1 scans: no pose at the time of the scan",
        "1 scans: message without a valid point",
        "1 scans: message that cannot be decoded",
    ):
        assert f"skipped   {line}" in done.stdout
    with BagWriter(tmp_path / "a.mcap") as bag:
        bag.transforms(0.0, {("odom", "lidar"): np.eye(4)})
        bag.cloud("/points", 0.0, "lidar", room[:0])
    empty = run_here(monkeypatch, "map", tmp_path / "empty", *bag_options, *QUIET)
    assert "a: no scan of 1 can be used: message without a valid point" in refused(empty)


def test_odometry_maps_a_recording_without_poses(run):
    done = run("dataset=synthetic_building_2d", "dataset.n_scans=3", "dataset.odometry=mixture")
    assert (done.folder / "trajectory.tum").is_file()
    assert "3 poses estimated" in done.stdout
    assert "ATE" in done.stdout
