"""gmmtorch-robot: what a robot writes, alone and in a team, killed and restarted; and bad input."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from command_runs import (
    CHECKOUT,
    QUIET,
    Disk,
    Finished,
    as_it_was,
    composed,
    environment,
    refused,
    room_mesh,
    run_here,
    succeeded,
)
from exploration.replays import content

from gmmtorch.cli import robot
from gmmtorch.cli.from_options import links
from gmmtorch.cli.from_options.robots import facts_of
from gmmtorch.exploration.mission.replay import ReplayMission
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.sharing.messages.message_registry import encode_plan
from gmmtorch.sharing.replica.replica import Replica
from gmmtorch.sharing.store import Store
from gmmtorch.sharing.transport.frames import FramedTransport
from gmmtorch.sharing.transport.security import TeamKey
from gmmtorch.sharing.transport.team_key import KEY_VARIABLE
from gmmtorch.sharing.transport.udp import UdpTransport

Run = Callable[..., Finished]

SMALL = ["sensor.width=48", "sensor.height=36", "runtime.cache=false"]
LOG = [
    "source=log",
    "dataset@log.dataset=synthetic_building_2d",
    "log.dataset.n_scans=12",
    "log.dataset.stride=2",
]
LOG += ["map@log.map=windowed", "log.map.window=3", "settle=0"]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Runs a robot in this process, at a free address, without figures unless told otherwise."""
    monkeypatch.delenv(KEY_VARIABLE, raising=False)

    def run_command(*options: str, name: str = "run") -> Finished:
        chosen = {option.split("=")[0] for option in options}
        defaults = [*QUIET, "link.listen=127.0.0.1:0", "team.size=1"]
        kept = [option for option in defaults if option.split("=")[0] not in chosen]
        return run_here(monkeypatch, "robot", tmp_path / name, *kept, *options)

    return run_command


@contextmanager
def chatter(number: int, to: str, key: TeamKey | None = None) -> Iterator[UdpTransport]:
    """Another robot that sends plans all the time."""
    plan = encode_plan(number, 0, 0.0, 0.2, torch.zeros(4, 4))
    done = threading.Event()
    with UdpTransport.unicast(number, peers=[links.address("to", to)], key=key) as transport:

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
    assert results["config"]["clock"] == "wall"
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


def test_a_robot_works_without_listeners(run):
    done = succeeded(run(*LOG, "link.peers=[127.0.0.1:9]", "log.rate=50"))
    (row,) = done.results()["rows"]
    assert row["scans"] == row["n_scans"] == 6
    assert row["n_components"] > 0
    assert row["refused"] == {}


@pytest.mark.parametrize("options", ["team=grid_shared", "codec=thesis"])
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
        done = run(*LOG, *shown, "log.rate=3")
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
    done = succeeded(run(*LOG, f"journal.folder={tmp_path / 'file'}", "log.rate=50"))
    assert done.stdout.count("another journal.folder, or journal.enabled=false") == 1
    (row,) = done.results()["rows"]
    assert row["scans"] == 6


def test_a_store_on_a_full_disk_is_read(run, monkeypatch, tmp_path):
    kept, disk = tmp_path / "kept", Disk()
    options = [*LOG, f"journal.folder={kept}", "log.rate=50"]
    (first,) = succeeded(run(*options)).results()["rows"]
    opened, made = links.open_link, ReplayMission.__init__
    disowned: list[frozenset[bytes]] = []

    def open_link(*arguments, **options):
        disk.fill()
        return opened(*arguments)

    def make(*arguments, **options) -> None:
        made(*arguments, **options)
        disk.clear()

    monkeypatch.setattr(links, "open_link", open_link)
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
    command = [sys.executable, str(CHECKOUT / "scripts" / "robot.py"), *LOG, *QUIET[1:], "log.rate=50"]
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
    done = succeeded(run(*LOG, "log.rate=50", "settle=1000"))
    (row,) = done.results()["rows"]
    assert row["stopped"] is True
    assert row["scans"] == len(ticks) == 2
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == before


# -- among others ---------------------------------------------------------------------------------


def test_a_duplicate_id_ends_the_robot_with_the_remedy(run):
    (here,) = links.free_addresses(1)
    with chatter(1, here) as other:
        said = refused(run(*LOG, "id=1", "team.size=2", f"link.listen={here}", "settle=60"))
    assert f"robot 1 (127.0.0.1:{other.address[1]}" in said
    assert "own id" in said


