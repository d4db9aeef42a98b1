"""Snapshots: a few moments of a mission for pictures, evenly spread over the entropy reduction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from gmmtorch.exploration.mission.mission import Mission

_MOST = 16


class Snapshot(NamedTuple):
    """tick: number of ticks done. bits: entropy reduction so far. content: what was taken of the mission."""

    tick: int
    bits: float
    content: dict[str, Any]


class Snapshots:
    """At most 17 snapshots of a scored mission: the first, the last, and some between at about equal steps of
    entropy.

    The final entropy is not known in advance. So the class takes a snapshot after each step of entropy; once
    there are 16, it doubles the step and drops the snapshots between.

    Args:
        take: returns the content of a snapshot.
    """

    def __init__(self, take: Callable[[Mission], dict[str, Any]]) -> None:
        self._take = take
        self._step = 0.0  # bits
        self.taken: list[Snapshot] = []

    def update(self, mission: Mission) -> None:
        """Takes a snapshot if it is due. Called after every tick."""
        union = mission.score.union
        bits = union.observable_bits - union.entropy_bits
        if self.taken and not mission.is_over and bits <= self.taken[-1].bits + self._step:
            return
        if len(self.taken) == _MOST:
            self._thin()
        self.taken.append(Snapshot(mission.n_ticks, bits, self._take(mission)))

    def _thin(self) -> None:
        first, *others = self.taken
        self._step = 2 * (others[-1].bits - first.bits) / _MOST
        self.taken = [first]
        for snapshot in others:
            if snapshot.bits >= self.taken[-1].bits + self._step:
                self.taken.append(snapshot)

    def chosen(self, shares: Sequence[float] = (0.2, 0.5, 0.8)) -> list[Snapshot]:
        """The last snapshot, and those nearest to these shares of the final reduction; sorted by time, fewer
        if there are not enough."""
        *left, end = self.taken
        chosen = [end]
        for share in shares[: len(left)]:
            bits = [abs(snapshot.bits - share * end.bits) for snapshot in left]
            chosen.append(left.pop(bits.index(min(bits))))
        return sorted(chosen, key=lambda snapshot: snapshot.tick)
