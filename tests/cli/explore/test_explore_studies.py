"""gmmtorch-explore: what a study writes, and how it continues."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from cli.command_runs import CHECKOUT, QUIET, environment, succeeded, timeless
from cli.explore.explore_cases import FIELDS, SMALL

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
    assert pictures == {"entropy.png", "bandwidth.png", "summary.png"}
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
    assert {name for name in done.files() if name.endswith(".png")} == {"planners.png"}


def test_a_study_of_networks_compares_them_with_the_lossless_one(run):
    cut = "partitions:[{begin:1,end:3,groups:[[0],[1]]}]"
    variants = f"study.variants=[{{}},{{loss:0.5}},{{{cut}}},{{team:grid_shared}}]"
    options = [
        "experiment=fig4_5_bandwidth",
        "study.seeds=[0]",
        variants,
        "evaluation.codecs=[]",
        "network.announce=2",
    ]
    done = succeeded(run(*options, "report.figures=true", "duration=5", "evaluation.every=1"))
    pictures = {name for name in done.files() if name.endswith(".png")}
    assert pictures == {"loss.png", "entropy.png", "bandwidth.png", "summary.png"}
    lossless, lossy, parted, grids = done.results()["rows"]
    for row in (lossless, lossy, parted, grids):
        assert row["bits_per_byte"] == row["entropy_reduction_bits"] / row["wire_bytes"]
    assert lossless["wire_ratio"] == grids["wire_ratio"] == 1
    assert lossy["wire_ratio"] == lossy["wire_bytes"] / lossless["wire_bytes"]
    assert parted["missing_share"][3] > lossless["missing_share"][3]  # after three seconds, apart for two
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
    assert pictures == {"deviations.png", "entropy.png", "bandwidth.png", "summary.png"}
    rows = done.results()["rows"]
    assert [(row["framework"], row["shell"], row["update_stride"], row["codec"]) for row in rows] == [
        ("gmm_shared", 0.5, 11, "quantized"),
        ("gmm_shared", 0.0, 11, "quantized"),
        ("gmm_shared", 0.5, None, "quantized"),
        ("gmm_thesis", 0.0, None, "thesis"),
    ]
    head = (done.folder / "summary.md").read_text().splitlines()[0]
    assert head == "| 1 seeds: mean (range) | E0 | E0, shell=0 | E0, update_stride=null | thesis |"


def test_a_trial_of_a_study_equals_the_single_mission(run):
    single = succeeded(run("seed=1"))
    assert single.stderr == ""
    assert not [name for name in single.files() if name.endswith(".png") or "tfevents" in name]
    (alone,) = timeless(single.results())["rows"]
    options = ["experiment=fig4_5_bandwidth", "study.seeds=[1,2]", "study.variants=[{team:gmm_shared}]"]
    trial, other = timeless(succeeded(run(*options, name="study")).results())["rows"]
    added = {name for name in trial if name.removesuffix("_bytes_over_time") in ("octree", "draco")}
    added |= {"bytes_octree", "bytes_draco"}
    assert trial.keys() - alone.keys() == added
    for name in ("t50", "t90", "reference_bits"):  # of all seeds
        added.add(name)
        del alone[name]
    assert {name: value for name, value in trial.items() if name not in added} == alone
    assert other["entropy_bits"] != trial["entropy_bits"]


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
        "workers=2",
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