def test_frames_of_an_earlier_session_are_no_duplicate_id(run, tmp_path):
    kept = f"journal.folder={tmp_path / 'kept'}"
    succeeded(run(*LOG, "log.rate=50", "settle=0", kept))
    with sqlite3.connect(tmp_path / "kept" / "robot_0.sqlite") as db:
        ((session,),) = db.execute("SELECT id FROM session").fetchall()
    db.close()
    (here,) = links.free_addresses(1)
    with chatter(0, here) as recorded:
        recorded._sealer.session = session  # as if its frames were replayed
        again = run(*LOG, "settle=7", kept, f"link.listen={here}", name="again")
    (row,) = succeeded(again).results()["rows"]
    assert row["refused"]["duplicate_id"] > 100
    assert row["namesakes"] == {}


def test_frames_with_another_key_are_counted_and_logged_once(run, tmp_path):
    (here,) = links.free_addresses(1)
    own = TeamKey.generate().save(tmp_path / "own.key")
    with chatter(1, here, TeamKey.generate()) as other:
        options = [f"link.listen={here}", f"link.key_file={own}", "report.progress=true", "log.rate=4"]
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
    (here,), there = links.free_addresses(1), ("127.0.0.1", 0)
    with UdpTransport.unicast(1, there, [links.address("here", here)]) as transport:
        address = f"127.0.0.1:{transport.address[1]}"
        of_team = ["team.size=1", f"link.listen={here}", f"link.peers=[{address}]", "journal.folder=kept"]
        first = start(*log, *of_team, "log.rate=8", "hydra.run.dir=first", cwd=tmp_path)
        while first.poll() is None and not saved_scans(tmp_path / "kept" / "robot_0.sqlite"):
            time.sleep(0.1)
        first.kill()
        assert first.wait(60) == -signal.SIGKILL, (tmp_path / "output").read_text()
        transport.deliver(1, 0.0)  # lost
        again = start(*log, *of_team, "log.rate=50", "settle=5", "hydra.run.dir=again", cwd=tmp_path)
        late = ReplayMission(Replica(1), [], transport, GaussianMap, announce_every=0.3)
        while again.poll() is None:
            late.exchange(time.monotonic())
            time.sleep(0.01)
        assert again.returncode == 0, (tmp_path / "output").read_text()
    (row,) = Finished(0, "", "", tmp_path / "again").results()["rows"]
    assert 10 <= row["resumed_at"] < 32
    assert row["scans"] == row["n_scans"] == 32
    assert row["digest"] == late.replica.digest().hex()
    (unharmed,) = succeeded(run(*LOG, *log, "log.rate=50")).results()["rows"]

    def said(path: str) -> Counter[tuple[object, ...]]:
        return content(GaussianMap.load(tmp_path / path).components())

    assert content(late.replica.components()) == said(row["own_map_path"]) == said(unharmed["own_map_path"])


