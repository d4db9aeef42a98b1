"""What a robot shows of itself: a status line, numbers in TensorBoard, and numbers over time for its row."""

from __future__ import annotations

import sys
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from omegaconf import DictConfig

if TYPE_CHECKING:
    from gmmtorch.exploration.node import Node
    from gmmtorch.report.board import Board

_EVERY = 1.0  # seconds of the robot's time between what is shown
_SERIES = {"entropy_bits": "entropy_bits", "records": "records_over_time", "bytes_sent": "bytes_over_time"}


class RobotReport:
    """Shows a robot as `report.*` want it. Called with the robot's time, as often as one likes.

    Attributes:
        series: of the robot's row: "times" (s), at least `evaluation.every` apart, and numbers then.
    """

    def __init__(self, config: DictConfig, node: Node, folder: Path) -> None:
        self._node, self._every = node, config.evaluation.every
        self._shown_until = self._noted_until = 0.0
        self._live, self._last = config.report.progress, ""
        self.series: dict[str, list[float]] = {"times": []}
        self._board: Board | None = None
        if config.report.tensorboard:
            from gmmtorch.report.board import Board

            self._board = Board(folder / "tensorboard")

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
        if self._live:
            refused = f", {numbers['refused']:,.0f} refused" if numbers["refused"] else ""
            self._print(f"robot {self._node.robot}  {now:6.0f} s  {self._node.status()}{refused}")
        if self._board is not None:
            # Milliseconds, so that all robots of a team have one axis.
            self._board.scalars(numbers, prefix="robot", step=round(1000 * now))

    def _note(self, now: float) -> None:
        numbers = self._node.scalars()
        self.series["times"].append(now)
        for name, title in _SERIES.items():
            if name in numbers:
                self.series.setdefault(title, []).append(numbers[name])

    def _print(self, line: str) -> None:
        """On a terminal in place of the last one; in a log below it."""
        if sys.stderr.isatty():
            sys.stderr.write("\r" + line.ljust(len(self._last)))
        else:
            sys.stderr.write(line + "\n")
        sys.stderr.flush()
        self._last = line

    def close(self) -> None:
        """End the line, and the file."""
        if self._last and sys.stderr.isatty():
            sys.stderr.write("\n")
        if self._board is not None:
            self._board.close()

    def __enter__(self) -> RobotReport:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
