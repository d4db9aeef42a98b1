"""What a robot shows of itself: a status line, numbers in TensorBoard, and numbers over time for its row."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol

from omegaconf import DictConfig

from gmmtorch.cli import common
from gmmtorch.cli.status_line import StatusLine

if TYPE_CHECKING:
    from gmmtorch.exploration.mission.node import Node

_EVERY = 1.0  # seconds of the robot's time between what is shown
_SERIES = {"entropy_bits": "entropy_bits", "records": "records_over_time", "bytes_sent": "bytes_over_time"}


_COMPARE = "; compare link.key_file, or $GMMTORCH_TEAM_KEY, of all robots"


class _Display(Protocol):
    """Where a robot is shown. All may raise `OSError`."""

    option: str
    """That it is there for."""

    def show(self, now: float, numbers: dict[str, float]) -> None: ...
    def close(self) -> None: ...


class RobotReport:
    """Shows a robot as `report.*` want it. Called with the robot's time, as often as one likes.

    What can no longer be written is switched off, which the log says once; the robot goes on.

    Attributes:
        series: of the robot's row: "times" (s), at least `evaluation.every` apart, and numbers then.
    """

    def __init__(self, config: DictConfig, node: Node, folder: Path) -> None:
        self._node, self._every = node, config.evaluation.every
        self._shown_until = self._noted_until = 0.0
        self.series: dict[str, list[float]] = {"times": []}
        self._displays: list[_Display] = []
        if config.report.progress and sys.stderr is not None:  # as it is where it was closed
            self._displays.append(_Line(node))
        if config.report.tensorboard:
            try:
                self._displays.append(_Events(folder / "tensorboard"))
            except OSError as error:
                _tell_off(_Events.option, error)

    def __call__(self, now: float) -> None:
        """Show and note what there is at the time `now` (s), if there has been nothing for a while."""
        if now >= self._shown_until:
            self._shown_until = now + _EVERY
            self._show(now)
        if now >= self._noted_until - 1e-9:
            self._noted_until = now + self._every
            self._note(now)

    def finish(self, now: float) -> None:
        """Show and note what there is in the end, in place of what was noted a moment ago."""
        self._show(now)
        times = self.series["times"]
        if times and now - times[-1] < min(_EVERY, self._every):
            for values in self.series.values():
                values.pop()
        self._note(now)

    def _show(self, now: float) -> None:
        numbers = self._node.scalars()
        for display in list(self._displays):
            try:
                display.show(now, numbers)
            except OSError as error:
                self._displays.remove(display)
                with contextlib.suppress(OSError):  # as it has just said
                    display.close()
                _tell_off(display.option, error)

    def _note(self, now: float) -> None:
        numbers = self._node.scalars()
        self.series["times"].append(now)
        for name, title in _SERIES.items():
            if name in numbers:
                self.series.setdefault(title, []).append(numbers[name])

    def close(self) -> None:
        """End the line, and the file."""
        while self._displays:
            display = self._displays.pop()
            try:
                display.close()
            except OSError as error:
                _tell_off(display.option, error)

    def __enter__(self) -> RobotReport:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class _Line:
    """The status line, and the log above it."""

    option = "report.progress"

    def __init__(self, node: Node) -> None:
        self._node, self._line = node, StatusLine()
        common.logger.addHandler(self._line)  # before those of the root, which Hydra has set up

    def show(self, now: float, numbers: dict[str, float]) -> None:
        refused = f", {numbers['refused']:,.0f} refused" if numbers["refused"] else ""
        self._line.show(f"robot {self._node.robot}  {now:6.0f} s  {self._node.status()}{refused}")

    def close(self) -> None:
        common.logger.removeHandler(self._line)
        self._line.end()


class _Events:
    """TensorBoard's."""

    option = "report.tensorboard"

    def __init__(self, folder: Path) -> None:
        from gmmtorch.report.tensorboard_writer import Board

        self._board = Board(folder)

    def show(self, now: float, numbers: dict[str, float]) -> None:
        # Milliseconds, so that all robots of a team have one axis.
        self._board.scalars(numbers, prefix="robot", step=round(1000 * now))

    def close(self) -> None:
        self._board.close()


def _tell_off(option: str, error: OSError) -> None:
    common.logger.warning("%s is switched off, and the robot goes on: %s", option, error)


def print_refusals(rows: Sequence[dict[str, Any]]) -> None:
    """A line for each robot, by its row, that has refused what came over the network: why, and how often."""
    for row in rows:
        if counts := row["refused"]:
            told = ", ".join(f"{n:,} {reason}" for reason, n in counts.items())
            remedy = _COMPARE if "wrong_key" in counts else ""
            print(f"robot {row['robot']} refused {sum(counts.values()):,} frames: {told}{remedy}")
