"""Callbacks that report the progress of long work."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Event = Callable[[str, int, int | None], None]
"""(stage, done, total): the name of the stage, the work done so far, and all its work (None if unknown)."""

Row = dict[str, Any]
"""One row of results.json: values by field."""

OnRows = Callable[[list[Row]], object]
"""Called with all rows so far after each new row, so that a run that fails late keeps its rows."""


def ignore(stage: str, done: int, total: int | None) -> None:
    """The default callback: ignores all events."""
