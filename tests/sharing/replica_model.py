"""A model of a replica with plain dictionaries that never forgets."""

from __future__ import annotations

from gmmtorch.mapping.components import Components
from gmmtorch.team.sharing.messages.message_registry import (
    ComponentsMessage,
    CorrectionMessage,
    CountersMessage,
    SupersessionMessage,
    decode,
)


def rows(components: Components) -> dict[int, tuple]:
    """Mean, covariance, support, flag and (origin, count) pairs of each component by its key."""
    found = {}
    for row, (robot, sequence) in enumerate(components.ids.tolist()):
        seen = [
            (tuple(components.origins[components.seen_from[e]].tolist()), float(components.seen_count[e]))
            for e in range(len(components.seen_by))
            if int(components.seen_by[e]) == row
        ]
        found[robot << 52 | sequence] = (
            tuple(components.means[row].tolist()),
            tuple(components.covariances[row].flatten().tolist()),
            float(components.support[row]),
            bool(components.max_range[row]),
            tuple(seen),
        )
    return found


class Model:
    """The union of all received records, and the components that follow from it."""

    def __init__(self) -> None:
        self.records: dict[int, object] = {}

    def receive(self, datagram: bytes) -> None:
        message = decode(datagram)
        if isinstance(message, ComponentsMessage):
            self.records.update(rows(message.components))
        elif isinstance(message, SupersessionMessage | CountersMessage | CorrectionMessage):
            self.records[message.key] = message

    def dead(self) -> set[int]:
        dead: set[int] = set()
        while True:
            more = set(dead)
            for message in self.records.values():
                if isinstance(message, SupersessionMessage) and _numbers(message.new) <= dead | set(
                    self.records
                ):
                    more |= _numbers(message.old)
            if more == dead:
                return dead
            dead = more

    def counting(self) -> dict[int, object]:
        dead = self.dead()
        return {key: record for key, record in self.records.items() if key not in dead}

    def components(self) -> dict[int, tuple]:
        return {key: row for key, row in self.counting().items() if isinstance(row, tuple)}

    def support(self, key: int) -> float:
        largest: dict[int, float] = {}
        for record in self.counting().values():
            if isinstance(record, CountersMessage):
                for component, total in zip(record.components.tolist(), record.points.tolist(), strict=True):
                    if component == key:
                        life = record.key >> 28
                        largest[life] = max(largest.get(life, 0.0), total)
        return self.components()[key][2] + sum(largest[life] for life in sorted(largest))

    def shift(self, key: int) -> tuple[float, ...]:
        """The shift of a component by corrections without rotation."""
        latest: dict[tuple[int, int], CorrectionMessage] = {}
        for record in self.counting().values():
            if isinstance(record, CorrectionMessage):
                scan = (record.key >> 52, record.scan)
                other = latest.get(scan)
                if other is None or (record.version, record.key) > (other.version, other.key):
                    latest[scan] = record
        last = [latest[scan] for scan in sorted(latest) if key in latest[scan].moved]
        return tuple(last[-1].pose[:3].tolist()) if last else (0.0, 0.0, 0.0)


def _numbers(intervals) -> set[int]:
    return {number for begin, end in intervals.pairs() for number in range(begin, end)}
