"""The clocks that missions run by, and the loop that drives a mission by a clock."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import NamedTuple, Protocol

from gmmtorch.errors import check_number

_LONGEST_SLEEP = 0.02  # seconds between two calls of `idle` at most
_SHORTEST_SLEEP = 1e-4
"""Seconds. Rounding of shorter sleeps could keep the clock from ever reaching its target."""


class SimulatedClock:
    """Simulated seconds. Waiting takes no time: the clock jumps to the time waited for, without `idle`."""

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
        check_number("speed", speed, above=True)
        self._speed, self._clock, self._sleep = speed, clock, sleep
        self._last, self._elapsed = clock(), 0.0

    def now(self) -> float:
        reading = self._clock()
        self._elapsed += max(0.0, reading - self._last)
        self._last = reading
        return self._elapsed * self._speed

    def wait(self, until: float, idle: Callable[[], object], stopped: Callable[[], bool]) -> None:
        """Returns at the time `until`, or as soon as `stopped` returns True; calls `idle` meanwhile."""
        while not stopped() and self.now() < until:
            idle()
            seconds = (until - self.now()) / self._speed
            self._sleep(min(max(seconds, _SHORTEST_SLEEP), _LONGEST_SLEEP))


Clock = SimulatedClock | WallClock
"""The time of a mission in seconds since its start. It never decreases."""


class Stopwatch:
    """Sums the time of stages in `seconds`. A nested stage counts for itself only, not for that around it.

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


_LOOK = 0.2  # mission seconds between two checks for news while a team settles, at most


class Exchanging(Protocol):
    """One or more robots that share a map. Times are seconds of one clock."""

    def exchange(self, now: float) -> None:
        """Listens, answers and announces, without other work."""

    def content(self) -> Hashable:
        """A value that changes whenever a robot adds records to its map."""
        ...


class Drivable(Exchanging, Protocol):
    """One or more robots with work to do. Times are seconds since the start of the mission."""

    @property
    def tick_seconds(self) -> float:
        """Seconds between ticks."""
        ...

    @property
    def is_over(self) -> bool:
        """Whether no work is left; the robots may still exchange messages."""
        ...

    def tick(self, now: float) -> None:
        """Does one step of work, listening included."""


class Run(NamedTuple):
    """ticks: done. late: ticks that delayed the next one. seconds: mission time at the end."""

    ticks: int
    late: int
    seconds: float


def drive(
    mission: Drivable,
    clock: Clock,
    *,
    stop: Callable[[], bool] = lambda: False,
    on_step: Callable[[], object] = lambda: None,
) -> Run:
    """Ticks until the mission is over or `stop` returns True.

    Tick n is due `n * tick_seconds` after the start. While the clock waits, the robots exchange messages.
    A tick that takes longer than `tick_seconds` delays all later ticks by the excess; none is skipped.

    stop: checked before each tick, and at least every 20 ms of a `WallClock`. on_step: called after every
    tick and every exchange.
    """
    begin, ticks, late = 0.0, 0, 0

    def idle() -> None:
        mission.exchange(clock.now())
        on_step()

    while not mission.is_over:
        clock.wait(begin + ticks * mission.tick_seconds, idle, stop)
        if stop():
            break
        mission.tick(clock.now())
        ticks += 1
        excess = clock.now() - (begin + ticks * mission.tick_seconds)
        if excess > 0:
            late, begin = late + 1, begin + excess
        on_step()
    return Run(ticks, late, clock.now())


def settle(
    mission: Exchanging,
    clock: Clock,
    quiet: float,
    *,
    stop: Callable[[], bool] = lambda: False,
    on_step: Callable[[], object] = lambda: None,
) -> None:
    """Exchanges messages until `mission.content` has not changed for `quiet` seconds, or `stop` returns True.
    Raises `InvalidArgumentError` if `quiet` is negative or infinite."""
    check_number("settle", quiet)

    def idle() -> None:
        mission.exchange(clock.now())
        on_step()

    since, content = clock.now(), mission.content()
    while not stop() and clock.now() < since + quiet:
        clock.wait(min(clock.now() + _LOOK, since + quiet), idle, stop)
        before, content = content, mission.content()
        if content != before:
            since = clock.now()
