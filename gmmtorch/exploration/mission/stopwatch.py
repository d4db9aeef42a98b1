"""Stopwatch: time by stage."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Stopwatch:
    """Adds up the time of stages; what a stage takes within another counts to itself alone.

    seconds: so far, by stage.

    Args:
        clock: seconds since any time; of the wall, or `time.process_time`, of which other work on the
            machine takes nothing.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.seconds: dict[str, float] = {}
        self._clock = clock
        self._inner = 0.0

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time what is done within."""
        begin, outer, self._inner = self._clock(), self._inner, 0.0
        yield
        spent = self._clock() - begin
        self.seconds[stage] = self.seconds.get(stage, 0.0) + spent - self._inner
        self._inner = outer + spent
