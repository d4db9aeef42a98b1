"""Snapshots: a few moments of a mission, spread over what was learned, however long that took."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from gmmtorch.exploration.mission.mission import Mission

_MOST = 16


class Snapshot(NamedTuple):
    """tick: of the mission. bits: of the observable entropy that had gone. content: what was taken."""

    tick: int
    bits: float
    content: dict[str, Any]


class Snapshots:
    """Keeps at most 17 moments: the first it is shown, the end, and what lies between at about even steps of
    entropy.

    How much there is to learn is known at the end alone. So a moment is kept whenever a step more has gone;
    once there are 16, only those stay that are two such steps apart, and steps are that long from then on.

    Args:
        take: what is kept of a mission at a moment: a nested state, as `save_checkpoint` takes them.
    """

    def __init__(self, take: Callable[[Mission], dict[str, Any]]) -> None:
        self._take = take
        self._step = 0.0  # bits
        self.moments: list[Snapshot] = []

    def look(self, mission: Mission) -> None:
        """See a mission after a step of it, and keep the moment if it is due."""
        bits = mission.union.observable_bits - mission.union.entropy_bits
        if self.moments and not mission.is_over and bits <= self.moments[-1].bits + self._step:
            return
        if len(self.moments) == _MOST:
            self._thin()
        self.moments.append(Snapshot(mission.tick, bits, self._take(mission)))

    def _thin(self) -> None:
        first, *others = self.moments
        self._step = 2 * (others[-1].bits - first.bits) / _MOST
        self.moments = [first]
        for moment in others:
            if moment.bits >= self.moments[-1].bits + self._step:
                self.moments.append(moment)

    def chosen(self, shares: Sequence[float] = (0.2, 0.5, 0.8)) -> list[Snapshot]:
        """The moments, in their order, at which about these shares had gone of what has gone in the end, and
        the end; fewer if there are not so many."""
        *left, end = self.moments
        chosen = [end]
        for share in shares[: len(left)]:
            bits = [abs(moment.bits - share * end.bits) for moment in left]
            chosen.append(left.pop(bits.index(min(bits))))
        return sorted(chosen, key=lambda moment: moment.tick)

    def state(self) -> dict[str, Any]:
        return {"step": self._step, "moments": [list(moment) for moment in self.moments]}

    def restore(self, state: dict[str, Any]) -> None:
        self._step = float(state["step"])
        self.moments = [Snapshot(int(tick), float(bits), content) for tick, bits, content in state["moments"]]
