"""The driver of all missions: ticks at their times by a clock, then an exchange until no news arrives."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import NamedTuple, Protocol

from gmmtorch.exploration.mission.clocks import Clock, check_pace

_LOOK = 0.2
"""Mission seconds between two checks for news while a team settles, at most."""


class Drivable(Protocol):
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

    def exchange(self, now: float) -> None:
        """Listens, answers and announces, without other work."""

    def content(self) -> Hashable:
        """A value that changes whenever a robot adds records to its map."""
        ...


class Run(NamedTuple):
    """ticks: done. late: ticks that delayed the next one. seconds: mission time at the end."""

    ticks: int
    late: int
    seconds: float


def never() -> bool:
    """The default stop condition."""
    return False


def ignore_step() -> None:
    """The default callback: ignores every step."""


def drive(
    mission: Drivable,
    clock: Clock,
    *,
    stop: Callable[[], bool] = never,
    on_step: Callable[[], object] = ignore_step,
) -> Run:
    """Ticks until the mission is over or `stop` returns True.

    Tick n is due `n * tick_seconds` after the start. While the clock waits, the robots exchange messages.
    A tick that takes longer than `tick_seconds` delays all later ticks by the excess; none is skipped or
    shortened.

    Args:
        stop: checked before each tick, and at least every 20 ms of a `WallClock`.
        on_step: called after every tick and every exchange.
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
    mission: Drivable,
    clock: Clock,
    quiet: float,
    *,
    stop: Callable[[], bool] = never,
    on_step: Callable[[], object] = ignore_step,
) -> None:
    """Exchanges messages until `mission.content` has not changed for `quiet` seconds, or `stop` returns True.

    Raises `InvalidArgumentError` if `quiet` is negative or infinite.
    """
    check_pace(settle=quiet)

    def idle() -> None:
        mission.exchange(clock.now())
        on_step()

    since, content = clock.now(), mission.content()
    while not stop() and clock.now() < since + quiet:
        clock.wait(min(clock.now() + _LOOK, since + quiet), idle, stop)
        before, content = content, mission.content()
        if content != before:
            since = clock.now()
