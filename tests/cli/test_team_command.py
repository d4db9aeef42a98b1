"""gmmtorch-team: robots as processes fly what one process flies, replay logs, and do not outlive it."""

from __future__ import annotations

import itertools
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from command_runs import COMMANDS, QUIET, Disk, Finished, refused, run_here, succeeded
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from test_robot_command import LOG, SMALL, room

from gmmtorch.cli import missions, robot_process, team
from gmmtorch.cli.robot_process import RobotProcess
from gmmtorch.exploration.mission.team_setup import assemble
from gmmtorch.sharing.transport.team_key import KEY_VARIABLE

Run = Callable[..., Finished]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    monkeypatch.setitem(COMMANDS, "team", team)
    monkeypatch.delenv(KEY_VARIABLE, raising=False)

    def run_command(*options: str) -> Finished:
        return run_here(monkeypatch, "team", tmp_path / "run", *QUIET, "team.size=2", *options)

    return run_command


# -- in step --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """Two robots in a room for four seconds, with everything that is shown."""
    folder = tmp_path_factory.mktemp("team")
    options = ["world=mesh", f"world.path={room(folder / 'room.obj')}", *SMALL, "team.size=2"]
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setitem(COMMANDS, "team", team)
        monkeypatch.delenv(KEY_VARIABLE, raising=False)
        options += ["duration=4", "evaluation.every=2"]
        return succeeded(run_here(monkeypatch, "team", folder / "run", *options))


def test_it_is_the_mission_that_one_process_flies(flown):
    results = flown.results()
    config: Any = OmegaConf.create(results["config"])
    options = replace(missions.team_options(config, config.seed, {}), latency=0.0)
    mission = assemble(missions.world_options(config).open(options), options)
    while not mission.is_over:
        mission.step()
    mission.converge(config.settle)
    summary, *rows = results["rows"]
    for row, agent, entropy in zip(
        rows, mission.agents, mission.samples["entropy_bits_per_robot"], strict=True
    ):
        assert row["digest"] == agent.robot.mapper.digest().hex()
        assert row["views_digest"] == agent.robot.library.digest().hex()
        assert row["path_length"] == agent.robot.path_length
        assert row["bytes_sent"] == mission.network.traffic(agent.number).bytes > 0
        assert row["datagrams"] == mission.network.traffic(agent.number).datagrams
        assert row["times"] == mission.samples["times"] == [0.0, 2.0, 4.0]
        assert row["entropy_bits"] == pytest.approx(entropy, rel=1e-12)
        assert row["late"] == 0
        assert row["socket_datagrams"] == row["datagrams"]
        assert row["socket_bytes"] + 28 * row["socket_datagrams"] == row["wire_bytes"]
    assert summary["same_map"] is True
    assert summary["path_length"] > 0
    assert summary["bytes_sent"] == mission.network.n_bytes
    assert summary["n_robots"] == 2
    assert summary["encounters"] == summary["collisions"] == 0


def test_everything_is_where_it_is_said_to_be(flown):
    assert flown.results()["config"]["clock"] == "lockstep"
    files = flown.files()
    for number in (0, 1):
        here = f"robot_{number}/"
        assert {
            here + "results.json",
            here + "map.safetensors",
            here + "trajectory.npz",
            here + "output.log",
        } <= files
        assert any(name.startswith(here + "tensorboard/events") for name in files)
        assert here + "run.png" not in files
        assert not any(name.startswith(here + "journal") for name in files)
        assert "% of the entropy left" in (flown.folder / here / "output.log").read_text()
    assert "run.png" in files
    assert any(name.startswith("team/events") for name in files)
    assert "2 robots: all hold the same map" in flown.stdout
    assert f"browse    tensorboard --logdir {flown.folder}\n" in flown.stdout


# -- by the clock ---------------------------------------------------------------------------------


def test_a_log_is_replayed_by_all_and_each_ends_with_all_of_it(run):
    options = ["log.rate=20", "settle=8", "network.announce=0.3", "network.loss=0.2"]
    done = succeeded(run(*LOG, *options))
    summary, *rows = done.results()["rows"]
    assert done.results()["config"]["clock"] == "wall"
    assert summary["same_map"] is True
    assert [row["scans"] for row in rows] == [3, 3]
    assert all(row["n_records"] == summary["n_records"] > 0 for row in rows)
    assert not {"figures", "run.png"} & done.files()
    assert "browse" not in done.stdout


class Done:
    """A robot that works while it is asked so often, and has refused something."""

    def __init__(self, number: int, n_asked: int, disk: Disk | None = None) -> None:
        self.number, self._left, self._disk = number, n_asked, disk

    def is_at_work(self) -> bool:
        self._left -= 1
        return self._left >= 0

    def status(self) -> str:
        return f"robot {self.number} {'works' if self._left >= 0 else 'has ended'}"

    def row(self) -> dict[str, Any]:
        if self._disk is not None:
            self._disk.fill()
        refused = {"wrong_key": 7} if self.number else {}
        return {"robot": self.number, "digest": "12", "n_records": 5, "refused": refused}


def test_those_that_still_work_are_shown(monkeypatch):
    notes: list[str] = []

    class Bars:
        def __call__(self, stage: str, done: int) -> None: ...

        def note(self, stage: str, text: str) -> None:
            notes.append(text)

    times = itertools.count(0.0, 2.0)
    monkeypatch.setattr(team, "_PAUSE", 0.0)
    monkeypatch.setattr(team.time, "monotonic", lambda: next(times))
    robots: Any = [Done(0, 2), Done(1, 12)]
    team._by_the_clock(robots, Bars())  # type: ignore[arg-type]
    assert set(notes) == {"robot 0 works", "robot 1 works"}
    assert len(notes) == 12
    assert set(notes[2:]) == {"robot 1 works"}


