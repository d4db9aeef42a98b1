"""How long work tells of its progress."""

from __future__ import annotations

from collections.abc import Callable

Event = Callable[[str, int, int | None], None]
"""Called with a stage's name, how much of it is done, and how much there is."""


def ignore(stage: str, done: int, total: int | None) -> None:
    """Nobody listens."""
