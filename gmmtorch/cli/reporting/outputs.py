"""Writes a run's files to a disk that may fail, and reports the missing files once."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path


class Outputs:
    """Writes the files of a run's folder; a failed file does not prevent the next ones."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._missing: dict[str, list[str]] = {}
        """Names of missing files by the reason."""

    def written(self, name: str, write: Callable[[Path], object]) -> Path | None:
        """Call `write` with the path of the file or folder `name`; returns the path, or None if it fails."""
        path = self.folder / name
        try:
            write(path)
        except OSError as error:
            cause = error.__cause__ if isinstance(error.__cause__, OSError) else error
            self._missing.setdefault(cause.strerror or str(cause), []).append(name)
            return None
        return path

    def check(self) -> None:
        """Raises `OutputError` with the names of the missing files and the reasons."""
        from gmmtorch.errors import OutputError

        if self._missing:
            missing = "; ".join(f"{', '.join(names)} ({why})" for why, names in self._missing.items())
            raise OutputError(
                f"hydra.run.dir={self.folder} does not contain all results: {missing}. Free space there, or "
                "give another folder."
            )


@contextmanager
def terse() -> Iterator[None]:
    """Suppresses Python's call stacks for a disk that fails; `Outputs` reports the failure in one line.

    Python would print a call stack for each log record that cannot be written, and for TensorBoard's writer
    thread.
    """
    raising, hook = logging.raiseExceptions, threading.excepthook

    def report(ended: threading.ExceptHookArgs) -> None:
        if not (
            type(ended.thread).__module__.startswith("tensorboard.") and issubclass(ended.exc_type, OSError)
        ):
            hook(ended)

    logging.raiseExceptions, threading.excepthook = False, report
    try:
        yield
    finally:
        logging.raiseExceptions, threading.excepthook = raising, hook
