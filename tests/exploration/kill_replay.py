"""Kills a replaying robot's process at random, and looks at what has become of the map.

    PYTHONPATH=tests python -m exploration.kill_replay 20

A robot replays a log over UDP to one that listens, and is killed again and again: half of its lives end by
the clock, half inside a file operation, writes after a random part of their bytes. Then it is left alone
until its log is over. Its map, and the listener's, must be that of a robot that was never killed, to the bit.
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
from sharing.kill_journal import _die_in_operation

from gmmtorch.exploration.mission.node import run_paced
from gmmtorch.exploration.mission.replay import ReplayNode
from gmmtorch.files import write_json
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.sharing.journal import Journal
from gmmtorch.sharing.replica.replica import Replica
from gmmtorch.sharing.transport.udp import LOOPBACK, UdpTransport, unicast_socket

N_SCANS = 31
KILLS_OF_A_ROBOT = 5
_RATE, _ANNOUNCE = 50.0, 0.1  # hertz, seconds
_LONGEST_LIFE, _MOST_OPERATIONS = 1.0, 40
_PATIENCE = 90.0  # seconds


def main(n: int, seed: int, home: Path) -> dict[str, object]:
    """Kill robots n times; what was found of each of them."""
    rng, rules = random.Random(seed), sorted(RULES)
    robots = [
        _robot(rng, rules[number % len(rules)], min(KILLS_OF_A_ROBOT, n - begin), home / str(number))
        for number, begin in enumerate(range(0, n, KILLS_OF_A_ROBOT))
    ]
    return {"kills": n, "sound": all(robot["sound"] for robot in robots), "robots": robots}


def _robot(rng: random.Random, rule: str, n_kills: int, home: Path) -> dict[str, object]:
    """Kill one so often, then leave it alone."""
    ports, listener, reached = _free_ports(), Replica(1), []
    for _ in range(n_kills):
        limit = rng.randrange(1, _MOST_OPERATIONS) if rng.random() < 0.5 else None
        seconds = _PATIENCE if limit else rng.uniform(0.0, _LONGEST_LIFE)
        _life(rule, home, ports, listener, limit, rng.getrandbits(32), seconds)
        reached.append(max((path.name for path in home.glob("map-*.state")), default=None))
    row = _life(rule, home, ports, listener, None, 0, _PATIENCE)
    said, expected = content(listener.components()), content(mapped(rule, log(N_SCANS)).components())
    return {
        "rule": rule,
        "reached": reached,
        "resumed_at": row.get("resumed_at"),
        "components": expected.total(),
        "lost": (expected - said).total(),
        "doubled": (said - expected).total(),
        "sound": said == expected and row.get("digest") == listener.digest().hex(),
    }


def _life(
    rule: str,
    home: Path,
    ports: tuple[int, int],
    listener: Replica,
    limit: int | None,
    seed: int,
    seconds: float,
) -> dict[str, object]:
    """One life, which ends in file operation `limit`, after so many seconds, or when the log is over and both
    say the same; what it left in row.json."""
    row = home / "row.json"
    row.unlink(missing_ok=True)
    child = os.fork()  # no thread runs here: the listener's ends with its transport
    if child == 0:
        try:
            _die_in_operation(random.Random(seed), limit, -1)
            _replay(rule, home, ports)
        except BaseException as error:
            sys.stderr.write(f"{error!r}\n")
        finally:
            os._exit(1)  # nobody gets here who is killed in time
    transport = UdpTransport.unicast(1, (LOOPBACK, ports[1]), [(LOOPBACK, ports[0])])
    node = ReplayNode(listener, [], transport, GaussianMap, announce_every=_ANNOUNCE)
    end, status = time.monotonic() + seconds, None
    while status is None and time.monotonic() < end:
        node.listen(time.monotonic())
        died, how = os.waitpid(child, os.WNOHANG)
        status = how if died else None
        if row.exists() and json.loads(row.read_text())["digest"] == listener.digest().hex():
            break
        time.sleep(0.005)
    if status is None:
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
    node.close()
    assert os.WIFSIGNALED(status), "It has not been killed: it has failed."
    return json.loads(row.read_text()) if row.exists() else {}


def _replay(rule: str, home: Path, ports: tuple[int, int]) -> None:
    replica = Replica(0)
    node = ReplayNode(
        replica,
        log(N_SCANS),
        UdpTransport.unicast(0, (LOOPBACK, ports[0]), [(LOOPBACK, ports[1])]),
        lambda: GaussianMap(RULES[rule]),
        journal=Journal(home / "journal", replica, most_log_bytes=4000),
        folder=home,
        announce_every=_ANNOUNCE,
        keep_every=4,
    )
    run_paced(node, _RATE)
    while True:
        node.listen(time.monotonic())
        write_json(home / "row.json", node.row())
        time.sleep(0.05)


def _free_ports() -> tuple[int, int]:
    with unicast_socket((LOOPBACK, 0)) as one, unicast_socket((LOOPBACK, 0)) as other:
        return one.getsockname()[1], other.getsockname()[1]


if __name__ == "__main__":
    torch.set_num_threads(1)
    log(N_SCANS)  # before any fork
    with tempfile.TemporaryDirectory() as temporary:
        made = main(int(sys.argv[1]), int([*sys.argv, "0"][2]), Path(temporary))
    sys.stdout.write(json.dumps(made) + "\n")
    sys.exit(0 if made["sound"] else 1)
