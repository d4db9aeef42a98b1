"""Heartbeat: how often a robot announces what it holds."""

from __future__ import annotations

import math
from typing import Any

from gmmtorch.errors import InvalidArgumentError

_SLOWEST = 16  # times the period


class Heartbeat:
    """Due every period while what is announced changes, and ever more seldom while it does not.

    Nor does it slow down while it is urgent: while something is known to be missing.

    An announcement that is lost must be said again, but not for ever at the same pace: a team at rest would
    send little else. After each that says nothing new the period doubles, up to sixteen times.

    Args:
        period: seconds.
    """

    def __init__(self, period: float) -> None:
        if not 0 < period < math.inf:
            raise InvalidArgumentError(f"announce_every={period} must be above zero seconds, and finite.")
        self._period = self._wait = float(period)
        self._last: float | None = None
        self._said: tuple[int, ...] | None = None

    def due(self, now: float, content: tuple[int, ...], urgent: bool = False) -> bool:
        """Whether it is time, at `now` (s), to announce a content that these numbers stand for; it is taken
        to be done then. The first call starts the first period; so does a clock that was set back."""
        if self._last is None or now < self._last:
            self._last, self._said, self._wait = now, content, self._period
            return False
        is_old = content == self._said and not urgent
        wait = self._wait if is_old else self._period
        if now - self._last < wait - 1e-9:
            return False
        self._wait = min(2 * wait, _SLOWEST * self._period) if is_old else self._period
        self._last, self._said = now, content
        return True

    def state(self) -> dict[str, Any]:
        said = None if self._said is None else list(self._said)
        return {"wait": self._wait, "last": self._last, "said": said}

    def restore(self, state: dict[str, Any]) -> None:
        said = state["said"]
        self._wait, self._last = float(state["wait"]), state["last"]
        self._said = None if said is None else tuple(said)
