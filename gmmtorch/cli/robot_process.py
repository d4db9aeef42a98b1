"""RobotProcess: gmmtorch-robot as a process that belongs to a team's."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

from gmmtorch.cli.robot import TEAM_VARIABLE

_COMMAND = (sys.executable, "-m", "gmmtorch.cli.robot")
_PATIENCE = 30.0  # seconds for a robot to end when it is told to
_GRACE = 5.0  # seconds for one that has fallen silent to end, and so to say why
_TAIL = 1 << 14  # bytes of its output that are looked at
_NEVER_MATTERS = "Set the environment variable HYDRA_FULL_ERROR"
_ERROR = "gmmtorch: error: "


class RobotProcess:
    """A robot's process. It ends when it is told to, and when the process that started it has ended.

    Args:
        overrides: its options. folder: its run directory; what it prints goes to output.log there.
        in_step: whether it is spoken to, by `pipes`.
    """

    def __init__(self, number: int, overrides: Sequence[str], folder: Path, in_step: bool) -> None:
        self.number, self.folder = number, folder
        folder.mkdir(parents=True, exist_ok=True)
        self.output = folder / "output.log"
        with self.output.open("wb") as output:
            self._process = subprocess.Popen(
                [*_COMMAND, *overrides, f"hydra.run.dir={_quoted(folder)}"],
                stdin=subprocess.PIPE if in_step else subprocess.DEVNULL,
                stdout=subprocess.PIPE if in_step else output,
                stderr=output,
                encoding="utf-8",
                env=_environment(),
            )

    @property
    def pipes(self) -> tuple[IO[str], IO[str]]:
        """What it reads from, and what it writes to. Of a process in step."""
        asked, answered = self._process.stdin, self._process.stdout
        if asked is None or answered is None:
            raise RuntimeError("This robot goes by the clock; nobody speaks to it.")
        return asked, answered

    def is_at_work(self) -> bool:
        """Whether it still runs. Raises `GmmTorchError` if it has ended badly."""
        from gmmtorch.errors import GmmTorchError

        status = self._process.poll()
        if status in (None, 0):
            return status is None
        why = f"it was ended by {signal.Signals(-status).name}" if status < 0 else self.status()
        raise GmmTorchError(
            f"Robot {self.number} has ended: {why.removeprefix(_ERROR)} (its output: {self.output})"
        )

    def explain(self) -> None:
        """Raises `GmmTorchError` with what it said last, if it has ended badly, or is about to."""
        if self._wait(_GRACE):
            self.is_at_work()

    def status(self) -> str:
        """The last line that it has printed, of those that say something."""
        with self.output.open("rb") as output:
            output.seek(max(0, output.seek(0, os.SEEK_END) - _TAIL))
            lines = output.read().decode("utf-8", "replace").splitlines()
        said = [line.strip() for line in lines if line.strip() and not line.startswith(_NEVER_MATTERS)]
        return said[-1] if said else ""

    def row(self) -> dict[str, Any]:
        """What it has left in results.json, once its work is done."""
        from gmmtorch.errors import GmmTorchError

        self._wait(_PATIENCE)  # for it to close what it has open
        try:
            row: dict[str, Any] = json.loads((self.folder / "results.json").read_text("utf-8"))["rows"][0]
        except (OSError, ValueError, LookupError) as error:
            raise GmmTorchError(
                f"Robot {self.number} has left no results ({error}); see {self.output}."
            ) from error
        return row

    def _wait(self, seconds: float) -> bool:
        """Whether it has ended, at the latest after so long."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(max(seconds, 0.0))
        return self._process.returncode is not None

    def _forget(self) -> None:
        """Kill it if it still runs, and let go of its pipes."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):  # of what it never read
                    pipe.close()


def end_all(robots: Sequence[RobotProcess]) -> None:
    """End those that have not, if need be by force; at once where somebody is too impatient to wait."""
    try:
        for robot in robots:
            robot._process.terminate()
        end = time.monotonic() + _PATIENCE
        for robot in robots:
            robot._wait(end - time.monotonic())
    finally:
        for robot in robots:
            robot._forget()


def _environment() -> dict[str, str]:
    """The robot imports what this process would import, wherever that is."""
    found = os.pathsep.join(path for path in sys.path if path)
    return {**os.environ, "PYTHONPATH": found, TEAM_VARIABLE: str(os.getpid())}


def _quoted(path: Path) -> str:
    """As a value that Hydra's grammar takes as it is."""
    return "'" + str(path).replace("'", "\\'") + "'"
