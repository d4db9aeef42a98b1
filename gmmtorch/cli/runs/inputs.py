"""The recordings that `inputs` names: local paths and globs, and URLs that fsspec reads."""

from __future__ import annotations

import contextlib
import glob
import hashlib
import re
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from gmmtorch.errors import DataError, MissingDataError

_LONGEST_NAME = 60


def find_recordings(inputs: Sequence[str]) -> dict[str, str]:
    """The address of each recording by a name that is unique and a valid file name, sorted.

    inputs: files or folders, globs with *, ? and **, and URLs such as s3://bucket/drives/*.mcap. What two of
    them match is one recording.

    Raises `MissingDataError` for an input that matches nothing, and `DataError` for a URL that cannot be
    read.
    """
    found: dict[str, str] = {}
    for pattern in inputs:
        matches = _remote(pattern) if "://" in pattern else _local(pattern)
        if not matches:
            raise MissingDataError(
                f"inputs={pattern!r} matches no file or folder; give paths, globs or URLs of recordings."
            )
        found |= {_name(address): address for address in matches}
    return dict(sorted(found.items()))


def _local(pattern: str) -> list[str]:
    matches = glob.glob(str(Path(pattern).expanduser()), recursive=True)
    return [str(Path(match).resolve()) for match in matches]


def _remote(pattern: str) -> list[str]:
    with _errors_of(pattern):
        system, path = _file_system(pattern)
        matches = system.glob(path) if glob.has_magic(path) else [path] if system.exists(path) else []
        return [str(system.unstrip_protocol(match)) for match in matches]


def _name(address: str) -> str:
    """The last part of an address, and the start of its hash, because two folders can have equal names."""
    last = address.rstrip("/").split("/")[-1] if "://" in address else Path(address).name
    stem = re.sub(r"[^\w.-]+", "_", last)[:_LONGEST_NAME].strip(".")
    return f"{stem or 'recording'}-{hashlib.sha256(address.encode()).hexdigest()[:8]}"


@contextlib.contextmanager
def local_copy(address: str) -> Iterator[Path]:
    """A local path of a recording. A remote one is copied to a temporary folder, which is removed at the end.

    Raises `DataError` if it cannot be copied.
    """
    if "://" not in address:
        yield Path(address)
        return
    with tempfile.TemporaryDirectory(prefix="gmmtorch-") as folder:
        target = Path(folder) / address.rstrip("/").split("/")[-1]
        with _errors_of(address):
            system, path = _file_system(address)
            system.get(path, str(target), recursive=bool(system.isdir(path)))
        yield target


def _file_system(url: str) -> tuple[Any, str]:
    import fsspec  # a dependency of torch

    system, path = fsspec.core.url_to_fs(url)
    return system, str(path)


@contextlib.contextmanager
def _errors_of(url: str) -> Iterator[None]:
    """Errors of a file system become a `DataError` that names the URL."""
    try:
        yield
    except ImportError as error:
        protocol = url.partition("://")[0]
        raise DataError(
            f"inputs: {url} cannot be read: {error}. fsspec reads {protocol}:// with that package: install "
            "it with pip."
        ) from error
    except Exception as error:  # every file system has errors of its own
        raise DataError(
            f"inputs: {url} cannot be read ({type(error).__name__}: {error}); check the address and your "
            "access to it."
        ) from error
