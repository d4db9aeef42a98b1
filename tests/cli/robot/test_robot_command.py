"""gmmtorch-robot: what a robot writes, alone and in a team, killed and restarted."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from cli.command_runs import CHECKOUT, QUIET, Disk, Finished, environment, refused, room_mesh, succeeded
from cli.robot.robot_cases import LOG, SMALL
from exploration.replays import content

from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.team.cli import from_options, robot
from gmmtorch.team.exploration.mission.replay import ReplayMission
from gmmtorch.team.sharing import FramedTransport, Replica, TeamKey, UdpTransport, encode_plan


@contextmanager
def chatter(number: int, to: str, key: TeamKey | None = None) -> Iterator[UdpTransport]:
    """Another robot that sends plans all the time."""
    plan = encode_plan(number, 0, 0.0, 0.2, torch.zeros(4, 4))
    done = threading.Event()
    with UdpTransport.unicast(number, peers=[from_options.address("to", to)], key=key) as transport:

        def talk() -> None:
            while not done.wait(0.01):
                transport.send(number, plan, 0.0, "plans")

        thread = threading.Thread(target=talk)
        thread.start()
        try:
            yield transport
        finally:
            done.set()
            thread.join()


# -- a robot alone --------------------------------------------------------------------------------


def test_a_single_robot_flies_and_reports(run, tmp_path):
    world = ["world=mesh", f"world.path={room_mesh(tmp_path / 'room.obj')}", *SMALL]
    shown = ["report.progress=true", "report.figures=true", "report.tensorboard=true"]
    done = succeeded(run(*world, *shown, "duration=4", "speed=8", "settle=0", "evaluation.every=2"))
    results = done.results()
    (row,) = results["rows"]
    assert results["command"] == "robot"
    assert row["n_components"] > 0
    assert row["collisions"] == 0
    assert (row["robot"], row["ticks_late"], row["stopped"], row["unkept"]) == (
        0,
        row["ticks_late"],
        False,
        0,
    )
    assert row["times"][0] == 0.0
    assert row["times"] == sorted(set(row["times"]))
    assert row["entropy_bits"][0] == row["observable_bits"]
    assert {len(row["times"])} == {
        len(row[name]) for name in ("entropy_bits", "records_over_time", "bytes_over_time")
    }
    assert row["entropy_bits"][-1] == row["entropy_bits_left"] < row["observable_bits"]
    assert row["records_over_time"][-1] == row["n_records"]
    with np.load(row["trajectory_path"]) as kept:
        assert kept["poses"].shape == (5, 4)
    assert GaussianMap.load(row["map_path"]).n_components == row["n_components"]
    files = done.files()
    assert {"run.png", "trajectory.npz"} <= files
    assert any(name.startswith("tensorboard/events") for name in files)
    assert "robot_0.sqlite" in files
    assert "% of the entropy left" in done.stderr
    assert row["digest"] in done.stdout
    assert "browse    tensorboard" in done.stdout
    assert "cannot be restarted" not in done.stdout


@pytest.mark.parametrize("options", ["team=grid_shared", "team=gmm_thesis"])
def test_a_robot_that_cannot_be_restarted_is_warned_of(run, tmp_path, options):
    world = ["world=mesh", f"world.path={room_mesh(tmp_path / 'room.obj')}", *SMALL]
    done = succeeded(run(*world, options, "duration=1", "settle=0"))
    assert done.stdout.count("cannot be restarted") == 1
    assert done.results()["rows"][0]["not_merged"] == {}


# -- a disk that is full --------------------------------------------------------------------------


def test_a_robot_continues_on_a_full_disk_and_names_missing_files(run, monkeypatch):
    tick, disk = ReplayMission.tick, Disk()

    def filling(mission: ReplayMission, now: float) -> None:
        tick(mission, now)
        if mission.position == 2:
            disk.fill()

    monkeypatch.setattr(ReplayMission, "tick", filling)
    shown = ["report.progress=true", "report.figures=true", "report.tensorboard=true"]
    with disk:
        done = run(*LOG, *shown, "sensor.rate=3")
    assert done.status == 1
    assert done.stdout.count("report.tensorboard is switched off") == 1
    assert done.stdout.count("is no longer written, and the robot continues") == 1
    assert "\nrobot 0\n" in done.stdout  # the table
    assert "n_records" in done.stdout
    assert "scan 6/6" in done.stderr
    *status, error = done.stderr.splitlines()
    assert all(line.startswith("robot 0 ") for line in status)  # no tracebacks
    assert error.startswith(f"gmmtorch: error: hydra.run.dir={done.folder} does not contain all results: ")
    for name in ("map.safetensors", "own_map.safetensors", "results.json", "run.png", "File too large"):
        assert error.count(name) == (2 if name == "map.safetensors" else 1)
    assert not (done.folder / "results.json").exists()


def test_a_robot_starts_without_a_writable_store(run, tmp_path):
    (tmp_path / "file").write_text("")
    done = succeeded(run(*LOG, f"journal.folder={tmp_path / 'file'}", "sensor.rate=50"))
    assert done.stdout.count("Choose another folder, or run without a store") == 1
    assert done.stdout.count("Set journal.folder to another folder.") == 1
    (row,) = done.results()["rows"]
    assert row["scans"] == 6


def test_a_store_on_a_full_disk_is_read(run, monkeypatch, tmp_path):
    kept, disk = tmp_path / "kept", Disk()
    options = [*LOG, f"journal.folder={kept}", "sensor.rate=50"]
    (first,) = succeeded(run(*options)).results()["rows"]
    opened, made = from_options.open_link, ReplayMission.__init__
    disowned: list[frozenset[bytes]] = []

    def open_link(*arguments, **options):
        disk.fill()
        return opened(*arguments)

    def make(*arguments, **options) -> None:
        made(*arguments, **options)
        disk.clear()

    monkeypatch.setattr(from_options, "open_link", open_link)
    monkeypatch.setattr(ReplayMission, "__init__", make)
    monkeypatch.setattr(FramedTransport, "disown", lambda _, sessions: disowned.append(frozenset(sessions)))
    with disk:
        done = succeeded(run(*options, name="again"))
    assert done.stdout.count("robot_0.sqlite is no longer written") == 1
    assert [len(former) for former in disowned] == [1]
    (row,) = done.results()["rows"]
    assert row["resumed_at"] > 0
    assert row["digest"] == first["digest"]
    assert row["incarnation"] != first["incarnation"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.slow
def test_a_robot_continues_without_standard_error(tmp_path):
    command = [sys.executable, str(CHECKOUT / "scripts" / "robot.py"), *LOG, *QUIET[1:], "sensor.rate=50"]
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run(
            [*command, "team.size=1", "link.listen=127.0.0.1:0", "hydra.run.dir=run"],
            cwd=tmp_path,
            env=environment(),
            stdout=subprocess.PIPE,
            stderr=full,
            text=True,
            timeout=120,
        )
    assert done.returncode == 0
    assert done.stdout.count("report.progress is switched off") == 1
    assert (tmp_path / "run" / "results.json").is_file()


# -- told to stop ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT", "orphaned"])
def test_a_stopped_robot_writes_its_results(run, monkeypatch, name):
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    ticks: list[float] = []
    tick = ReplayMission.tick

    def ended(mission: ReplayMission, now: float) -> None:
        tick(mission, now)
        ticks.append(now)
        if len(ticks) == 2:
            if name == "orphaned":
                monkeypatch.setattr(os, "getppid", lambda: 1)
            else:
                os.kill(os.getpid(), getattr(signal, name))

    monkeypatch.setattr(ReplayMission, "tick", ended)
    monkeypatch.setenv(robot.TEAM_VARIABLE, str(os.getppid()))
    done = succeeded(run(*LOG, "sensor.rate=50", "settle=1000"))
    (row,) = done.results()["rows"]
    assert row["stopped"] is True
    assert row["scans"] == len(ticks) == 2
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == before


# -- among others ---------------------------------------------------------------------------------


def test_a_duplicate_id_ends_the_robot_with_the_remedy(run):
    (here,) = from_options.free_addresses(1)
    with chatter(1, here) as other:
        said = refused(run(*LOG, "id=1", "team.size=2", f"link.listen={here}", "settle=60"))
    assert f"robot 1 (127.0.0.1:{other.address[1]}" in said
    assert "own id" in said


def test_frames_with_another_key_are_counted_and_logged_once(run, tmp_path):
    (here,) = from_options.free_addresses(1)
    own = tmp_path / "own.key"
    own.touch(0o600)
    own.write_text(bytes(range(32)).hex())
    with chatter(1, here, TeamKey.generate()) as other:
        options = [f"link.listen={here}", f"link.key_file={own}", "report.progress=true", "sensor.rate=4"]
        done = succeeded(run(*LOG, *options, "team.size=2"))
    (row,) = done.results()["rows"]
    assert row["refused"].keys() == {"wrong_key"}
    assert row["refused"]["wrong_key"] > 10
    assert row["heard"] == 0
    assert done.stdout.count("cannot be opened") == 1
    assert f"from 127.0.0.1:{other.address[1]}" in done.stdout
    assert "same team key" in done.stdout
    assert " refused" in done.stderr
    assert f"\nrobot 0 refused {row['refused']['wrong_key']:,} frames: " in done.stdout
    assert "link.key_file, or $GMMTORCH_TEAM_KEY" in done.stdout
    assert own.read_text().strip() not in done.stdout + done.stderr + str(done.results())


def start(*options: str, cwd: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, str(CHECKOUT / "scripts" / "robot.py"), *QUIET, *LOG, *options]
    with (cwd / "output").open("ab") as output:
        return subprocess.Popen(command, cwd=cwd, env=environment(), stdout=output, stderr=output)


def saved_scans(path: Path) -> int:
    """The progress in a copy of a store that another process has open."""
    copy = path.parent.with_name("copy")
    shutil.rmtree(copy, ignore_errors=True)
    try:
        shutil.copytree(path.parent, copy)
        with contextlib.closing(sqlite3.connect(copy / path.name)) as db:
            ((scans,),) = db.execute("SELECT max(scans) FROM progress").fetchall()
    except (OSError, sqlite3.Error):  # it is not there yet, or is being written
        return 0
    return scans or 0


@pytest.mark.slow
def test_a_killed_robot_continues_and_its_teammate_catches_up(run, tmp_path):
    log = ["log.dataset.n_scans=64", "network.announce=0.3"]
    (here,), there = from_options.free_addresses(1), ("127.0.0.1", 0)
    with UdpTransport.unicast(1, there, [from_options.address("here", here)]) as transport:
        address = f"127.0.0.1:{transport.address[1]}"
        of_team = ["team.size=1", f"link.listen={here}", f"link.peers=[{address}]", "journal.folder=kept"]
        first = start(*log, *of_team, "sensor.rate=8", "hydra.run.dir=first", cwd=tmp_path)
        while first.poll() is None and not saved_scans(tmp_path / "kept" / "robot_0.sqlite"):
            time.sleep(0.1)
        first.kill()
        assert first.wait(60) == -signal.SIGKILL, (tmp_path / "output").read_text()
        transport.deliver(1, 0.0)  # lost
        again = start(*log, *of_team, "sensor.rate=50", "settle=5", "hydra.run.dir=again", cwd=tmp_path)
        late = ReplayMission(Replica(1), [], transport, GaussianMap, announce_every=0.3)
        while again.poll() is None:
            late.exchange(time.monotonic())
            time.sleep(0.01)
        assert again.returncode == 0, (tmp_path / "output").read_text()
    (row,) = Finished(0, "", "", tmp_path / "again").results()["rows"]
    assert 10 <= row["resumed_at"] < 32
    assert row["scans"] == row["n_scans"] == 32
    assert row["digest"] == late.replica.digest().hex()
    (unharmed,) = succeeded(run(*LOG, *log, "sensor.rate=50")).results()["rows"]

    def said(path: str) -> Counter[tuple[object, ...]]:
        return content(GaussianMap.load(tmp_path / path).components())

    assert content(late.replica.components()) == said(row["own_map_path"]) == said(unharmed["own_map_path"])
