"""gmmtorch-team: robots as processes share one map, and end with the process of the team."""

from __future__ import annotations

import itertools
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cli.robot.robot_cases import LOG, SMALL
from command_runs import QUIET, Disk, Finished, refused, room_mesh, run_here, succeeded
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from sharing.replica_histories import everything

from gmmtorch.team.cli import team
from gmmtorch.team.cli.from_options import facts_of
from gmmtorch.team.cli.team import RobotProcess
from gmmtorch.team.sharing import KEY_VARIABLE, Replica, Store

Run = Callable[..., Finished]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    monkeypatch.delenv(KEY_VARIABLE, raising=False)

    def run_command(*options: str) -> Finished:
        return run_here(monkeypatch, "team", tmp_path / "run", *QUIET, "team.size=2", *options)

    return run_command


# -- a team in a world ----------------------------------------------------------------------------


@pytest.mark.slow
def test_a_team_holds_the_map_of_one_replica_with_all_records(tmp_path, monkeypatch):
    monkeypatch.delenv(KEY_VARIABLE, raising=False)
    options = ["world=mesh", f"world.path={room_mesh(tmp_path / 'room.obj')}", *SMALL, "team.size=2"]
    options += ["duration=4", "speed=2", "settle=12", "evaluation.every=2", "network.announce=0.5"]
    done = succeeded(run_here(monkeypatch, "team", tmp_path / "run", *options))
    summary, *rows = done.results()["rows"]
    observer = Replica(9, dim=3)
    facts = facts_of(OmegaConf.create(done.results()["config"]))
    for number in (0, 1):
        one = Replica(number, dim=3)
        with Store(done.folder / f"robot_{number}" / f"robot_{number}.sqlite", number, facts) as store:
            store.restore(one)
        for datagram in everything(one):
            observer.receive(datagram)
    assert {row["digest"] for row in rows} == {observer.digest().hex()}
    assert summary["same_map"] is True
    assert (summary["n_robots"], summary["collisions"]) == (2, 0)
    assert summary["path_length"] == sum(row["path_length"] for row in rows)  # 0 if every tick is late
    assert summary["bytes_sent"] == sum(row["bytes_sent"] for row in rows) > 0
    for row in rows:
        assert row["n_components"] > 0
        assert row["stopped"] is False
        assert 0 <= row["ticks_late"] <= 4  # of the 4 ticks of the mission
        assert row["socket_bytes"] + 28 * row["socket_datagrams"] == row["wire_bytes"]

    files = done.files()
    for number in (0, 1):
        here = f"robot_{number}/"
        names = ("results.json", "map.safetensors", "trajectory.npz", "output.log")
        assert {here + name for name in names} <= files
        assert any(name.startswith(here + "tensorboard/events") for name in files)
        assert here + "run.png" not in files
        assert "% of the entropy left" in (done.folder / here / "output.log").read_text()
    assert "run.png" in files
    assert any(name.startswith("team/events") for name in files)
    assert "2 robots: all hold the same map" in done.stdout
    assert f"browse    tensorboard --logdir {done.folder}\n" in done.stdout


# -- a team that replays a log --------------------------------------------------------------------


@pytest.mark.slow
def test_a_team_replays_a_log_and_all_robots_end_with_all_records(run):
    options = ["sensor.rate=20", "settle=8", "network.announce=0.3", "network.loss=0.2"]
    done = succeeded(run(*LOG, *options))
    summary, *rows = done.results()["rows"]
    assert summary["same_map"] is True
    assert [row["scans"] for row in rows] == [3, 3]
    assert all(row["n_records"] == summary["n_records"] > 0 for row in rows)
    assert not {"figures", "run.png"} & done.files()
    assert "browse" not in done.stdout


class Done:
    """A robot that runs for some checks, and has refused something."""

    def __init__(self, number: int, n_checks: int, disk: Disk | None = None) -> None:
        self.number, self._left, self._disk = number, n_checks, disk

    def is_running(self) -> bool:
        self._left -= 1
        return self._left >= 0

    def last_line(self) -> str:
        return f"robot {self.number} {'works' if self._left >= 0 else 'has ended'}"

    def row(self) -> dict[str, Any]:
        if self._disk is not None:
            self._disk.fill()
        refused = {"wrong_key": 7} if self.number else {}
        return {"robot": self.number, "digest": "12", "n_records": 5, "refused": refused}


def test_the_status_is_of_robots_that_run(monkeypatch):
    notes: list[str] = []

    class Bars:
        def __call__(self, stage: str, done: int) -> None: ...

        def note(self, stage: str, text: str) -> None:
            notes.append(text)

    times = itertools.count(0.0, 2.0)
    monkeypatch.setattr(team, "_PAUSE", 0.0)
    monkeypatch.setattr(team.time, "monotonic", lambda: next(times))
    robots: Any = [Done(0, 2), Done(1, 12)]
    team._wait(robots, Bars(), lambda _: None)  # type: ignore[arg-type]
    assert set(notes) == {"robot 0 works", "robot 1 works"}
    assert len(notes) == 12
    assert set(notes[2:]) == {"robot 1 works"}


