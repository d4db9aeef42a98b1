"""RobotProcess: a gmmtorch-robot process that belongs to a team's process."""

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
from typing import Any

from gmmtorch.cli.robot import TEAM_VARIABLE

_COMMAND = (sys.executable, "-m", "gmmtorch.cli.robot")
_PATIENCE = 30.0
"""Seconds for a robot to end once it is told to."""
_TAIL = 1 << 14
"""Bytes at the end of a robot's output that are searched for its last line."""
_IGNORED_LINE = "Set the environment variable HYDRA_FULL_ERROR"
_ERROR = "gmmtorch: error: "


class RobotProcess:
    """A robot's process. It ends when it is told to, and when the process that started it has ended.

    Args:
        overrides: its options. folder: its run directory; its output goes to output.log there.
    """

    def __init__(self, number: int, overrides: Sequence[str], folder: Path) -> None:
        self.number, self.folder = number, folder
        folder.mkdir(parents=True, exist_ok=True)
        self.output = folder / "output.log"
        with self.output.open("wb") as output:
            self._process = subprocess.Popen(
                [*_COMMAND, *overrides, f"hydra.run.dir={_quoted(folder)}"],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=_environment(),
            )

    def is_running(self) -> bool:
        """Whether it still runs. Raises `GmmTorchError` if it failed."""
        from gmmtorch.errors import GmmTorchError

        status = self._process.poll()
        if status in (None, 0):
            return status is None
        reason = f"it was ended by {signal.Signals(-status).name}" if status < 0 else self.last_line()
        raise GmmTorchError(
            f"Robot {self.number} has ended: {reason.removeprefix(_ERROR)} (its output: {self.output})"
        )

    def last_line(self) -> str:
        """The last line of its output that says something."""
        with self.output.open("rb") as output:
            output.seek(max(0, output.seek(0, os.SEEK_END) - _TAIL))
            lines = output.read().decode("utf-8", "replace").splitlines()
        said = [line.strip() for line in lines if line.strip() and not line.startswith(_IGNORED_LINE)]
        return said[-1] if said else ""

    def row(self) -> dict[str, Any]:
        """Its row of results.json, once it has ended. Raises `GmmTorchError` if there is none."""
        from gmmtorch.errors import GmmTorchError

        try:
            row: dict[str, Any] = json.loads((self.folder / "results.json").read_text("utf-8"))["rows"][0]
        except (OSError, ValueError, LookupError) as error:
            raise GmmTorchError(
                f"Robot {self.number} has left no results ({error}); see {self.output}."
            ) from error
        return row


def end_all(robots: Sequence[RobotProcess]) -> None:
    """Ends the robots that still run: politely, and by force after 30 seconds or a second interrupt."""
    try:
        for robot in robots:
            robot._process.terminate()
        end = time.monotonic() + _PATIENCE
        for robot in robots:
            with contextlib.suppress(subprocess.TimeoutExpired):
                robot._process.wait(max(end - time.monotonic(), 0.0))
    finally:
        for robot in robots:
            robot._process.kill()
            robot._process.wait()


def _environment() -> dict[str, str]:
    """The environment of a robot, in which it imports the same packages as this process."""
    found = os.pathsep.join(path for path in sys.path if path)
    return {**os.environ, "PYTHONPATH": found, TEAM_VARIABLE: str(os.getpid())}


def _quoted(path: Path) -> str:
    """A path as a value that Hydra's grammar accepts."""
    return "'" + str(path).replace("'", "\\'") + "'"
