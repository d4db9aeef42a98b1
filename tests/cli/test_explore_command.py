"""gmmtorch-explore: what a mission and a study write, how a study continues, and bad input."""

from __future__ import annotations

import itertools
import math
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from command_runs import (
    CHECKOUT,
    COMMANDS,
    QUIET,
    Finished,
    environment,
    refused,
    run_here,
    succeeded,
    timeless,
)

import gmmtorch
from gmmtorch.cli import explore, export
from gmmtorch.mapping.gaussian_map import GaussianMap

Run = Callable[..., Finished]

FIELDS = {
    "framework", "seed", "world", "n_robots", "duration", "times", "entropy_bits", "entropy_bits_per_robot",
    "observable_bits", "entropy_reduction_bits", "t50", "t90", "bytes_sent", "bytes_raw_points", "datagrams",
    "map_disagreement", "auc", "cross_entropy_bits", "collisions", "path_length", "coverage_per_metre",
    "overlap", "wall_seconds",
}  # fmt: skip
SMALL = ["team.size=2", "sensor.width=48", "sensor.height=36", "runtime.workers=1"]
ROOM = (7.0, 6.0, 3.0)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mesh: the six walls of an empty room, two triangles each."""
    path = tmp_path_factory.mktemp("mesh") / "room.obj"
    corners = [f"v {x} {y} {z}" for x, y, z in itertools.product(*((0.0, side) for side in ROOM))]
    walls = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    faces = [f"f {a} {b} {c}\nf {a} {c} {d}" for a, b, c, d in walls]
    path.write_text("\n".join([*corners, *faces, ""]))
    return path


@pytest.fixture(scope="module", autouse=True)
def with_these_commands(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The commands of this file, with a cache of worlds of their own."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setitem(COMMANDS, "explore", explore)
        monkeypatch.setitem(COMMANDS, "export", export)
        monkeypatch.setenv("GMMTORCH_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def run_in(monkeypatch: pytest.MonkeyPatch, folder: Path, room: Path, *options: str) -> Finished:
    """Two robots in the room for two seconds, without figures unless told otherwise."""
    defaults = [*QUIET, *SMALL, "world=mesh", f"world.path={room}", "duration=2", "evaluation.every=2"]
    chosen = {option.split("=")[0] for option in options}  # Hydra accepts a group only once
    kept = [option for option in defaults if option.split("=")[0] not in chosen]
    return run_here(monkeypatch, "explore", folder, *kept, *options)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, room: Path) -> Run:
    def run_command(*options: str, name: str = "run") -> Finished:
        return run_in(monkeypatch, tmp_path / name, room, *options)

    return run_command


# -- a whole mission ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory, room: Path) -> Iterator[Finished]:
    """Nine seconds in the room, with everything that the command writes."""
    shown = [f"report.{name}=true" for name in ("progress", "figures", "tensorboard")]
    with pytest.MonkeyPatch.context() as monkeypatch:
        folder = tmp_path_factory.mktemp("explore") / "run"
        yield succeeded(run_in(monkeypatch, folder, room, "duration=9", *shown))


@pytest.fixture(scope="module")
def row(mission: Finished) -> dict[str, Any]:
    (only,) = mission.results()["rows"]
    return dict(only)


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
    names = "bandwidth entropy mixture profile team_map trajectories"
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


# -- options --------------------------------------------------------------------------------------


def test_equal_runs_give_equal_rows_and_another_seed_gives_others(run):
    first, again, other = (
        succeeded(run(f"seed={seed}", name=name)) for seed, name in ((1, "a"), (1, "b"), (2, "c"))
    )
    assert timeless(first.results()) == timeless(again.results())
    assert timeless(first.results())["rows"] != timeless(other.results())["rows"]
    assert first.stderr == ""
    assert not [name for name in first.files() if name.endswith(".png") or "tfevents" in name]


@pytest.mark.parametrize("team", ["grid_shared", "grid_isolated"])
def test_teams_of_grids_leave_no_mixture(team, run):
    done = succeeded(run(f"team={team}", "planner=frontier"))
    (row,) = done.results()["rows"]
    assert (row["framework"], row["planner"], row["n_components"]) == (team, "frontier", None)
    assert "map.safetensors" not in done.files()


def test_options_reach_the_mission(run):
    options = ["information=fsmi", "coordination=myopic", "network.loss=0.5", "world.resolution=0.25"]
    cut = {"begin": 1.0, "end": 3.0, "groups": [[0], [1]]}
    options += ["network.jitter=0.02", "network.duplication=0.5", "network.reach=15", "network.delay=0.1"]
    options += ["network.partitions=[{begin: 1, end: 3, groups: [[0], [1]]}]", "duration=4"]
    options += ["network.announce=1.5", "network.budget=2000"]
    options += ["evaluation.codecs=[octree]", "team.start=[[2,3,1.5,0],[5,3,1.5,3]]", "planner.prior=0.5"]
    done = succeeded(run(*options))
    (row,) = done.results()["rows"]
    names = ["information", "coordination", "loss", "resolution", "planning_prior"]
    assert [row[name] for name in names] == ["fsmi", "myopic", 0.5, 0.25, 0.5]
    names = ["delay", "jitter", "duplication", "reach", "partitions", "announce", "budget"]
    assert [row[name] for name in names] == [0.1, 0.02, 0.5, 15.0, [cut], 1.5, 2000.0]
    assert row["bytes_by_kind"]["announcements"] > 0
    assert row["reception"]["cut_off"] > 0
    assert 0 < row["bytes_octree"] < row["bytes_raw_points"]
    with np.load(done.folder / "trajectories.npz") as kept:
        assert kept["robot_0"][0].tolist() == [2, 3, 1.5, 0]
        assert kept["robot_1"][0].tolist() == [5, 3, 1.5, 3]


def test_the_map_is_that_of_the_end_of_the_mission(run):
    cut = "network.partitions=[{begin: 0, end: 4, groups: [[0], [1]]}]"  # until after the mission
    done = succeeded(run(cut))
    (row,) = done.results()["rows"]
    assert row["missing_share"][-1] > 0
    assert row["converged_after"] > 0
    made = GaussianMap.load(done.folder / "map.safetensors")
    assert len(made.components()) == row["n_components"]


def test_jobs_of_a_sweep_have_folders_and_are_not_run_again_in_them(run, steps, tmp_path):
    for _ in range(2):
        done = succeeded(run("-m", "seed=0,1", f"hydra.sweep.dir={tmp_path / 'sweep'}"))
        for number in (0, 1):
            job = Finished(0, "", "", tmp_path / "sweep" / str(number))
            assert job.results()["seed"] == job.results()["rows"][0]["seed"] == number
        assert not (done.folder / "results.json").exists()
        assert steps == [0, 1, 0, 1]
    succeeded(run("-m", "seed=0,1", f"hydra.sweep.dir={tmp_path / 'sweep'}", "report.figures=true"))
    assert steps == [0, 1] * 4  # to draw the figures


# -- studies --------------------------------------------------------------------------------------

STUDY = [
    "experiment=fig4_4_entropy",
    "study.seeds=[0,1]",
    "study.variants=[{team:grid_shared},{team:grid_isolated}]",
]


def test_a_study_has_a_row_for_each_trial_and_runs_none_again(run, steps):
    done = succeeded(run(*STUDY, "report.figures=true", "report.tensorboard=true", "report.progress=true"))
    rows = done.results()["rows"]
    assert [(row["framework"], row["seed"]) for row in rows] == [
        ("grid_shared", 0),
        ("grid_isolated", 0),
        ("grid_shared", 1),
        ("grid_isolated", 1),
    ]
    assert all(row.keys() >= FIELDS for row in rows)
    shared = [row["entropy_reduction_bits"] for row in rows if row["framework"] == "grid_shared"]
    assert all(row["reference_bits"] == pytest.approx(sum(shared) / 2) for row in rows)
    pictures = {name for name in done.files() if name.endswith(".png")}
    assert pictures == {"entropy.png", "bandwidth.png", "summary.png", "profile.png"}
    assert any("tfevents" in name for name in done.files())
    summary = (done.folder / "summary.md").read_text()
    assert summary.startswith("| 2 seeds: mean (range) | E1")
    assert "95 % interval" in summary
    assert len(list(done.folder.rglob("trajectories.npz"))) == 4
    assert re.search(r"simulated seconds: +\d+%.* \d/8 ", done.stderr)
    assert "of the entropy left" in done.stderr
    assert len(steps) == 4 * 2

    again = succeeded(run(*STUDY))
    assert len(steps) == 4 * 2
    assert again.results()["rows"] == rows  # equal times too: the rows were read
    longer = succeeded(run(*STUDY, "study.seeds=[0]", "duration=3"))
    assert len(steps) == 4 * 2 + 2 * 3
    assert [row["duration"] for row in longer.results()["rows"]] == [3, 3]


def test_a_study_of_planners_compares_them(run):
    variants = "study.variants=[{planner:frontier},{planner:random}]"
    options = ["experiment=planners", "study.seeds=[0]", variants, "report.figures=true"]
    done = succeeded(run(*options))
    assert [row["planner"] for row in done.results()["rows"]] == ["frontier", "random"]
    assert {name for name in done.files() if name.endswith(".png")} == {"planners.png", "profile.png"}


def test_a_study_of_networks_compares_them_with_the_lossless_one(run):
    cut = "partitions:[{begin:1,end:3,groups:[[0],[1]]}]"
    variants = f"study.variants=[{{}},{{loss:0.5}},{{{cut}}},{{team:grid_shared}}]"
    options = ["experiment=fig4_5_bandwidth", "study.seeds=[0]", variants, "evaluation.codecs=[]"]
    done = succeeded(run(*options, "report.figures=true", "duration=5", "evaluation.every=1"))
    pictures = {name for name in done.files() if name.endswith(".png")}
    assert pictures == {"loss.png", "entropy.png", "bandwidth.png", "summary.png", "profile.png"}
    lossless, lossy, parted, grids = done.results()["rows"]
    for row in (lossless, lossy, parted, grids):
        assert row["bits_per_byte"] == row["entropy_reduction_bits"] / row["wire_bytes"]
    assert lossless["wire_ratio"] == grids["wire_ratio"] == 1
    assert lossy["wire_ratio"] == lossy["wire_bytes"] / lossless["wire_bytes"]
    assert max(parted["missing_share"]) > max(lossless["missing_share"][2:])
    lines = [line for line in done.stdout.splitlines() if line.startswith("E")]
    names = ["E0, lossless", "E0, 50 % lost", "E0, partition 0 | 1, 1–3 s", "E1, lossless"]
    assert [any(line.startswith(f"{name} ") for line in lines) for name in names] == [True] * 4


def test_a_study_of_deviations_compares_each_with_ours(run):
    variants = (
        "{team:gmm_shared},{team:gmm_shared,shell:0},{team:gmm_shared,update_stride:null},{team:gmm_thesis}"
    )
    options = ["experiment=deviations", "study.seeds=[0]", f"study.variants=[{variants}]"]
    done = succeeded(run(*options, "report.figures=true", "report.tensorboard=true"))
    pictures = {name for name in done.files() if name.endswith(".png")}
    assert pictures == {"deviations.png", "entropy.png", "bandwidth.png", "summary.png", "profile.png"}
    rows = done.results()["rows"]
    assert [(row["framework"], row["shell"], row["update_stride"], row["codec"]) for row in rows] == [
        ("gmm_shared", 0.5, 11, "quantized"),
        ("gmm_shared", 0.0, 11, "quantized"),
        ("gmm_shared", 0.5, None, "quantized"),
        ("gmm_thesis", 0.0, None, "thesis"),
    ]
    head = (done.folder / "summary.md").read_text().splitlines()[0]
    assert head == "| 1 seeds: mean (range) | E0 | E0, shell=0 | E0, update_stride=null | thesis |"
    (alone,) = timeless(succeeded(run("team=gmm_thesis", name="alone")).results())["rows"]
    (same,) = timeless({"rows": rows[3:]})["rows"]
    assert {name: same[name] for name in alone if name not in ("t50", "t90", "reference_bits")} == {
        name: value for name, value in alone.items() if name not in ("t50", "t90", "reference_bits")
    }


def test_a_trial_of_a_study_equals_the_single_mission(run):
    (alone,) = timeless(succeeded(run("team=grid_shared", "seed=1")).results())["rows"]
    options = ["experiment=fig4_5_bandwidth", "study.seeds=[1]", "study.variants=[{team:grid_shared}]"]
    (trial,) = timeless(succeeded(run(*options, name="study")).results())["rows"]
    added = {name for name in trial if name.removesuffix("_bytes_over_time") in ("octree", "draco")}
    added |= {"bytes_octree", "bytes_draco"}
    assert trial.keys() - alone.keys() == added
    assert {name: value for name, value in trial.items() if name not in added} == alone


def test_variants_that_differ_in_one_option_are_different_trials(run, steps):
    cut = "partitions:[{begin:0,end:1,groups:[[0]]}]"
    variants = f"study.variants=[{{loss:0.5}},{{planning_prior:0.5}},{{{cut}}},{{delay:0.2}},{{budget:9}}]"
    options = ["experiment=fig4_4_entropy", "study.seeds=[0]", variants, "duration=1"]
    for _ in range(2):
        succeeded(run(*options))
        assert len(steps) == 5


def start(folder: Path, *options: str, temporary: Path | None = None) -> subprocess.Popen[bytes]:
    """The command in a process of its own."""
    script = str(CHECKOUT / "scripts" / "explore.py")
    return subprocess.Popen(
        [sys.executable, script, f"hydra.run.dir={folder}", *options],
        cwd=folder.parent,
        env=environment() | ({} if temporary is None else {"TMPDIR": str(temporary)}),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + 90
    while time.monotonic() < deadline and process.poll() is None and not condition():
        time.sleep(0.02)
    assert condition()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals are those of POSIX")
def test_a_killed_study_keeps_finished_trials_and_runs_the_others(run, room, steps, tmp_path):
    killed = tmp_path / "run"
    with start(
        killed, *QUIET, *SMALL, "world=mesh", f"world.path={room}", "duration=2", "evaluation.every=2", *STUDY
    ) as process:
        try:
            wait_until(lambda: any(killed.rglob("row.json")), process)
        finally:
            process.kill()
        process.communicate(timeout=30)
    n_kept = len([*killed.rglob("row.json")])
    assert n_kept < 4
    continued = succeeded(run(*STUDY))
    assert len(steps) == (4 - n_kept) * 2
    whole = succeeded(run(*STUDY, name="whole"))
    assert timeless(continued.results())["rows"] == timeless(whole.results())["rows"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals are those of POSIX")
def test_no_process_of_a_killed_study_survives(room, tmp_path):
    killed, temporary = tmp_path / "killed", tmp_path / "temporary"
    temporary.mkdir()
    small = [option for option in SMALL if "workers" not in option]
    options = [
        *QUIET,
        *small,
        "world=mesh",
        f"world.path={room}",
        "duration=1e6",
        "runtime.workers=2",
        *STUDY,
    ]
    with start(killed, *options, *STUDY, temporary=temporary) as process:
        try:
            wait_until(lambda: len([*killed.glob("trials/*")]) == 2, process)
            time.sleep(1.0)
        finally:
            process.kill()
        process.communicate(timeout=60)  # ends once no process can write to the pipe
    assert process.returncode == -signal.SIGKILL


# -- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("team.size=0", "team.size=0"),
        ("team.size=99", "team.size=99 31"),
        ("team.start=[[0,3,1.5,0],[3,3,1.5,0]]", "team.start[0] surface"),
        ("team.start=[[3,3,1.5,0],[50,3,1.5,0]]", "team.start[1] outside bounds room"),
        ("team.start=[[3,3,1.5,0],[3,3.2,1.5,0]]", "team.start[1] touches"),
        ("team.start=[[3,3,1.5,0]]", "team.start 2 robots"),
        ("team.start=[[3,3,1.5,a],[2,2,1.5,0]]", "team.start"),
        ("team.start=[3,3]", "team.start"),
        ("team.start=[[nan,3,1.5,0],[2,2,1.5,0]]", "team.start[0] finite"),
        ("world.path=/no/where.ply", "world.path=/no/where.ply"),
        ("world.bounds=[20,20,0,30,30,3]", "world.bounds=[20.0, do not meet room"),
        ("world.bounds=[0,0,0,3]", "world.bounds= six"),
        ("world.resolution=0", "world.resolution=0.0"),
        ("sensor.horizontal_fov=0", "sensor.horizontal_fov=0.0"),
        ("sensor.max_range=0", "sensor.max_range=0.0"),
        ("sensor.max_range=0.05", "sensor.max_range=0.05 robot.radius world.resolution"),
        ("duration=2.5", "duration=2.5 sensor.rate"),
        ("sensor.rate=0", "sensor.rate=0.0"),
        ("sensor.noise=-1", "sensor.noise=-1.0"),
        ("sensor.rate=0.7", "sensor.rate=0.7 robot.duration"),
        ("duration=-1", "duration=-1.0"),
        ("robot.duration=-1", "robot.duration=-1.0"),
        ("network.loss=1", "network.loss=1.0"),
        ("network.bandwidth=0", "network.bandwidth=0.0"),
        ("network.delay=-1", "network.delay=-1.0 time"),
        ("network.jitter=-1", "network.jitter=-1.0 time"),
        ("network.duplication=2", "network.duplication=2.0"),
        ("network.reach=0", "network.reach=0.0 metres"),
        ("network.partitions=[{begin:2,end:1,groups:[[0]]}]", "network.partitions[0]= begin end"),
        ("network.partitions=[{begin:0,end:1,groups:[[0,2]]}]", "network.partitions[0].groups= 2"),
        ("network.partitions=[{begin:0,end:1,groups:[[0,1]]}]", "network.partitions[0].groups= leave it out"),
        ("network.partitions=[cut]", "network.partitions[0]='cut'"),
        ("network.announce=0", "network.announce=0.0 seconds"),
        ("network.budget=0", "network.budget=0.0 bytes"),
        ("map.window=[8,8]", "map.window=[8, three"),
        ("map.window=[8,8,8]", "map.window=[8, sensor.max_range"),
        ("map.rays=0", "map.rays=0.0"),
        ("map.noise=0", "map.noise=0.0"),
        ("map.observed=-1", "map.observed=-1.0"),
        ("planner.prior=0", "planner.prior=0.0"),
        ("planner.beams=0", "planner.beams=0"),
        ("information=x", "information='x' csqmi fsmi"),
        ("coordination=x", "coordination='x' myopic greedy"),
        ("rounds=0", "rounds=0"),
        ("codec=zip", "codec='zip' quantized thesis"),
        ("transport=zenoh", "transport='zenoh' in_process"),
        ("evaluation.codecs=[jpeg]", "evaluation.codecs 'jpeg' octree draco"),
        ("evaluation.every=0", "evaluation.every=0.0"),
        ("belief.clamp=0.6", "belief.clamp=0.6"),
        ("belief.prior=-1", "belief.prior=-1.0"),
        ("robot.radius=5", "robot.radius=5.0 room"),
        ("runtime.threads=0", "runtime.threads=0"),
        ("runtime.device=meta", "runtime.device=meta"),
        ("seed=-1", "seed=-1"),
        ("checkpoint.folder=kept", "checkpoint.folder=kept hydra.run.dir=RUN"),
        ("checkpoint.every=4", "checkpoint.every=4.0 hydra.run.dir=RUN"),
        ("experiment=fig4_4_entropy runtime.workers=0", "runtime.workers=0"),
        ("experiment=fig4_4_entropy study.name=other", "study.name='other' trials"),
        ("experiment=fig4_4_entropy study.variants=[]", "study.variants study.seeds"),
        ("planner.rest=1.5", "planner.rest=1.5"),
        ("experiment=fig4_4_entropy study.variants=[{colour:1}]", "study.variants colour team planner"),
        ("experiment=fig4_4_entropy study.variants=[{team:x}]", "team='x' gmm_shared"),
        ("experiment=fig4_4_entropy study.variants=[{announce:0}]", "study.variants: announce=0"),
        ("experiment=fig4_4_entropy study.seeds=[-1]", "seed=-1"),
    ],
)
def test_a_bad_value_is_named_in_one_line(options, words, run):
    line = refused(run(*options.split()))
    for word in words.split():  # as a whole: duration= is not robot.duration=
        assert re.search(rf"(?<![\w.]){re.escape(word)}", line), (word, line)


def test_bad_values_are_found_before_the_first_tick(run, steps):
    for options in (["network.loss=1"], ["information=x"], ["map.window=[8,8,8]"], ["sensor.rate=0.7"]):
        refused(run(*options))
    refused(run("checkpoint.every=60"))
    assert steps == []


def test_a_recording_without_rerun_is_found_before_the_first_tick(run, steps, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert "pip install 'gmmtorch[viewer]'" in refused(run("report.recording=true"))
    assert steps == []


@pytest.mark.parametrize(
    "options",
    [
        "team.start=3",
        "experiment=fig4_4_entropy study.seeds=[]",
        "experiment=fig4_4_entropy study.variants=[{loss:high}]",
        "experiment=fig4_4_entropy study.variants=[{budget:high}]",
    ],
)
def test_a_value_of_the_wrong_kind_is_named_in_one_line(options, run):
    name = options.split()[-1].split("=")[0].split(".")[-1]
    assert name in refused(run(*options.split(), "study.seeds=[0]" if "high" in options else "seed=0"))


def test_a_bad_variant_is_found_before_the_first_tick(run, steps):
    variants = "study.variants=[{team:grid_isolated},{loss:1}]"
    assert "study.variants: loss=1 " in refused(run("experiment=fig4_4_entropy", "study.seeds=[0]", variants))
    assert steps == []


def test_a_missing_mesh_is_named(monkeypatch, tmp_path):
    line = refused(run_here(monkeypatch, "explore", tmp_path / "run", *QUIET, *SMALL, "world=mesh"))
    assert "world=mesh needs world.path=FILE" in line


@pytest.mark.parametrize("size", ["[12,10]", "[12,10,3.5]", "[1,1,1]", "[nan,20,4]"])
@pytest.mark.parametrize("world", ["warehouse", "tunnels"])
def test_a_too_small_world_names_the_least_size(world, size, monkeypatch, tmp_path):
    options = [*QUIET, *SMALL, f"world={world}", f"world.size={size}"]
    assert "at least (" in refused(run_here(monkeypatch, "explore", tmp_path / "run", *options))


@pytest.mark.parametrize(
    "kind",
    [
        "truncated.ply",
        "text.ply",
        "cloud.xyz",
        "text.obj",
        "text.stl",
    ],
)
def test_a_file_that_is_not_a_mesh_is_named(kind, run, tmp_path, room):
    path = tmp_path / kind
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    texts = {"truncated.ply": f"{header}0 0 0\n1 0 0\n", "cloud.xyz": "0 0 0\n1 1 1\n"}
    path.write_text(texts.get(kind, "no mesh at all\n"))
    assert str(path) in refused(run(f"world.path={path}"))


def test_half_a_mesh_is_rejected(run, tmp_path, room):
    path = tmp_path / "half.obj"
    path.write_text(room.read_text()[:-60])
    line = refused(run(f"world.path={path}", "robot.radius=3"))
    assert "half" in line


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("duration=long", "duration=long could not be converted to Float"),
        ("team.size=two", "team.size=two could not be converted to Integer"),
        ("team=gmm", "team=gmm does not exist gmm_shared grid_isolated"),
        ("world=moon", "world=moon does not exist tunnels warehouse"),
        (
            "world.size=[10,10,3]",
            "world.size is not an option with world=mesh another choice of world= has it",
        ),
        ("sensor.widht=3", "sensor.widht is not an option did you mean sensor.width?"),
        ("runtime.memory_limit=1000", "runtime.memory_limit is not an option"),
    ],
)
def test_wrong_types_and_unknown_options_are_explained_without_a_traceback(option, words, run):
    done = run(option)
    assert done.status == 1
    assert "Traceback" not in done.stderr
    assert all(word in done.stderr for word in words.split()), done.stderr
    assert not done.folder.exists()


def test_robots_that_never_left_their_start_are_reported(caplog):
    robots = [
        SimpleNamespace(number=number, path_length=length) for number, length in enumerate((0.0, 3.0, 0.0))
    ]
    explore.warn_of_robots_at_their_start(SimpleNamespace(robots=robots, elapsed=29.0))
    assert not caplog.messages
    explore.warn_of_robots_at_their_start(SimpleNamespace(robots=robots, elapsed=30.0))
    (said,) = caplog.messages
    assert "0, 2" in said
    assert "team.start" in said
    explore.warn_of_robots_at_their_start(SimpleNamespace(robots=robots[1:2], elapsed=60.0))
    assert len(caplog.messages) == 1
