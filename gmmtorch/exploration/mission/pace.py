"""Pace: how far a mission is, told to whoever waits for it, in this process or another."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from gmmtorch.exploration.mission.mission import Mission
from gmmtorch.files import write_json


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
    """The last pace of each of several missions, in files that their processes leave for this one.

    Writing neither waits nor fills anything up, whoever looks. May be pickled.

    Args:
        paths: of the files, one a mission; what lies there of an earlier run is deleted. None: of that
            mission nothing is heard.
    """

    def __init__(self, paths: Sequence[Path | None]) -> None:
        self._paths = paths
        self._seen: dict[int, Pace] = {}
        self.forget()

    def note(self, number: int, pace: Pace) -> None:
        """How far a mission is."""
        if (path := self._paths[number]) is not None:
            write_json(path, pace._asdict())

    def changes(self) -> list[tuple[int, Pace]]:
        """The missions that have got further since this was asked last, and how far they are."""
        now = {
            number: Pace(**json.loads(path.read_bytes()))
            for number, path in enumerate(self._paths)
            if path is not None and path.is_file()
        }
        changed = [(number, pace) for number, pace in now.items() if self._seen.get(number) != pace]
        self._seen = now
        return changed

    def forget(self) -> None:
        """Delete the files."""
        for path in self._paths:
            if path is not None:
                path.unlink(missing_ok=True)
