"""Kills the process of a robot that replays a log at random, and checks what becomes of its map.

    PYTHONPATH=tests python -m exploration.kill_replay 20

A robot replays a log over UDP to a listener, and is killed again and again: half of its lives end by the
clock, half after a random number of SQLite's virtual machine steps. Then it runs to the end of its log. Its
map, and the listener's, must equal that of a robot that was never killed, to the bit.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import tempfile
import time
from pathlib import Path

import torch
from exploration.replays import RULES, content, log, mapped
from sharing.kill_store import die_after_steps

from gmmtorch.files import write_json
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.team.exploration import ReplayingRobotView, ReplayMission, WallClock, drive
from gmmtorch.team.sharing import Replica, Store, UdpTransport
from gmmtorch.team.sharing.transport.udp import LOOPBACK, unicast_socket

N_SCANS = 31
KILLS_OF_A_ROBOT = 5
_RATE, _ANNOUNCE = 50.0, 0.1  # hertz, seconds
_LONGEST_LIFE, _MOST_STEPS = 1.0, 4000
_PATIENCE = 90.0  # seconds


def main(n: int, seed: int, home: Path) -> dict[str, object]:
    """Kills robots n times; returns what was found of each."""
    rng, rules = random.Random(seed), sorted(RULES)
    robots = [
        _robot(rng, rules[number % len(rules)], min(KILLS_OF_A_ROBOT, n - begin), home / str(number))
        for number, begin in enumerate(range(0, n, KILLS_OF_A_ROBOT))
    ]
    return {"kills": n, "sound": all(robot["sound"] for robot in robots), "robots": robots}


def _robot(rng: random.Random, rule: str, n_kills: int, home: Path) -> dict[str, object]:
    """Kills a robot so often, then lets it end."""
    ports, listener = _free_ports(), Replica(1)
    for _ in range(n_kills):
        steps = rng.randrange(1, _MOST_STEPS) if rng.random() < 0.5 else None
        _life(rule, home, ports, listener, steps, _PATIENCE if steps else rng.uniform(0.0, _LONGEST_LIFE))
    row = _life(rule, home, ports, listener, None, _PATIENCE)
    said, expected = content(listener.components()), content(mapped(rule, log(N_SCANS)).components())
    return {
        "rule": rule,
        "resumed_at": row.get("resumed_at"),
        "components": expected.total(),
        "lost": (expected - said).total(),
        "doubled": (said - expected).total(),
        "sound": said == expected and row.get("digest") == listener.digest().hex(),
    }


def _life(
    rule: str, home: Path, ports: tuple[int, int], listener: Replica, steps: int | None, seconds: float
) -> dict[str, object]:
    """One life, which ends after `steps` steps of SQLite, after `seconds`, or when the log is over and both
    replicas are equal; returns the row that it left."""
    row = home / "row.json"
    row.unlink(missing_ok=True)
    child = os.fork()  # this process has no thread now: the listener's ends with its transport
    if child == 0:
        try:
            die_after_steps(steps)
            _replay(rule, home, ports)
        except BaseException as error:
            sys.stderr.write(f"{error!r}\n")
        finally:
            os._exit(1)  # not reached by those that are killed in time
    transport = UdpTransport.unicast(1, (LOOPBACK, ports[1]), [(LOOPBACK, ports[0])])
    mission = ReplayMission(listener, [], transport, GaussianMap, announce_every=_ANNOUNCE)
    end, status = time.monotonic() + seconds, None
    while status is None and time.monotonic() < end:
        mission.exchange(time.monotonic())
        died, how = os.waitpid(child, os.WNOHANG)
        status = how if died else None
        if row.exists() and json.loads(row.read_text())["digest"] == listener.digest().hex():
            break
        time.sleep(0.005)
    if status is None:
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
    transport.close()
    assert os.WIFSIGNALED(status), "It was not killed: it failed."
    return json.loads(row.read_text()) if row.exists() else {}


def _replay(rule: str, home: Path, ports: tuple[int, int]) -> None:
    replica, store = Replica(0), Store(home / "robot.sqlite", 0)
    store.restore(replica)
    transport = UdpTransport.unicast(0, (LOOPBACK, ports[0]), [(LOOPBACK, ports[1])])
    transport.disown(store.begin_session(transport.session))
    mission = ReplayMission(
        replica,
        log(N_SCANS),
        transport,
        lambda: GaussianMap(RULES[rule]),
        rate=_RATE,
        store=store,
        announce_every=_ANNOUNCE,
        keep_every=4,
    )
    drive(mission, WallClock())
    while True:
        mission.exchange(time.monotonic())
        write_json(home / "row.json", ReplayingRobotView(mission, transport).row())
        time.sleep(0.05)


def _free_ports() -> tuple[int, int]:
    with unicast_socket((LOOPBACK, 0)) as one, unicast_socket((LOOPBACK, 0)) as other:
        return one.getsockname()[1], other.getsockname()[1]


if __name__ == "__main__":
    torch.set_num_threads(1)
    log(N_SCANS)  # computed before any fork
    with tempfile.TemporaryDirectory() as temporary:
        made = main(int(sys.argv[1]), int([*sys.argv, "0"][2]), Path(temporary))
    sys.stdout.write(json.dumps(made) + "\n")
    sys.exit(0 if made["sound"] else 1)
