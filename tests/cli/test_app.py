"""What all commands share: interrupts, mistyped options, version, help, completion, sweeps."""

from __future__ import annotations

import io
import logging
import os
import re
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from command_runs import COMMANDS, QUIET, Finished, refused, register_schemas, run_here, succeeded
from omegaconf import DictConfig

import gmmtorch
from gmmtorch.cli import common, options_help
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.cli import occupancy_runs
from gmmtorch.kernels import compiler
from gmmtorch.team.cli import explore


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Finished]:
    def run_command(command: str, *options: str) -> Finished:
        return run_here(monkeypatch, command, tmp_path / "run", *options)

    return run_command


def test_an_interrupt_that_python_drops_ends_the_command(monkeypatch, tmp_path):
    class Interrupted:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGINT)

    ended: list[int] = []

    def work(*_: object) -> None:
        Interrupted()
        for step in range(500):  # the interrupt arrives in the first of them
            time.sleep(0.02)
            ended.append(step)

    monkeypatch.setattr(occupancy_runs, "map_all", work)
    hook = sys.unraisablehook
    done = run_here(monkeypatch, "occupancy", tmp_path / "run", *QUIET)
    assert done.status == 130
    assert done.stderr == "gmmtorch: interrupted; all files that were written are complete.\n"
    assert len(ended) < 500
    assert sys.unraisablehook is hook


def test_a_log_call_with_wrong_arguments_ends_no_command(monkeypatch, tmp_path):
    """The handlers of logging report it; a call that is right is printed without control characters."""
    monkeypatch.setattr(logging, "raiseExceptions", False)
    logger, text = logging.Logger("a package"), io.StringIO()
    logger.addHandler(logging.StreamHandler(text))

    def work(*_: object) -> list[dict[str, float]]:
        logger.warning("%d points", "no")
        logger.warning("frame %s", "\x1b[31m")
        return [{}]

    monkeypatch.setattr(occupancy_runs, "map_all", work)
    done = run_here(monkeypatch, "occupancy", tmp_path / "run", *QUIET)
    assert done.status == 0, done.stderr
    assert text.getvalue() == "frame \\x1b[31m\n"


# -- mistyped options -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "options", "words"),
    [
        ("occupancy", "dataset.pth=x", "dataset.pth;did you mean dataset.path?"),
        ("occupancy", "dataset.path=x", "dataset.path;another choice of dataset= has it"),
        ("occupancy", "resolution=0.1", "did you mean evaluation.resolution?"),
        ("occupancy", "datset=carmen", "did you mean dataset?"),
        ("occupancy", "map=windwed", "map=windwed;did you mean map=windowed?;per_scan"),
        ("occupancy", "-m map=windowed,windwed", "did you mean map=windowed?"),
        ("occupancy", "experiment=fig4_4_entropy", "experiment=fig4_4_entropy does not exist"),
        ("occupancy", "hydra.run.dri=x", "did you mean hydra.run.dir?"),
        ("occupancy", "method=[em", "method=[em;quote"),
        ("fit", "-m mixture.n_componets=3,4", "did you mean mixture.n_components?"),
        ("robot", "dataset@log.dataset=carmn", "did you mean dataset@log.dataset=carmen?"),
        ("explore", "network.los=0.1", "did you mean network.loss?"),
        ("robot", "log.map.window=5", "log.map.window is no longer an option: give;log.map={name: windowed"),
        ("map", "map.hit_length=2", "map.hit_length is no longer an option: map.prior=1"),
        ("localize", "align=rigid", "align is no longer an option: the truth is in the frame of the map"),
        ("map", "map.cutoff=2", "map.cutoff is no longer an option: it is a constant;`GaussianMap`"),
        ("map", "map.min_points=2", "map.min_points is no longer an option: it is a constant;learning rule"),
        ("robot", "link.listen_endpoints=[]", "is no longer an option: give link.listen"),
        ("explore", "checkpoint.every=60", "checkpoint.every is no longer;continues;hydra.run.dir=RUN"),
    ],
)
def test_a_typo_names_the_nearest_option_or_choice(command, options, words, run):
    line = refused(run(command, *options.split()))
    assert all(word in line for word in words.split(";")), line
    assert "+" not in line


