"""Diminishing returns: when flying on is no longer worth it, and when it is again."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

from gmmtorch.errors import InvalidArgumentError

_NEWS = 0.25  # of the best window: what teammates must find before a robot that rests looks for more


@dataclass(frozen=True)
class StoppingRule:
    """A robot rests once what it learned in the last `window` seconds is below `share` of the most it ever
    learned in as many; 0: never. A window should be longer than a way across the map."""

    share: float = 0.01
    window: float = 120.0

    def __post_init__(self) -> None:
        if not 0 <= self.share < 1:
            raise InvalidArgumentError(f"planner.rest={self.share} must be at least 0, and below 1.")
        if not 0 < self.window < math.inf:
            raise InvalidArgumentError(f"window={self.window} must be above zero seconds, and finite.")


class StoppingCriterion:
    """Follows what a robot learns, and says whether it should rest.

    Views promise more than they bring where only slivers are left that no camera resolves, and a
    planner that believes them flies on for ever. What a robot's own frames take off the entropy
    of its map cannot be argued with. Once it rests, news of teammates that add up to a quarter of its best
    window wake it, for a window at least.

    Time in which it was boxed in does not count: nothing it could have done would have taught it more.
    """

    def __init__(self, rule: StoppingRule | None = None) -> None:
        self.rests = False
        self._rule = StoppingRule() if rule is None else rule
        self._noted: deque[tuple[float, float]] = deque()  # time (s) and bits learned, a window of them
        self._best = 0.0
        self._known = 0.0  # bits, when it came to rest
        self._when: float | None = None  # of the last note, s
        self._lost = 0.0  # seconds that do not count

    def note(self, now: float, learned: float, known: float, boxed_in: bool = False) -> None:
        """What is so at time `now` (s): bits that the robot's own frames took off the entropy of its map,
        and bits that are off it altogether. boxed_in: whether it was since the last note."""
        if boxed_in and self._when is not None:
            self._lost += now - self._when
        self._when = now
        if self.rests:
            if known - self._known >= _NEWS * self._best:
                self.rests = False
                self._noted.clear()
            return
        if boxed_in:
            return
        now -= self._lost
        self._noted.append((now, learned))
        while len(self._noted) > 1 and self._noted[1][0] <= now - self._rule.window:
            self._noted.popleft()
        begin, before = self._noted[0]
        if now - begin < self._rule.window:
            return
        self._best = max(self._best, learned - before)
        if learned - before < self._rule.share * self._best:
            self.rests, self._known = True, known

    def state(self) -> dict[str, Any]:
        return {
            "rests": self.rests,
            "noted": [list(entry) for entry in self._noted],
            "best": self._best,
            "known": self._known,
            "when": self._when,
            "lost": self._lost,
        }

    def restore(self, state: dict[str, Any]) -> None:
        self.rests = bool(state["rests"])
        self._noted = deque((float(now), float(learned)) for now, learned in state["noted"])
        self._best, self._known = float(state["best"]), float(state["known"])
        self._when = None if state["when"] is None else float(state["when"])
        self._lost = float(state["lost"])
