"""The clocks that missions run by, and a stopwatch for the stages of their work."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from gmmtorch.errors import InvalidArgumentError

_LONGEST_SLEEP = 0.02
"""Seconds between two calls of `idle` at most."""
_SHORTEST_SLEEP = 1e-4
"""Seconds. Rounding of shorter sleeps could keep the clock from ever reaching its target."""


class Clock(Protocol):
    """The time of a mission in seconds since its start. It never decreases."""

    def now(self) -> float: ...

    def wait(self, until: float, idle: Callable[[], object], stopped: Callable[[], bool]) -> None:
        """Returns at the time `until`, or as soon as `stopped` returns True; calls `idle` meanwhile."""


class SimulatedClock:
    """Waiting takes no time: the clock jumps to the time waited for, and never calls `idle`."""

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        return self._now

    def wait(self, until: float, idle: Callable[[], object], stopped: Callable[[], bool]) -> None:
        self._now = until


class WallClock:
    """Real time, times `speed`. A system clock that is set back stands still for that step.

    Args:
        speed: mission seconds per second of `clock`.
        clock: seconds since any moment. sleep: waits for a number of seconds.
    """

    def __init__(
        self,
        speed: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        check_pace(speed=speed)
        self._speed, self._clock, self._sleep = speed, clock, sleep
        self._last, self._elapsed = clock(), 0.0

    def now(self) -> float:
        reading = self._clock()
        self._elapsed += max(0.0, reading - self._last)
        self._last = reading
        return self._elapsed * self._speed

    def wait(self, until: float, idle: Callable[[], object], stopped: Callable[[], bool]) -> None:
        while not stopped() and self.now() < until:
            idle()
            seconds = (until - self.now()) / self._speed
            self._sleep(min(max(seconds, _SHORTEST_SLEEP), _LONGEST_SLEEP))


def check_pace(*, rate: float = 1.0, speed: float = 1.0, settle: float = 0.0) -> None:
    """Raises `InvalidArgumentError` unless rate (Hz) and speed are positive and settle (s) is not negative;
    all must be finite."""
    for name, value in (("rate", rate), ("speed", speed)):
        if not 0 < value < math.inf:
            raise InvalidArgumentError(f"{name}={value} must be above zero, and finite.")
    if not 0 <= settle < math.inf:
        raise InvalidArgumentError(f"settle={settle} must be at least zero seconds, and finite.")


class Stopwatch:
    """Sums the time of stages. A nested stage counts for itself only, not for the stage around it.

    Attributes:
        seconds: total by stage.

    Args:
        clock: seconds since any moment: wall time, or `time.process_time`, which excludes other processes.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.seconds: dict[str, float] = {}
        self._clock = clock
        self._inner = 0.0

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Times the body of the `with` statement."""
        begin, outer, self._inner = self._clock(), self._inner, 0.0
        yield
        spent = self._clock() - begin
        self.seconds[stage] = self.seconds.get(stage, 0.0) + spent - self._inner
        self._inner = outer + spent
