"""Targets: readers with sound inputs, which `fuzz.py` changes."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from fuzzing.hostile_bytes import Change, changed

from gmmtorch import datasets


class Target(NamedTuple):
    """What is fed: `seeds` by the names of their files, and the function that reads such a file.

    mend: makes the checksums of a changed file right again.
    change: changes sound bytes, given all seeds and a source of random numbers.
    has_thread: whether the reader starts a thread, which a fork does not copy.
    """

    seeds: dict[str, bytes]
    read: Callable[[Path], object]
    mend: Callable[[bytes], bytes] | None = None
    change: Change = changed
    has_thread: bool = False


def taken(folder: Path, *names: str) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in names}


def read_all(kind: str, path: Path, **options: Any) -> None:
    for scan in datasets.load(kind, path, **options):
        scan.ends()


def in_folder(
    files: Mapping[str, bytes], changing: Mapping[str, str], read: Callable[[Path], object], **rest: Any
) -> Target:
    """A reader of folders. changing: names of files by those of their seeds; the others stay sound."""

    def read_one(path: Path) -> None:
        with tempfile.TemporaryDirectory(prefix="gmmtorch-fuzz", dir=path.parent.parent) as place:
            for name, data in {**files, changing[path.name]: path.read_bytes()}.items():
                (Path(place) / name).parent.mkdir(exist_ok=True)
                (Path(place) / name).write_bytes(data)
            read(Path(place))

    return Target({seed: files[name] for seed, name in changing.items()}, read_one, **rest)
