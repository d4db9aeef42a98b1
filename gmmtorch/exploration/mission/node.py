"""Node: one robot in a process of its own, whatever it does there; and the loop that runs it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from gmmtorch.errors import GmmTorchError, InvalidArgumentError

_REST = 0.02
"""Seconds between two looks into the inbox, at most."""
_LEAST = 1e-4
"""Seconds that it sleeps at least: rounding must not keep it from coming to the next tick."""
_LOOK = 0.2
"""Seconds between two looks at whether the team has fallen silent."""


class TwinError(GmmTorchError):
    """Another robot has this robot's number."""


class Node(Protocol):
    """Times `now` are seconds since it was started; they never fall."""

    @property
    def robot(self) -> int:
        """Its number."""

    def tick(self, now: float) -> None:
        """One step of its work; it listens, too."""

    @property
    def is_over(self) -> bool:
        """Whether it has no more work of its own; it may still listen and answer."""

    def listen(self, now: float) -> None:
        """Hear, answer, announce; no work: while it waits, and after its work is over."""

    @property
    def twin(self) -> str | None:
        """What is said of another robot of this number, if there is one."""

    def status(self) -> str:
        """One short line for a terminal."""

    def scalars(self) -> dict[str, float]:
        """Numbers for a plot. "records": of the map that is shared; while they change, there is news."""

    def row(self) -> dict[str, Any]:
        """What it leaves in results.json."""

    def files(self) -> dict[str, tuple[str, Callable[[Path], object]]]:
        """Its map, and whatever else it has made: of each its file's name, and what writes it to a path."""

    def close(self) -> None:
        """Keep what is to be kept, and let go of disk and network. May be called again."""


def check_number(node: Node) -> None:
    """Raises `TwinError` where another robot has this robot's number."""
    if node.twin is not None:
        raise TwinError(node.twin)


class Paced(NamedTuple):
    """ticks: done; late: of them, delayed by the one before; seconds: of the robots' time."""

    ticks: int
    late: int
    seconds: float


def run_paced(
    nodes: Node | Sequence[Node],
    rate: float,
    *,
    duration: float | None = None,
    speed: float = 1.0,
    settle: float = 0.0,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], object] = time.sleep,
    stop: Callable[[], bool] | None = None,
    on_status: Callable[[Node, float], None] | None = None,
    status_every: float = 1.0,
) -> Paced:
    """Run robots by the clock until their work is over, and on until nothing new comes.

    Between ticks they listen, every 20 ms at least. A tick that takes longer than its time delays all that
    follow; none is left out, and none hurried. The time of day is not asked for; a `clock` that is set back
    stands still for that step.

    Args:
        nodes: one, or several that share this thread.
        rate: ticks a second of the robots' time, of which `speed` pass in one second.
        duration: work ends after so many seconds of theirs, if it is not over before.
        settle: seconds of theirs without a new record, after which it ends for good.
        stop: asked every 20 ms at least whether to end at once; an Event's `is_set`, say.
        on_status: told of each node, with its time, every `status_every` seconds, and at the end.

    Whatever a node raises ends it. Nodes are not closed.
    """
    check_pace(rate, speed, settle)
    _check(status_every=status_every)
    if duration is not None and not duration >= 0:
        raise InvalidArgumentError(f"duration={duration} must be at least zero seconds.")
    team = list(nodes) if isinstance(nodes, Sequence) else [nodes]
    stopped = stop or (lambda: False)
    watch = _Watch(clock, speed)
    teller = _Teller(team, watch, on_status, status_every)
    limit = math.inf if duration is None else duration - 1e-9
    due, n_ticks, n_late = 0.0, 0, 0

    def wait(until: float) -> None:
        for node in team:
            node.listen(watch.now())
        teller.tell()
        sleep(min(max((until - watch.now()) / speed, _LEAST), _REST))

    while due < limit and not stopped() and not all(node.is_over for node in team):
        if watch.now() < due:
            wait(due)
            continue
        for node in team:
            (node.listen if node.is_over else node.tick)(watch.now())
        n_ticks, due = n_ticks + 1, due + 1 / rate
        if watch.now() > due:
            n_late, due = n_late + 1, watch.now()
        teller.tell()

    since, looked, content = watch.now(), -math.inf, None
    while not stopped() and watch.now() < since + settle:
        if watch.seconds() >= looked + _LOOK:
            looked, before = watch.seconds(), content
            content = [node.scalars().get("records") for node in team]
            since = since if before in (None, content) else watch.now()
        wait(since + settle)
    teller.tell(at_once=True)
    return Paced(n_ticks, n_late, watch.now())


class _Watch:
    """The time that has passed, of a clock that may be set."""

    def __init__(self, clock: Callable[[], float], speed: float) -> None:
        self._clock, self._speed = clock, speed
        self._last, self._passed = clock(), 0.0

    def seconds(self) -> float:
        """Real ones."""
        reading = self._clock()
        self._passed += max(0.0, reading - self._last)
        self._last = reading
        return self._passed

    def now(self) -> float:
        """The robots' time."""
        return self.seconds() * self._speed


class _Teller:
    """Tells how things are, not too often."""

    def __init__(
        self,
        team: Sequence[Node],
        watch: _Watch,
        on_status: Callable[[Node, float], None] | None,
        every: float,
    ) -> None:
        self._team, self._watch, self._on_status, self._every = team, watch, on_status, every
        self._next = every

    def tell(self, at_once: bool = False) -> None:
        if self._on_status is None or not (at_once or self._watch.seconds() >= self._next):
            return
        self._next = self._watch.seconds() + self._every
        for node in self._team:
            self._on_status(node, self._watch.now())


def check_pace(rate: float, speed: float, settle: float) -> None:
    """Raises `InvalidArgumentError` for what `run_paced` cannot go by."""
    _check(rate=rate, speed=speed)
    if not 0 <= settle < math.inf:
        raise InvalidArgumentError(f"settle={settle} must be at least zero seconds, and finite.")


def _check(**values: float) -> None:
    for name, value in values.items():
        if not 0 < value < math.inf:
            raise InvalidArgumentError(f"{name}={value} must be above zero, and finite.")
