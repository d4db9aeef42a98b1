"""gmmtorch-explore: what a mission writes, and options that reach it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from cli.command_runs import Finished, run_here, succeeded
from cli.explore.explore_cases import FIELDS

import gmmtorch
from gmmtorch.mapping.gaussian_map import GaussianMap

# -- a whole mission -------------------------------------------------------------------------------


def test_results_have_the_documented_fields(mission, row):
    results = mission.results()
    assert list(results) == ["command", "version", "seed", "config", "rows"]
    assert results["command"] == "explore"
    assert results["version"] == gmmtorch.__version__
    assert results["seed"] == results["config"]["seed"] == row["seed"] == 0
    assert results["config"]["sensor"]["width"] == 48
    assert row.keys() >= FIELDS
    about = ["framework", "world", "n_robots", "duration", "planner", "information", "coordination"]
    assert [row[name] for name in about] == ["gmm_shared", "room", 2, 9, "mcts", "csqmi", "greedy"]


def test_curves_have_a_value_at_each_time_and_end_at_the_fields_of_the_row(row):
    assert row["times"] == [0, 2, 4, 6, 8, 9]  # the end is always sampled
    for name in ("entropy_bits", "bytes_over_time", "raw_points_bytes_over_time"):
        assert len(row[name]) == 6
    assert [len(curve) for curve in row["entropy_bits_per_robot"]] == [6, 6]
    assert row["entropy_bits"][0] == row["observable_bits"]  # one bit per unknown cell
    assert row["observable_bits"] - row["entropy_bits"][-1] == row["entropy_reduction_bits"] > 0
    assert row["bytes_over_time"][-1] == row["bytes_sent"] == sum(row["bytes_by_kind"].values())
    assert row["raw_points_bytes_over_time"][-1] == row["bytes_raw_points"]
    assert row["bytes_raw_points"] % 12 == 0
    assert 0 < row["t50"] < row["t90"] <= 9
    assert 0 < row["bytes_sent"] < row["wire_bytes"]


def test_values_of_a_row_are_in_range(row):
    assert 0.5 < row["auc"] <= 1
    assert 0 <= row["map_disagreement"] < 0.05
    assert 0 < row["cross_entropy_bits"] < 1  # an empty map has 1
    assert 0 < row["observed_share"] <= 1
    assert 0 <= row["overlap"] <= 1
    assert row["collisions"] == 0
    cells = row["observed_share"] * row["observable_bits"]
    assert row["coverage_per_metre"] == pytest.approx(cells * 0.2**3 / row["path_length"])
    assert 0 < row["path_length"] <= 2 * 9 * math.hypot(1.5, 0.75)


def test_trajectories_have_the_length_of_the_row(mission, row):
    with np.load(mission.folder / "trajectories.npz") as kept:
        paths = [kept[f"robot_{n}"] for n in range(2)]
        assert set(kept) == {"robot_0", "robot_1"}
    for path in paths:
        assert path.shape == (10, 4)  # the start, and each second
        assert np.isfinite(path).all()
    chords = sum(np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1).sum() for path in paths)
    assert 0.7 * row["path_length"] < chords <= row["path_length"] + 1e-9
    apart = np.linalg.norm(paths[0][:, :3] - paths[1][:, :3], axis=1)
    assert apart.min() > 0.6


def test_the_run_directory_holds_figures_events_and_map(mission):
    files = mission.files()
    assert {"results.json", "map.safetensors", "trajectories.npz", ".hydra/overrides.yaml"} <= files
    assert any(name.startswith("trials/") and name.endswith("/row.json") for name in files)
    pictures = {name for name in files if name.endswith(".png")}
    names = "bandwidth entropy mixture team_map trajectories"
    assert pictures == {f"{name}.png" for name in names.split()}
    for name in pictures:
        assert (mission.folder / name).read_bytes().startswith(b"\x89PNG")
    assert not [name for name in files if Path(name).name.startswith(".") and "/" not in name]


def test_the_event_file_holds_curves_figures_and_growing_scenes(mission, row):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.util.tensor_util import make_ndarray

    events = EventAccumulator(str(mission.folder / "tensorboard")).Reload()
    curves = {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
    assert all(len(curve) > 1 for curve in curves.values())
    names = [tag.rpartition("/")[2] for tag in curves if "robot_" not in tag]
    assert len(set(names)) == len(names)  # each curve once
    assert "results/text_summary" in events.Tags()["tensors"]
    live = events.Scalars("mission/entropy_bits")
    assert [event.step for event in live] == row["times"]
    assert [event.value for event in live] == pytest.approx(row["entropy_bits"], rel=1e-6)
    flown = sum(events.Scalars(f"mission/robot_{n}/path_length")[-1].value for n in (0, 1))
    assert flown == pytest.approx(row["path_length"], rel=1e-6)
    assert {f"figures/{name}" for name in ("entropy", "team_map")} <= set(events.Tags()["images"])
    paths, mixture = (events.Tensors(f"{name}_VERTEX") for name in ("paths", "mixture"))
    times = [event.step for event in paths]
    assert times == [event.step for event in mixture]
    assert (len(times), times[-1]) == (4, 9)
    with np.load(mission.folder / "trajectories.npz") as kept:
        poses = [kept[f"robot_{n}"][:, :3] for n in range(2)]
    for event in paths:
        expected = np.concatenate([path[: event.step + 1] for path in poses])
        np.testing.assert_allclose(make_ndarray(event.tensor_proto)[0], expected, rtol=1e-6)
    sizes = [make_ndarray(event.tensor_proto).shape[1] for event in mixture]
    made = GaussianMap.load(mission.folder / "map.safetensors").components()
    surfaces = int((~made.max_range).sum())
    assert 0 < sizes[0] < sizes[-1]
    assert sizes[-1] % surfaces == 0  # vertices of each ellipsoid


def test_the_mixture_is_a_map_that_can_be_queried_and_exported(mission, row, monkeypatch, tmp_path):
    source, target = mission.folder / "map.safetensors", tmp_path / "mixture.npz"
    made = GaussianMap.load(source)
    with np.load(mission.folder / "trajectories.npz") as kept:
        path = torch.from_numpy(kept["robot_0"][:, :3])
    assert bool((made.occupancy(path, resolution=0.2)[1:] < 0.5).all())  # a robot flew there
    assert float(made.occupancy(path[:1] + 500, resolution=0.2)) == pytest.approx(0.5)
    options = [f"path={source}", f"output={target}", "format=npz", "report.progress=false"]
    succeeded(run_here(monkeypatch, "export", tmp_path / "export", *options))
    with np.load(target) as kept:
        sizes = {len(kept[name]) for name in kept if kept[name].ndim}
    assert 10 < max(sizes) <= row["n_components"]


def test_the_command_prints_a_table_and_progress(mission):
    lines = mission.stdout.splitlines()
    assert "room: 2 robots" in lines
    (line,) = (line for line in lines if line.startswith("gmm_shared "))
    assert line.split()[:3] == ["gmm_shared", "0", "mcts"]
    assert str(mission.folder / "results.json") in mission.stdout
    assert f"tensorboard --logdir {mission.folder / 'tensorboard'}" in mission.stdout
    assert "nan" not in mission.stdout.lower()
    assert "simulated seconds" in mission.stderr
    assert "% of the entropy left" in mission.stderr
    assert "x real time" in mission.stderr
    assert "Traceback" not in mission.stderr
    assert "Warning" not in mission.stderr
    assert "%|" not in mission.stdout


# -- options ---------------------------------------------------------------------------------------


def test_teams_of_grids_leave_no_mixture(run):
    done = succeeded(run("team=grid_isolated", "planner=frontier"))
    (row,) = done.results()["rows"]
    assert (row["framework"], row["planner"], row["n_components"]) == ("grid_isolated", "frontier", None)
    assert "map.safetensors" not in done.files()


def test_options_reach_the_mission(run):
    options = ["information=fsmi", "coordination=myopic", "network.loss=0.5", "world.resolution=0.25"]
    cut = {"begin": 1.0, "end": 9.0, "groups": [[0], [1]]}  # until after the mission
    options += ["network.jitter=0.02", "network.duplication=0.5", "network.reach=15", "network.delay=0.1"]
    options += ["network.partitions=[{begin: 1, end: 9, groups: [[0], [1]]}]", "duration=4"]
    options += ["network.announce=1.5", "network.budget=2000"]
    options += ["evaluation.codecs=[octree]", "team.start=[[2,3,1.5,0],[5,3,1.5,3]]"]
    done = succeeded(run(*options))
    (row,) = done.results()["rows"]
    names = ["information", "coordination", "loss", "resolution"]
    assert [row[name] for name in names] == ["fsmi", "myopic", 0.5, 0.25]
    names = ["delay", "jitter", "duplication", "reach", "partitions", "announce", "budget"]
    assert [row[name] for name in names] == [0.1, 0.02, 0.5, 15.0, [cut], 1.5, 2000.0]
    assert row["bytes_by_kind"]["announcements"] > 0
    assert row["reception"]["cut_off"] > 0
    assert 0 < row["bytes_octree"] < row["bytes_raw_points"]
    with np.load(done.folder / "trajectories.npz") as kept:
        assert kept["robot_0"][0].tolist() == [2, 3, 1.5, 0]
        assert kept["robot_1"][0].tolist() == [5, 3, 1.5, 3]
    assert row["missing_share"][-1] > 0
    assert row["converged_after"] > 0
    assert len(GaussianMap.load(done.folder / "map.safetensors").components()) == row["n_components"]


def test_jobs_of_a_sweep_have_folders_and_are_not_run_again_in_them(run, steps, tmp_path):
    for _ in range(2):
        done = succeeded(run("-m", "seed=0,1", f"hydra.sweep.dir={tmp_path / 'sweep'}"))
        for number in (0, 1):
            job = Finished(0, "", "", tmp_path / "sweep" / str(number))
            assert job.results()["seed"] == job.results()["rows"][0]["seed"] == number
        assert not (done.folder / "results.json").exists()
        assert steps == [0, 1, 0, 1]
    succeeded(run("-m", "seed=0", f"hydra.sweep.dir={tmp_path / 'sweep'}", "report.figures=true"))
    assert steps == [0, 1] * 3  # to draw the figures