@pytest.mark.parametrize("launcher", ["joblib", "ray"])
@pytest.mark.parametrize("has_other_plugins", [True, False])
def test_a_launcher_that_is_not_installed_names_its_extra(launcher, has_other_plugins, monkeypatch):
    def find_spec(name: str) -> None:
        if not has_other_plugins:
            raise ModuleNotFoundError("No module named 'hydra_plugins'")

    monkeypatch.setattr(options_help, "find_spec", find_spec)
    overrides = [f"hydra/launcher={launcher}", "seed=0,1"]
    message = options_help.explained("occupancy", overrides, RuntimeError("not found"))
    assert f"hydra-{launcher}-launcher" in message
    assert "gmmtorch[sweep]" in message


@pytest.mark.parametrize("command", ["fit", "map", "ros"])
def test_fused_kernels_without_a_compiler_are_refused_by_the_name_of_the_option(command, run, monkeypatch):
    monkeypatch.setattr(compiler, "compiler_failure", lambda *_: "the package warp-lang does not load (test)")
    line = refused(run(command, "runtime.kernels=fused"))
    assert "runtime.kernels=fused needs the kernel compiler" in line
    assert "pip install 'gmmtorch[fast]', or choose runtime.kernels=auto or runtime.kernels=torch." in line


def test_a_folder_that_cannot_be_written_is_a_one_line_error(run, tmp_path):
    (tmp_path / "file").touch()
    line = refused(run("occupancy", f"hydra.run.dir={tmp_path / 'file' / 'run'}"))
    assert "hydra.run.dir" in line
    assert str(tmp_path / "file") in line
    line = refused(run("occupancy", "-m", f"hydra.sweep.dir={tmp_path / 'file' / 'runs'}"))
    assert "as in hydra.sweep.dir=" in line


# -- version, help, completion --------------------------------------------------------------------


def test_characters_that_the_encoding_of_the_output_lacks_are_no_error(monkeypatch):
    output = io.TextIOWrapper(io.BytesIO(), encoding="cp1252")
    monkeypatch.setattr(sys, "stdout", output)
    monkeypatch.setattr(sys, "argv", ["gmmtorch-explore", "--help"])
    explore.main()
    output.flush()
    assert "duplication=0.0" in output.buffer.getvalue().decode("cp1252")


def test_the_version_is_that_of_the_package(run):
    assert succeeded(run("fit", "--version")).stdout == f"gmmtorch {gmmtorch.__version__}\n"


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_describes_every_option_in_a_line(command, run):
    shown = succeeded(run(command, "--help")).stdout
    lines = shown.split("== Options, with their values ==\n")[1].split("\nFlags:")[0].splitlines()
    assert len(lines) >= 10
    for line in lines:
        value, _, about = line.partition("  ")
        assert re.fullmatch(r"[\w.]+=\S.*", value), line
        assert len(about.strip()) > 3, line
    assert "evaluation.every" not in shown or "seconds between" in shown


@pytest.mark.slow
def test_every_option_of_every_choice_is_described():
    register_schemas()
    seen = set()  # a choice has the same options in every command
    for command in COMMANDS:
        groups = options_help.groups_of(command)
        chosen = {(group, choice) for group, choices in groups.items() for choice in choices}
        for group, choice in sorted(chosen - seen):
            made = options_help.configuration(command, [f"{group}={choice}"])
            options = options_help.options_of(made)
            assert not [one for one in options if len(one.about) < 4 or one.about[-1] in ",;:"], choice
        seen |= chosen


