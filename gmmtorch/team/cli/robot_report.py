"""What the process of a robot shows: a status line and scalars; and how it writes files to a failing disk."""

from __future__ import annotations

import contextlib
import logging
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from gmmtorch.cli import drop_unwritable, logger
from gmmtorch.errors import OutputError

if TYPE_CHECKING:
    from gmmtorch.report import Board
    from gmmtorch.team.exploration import RobotView

_PERIOD = 1.0
"""Seconds of the robot's time between two updates of the displays."""
_CURVES = {"entropy_bits": "entropy_bits", "records": "records_over_time", "bytes_sent": "bytes_over_time"}
"""Fields of the row by the scalars whose values over time they hold."""
_COMPARE_KEYS = "; compare link.key_file, or $GMMTORCH_TEAM_KEY, of all robots"


class RobotReport:
    """Shows a robot as the options `report.*` say. Call it with the robot's time (s) as often as you like.

    A display that fails is closed, which the log says once; the robot continues.

    Attributes:
        series: fields of the robot's row: "times" (s), at least `evaluation.every` apart, and scalars then.
    """

    def __init__(self, config: DictConfig, view: RobotView, folder: Path) -> None:
        self._view, self._sample_every = view, config.evaluation.every
        self._next_show = self._next_sample = 0.0
        self.series: dict[str, list[float]] = {"times": []}
        self._displays: dict[str, _StatusLine | Board] = {}  # by the option that asks for it
        if config.report.progress and sys.stderr is not None:  # it is None if the process has closed it
            self._displays["report.progress"] = _StatusLine(view)
        if config.report.tensorboard:
            from gmmtorch.report import Board

            try:
                self._displays["report.tensorboard"] = Board(folder / "tensorboard")
            except OSError as error:
                _log_failure("report.tensorboard", error)

    def __call__(self, now: float) -> None:
        """Updates the displays and the series at the time `now` (s), if it is time to."""
        if now >= self._next_show:
            self._next_show = now + _PERIOD
            self._show(now)
        if now >= self._next_sample - 1e-9:
            self._next_sample = now + self._sample_every
            self._sample(now)

    def finish(self, now: float) -> None:
        """Updates the displays and the series for the last time. A sample of a moment ago is replaced."""
        self._show(now)
        times = self.series["times"]
        if times and now - times[-1] < min(_PERIOD, self._sample_every):
            for values in self.series.values():
                values.pop()
        self._sample(now)

    def _show(self, now: float) -> None:
        scalars = self._view.scalars()
        for option, display in list(self._displays.items()):
            try:
                if isinstance(display, _StatusLine):
                    display.show(now, scalars)
                else:  # steps are milliseconds, so that all robots of a team have the same axis
                    display.scalars(scalars, prefix="robot", step=round(1000 * now))
            except OSError as error:
                del self._displays[option]
                with contextlib.suppress(OSError):
                    display.close()
                _log_failure(option, error)

    def _sample(self, now: float) -> None:
        scalars = self._view.scalars()
        self.series["times"].append(now)
        for name, field in _CURVES.items():
            if name in scalars:
                self.series.setdefault(field, []).append(scalars[name])

    def close(self) -> None:
        """Closes the displays."""
        while self._displays:
            option, display = self._displays.popitem()
            try:
                display.close()
            except OSError as error:
                _log_failure(option, error)

    def __enter__(self) -> RobotReport:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _StatusLine(logging.Handler):
    """A status line on standard error, below the log.

    On a terminal, each status line replaces the last; in a file it is appended. As a handler of the log it
    ends the status line before each record, so that records have their own lines.
    """

    def __init__(self, view: RobotView) -> None:
        super().__init__()
        self._view = view
        self._width = 0  # of the line that the terminal's cursor is on
        logger.addHandler(self)  # runs before the handlers of the root logger

    def show(self, now: float, scalars: dict[str, float]) -> None:
        refused = f", {scalars['refused']:,.0f} refused" if scalars["refused"] else ""
        line = f"robot {self._view.robot}  {now:6.0f} s  {self._view.status()}{refused}"
        self.acquire()  # other threads may log
        try:
            if sys.stderr.isatty():
                sys.stderr.write("\r" + line.ljust(self._width))
                self._width = len(line)
            else:
                sys.stderr.write(line + "\n")
            sys.stderr.flush()
        except OSError:
            drop_unwritable()
            raise
        finally:
            self.release()

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self._end()
        except OSError:
            self.handleError(record)

    def close(self) -> None:
        logger.removeHandler(self)
        super().close()
        self._end()

    def _end(self) -> None:
        """Starts a new line if there is a status line."""
        if self._width:
            self._width = 0
            sys.stderr.write("\n")
            sys.stderr.flush()


def _log_failure(option: str, error: OSError) -> None:
    logger.warning("%s is switched off, and the robot continues: %s", option, error)


def print_refusals(rows: Sequence[dict[str, Any]]) -> None:
    """Prints, for each row of a robot that refused frames, how many and why."""
    for row in rows:
        if counts := row["refused"]:
            reasons = ", ".join(f"{n:,} {reason}" for reason, n in counts.items())
            remedy = _COMPARE_KEYS if "wrong_key" in counts else ""
            print(f"robot {row['robot']} refused {sum(counts.values()):,} frames: {reasons}{remedy}")


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
