"""Kills a process in the middle of each kind of write, and lets its disk be full, at every kind of place.

    PYTHONPATH=tests python -m kill_writes

A first version of the files is there. A child writes the second one and is killed by the system when a file
reaches a number of bytes, or before a rename. What is left must be one of the versions, as a whole. Then the
same limit is an error of the disk instead: the child must raise an `OutputError` of one line that names the
path, and leave the first version and nothing else. Prints the number of deaths and of full disks by kind.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from mapping.random_components import random_components

from gmmtorch import GaussianMap
from gmmtorch.datasets import BagReader, load
from gmmtorch.errors import MissingDataError, OutputError
from gmmtorch.export.bag import BagWriter
from gmmtorch.files import write_json, write_npz
from gmmtorch.mapping import MapBuilder, TiledMap, merge, tile_files
from gmmtorch.report.style import new_figure, save_figure


class Kind(NamedTuple):
    """write: writes version 0 or 1 into a folder. read: the version that is there; raises an error if none
    is whole. may_be_gone: whether there may be none, because the same write can be done again."""

    write: Callable[[Path, int], object]
    read: Callable[[Path], int]
    may_be_gone: bool = False


def kinds(home: Path) -> dict[str, Kind]:
    maps = [GaussianMap.of(random_components(3, k=k, seed=k)) for k in (30, 50)]
    return {
        "map": Kind(
            lambda place, i: maps[i].save(place / "a.safetensors"),
            lambda place: [30, 50].index(GaussianMap.load(place / "a.safetensors").n_components),
        ),
        "json": Kind(
            lambda place, i: write_json(place / "results.json", {"rows": [i] * 500}),
            lambda place: int(json.loads((place / "results.json").read_text())["rows"][499]),
        ),
        "npz": Kind(
            lambda place, i: write_npz(place / "a.npz", x=np.random.default_rng(i).random(300)),
            lambda place: int(np.load(place / "a.npz")["x"][0] == np.random.default_rng(1).random()),
        ),
        "checkpoint": checkpoint(),
        "picture": picture(),
        "growing tiles": growing(maps),
        "merged tiles": merged(maps, home),
        **{f"bag {suffix}": recording(f"a.{suffix}") for suffix in ("mcap", "bag", "db3")},
    }


def checkpoint() -> Kind:
    scans = load("synthetic_building_2d", n_scans=4)

    def builder() -> MapBuilder:
        return MapBuilder(scans, GaussianMap(window=1))

    made = [builder(), builder()]
    for one, n in zip(made, (2, 4), strict=True):
        steps = one.insert_all()
        for _ in range(n):
            next(steps)

    def read(place: Path) -> int:
        found = builder()
        found.load(place / "checkpoint.safetensors", {})
        return [2, 4].index(found.record.n_read)

    return Kind(lambda place, i: made[i].save(place / "checkpoint.safetensors", {}), read)


def picture() -> Kind:
    from PIL import Image

    figures = [new_figure(1.0, 1.0), new_figure(2.0, 1.0)]

    def read(place: Path) -> int:
        with Image.open(place / "a.png") as image:
            image.load()
            return int(image.width > 1.5 * image.height)

    return Kind(lambda place, i: save_figure(figures[i], place / "a.png"), read)


def growing(maps: list[GaussianMap]) -> Kind:
    def write(place: Path, i: int) -> None:
        if i == 0:
            TiledMap.create(place, GaussianMap(), 3, side=2.0)
        TiledMap(place).add(maps[i].components())

    return Kind(write, lambda place: [30, 80].index(TiledMap(place).open().n_components))


def merged(maps: list[GaussianMap], home: Path) -> Kind:
    parts = []
    for number, one in enumerate(maps):
        (home / str(number)).mkdir()
        for name, data in tile_files(one.components(), one.settings, 2.0).items():
            (home / str(number) / name).write_bytes(data)
        parts.append(TiledMap(home / str(number)))
    return Kind(
        lambda place, i: merge(place, parts[: i + 1]),
        lambda place: [30, 80].index(TiledMap(place).open().n_components),
        may_be_gone=True,  # the maps that are merged are still there
    )


def recording(name: str) -> Kind:
    def write(place: Path, i: int) -> None:
        with BagWriter(place / name) as bag:
            for k in range(3 + i):
                bag.cloud("/points", float(k), "lidar", np.ones((100, 3)))

    return Kind(write, lambda place: len(list(BagReader(place / name).messages(["/points"]))) - 3)


# -- deaths ------------------------------------------------------------------------------------------


def child(kind: Kind, place: Path, n_bytes: int | None, n_renames: int | None, is_killed: bool) -> int:
    """The status of a process that writes version 1: it is killed, meets a full disk (7), or ends (0)."""
    pid = os.fork()
    if pid:
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    status = 3
    try:
        if n_bytes is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_DFL if is_killed else signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, n_bytes))
        if n_renames is not None:
            die_at_rename(n_renames)
        kind.write(place, 1)
        status = 0
    except OutputError as error:
        status = 7 if "\n" not in str(error) and str(place) in str(error) else 8
    finally:
        os._exit(status)


def die_at_rename(number: int) -> None:
    replace, left = os.replace, [number]

    def counted(source: str, target: str) -> None:
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        left[0] -= 1
        replace(source, target)

    os.replace = counted
    Path.replace = lambda self, target: counted(self, target) or Path(target)  # type: ignore[assignment, method-assign]


def contents(place: Path) -> dict[str, bytes]:
    return {str(one): one.read_bytes() for one in sorted(place.rglob("*")) if one.is_file()}


def tried(name: str, kind: Kind) -> Counter[str]:
    """The outcomes of one kind of write. Raises an error if what is left is neither version."""
    counts: Counter[str] = Counter()
    limits = [0, 1, 100, 1000, 2000, 4000, 8000, 20_000]
    cases: list[tuple[int | None, int | None, bool]] = [(n, None, True) for n in limits]
    cases += [(n, None, False) for n in limits] + [(None, n, True) for n in range(12)]
    for n_bytes, n_renames, is_killed in cases:
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder) / "a"
            place.mkdir()
            kind.write(place, 0)
            before = contents(place)
            status = child(kind, place, n_bytes, n_renames, is_killed)
            try:
                version = kind.read(place)
            except MissingDataError:
                assert kind.may_be_gone, (name, n_bytes, n_renames)
                counts["gone"] += 1
                continue
            case = name, n_bytes, n_renames, is_killed, status, version
            if status < 0:
                counts[f"killed, version {version}"] += 1
            elif status == 0:
                assert version == 1, case
                counts["finished"] += 1
            else:
                assert (status, version) == (7, 0), case
                assert contents(place) == before, case
                counts["full"] += 1
    return counts


def main() -> None:
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as home:
        print(json.dumps({name: tried(name, kind) for name, kind in kinds(Path(home)).items()}))


if __name__ == "__main__":
    main()
