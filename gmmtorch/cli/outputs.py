"""What a run writes on a disk that may fail: every file is tried, and what is missing is told once."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path


class Outputs:
    """The files of a run's folder, written one after another, each whether or not those before could be."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._unwritten: dict[str, list[str]] = {}
        """What was not written, by why."""

    def written(self, name: str, write: Callable[[Path], object]) -> Path | None:
        """The file or folder `name` of the run's folder, which `write` fills; None where it cannot."""
        path = self.folder / name
        try:
            write(path)
        except OSError as error:
            cause = error.__cause__ if isinstance(error.__cause__, OSError) else error
            self._unwritten.setdefault(cause.strerror or str(cause), []).append(name)
            return None
        return path

    def check(self) -> None:
        """Raises `OutputError`, which names all that was not written, and why."""
        from gmmtorch.errors import OutputError

        if self._unwritten:
            missing = "; ".join(f"{', '.join(names)} ({why})" for why, names in self._unwritten.items())
            raise OutputError(
                f"hydra.run.dir={self.folder} has not got all results: {missing}. Free space there, or give "
                "another folder."
            )


@contextmanager
def terse() -> Iterator[None]:
    """Within it a disk that fails is told of by whoever has something to write, in a line. Python itself
    would print a call stack for every record that the log's file does not take, and for the thread that
    writes TensorBoard's events."""
    raising, hook = logging.raiseExceptions, threading.excepthook

    def told(ended: threading.ExceptHookArgs) -> None:
        if not (
            type(ended.thread).__module__.startswith("tensorboard.") and issubclass(ended.exc_type, OSError)
        ):
            hook(ended)

    logging.raiseExceptions, threading.excepthook = False, told
    try:
        yield
    finally:
        logging.raiseExceptions, threading.excepthook = raising, hook
