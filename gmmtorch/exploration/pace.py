"""Pace: how far a mission is, told to whoever waits for it, in this process or another."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from gmmtorch.exploration.mission import Mission


class Pace(NamedTuple):
    """How far a mission is. now: simulated seconds. entropy_left: share of the observable bits. n_bytes:
    sent. speed: simulated seconds in one of wall time; 0 where none has passed."""

    now: float
    entropy_left: float
    n_bytes: float
    speed: float


def pace_of(mission: Mission) -> Pace:
    """How far a mission is now."""
    left = mission.union.entropy_bits / max(1.0, mission.union.observable_bits)
    seconds = sum(mission.stages.values())
    return Pace(mission.now, left, mission.network.n_bytes, mission.now / seconds if seconds > 0 else 0.0)


class Paces:
    """The last pace of each of n missions, in a file that their processes map into memory.

    Writing neither waits nor fills anything up, whoever looks. May be pickled.

    Args:
        path: of the file, which is made anew.
    """

    def __init__(self, path: Path, n: int) -> None:
        self._path = path
        self._seen = np.zeros((n, len(Pace._fields)))
        self._rows("w+").flush()

    def note(self, number: int, pace: Pace) -> None:
        """How far a mission is."""
        self._rows()[number] = pace

    def changes(self) -> list[tuple[int, Pace]]:
        """The missions that have got further since this was asked last, and how far they are."""
        now = np.array(self._rows())
        changed = (now != self._seen).any(1).nonzero()[0].tolist()
        self._seen = now
        return [(number, Pace(*now[number].tolist())) for number in changed]

    def _rows(self, mode: Literal["r+", "w+"] = "r+") -> np.memmap:
        return np.memmap(self._path, np.float64, mode, shape=self._seen.shape)
