"""gmmtorch-localize: poses of a recording in a saved map, its files, scores, messages and errors."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import torch
from command_runs import QUIET, Finished, refused, run_here, succeeded
from sensor_bags import BagWriter

from gmmtorch.datasets import Dataset, load, read_trajectory
from gmmtorch.export.trajectory_files import write_tum
from gmmtorch.mapping.gaussian_map import GaussianMap

N = 30  # scans of a circuit of the flat building
RECORDING = ["dataset=synthetic_building_2d", f"dataset.n_scans={N}"]


@pytest.fixture(scope="module")
def scans() -> Dataset:
    return load("synthetic_building_2d", n_scans=N)


@pytest.fixture(scope="module")
def saved(tmp_path_factory, scans) -> Path:
    """A run directory with a map."""
    built = GaussianMap()
    for scan in scans:
        built.insert(scan)
    folder = tmp_path_factory.mktemp("map")
    built.save(folder / "map.safetensors")
    return folder


@pytest.fixture
def run(monkeypatch, tmp_path, saved):
    def localize(*options: str) -> Finished:
        return run_here(monkeypatch, "localize", tmp_path / "run", f"map={saved}", *RECORDING, *options)

    return localize


def test_scans_are_found_and_scored_and_every_file_is_written(run, scans):
    done = succeeded(run("pose=dataset", "motion=dataset", "truth=dataset", "report.progress=false"))
    row = done.results()["rows"][0]
    assert row["n_found"] == row["n_scored"] == N
    assert row["ate"] < 0.05
    assert row["rpe"] < 0.1
    assert row["ate_degrees"] < 1
    assert row["lost"] == row["messages"] == []
    assert {"trajectory.tum", "trajectory.csv", "path.png"} <= done.files()
    assert any(name.startswith("tensorboard/") for name in done.files())
    written = read_trajectory(done.folder / "trajectory.tum").poses
    table = list(csv.DictReader((done.folder / "trajectory.csv").open()))
    assert len(written) == len(table) == N
    positions = np.array([[float(line["x"]), float(line["y"])] for line in table])
    np.testing.assert_allclose(positions, written.translation[:, :2], atol=1e-6)
    assert all(0 < float(line["cov_x_x"]) < 0.01 and line["doubts"] == "" for line in table)


def test_the_pose_may_be_given_and_the_truth_a_file(run, scans, tmp_path):
    x, y, yaw = (
        scans.pose(0)[0, 2],
        scans.pose(0)[1, 2],
        torch.atan2(scans.pose(0)[1, 0], scans.pose(0)[0, 0]),
    )
    poses = torch.stack([scans.pose(number) for number in range(N)])
    write_tum(tmp_path / "truth.tum", torch.arange(N).double(), poses)
    pose = f"pose=[{x + 0.2:.3f},{y - 0.2:.3f},{yaw + 0.1:.3f}]"
    done = succeeded(run(pose, f"truth={tmp_path / 'truth.tum'}", "motion=dataset", *QUIET))
    assert done.results()["rows"][0]["n_scored"] == N
    assert done.results()["rows"][0]["ate"] < 0.05


def test_the_imu_of_a_bag_without_poses_predicts_the_headings(monkeypatch, tmp_path, saved):
    pytest.importorskip("rosbags")
    near = load("synthetic_building_2d", n_scans=240)
    poses = torch.stack([near.pose(number) for number in range(8)])
    steps = torch.linalg.solve(poses[:-1], poses[1:])
    rates = torch.atan2(steps[:, 1, 0], steps[:, 0, 0])  # a scan a second
    with BagWriter(tmp_path / "a.mcap") as bag:
        for number, pose in enumerate(poses):
            points = (near[number].points - pose[:2, 2]) @ pose[:2, :2]
            bag.cloud("/points", number + 1.0, "lidar", torch.nn.functional.pad(points, (0, 1)))
        for time in np.arange(0.95, 8.1, 0.1):
            velocity = {"x": 0.0, "y": 0.0, "z": float(rates[min(max(int(time) - 1, 0), 6)])}
            fields = {"header": {"frame_id": "lidar"}, "angular_velocity": velocity}
            bag.message("/imu", "sensor_msgs/msg/Imu", time, fields)
    write_tum(tmp_path / "truth.tum", torch.arange(8).double() + 1, poses)
    x, y, yaw = poses[0, 0, 2], poses[0, 1, 2], torch.atan2(poses[0, 1, 0], poses[0, 0, 0])
    options = [f"map={saved}", "dataset=rosbag", f"dataset.path={tmp_path / 'a.mcap'}"]
    options += ["dataset.poses=standing", f"pose=[{x:.3f},{y:.3f},{yaw:.3f}]", "motion=imu"]
    options += [f"truth={tmp_path / 'truth.tum'}", *QUIET]
    done = succeeded(run_here(monkeypatch, "localize", tmp_path / "run", *options))
    row = done.results()["rows"][0]
    assert row["n_found"] >= 6  # the map has few scans
    assert row["ate"] < 0.05
    other = run_here(monkeypatch, "localize", tmp_path / "other", *options, "dataset.imu_topic=/imu/raw")
    assert "of several IMUs, the one with most messages is read" in refused(other)


def test_a_wrong_first_pose_is_recovered_from(run):
    done = succeeded(run("pose=[500,500,0]", "motion=dataset", "truth=dataset", *QUIET))
    row = done.results()["rows"][0]
    assert row["lost"][0]["first"] == 0
    assert row["n_found"] > 0.9 * N
    assert row["ate"] < 0.1


def test_a_map_of_another_place_is_said(monkeypatch, tmp_path, scans):
    m = GaussianMap()
    for scan in load("synthetic_building_2d", n_scans=12, seed=5):
        far = torch.eye(3).double()
        far[:2, :2] = torch.tensor([[-1.0, 0.0], [0.0, 1.0]])  # a mirror image: another building
        m.insert(type(scan)(scan.points.double() @ far[:2, :2], scan.origin.double() @ far[:2, :2]))
    m.save(tmp_path / "other.safetensors")
    short = ["dataset=synthetic_building_2d", "dataset.n_scans=60", "dataset.stride=20", *QUIET]
    done = succeeded(
        run_here(monkeypatch, "localize", tmp_path / "run", f"map={tmp_path}/other.safetensors", *short)
    )
    row = done.results()["rows"][0]
    assert row["n_found"] == 0
    assert row["ate"] is None
    assert "No scan was found: give the map of this place" in done.stdout
    assert (done.folder / "trajectory.tum").read_text().count("\n") == 1


def test_errors_are_one_line(run, monkeypatch, tmp_path, saved):
    assert "map is not set; give map=FILE" in refused(run_here(monkeypatch, "localize", tmp_path / "run"))
    assert "dataset.path is not set" in refused(
        run_here(monkeypatch, "localize", tmp_path / "run", f"map={saved}", "dataset=carmen")
    )
    assert "is 2D, and the scans of" in refused(
        run_here(monkeypatch, "localize", tmp_path / "run", f"map={saved}", "dataset.n_scans=2")
    )
    assert "pose=[1, 2] is not a pose in a 2D map; give [x,y,yaw]" in refused(run("pose=[1,2]"))
    assert "pose=here is not a pose" in refused(run("pose=here"))
    assert "motion='wheels' is not one of constant, dataset" in refused(run("motion=wheels"))
    assert "motion=imu cannot be used: it needs the IMU of a ROS bag" in refused(run("motion=imu"))
    assert "truth=none.tum does not exist" in refused(run("truth=none.tum"))
    (tmp_path / "late.tum").write_text("1000 0 0 0 0 0 0 1\n1001 0 0 0 0 0 0 1\n")
    assert "has no pose at the time of a scan" in refused(run(f"truth={tmp_path / 'late.tum'}"))
