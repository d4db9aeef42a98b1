"""gmmtorch-map: its files, stopping and continuing, exports, and errors."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_runs import QUIET, Disk, Finished, refused, run_here, succeeded
from mapping.map_cases import assert_same_components

from gmmtorch.datasets import load
from gmmtorch.mapping import GaussianMap, MapBuilder, TiledMap
from gmmtorch.report import Board

Run = Callable[..., Finished]
NO_POSES = (
    "dataset.motion={} predicts the poses of odometry, but dataset.odometry=none estimates no poses; use "
    "dataset.odometry=mixture, or dataset.motion=constant"
)
WHEELS = "dataset.motion='wheels' is not one of constant, dataset, imu"
SMALL = ["dataset=synthetic_building_2d", "dataset.n_scans=10", "map.window=4", "resolution=0.2"]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    def run_command(*options: str) -> Finished:
        return run_here(monkeypatch, "map", tmp_path / "run", *SMALL, *QUIET, *options)

    return run_command


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """A run with everything that it writes."""
    options = [*SMALL, "report.progress=false", "export=[map_server,cloud]"]
    with pytest.MonkeyPatch.context() as patch:
        return succeeded(run_here(patch, "map", tmp_path_factory.mktemp("map") / "run", *options))


def test_a_run_writes_the_map_its_trajectory_pictures_exports_and_results(whole):
    row = whole.results()["rows"][0]
    built = GaussianMap.load(whole.folder / "map.safetensors")
    assert (row["n_scans"], row["n_skipped"], row["n_components"]) == (10, 0, built.n_components)
    assert row["nbytes"] == (whole.folder / "map.safetensors").stat().st_size
    assert built.resolution == 0.2
    trajectory = np.loadtxt(whole.folder / "trajectory.tum")
    assert trajectory.shape == (10, 8)
    steps = np.linalg.norm(np.diff(trajectory[:, 1:4], axis=0), axis=1)
    assert row["metres"] == pytest.approx(steps.sum(), rel=1e-6)
    files = whole.files()
    assert {"navigation.yaml", "navigation.pgm", "cloud.ply", "above.png", "components.png"} <= files
    assert ("reliability.png" in files) == bool(row["predictions"])
    assert any(name.startswith("tensorboard/events") for name in files)
    assert "checkpoint.safetensors" not in files
    assert "navigation.pgm" in whole.stdout


def test_a_stopped_run_continues_to_the_same_map(run, whole, monkeypatch):
    insert, inserted = MapBuilder._insert, []

    def stop_at_six(self: MapBuilder, index: int) -> None:
        insert(self, index)
        inserted.append(index)
        if inserted == list(range(6)):
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(MapBuilder, "_insert", stop_at_six)
    handlers = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    stopped = run()
    assert stopped.status == 130
    assert "stopped after scan 6 of 10" in stopped.stderr
    assert "checkpoint.safetensors" in stopped.files()
    assert "map.safetensors" not in stopped.files()
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == handlers
    other = run("seed=5")
    assert other.status == 1
    assert "is of another run: it has seed=0, this run has seed=5" in other.stderr
    again = succeeded(run())
    assert "continues after scan 6" in again.stdout
    assert inserted == list(range(10))
    for name in ("map.safetensors", "trajectory.tum"):
        assert (again.folder / name).read_bytes() == (whole.folder / name).read_bytes()


def test_a_map_larger_than_its_memory_grows_in_tiles_and_continues(monkeypatch, tmp_path):
    options = [*SMALL, *QUIET, "map.memory=1e5", "tile=5"]
    whole = succeeded(run_here(monkeypatch, "map", tmp_path / "whole", *options))
    insert = MapBuilder._insert

    def stopped_after(self: MapBuilder, index: int) -> None:
        insert(self, index)
        if index == 6:  # one window of four scans is finished
            raise KeyboardInterrupt

    monkeypatch.setattr(MapBuilder, "_insert", stopped_after)
    assert run_here(monkeypatch, "map", tmp_path / "run", *options).status != 0
    assert TiledMap(tmp_path / "run" / "tiles").n_scans == 4
    monkeypatch.setattr(MapBuilder, "_insert", insert)
    other = run_here(monkeypatch, "map", tmp_path / "run", *options, "seed=5")
    assert "is of another run: it has seed=0, this run has seed=5" in other.stderr
    again = succeeded(run_here(monkeypatch, "map", tmp_path / "run", *options))
    assert "checkpoint.safetensors" not in again.files()
    one, other = (TiledMap(run.folder / "tiles") for run in (whole, again))
    # The calibration goes on from that of the file, which has the coefficients without the predictions.
    assert_same_components(one.open().components(), other.open().components())
    assert one.n_scans == again.results()["rows"][0]["n_scans"] == 10
    assert (again.folder / "trajectory.tum").read_bytes() == (whole.folder / "trajectory.tum").read_bytes()
    third = run_here(monkeypatch, "map", tmp_path / "run", *options)
    assert "has a map" in third.stderr


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("export=[mesch]", "'mesch' is not one of map_server"),
        ("resolution=0", "resolution=0"),
        ("map.memory=0", "map.memory"),
        ("map.memory=1e6 view=true", "with map.memory, use gmmtorch-view"),
        ("map.memory=1e6 map.max_bytes=1000", "budget"),
        ("dataset.motion=dataset", NO_POSES.format("dataset")),
        ("dataset.motion=imu", NO_POSES.format("imu")),
        ("dataset.motion=wheels", WHEELS),
        ("dataset.odometry=auto dataset.motion=wheels", WHEELS),
        ("dataset.odometry=mixture dataset.motion=wheels", WHEELS),
    ],
)
def test_wrong_options_are_refused_before_any_work(options, words, run):
    assert words in refused(run(*options.split()))


def test_only_gmmtorch_map_grows_a_map_in_tiles(monkeypatch, tmp_path):
    options = [*SMALL[:2], *QUIET, "map.memory=1e6"]
    assert "map.memory" in refused(run_here(monkeypatch, "occupancy", tmp_path / "other", *options))


def test_an_export_whose_package_is_missing_is_refused_before_any_work(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyoctomap", None)
    monkeypatch.setattr(MapBuilder, "insert_all", pytest.fail)
    assert "pip install 'gmmtorch[baselines]'" in refused(run("export=[octomap]"))


def test_scans_of_a_bag_that_cannot_be_used_are_counted_and_printed(monkeypatch, tmp_path):
    pytest.importorskip("rosbags")
    from sensor_bags import BagWriter

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


@pytest.fixture
def recording(tmp_path: Path) -> tuple[Path, np.ndarray]:
    """A folder of three scans without poses, and their true poses in the frame of the first one."""
    source, folder = load("synthetic_building"), tmp_path / "recording"
    (folder / "scans").mkdir(parents=True)
    for index in range(3):
        points = source[index].transformed(source.pose(index).inverse()).points.numpy()[::10]
        header = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        header += f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA ascii\n"
        rows = "\n".join(f"{x:.4f} {y:.4f} {z:.4f}" for x, y, z in points)
        (folder / "scans" / f"{index}.pcd").write_text(header + rows + "\n")
    return folder, np.stack([np.linalg.solve(source.pose(0), source.pose(i)) for i in range(3)])


def test_odometry_auto_estimates_the_poses_of_a_recording_without_poses(monkeypatch, recording, tmp_path):
    folder, true = recording
    options = ["dataset=scan_folder", f"dataset.path={folder}", "dataset.odometry=auto", *QUIET]
    done = succeeded(run_here(monkeypatch, "map", tmp_path / "run", *options))
    assert "3 poses estimated" in done.stdout
    odometry = done.results()["rows"][0]["odometry"]
    assert (odometry["method"], odometry["n_lost"], odometry["ate"]) == ("mixture", 0, None)
    table = np.genfromtxt(
        done.folder / "trajectory.csv", delimiter=",", names=True, dtype=None, encoding="utf8"
    )
    poses = np.loadtxt(done.folder / "trajectory.tum")
    assert np.allclose(poses[:, 1:4], true[:, :3, 3], atol=0.05)
    assert np.allclose(table["x"], poses[:, 1], atol=1e-6)
    assert table["found"].tolist() == [1, 1, 1]
    assert table["cov_x_x"][0] == 0
    assert (table["cov_x_x"][1:] > 0).all()


def test_odometry_auto_keeps_given_poses_and_mixture_is_scored_by_them(monkeypatch, recording, tmp_path):
    folder, true = recording
    np.savetxt(folder / "poses.txt", true[:, :3].reshape(3, 12))
    options = ["dataset=scan_folder", f"dataset.path={folder}", *QUIET]
    given = succeeded(run_here(monkeypatch, "map", tmp_path / "given", *options, "dataset.odometry=auto"))
    assert "poses estimated" not in given.stdout
    assert "trajectory.csv" not in given.files()
    assert "odometry" not in given.results()["rows"][0]
    done = succeeded(run_here(monkeypatch, "map", tmp_path / "run", *options, "dataset.odometry=mixture"))
    odometry = done.results()["rows"][0]["odometry"]
    assert odometry["align"] in ("rigid", "first")
    assert 0 < odometry["ate"] < 0.05
    assert 0 < odometry["rpe"] < 0.05
    assert odometry["rpe_degrees"] < 1
    imu = ["dataset.odometry=mixture", "dataset.motion=imu"]
    text = refused(run_here(monkeypatch, "map", tmp_path / "imu", *options, *imu))
    assert "dataset.motion=imu cannot be used: it needs the IMU of a ROS bag" in text
    assert "Predict with dataset.motion=constant or dataset.motion=dataset." in text


def test_a_disk_that_fills_up_ends_in_one_line_with_what_was_saved(monkeypatch, tmp_path):
    options = [*SMALL, "report.progress=false"]
    with Disk() as disk:
        plain = Board.scalars

        def fill(*arguments: Any, **row: Any) -> None:
            disk.fill()
            plain(*arguments, **row)

        monkeypatch.setattr(Board, "scalars", fill)
        done = run_here(monkeypatch, "map", tmp_path / "run", *options)
    assert done.status == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"gmmtorch: error: {done.folder / 'tensorboard'} cannot be written: ")
    assert f" Saved in {done.folder}: above.png, " in line
    assert "map.safetensors" in line
    assert GaussianMap.load(done.folder / "map.safetensors").n_components