def test_the_help_shows_the_options_of_the_chosen_data_set(run):
    shown = succeeded(run("occupancy", "--help", "dataset=depth_frames")).stdout
    assert re.search(
        r"^dataset\.pixel_stride=1 +every n-th pixel of every n-th row of depth images$", shown, re.MULTILINE
    )
    shown = succeeded(run("map", "--help", "dataset=rosbag")).stdout
    assert re.search(r"^dataset\.deskew=true +each point with a time gets", shown, re.MULTILINE)


@pytest.mark.parametrize(
    ("command", "line", "expected"),
    [
        (
            "occupancy",
            "dataset=s",
            "dataset=scan_folder dataset=synthetic_building dataset=synthetic_building_2d",
        ),
        ("occupancy", "dataset=depth_frames dataset.pix", "dataset.pixel_stride="),
        ("occupancy", "report.figures=", "report.figures=false report.figures=true"),
        ("occupancy", "map=windowed map.no", "map.noise="),
        ("fit", "experiment=s", "experiment=sensor_model experiment=strategies"),
        (
            "explore",
            "experiment=",
            "experiment=deviations experiment=fig4_4_entropy experiment=fig4_5_bandwidth experiment=planners",
        ),
        ("explore", "check", ""),
        ("export", "bounds", "bounds="),
        ("robot", "dataset@log.dataset=ca", "dataset@log.dataset=carmen"),
        ("team", "network.b", "network.budget="),
        ("view", "map.safetensors sh", "shape="),
        ("localize", "bo", "bounds="),
        ("localize", "map=a.safetensors tr", "truth="),
    ],
)
def test_completion_offers_what_the_command_can_run(command, line, expected, run, monkeypatch):
    monkeypatch.setenv("COMP_LINE", f"gmmtorch-{command} {line}")
    assert succeeded(run(command, "-sc", "query=bash")).stdout.split() == expected.split()


# -- sweeps ---------------------------------------------------------------------------------------


def test_a_sweep_prints_one_table_with_its_failed_jobs(monkeypatch, tmp_path):
    chosen = []

    def work(config: DictConfig, _: object, __: str, folder: Path, ___: object) -> list[dict[str, float]]:
        chosen.append(common.chosen_options(config))
        if config.seed == 2:
            raise InvalidArgumentError("seed=2 fails.")
        if config.seed == 3:
            raise ZeroDivisionError("a mistake")
        rows = [{"method": "point", "resolution": 0.1, "kept": 1.0, "auc": 0.5 + config.seed / 10}]
        common.write_results("occupancy", config, rows, folder)
        common.print_table(rows, ["method"], "its own table")
        return rows

    monkeypatch.setattr(occupancy_runs, "map_all", work)
    folder = tmp_path / "sweep"
    options = ["-m", "seed=1,2,3", "map.noise=0.01", f"hydra.sweep.dir={folder}"]
    done = run_here(monkeypatch, "occupancy", tmp_path / "run", *QUIET, *options)
    assert done.status == 1
    assert done.stderr == "gmmtorch: error: 2 of 3 jobs failed: 1, 2.\n"
    assert "its own table" not in done.stdout
    swept = [{name: options[name] for name in ("seed", "map.noise")} for options in chosen]  # for HParams
    assert swept == [{"seed": seed, "map.noise": 0.01} for seed in (1, 2, 3)]
    assert all(
        options.keys() <= {"seed", "map.noise", *(q.split("=")[0] for q in QUIET)} for options in chosen
    )
    table = done.stdout.split(f"3 jobs in {folder}\n")[1].splitlines()
    assert table[0].split() == ["job", "seed", "method", "resolution", "kept", "auc", "error"]
    assert table[2].split() == ["0", "1", "point", "0.1", "1", "0.6000", "-"]
    assert table[3].endswith("seed=2 fails.")
    assert table[4].endswith("ZeroDivisionError: a mistake")
    assert "Traceback" in (folder / "2" / "error.txt").read_text()
    job = Finished(0, "", "", folder / "0")
    assert job.results()["seed"] == 1
    assert ".hydra/overrides.yaml" in job.files()
    assert not (tmp_path / "run" / "results.json").exists()