# -- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("clock=lockstep", "clock=lockstep clock=wall speed=2"),
        ("source=radio", "source='radio' world, log"),
        ("clock=sun", "clock='sun' wall"),
        ("transport=pigeon", "transport='pigeon' udp, zenoh"),
        ("id=2 team.size=2", "id=2 team.size=2"),
        ("source=log", "source=log dataset@log.dataset=carmen"),
        ("source=log dataset@log.dataset=carmen log.dataset.path=/no/log", "log.dataset.path=/no/log"),
        ("link.listen=7400", "link.listen='7400' 127.0.0.1:7447"),
        ("link.listen=127.0.0.1:70000", "link.listen='127.0.0.1:70000'"),
        ("link.peers=[127.0.0.1]", "link.peers='127.0.0.1'"),
        ("link.listen=0.0.0.0:0", "link.listen='0.0.0.0' link.key_file link.insecure=True"),
        ("link.group=239.71.77.7:7400 link.interface=10.1.2.3", "link.interface='10.1.2.3' link.key_file"),
        ("link.group=10.0.0.1:7400", "link.group='10.0.0.1' multicast"),
        ("link.group=239.71.77.7:7400 link.ttl=256", "link.ttl=256"),
        ("link.group=239.71.77.7:0", "link.group='239.71.77.7:0'"),
        ("link.peers=[10.0.0.2:7400]", "link.peers= link.listen= 0.0.0.0"),
        ("link.listen=198.51.100.7:0 link.insecure=true", "link.listen=198.51.100.7:0 0.0.0.0"),
        ("link.key_file=/nowhere/team.key", "/nowhere/team.key openssl"),
        ("transport=zenoh", "link.listen_endpoints=[] link.connect_endpoints=[]"),
        ("transport=zenoh link.scouting=true", "link.scouting=True link.key_file link.insecure=True"),
        (
            "transport=zenoh link.listen_endpoints=[tcp/10.0.0.3:7447]",
            "link.listen_endpoints='tcp/10.0.0.3:7447'",
        ),
    ],
)
def test_a_bad_value_is_named_in_one_line(options, words, run):
    line = refused(run(*options.split()))
    for word in words.split():
        assert word in line


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("speed=0", "speed=0.0"),
        ("settle=inf", "settle=inf"),
        ("log.rate=0", "log.rate=0.0"),
    ],
)
def test_paces_are_checked_before_anything_is_opened(options, words, run, monkeypatch):
    monkeypatch.setattr(links, "open_link", None)
    assert words in refused(run(*LOG, options))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("log.every=0", "log.every=0"),
        ("log.map.prior=-1", "log.map.prior=-1.0"),
        ("log.part=odd", "log.part='odd'"),
        ("log.start=here", "log.start='here'"),
        ("journal.sync=never", "journal.sync='never'"),
    ],
)
def test_a_bad_value_for_a_log_is_named_in_one_line(options, words, run):
    line = refused(run(*LOG, *options.split()))
    for word in words.split():
        assert word in line


@pytest.mark.parametrize(
    ("option", "host", "remedy"),
    [
        ("link.listen", "127.0.0.1", "give another port, or 0 for any that is free."),
        ("link.group", "239.71.77.7", "give another port."),
    ],
)
def test_a_port_in_use_is_named_with_the_remedy(option, host, remedy, run):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("", 0))
        where = f"{option}={host}:{taken.getsockname()[1]}"
        line = refused(run(*LOG, where))
    assert f"{where} " in line
    assert "another process has that port" in line
    assert remedy in line


def test_a_robot_without_peers_is_warned_of(run):
    said = succeeded(run(*LOG, "team.size=2", "log.rate=50")).stdout
    assert "link.peers=[]: robot 0 sends to no other robot" in said


def test_a_store_of_another_log_is_rejected(run, tmp_path):
    kept = f"journal.folder={tmp_path / 'kept'}"
    said = f"{kept} holds no robot_0.sqlite: the map starts empty."
    assert said in succeeded(run(*LOG, "log.rate=50", kept)).stdout
    assert "every" in refused(run(*LOG, "log.rate=50", kept, "log.every=2", name="other"))
    again = succeeded(run(*LOG, "log.rate=40", kept, name="again"))  # the rate may change
    assert said not in again.stdout


def test_a_store_of_another_world_is_rejected(run, tmp_path):
    kept = f"journal.folder={tmp_path / 'kept'}"
    succeeded(run(*LOG, "log.rate=50", kept))
    line = refused(run(kept, name="flying"))
    assert f"{kept.split('=')[0]}=" in line
    assert "source" in line


def test_a_store_in_use_is_named_by_its_option(run, tmp_path):
    with Store(tmp_path / "robot_0.sqlite", 0, {}):
        line = refused(run(*LOG, f"journal.folder={tmp_path}"))
    assert "journal.folder=" in line
    assert "runs already" in line
    assert "path=" not in line


def facts(*options: str) -> dict[str, object]:
    return facts_of(composed("robot", *options))


def test_facts_that_identify_a_world(tmp_path):
    with as_it_was():
        warehouse = facts()
        for other in ("world=tunnels", "world.seed=1", "world.size=[20,20,8]"):
            assert facts(other) != warehouse, other
        for same in ("seed=3", "world.resolution=0.4", "team.size=2", "sensor.max_range=4", "planner=random"):
            assert facts(same) == warehouse, same
        one, moved = room_mesh(tmp_path / "one.obj"), room_mesh(tmp_path / "moved.obj")
        meshes = [facts("world=mesh", f"world.path={path}") for path in (one, moved)]
        assert meshes[0] == meshes[1]
        one.write_text(one.read_text().replace("7.0", "7.5"))
        assert facts("world=mesh", f"world.path={one}") != meshes[0]
        assert facts("world=mesh") != meshes[0]
