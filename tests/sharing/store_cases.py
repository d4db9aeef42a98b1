"""Replicas with a store."""

from __future__ import annotations

import contextlib
import random
import shutil
import sqlite3
from pathlib import Path

import torch
from sharing.schedules import act

from gmmtorch.team.sharing.replica.replica import Replica
from gmmtorch.team.sharing.store import Restored, Store


def recorded(robot: int, n: int, seed: int = 0) -> list[bytes]:
    """The first n datagrams of a robot that adds, supersedes, counts and corrects."""
    rng, replica = random.Random(seed), Replica(robot)
    datagrams: list[bytes] = []
    while len(datagrams) < n:
        act(rng, replica)
        datagrams += replica.datagrams()
    return datagrams[:n]


def killed(path: Path, copy: Path) -> Path:
    """A copy of the files at `path`, as a process leaves them that is killed now."""
    copy.mkdir()
    for file in path.parent.glob(f"{path.name}*"):
        shutil.copy(file, copy)
    return copy / path.name


def filled(folder: Path, datagrams: list[bytes]) -> Path:
    """The store of robot 0, which received these one by one and was killed."""
    replica = Replica(0)
    with Store(folder / "first" / "robot.sqlite", 0) as store:
        store.restore(replica)
        for datagram in datagrams:
            assert replica.receive(datagram)
            assert store.keep([datagram])
        return killed(store.path, folder / "killed")


def reopened(path: Path, **options) -> tuple[Replica, Restored]:
    replica = Replica(0)
    with Store(path, 0, **options) as store:
        restored = store.restore(replica)
        store.close()
    return replica, restored


def rows(path: Path, table: str = "record") -> list[tuple]:
    with contextlib.closing(sqlite3.connect(path)) as db:
        return db.execute(f"SELECT * FROM {table}").fetchall()


def altered(path: Path, *statements: str) -> Path:
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as db:
        for statement in statements:
            db.execute(statement)
    return path


def state(n: int) -> dict[str, object]:
    return {"n": n, "none": None, "nested": [{"x": torch.full((2, 3), float(n), dtype=torch.float64)}]}
