"""What a robot shows of itself while it works: a status line, and numbers in TensorBoard."""

from __future__ import annotations

import sys
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from omegaconf import DictConfig

if TYPE_CHECKING:
    from gmmtorch.exploration.node import Node
    from gmmtorch.report import Board

_EVERY = 1.0  # seconds of the robot's time between numbers


class RobotReport:
    """Shows a robot as `report.*` want it. Called with the robot's time, as often as one likes."""

    def __init__(self, config: DictConfig, node: Node, folder: Path) -> None:
        self._node, self._next, self._last = node, 0.0, ""
        self._live = config.report.progress
        self._board: Board | None = None
        if config.report.tensorboard:
            from gmmtorch.report import Board

            self._board = Board(folder / "tensorboard")

    def __call__(self, now: float) -> None:
        """Show what there is at the time `now` (s), if there has been nothing for a while."""
        if now < self._next:
            return
        self._next = now + _EVERY
        if self._live:
            self._print(f"robot {self._node.robot}  {now:6.0f} s  {self._node.status()}")
        if self._board is not None:
            # Milliseconds, so that all robots of a team have one axis.
            self._board.scalars(self._node.scalars(), prefix="robot", step=round(1000 * now))

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
