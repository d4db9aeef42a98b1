"""TokenBucket: limits the bytes that are sent per second."""

from __future__ import annotations

import math

from gmmtorch.errors import InvalidArgumentError

_BURST = 1.0
"""Seconds of the rate that may be sent in one burst."""
_LEAST_BURST = 1200.0
"""Bytes: one datagram."""


class TokenBucket:
    """In any t seconds at most `rate` · t bytes are taken, and one burst: a second of the rate, or a
    datagram.

    The times may come from any clock. If it is set back, that step adds nothing.

    Args:
        rate: bytes per second.
    """

    def __init__(self, rate: float) -> None:
        if not 0 < rate < math.inf:
            raise InvalidArgumentError(f"budget={rate} must be above zero bytes a second, and finite.")
        self.rate = float(rate)
        self._most = max(_BURST * self.rate, _LEAST_BURST)
        self._tokens = self._most
        self._last: float | None = None

    def available(self, now: float) -> int:
        """Whole bytes that may be sent at the time `now` (s)."""
        if self._last is not None and now > self._last:
            self._tokens = min(self._most, self._tokens + self.rate * (now - self._last))
        self._last = now
        return max(0, int(self._tokens))

    def take(self, n_bytes: int) -> None:
        """Subtract bytes that were sent. More than were available delay later ones."""
        self._tokens -= n_bytes
