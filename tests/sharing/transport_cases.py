"""A team's key, a clock that tests set, and waiting for datagrams of real networks."""

from __future__ import annotations

import time
from collections.abc import Callable

from gmmtorch.sharing.transport.frames import FramedTransport
from gmmtorch.sharing.transport.team_key import TeamKey

SECRET = bytes(range(32))
KEY = TeamKey(SECRET)
Heard = list[tuple[int, bytes]]


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def until(is_done: Callable[[], bool]) -> None:
    """Waits for a condition; fails after a minute."""
    end = time.monotonic() + 60
    while not is_done():
        assert time.monotonic() < end
        time.sleep(0.002)


def heard(transport: FramedTransport, n: int) -> Heard:
    """The next n datagrams."""
    found: Heard = []
    until(lambda: len(found.extend(transport.deliver(transport.robot, 0.0)) or found) >= n)
    return found