def test_maps_without_digest_are_not_called_equal():
    row = {"n_records": 0, "bytes_sent": 3}
    found = [
        team._summary([{**row, "digest": one} for one in pair])["same_map"] for pair in ("aa", "ab", ["", ""])
    ]
    assert found == [True, False, None]


def test_files_that_a_full_disk_rejects_are_named_below_the_table(run, monkeypatch):
    with Disk() as disk:
        monkeypatch.setattr(team, "_started", lambda *_: [Done(k, 0, disk) for k in range(2)])
        done = run(*LOG)
    assert done.status == 1
    assert "2 robots: all hold the same map" in done.stdout
    assert "robot 1 refused 7 frames: 7 wrong_key; compare link.key_file" in done.stdout
    (error,) = done.stderr.splitlines()
    assert error.startswith(
        f"gmmtorch: error: hydra.run.dir={done.folder} does not contain all results: results.json ("
    )


# -- robots in trouble ----------------------------------------------------------------------------


@pytest.fixture
def robots(monkeypatch) -> list[RobotProcess]:
    """The robots that are started."""
    started: list[RobotProcess] = []

    class Noted(RobotProcess):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            started.append(self)

    monkeypatch.setattr(team, "RobotProcess", Noted)
    return started


def pretend(monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    """Replaces the robots' program; `number` is the robot's id in it."""
    find = (
        "import sys, os, time, signal\nnumber = int([a for a in sys.argv if a.startswith('id=')][-1][3:])\n"
    )
    monkeypatch.setattr(team, "_COMMAND", (sys.executable, "-c", find + code))


FAILS = "if number == 1: sys.exit('gmmtorch: error: no more of this')\n"
WAITS = "time.sleep(60)\n"
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
    ("code", "words"),
    [
        (FAILS + WAITS, "Robot 1 has ended: no more of this (its output"),
        (HYDRA + WAITS, "Robot 1 has ended: ImportError: no module named radio (its output"),
        ("if number == 1: os.kill(os.getpid(), signal.SIGKILL)\n" + WAITS, "ended by SIGKILL"),
        ("", "Robot 0 has left no results"),
    ],
)
def test_a_robot_that_fails_is_reported_and_ends_the_others(code, words, run, robots, monkeypatch):
    pretend(monkeypatch, code)
    assert words in refused(run(*LOG))
    assert len(robots) == 2
    assert all(robot._process.returncode is not None for robot in robots)


def test_robots_that_ignore_signals_are_killed(run, robots, monkeypatch):
    monkeypatch.setattr(team, "_PATIENCE", 0.3)
    pretend(monkeypatch, DEAF)
    refused(run(*LOG))
    assert [robot._process.returncode for robot in robots] == [-signal.SIGKILL, 1]


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("before", [signal.default_int_handler, signal.SIG_IGN])
def test_a_signal_ends_all_robots(before, name, run, robots, monkeypatch):
    """Also in a process that a shell has started in the background, with signals ignored."""
    pretend(monkeypatch, WAITS)
    number = getattr(signal, name)
    monkeypatch.setattr(team, "_status", lambda _: os.kill(os.getpid(), number))
    handler = signal.signal(number, before)
    try:
        done = run(*LOG)
        assert signal.getsignal(number) == before
    finally:
        signal.signal(number, handler)
    assert done.status == 130
    assert [robot._process.returncode for robot in robots] == [-signal.SIGTERM] * 2


# -- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("id=1", "id=1 gmmtorch-robot"),
        ("link.listen=127.0.0.1:7400", "link.listen gmmtorch-robot"),
        ("transport=zenoh link.peers=[tcp/127.0.0.1:7447]", "link.peers gmmtorch-robot"),
        ("speed=0", "speed=0.0"),
        ("settle=-1", "settle=-1.0"),
        ("team.size=40", "team.size=40"),
        ("runtime.device=meta", "runtime.device=meta"),
    ],
)
def test_bad_values_are_named_before_a_robot_is_started(options, words, run, robots, tmp_path, monkeypatch):
    if "settle" in options:
        monkeypatch.setattr(team, "_prepare", None)  # nor is the world opened
    world = ["world=mesh", f"world.path={room_mesh(tmp_path / 'room.obj')}"]
    line = refused(run(*world, *SMALL, *options.split()))
    for word in words.split():
        assert word in line
    assert not robots


@pytest.mark.parametrize("name", ["plain", "with space", "it's, [a] (strange) {place}=x", "ö"])
def test_every_folder_name_is_quoted_for_hydra(name):
    text = f"hydra.run.dir={team._quoted(Path('/tmp') / name)}"
    assert OverridesParser.create().parse_override(text).value() == f"/tmp/{name}"