def test_what_a_full_disk_does_not_take_is_told_below_the_table(run, monkeypatch):
    with Disk() as disk:
        monkeypatch.setattr(team, "_started", lambda *_: [Done(k, 0, disk) for k in range(2)])
        done = run(*LOG)
    assert done.status == 1
    assert "2 robots: all hold the same map" in done.stdout
    assert "robot 1 refused 7 frames: 7 wrong_key; compare link.key_file" in done.stdout
    (error,) = done.stderr.splitlines()
    assert error.startswith(
        f"gmmtorch: error: hydra.run.dir={done.folder} has not got all results: results.json ("
    )


# -- robots in trouble ----------------------------------------------------------------------------


@pytest.fixture
def robots(monkeypatch) -> list[RobotProcess]:
    """Those that are started."""
    started: list[RobotProcess] = []

    class Noted(RobotProcess):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            started.append(self)

    monkeypatch.setattr(team, "RobotProcess", Noted)
    return started


def pretend(monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    """Robots that do nothing but this, in which `number` is theirs."""
    find = (
        "import sys, os, time, signal\nnumber = int([a for a in sys.argv if a.startswith('id=')][-1][3:])\n"
    )
    monkeypatch.setattr(robot_process, "_COMMAND", (sys.executable, "-c", find + code))


FAILS = "if number == 1: sys.exit('gmmtorch: error: no more of this')\n"
WAITS = "time.sleep(600)\n"
HYDRA = (
    "if number == 1:\n"
    "  print('ImportError: no module named radio\\n\\nSet the environment variable HYDRA_FULL_ERROR=1 …')\n"
    "  sys.exit(1)\n"
)
DEAF = """
folder = sys.argv[-1].split("'")[1]
signal.signal(signal.SIGTERM, signal.SIG_IGN)
open(os.path.join(folder, "deaf"), "w").close()
while number == 1:
    if os.path.exists(os.path.join(folder, "..", "robot_0", "deaf")):
        sys.exit("gmmtorch: error: no more of this")
time.sleep(600)
"""


@pytest.mark.parametrize(
    ("source", "code", "words"),
    [
        ("log", FAILS + WAITS, "Robot 1 has ended: no more of this (its output"),
        ("log", HYDRA + WAITS, "Robot 1 has ended: ImportError: no module named radio (its output"),
        ("log", "if number == 1: os.kill(os.getpid(), signal.SIGKILL)\n" + WAITS, "ended by SIGKILL"),
        ("log", "", "Robot 0 has left no results"),
        (
            "world",
            FAILS + "print('{\"sent\": 0}', flush=True)\n" + WAITS,
            "Robot 1 has ended: no more of this",
        ),
        ("world", "print('hello', flush=True)\n" + WAITS, "Robot 0 is lost: it answers 'hello"),
    ],
)
def test_a_robot_that_fails_ends_the_others_and_is_told_of(
    source, code, words, run, robots, monkeypatch, tmp_path
):
    pretend(monkeypatch, code)
    monkeypatch.setattr(robot_process, "_GRACE", 1.0 if "hello" in code else 20.0)
    world = ["world=mesh", f"world.path={room(tmp_path / 'room.obj')}", *SMALL]
    assert words in refused(run(*(LOG if source == "log" else world)))
    assert len(robots) == 2
    assert all(robot._process.returncode is not None for robot in robots)


def test_robots_that_will_not_end_are_killed(run, robots, monkeypatch):
    monkeypatch.setattr(robot_process, "_PATIENCE", 0.3)
    pretend(monkeypatch, DEAF)
    refused(run(*LOG))
    assert [robot._process.returncode for robot in robots] == [-signal.SIGKILL, 1]


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_told_to_stop_it_ends_all_robots(name, run, robots, monkeypatch):
    pretend(monkeypatch, WAITS)
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(team, "_status", lambda _: os.kill(os.getpid(), getattr(signal, name)))
    done = run(*LOG)
    assert done.status == 130
    assert [robot._process.returncode for robot in robots] == [-signal.SIGTERM] * 2
    assert signal.getsignal(signal.SIGTERM) == before


# -- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("id=1", "id=1 gmmtorch-robot"),
        ("link.listen=127.0.0.1:7400", "link.listen gmmtorch-robot"),
        (
            "transport=zenoh link.connect_endpoints=[tcp/127.0.0.1:7447]",
            "link.connect_endpoints gmmtorch-robot",
        ),
        ("clock=sun", "clock='sun'"),
        ("clock=lockstep source=log", "clock=lockstep source=world"),
        ("journal.folder=kept", "journal.folder=kept clock=wall"),
        ("speed=2", "speed=2.0 clock=wall"),
        ("settle=-1 clock=wall", "settle=-1.0"),
        ("team.size=0", "team.size=0"),
        ("team.size=40", "team.size=40"),
        ("runtime.device=meta", "runtime.device=meta"),
    ],
)
def test_a_bad_value_is_named_before_a_robot_is_started(options, words, run, robots, tmp_path, monkeypatch):
    if "settle" in options:
        monkeypatch.setattr(team, "_prepare", None)  # nor is the world worked out
    line = refused(run("world=mesh", f"world.path={room(tmp_path / 'room.obj')}", *SMALL, *options.split()))
    for word in words.split():
        assert word in line
    assert not robots


@pytest.mark.parametrize("name", ["plain", "with space", "it's, [a] (strange) {place}=x", "ö"])
def test_any_folder_is_a_value_for_hydra(name):
    text = f"hydra.run.dir={robot_process._quoted(Path('/tmp') / name)}"
    assert OverridesParser.create().parse_override(text).value() == f"/tmp/{name}"
