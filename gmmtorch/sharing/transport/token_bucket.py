"""TokenBucket: no more than so many bytes a second, but for short bursts."""

from __future__ import annotations

import math
from typing import Any

from gmmtorch.errors import InvalidArgumentError

_BURST = 1.0  # seconds of the rate, at least one datagram
_LEAST = 1200.0


class TokenBucket:
    """In any span of t seconds no more is taken than `rate` · t and a burst: of one second, or one datagram.

    Times may be of any clock. One that is set back brings nothing for that step, and goes on from there.

    Args:
        rate: bytes a second.
    """

    def __init__(self, rate: float) -> None:
        if not 0 < rate < math.inf:
            raise InvalidArgumentError(f"budget={rate} must be above zero bytes a second, and finite.")
        self.rate = float(rate)
        self._most = max(_BURST * self.rate, _LEAST)
        self._tokens = self._most
        self._last: float | None = None

    def available(self, now: float) -> int:
        """Whole bytes that may be sent at the time `now` (s)."""
        if self._last is not None and now > self._last:
            self._tokens = min(self._most, self._tokens + self.rate * (now - self._last))
        self._last = now
        return max(0, int(self._tokens))

    def take(self, n_bytes: int) -> None:
        """They were sent; more than was available is paid for later."""
        self._tokens -= n_bytes

    def state(self) -> dict[str, Any]:
        return {"tokens": self._tokens, "last": self._last}

    def restore(self, state: dict[str, Any]) -> None:
        self._tokens, self._last = float(state["tokens"]), state["last"]
