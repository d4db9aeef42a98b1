"""StoppingCriterion: when a robot rests because it learns too little, and when it explores again."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from gmmtorch.errors import InvalidArgumentError

_NEWS_SHARE = 0.25
"""Share of the best window that teammates must learn before a resting robot explores again."""


@dataclass(frozen=True)
class StoppingRule:
    """A robot rests once it has learned less in the last `window` seconds than `share` of the most that it
    ever learned in one window. share=0: never. The window should be longer than a flight across the map."""

    share: float = 0.01
    window: float = 120.0

    def __post_init__(self) -> None:
        if not 0 <= self.share < 1:
            raise InvalidArgumentError(f"planner.rest={self.share} must be at least 0, and below 1.")
        if not 0 < self.window < math.inf:
            raise InvalidArgumentError(f"window={self.window} must be above zero seconds, and finite.")


class StoppingCriterion:
    """Decides from the entropy that a robot's own frames remove from its map whether the robot should rest.

    The expected gain of views is no criterion: it stays high where only slivers are left that no camera
    resolves. A resting robot wakes once its teammates have removed a quarter of its best window; it then
    flies for at least one window. Time in which the robot was boxed in does not count.

    Attributes:
        rests: whether the robot should rest.
    """

    def __init__(self, rule: StoppingRule | None = None) -> None:
        self.rests = False
        self._rule = StoppingRule() if rule is None else rule
        self._window: deque[tuple[float, float]] = deque()  # time (s) and bits learned
        self._best = 0.0  # bits learned in the best window
        self._known_at_rest = 0.0  # bits
        self._noted_at: float | None = None  # s
        self._boxed_in = 0.0  # seconds that do not count

    def note(self, now: float, learned: float, known: float, boxed_in: bool = False) -> None:
        """Updates the criterion at the time `now` (s).

        Args:
            learned: bits that the robot's own frames have removed from its map so far.
            known: bits removed in total. boxed_in: whether the robot was boxed in since the last call.
        """
        if boxed_in and self._noted_at is not None:
            self._boxed_in += now - self._noted_at
        self._noted_at = now
        if self.rests:
            if known - self._known_at_rest >= _NEWS_SHARE * self._best:
                self.rests = False
                self._window.clear()
            return
        if boxed_in:
            return
        now -= self._boxed_in
        self._window.append((now, learned))
        while len(self._window) > 1 and self._window[1][0] <= now - self._rule.window:
            self._window.popleft()
        begin, before = self._window[0]
        if now - begin < self._rule.window:
            return
        self._best = max(self._best, learned - before)
        if learned - before < self._rule.share * self._best:
            self.rests, self._known_at_rest = True, known
