"""What a robot itself has to say: it numbers it, counts, corrects, and supersedes what it said before."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.codec.component_batch import order_of, quantized
from gmmtorch.mapping.codec.quantization import NO_COUNT, quantize
from gmmtorch.mapping.components import Components
from gmmtorch.sharing.messages.component_messages import fitted
from gmmtorch.sharing.messages.envelope import split
from gmmtorch.sharing.messages.message_registry import decode
from gmmtorch.sharing.messages.record_messages import (
    RECORD_BYTES,
    CorrectionMessage,
    CountersMessage,
    RecordMessage,
    SupersessionMessage,
    counters_message,
    encode_record,
    pose_of,
)
from gmmtorch.sharing.replica.anti_entropy import Packet
from gmmtorch.sharing.replica.component_table import fingerprints, most_viewpoints
from gmmtorch.sharing.replica.intervals import Intervals, Ints
from gmmtorch.sharing.replica.record_keys import (
    MOST_RECORDS,
    author_of,
    first_key,
    ids_of,
    keys_of_author,
    keys_of_robot,
)
from gmmtorch.sharing.replica.records import MOST_VIEWPOINTS, Records

_MOST_SUPERSESSIONS = 32
"""Of this life, until they are made one."""
_SLACK = 64
"""Entries of totals that may be out of date before all are written again."""
_MOST_SHORT = 16
"""Records of totals of half the length that they may have, until they are made one."""


class Published(NamedTuple):
    """keys (K,): of the components that were given; written: keys of all records that were written; packets:
    datagrams of the components, ready to be sent."""

    keys: Ints
    written: Intervals
    packets: list[Packet]


class Author:
    """Writes the records of one life of a robot. Methods return the keys of what they have written."""

    def __init__(self, records: Records, robot: int, incarnation: int) -> None:
        self._records, self._robot, self._incarnation = records, robot, incarnation
        self._first = first_key(robot, incarnation)
        self._last = self._first + MOST_RECORDS - 1  # takes as many bytes as any: what fits with it fits
        self._mine, self.life = keys_of_robot(robot), keys_of_author(robot, incarnation)
        self._n = 0
        self._totals: dict[int, float] = {}  # exact, by key of the component
        self._told: dict[int, int] = {}  # rounded, as written last
        self._published: dict[int, int] = {}  # of a map: its own number of a component, and the key
        self._fold_at = _MOST_SUPERSESSIONS

    @property
    def written(self) -> Intervals:
        """Keys that this life has given, of all that it may give, `life`."""
        return Intervals.span(self._first, self._first + self._n)

    # -- components -------------------------------------------------------------------------------

    def publish(self, components: Components, old: Intervals, max_bytes: int) -> Published:
        """Components as new records that supersede old ones of this robot."""
        if most_viewpoints(components) > MOST_VIEWPOINTS:
            raise InvalidArgumentError(
                f"A component was seen from {most_viewpoints(components)} places; {MOST_VIEWPOINTS} fit into "
                "a datagram. Keep the most telling ones: mapping.sightings.limit_origins."
            )
        if not self._mine.covers(old):
            raise InvalidArgumentError(f"Only who made records supersedes them; robot={self._robot}.")
        values = quantize(components)
        order = order_of(values.places)
        first = self._numbers(len(order))
        numbered = np.arange(first, first + len(order))
        values = replace(values.arranged(order), ids=ids_of(numbered))
        # Here, too, they come by datagrams: so all robots of a team have the same batches.
        packets: list[Packet] = []
        written = Intervals.empty()
        for datagram, part in fitted(values, max_bytes):
            packets.append((datagram, self._records.add_components(part.restored(), bounded=False)))
            written |= packets[-1][1]
        keys = np.empty_like(numbered)
        keys[order.numpy()] = numbered
        superseded = self._supersede((old & self._records.held) - self._records.dead, written)
        return Published(keys, written | superseded, packets)

    def publish_map(self, components: Components, max_bytes: int) -> Published:
        """What a map of this robot's holds now: what is new in it, or has changed, in place of what has
        gone, or was otherwise. Components are known by their ids."""
        if bool((components.ids[:, 0] != self._robot).any()):
            robots = sorted({int(robot) for robot in components.ids[:, 0]})
            raise InvalidArgumentError(
                f"The map has components of robots {robots}, this is robot={self._robot}: make the map with "
                f"robot={self._robot}, or give components."
            )
        numbers = components.ids[:, 1].tolist()
        table, prints = self._records.table, fingerprints(quantized(components))
        said = [self._published.get(number, -1) for number in numbers]
        same = [
            key in table and table.print_of(key) == print_ for key, print_ in zip(said, prints, strict=True)
        ]
        rows = [row for row, is_same in enumerate(same) if not is_same]
        kept = {number: key for number, key, is_same in zip(numbers, said, same, strict=True) if is_same}
        gone = np.array(sorted(set(self._published.values()) - set(kept.values())), np.int64)
        changed = components.selected(torch.tensor(rows, dtype=torch.int64))
        published = self.publish(changed, Intervals.of(gone), max_bytes)
        fresh = zip([numbers[row] for row in rows], published.keys.tolist(), strict=True)
        self._published = {**kept, **dict(fresh)}
        return published

    # -- counts and corrections -------------------------------------------------------------------

    def count(self, gains: Mapping[int, float]) -> Intervals:
        """Points that components of any robot gained, by key, are added to this life's totals."""
        for key, gain in gains.items():
            if not 0 <= gain <= 2.0**40:
                raise InvalidArgumentError(f"A component gained {gain} points; counts go from 0 to 2⁴⁰.")
            self._totals[key] = min(self._totals.get(key, 0.0) + float(gain), 2.0**40)
        due = counters_message(self._first, {key: self._totals[key] for key in gains})
        lapsed = self._records.dead.contains(due.components)
        rises = {
            key: self._totals[key]
            for key, step, is_lapsed in zip(
                due.components.tolist(), due.steps.tolist(), lapsed.tolist(), strict=True
            )
            if step > self._told.get(key, NO_COUNT) and not is_lapsed
        }
        return self._write_totals(rises) | self._totals_anew()

    def _totals_anew(self) -> Intervals:
        """Many records of totals become few, and what is out of date in them goes: all of them where that is
        most; else those that are short."""
        mine = list(self._records.totals.of(author_of(self._first)).values())
        if sum(len(record.components) for record in mine) <= 2 * len(self._told) + _SLACK:
            mine = [r for r in mine if len(self._records.datagrams[r.key]) < RECORD_BYTES // 2]
            if len(mine) <= _MOST_SHORT:
                return Intervals.empty()
        told = np.unique(np.concatenate([record.components for record in mine]))
        lapsed = self._records.dead.contains(told)
        for key in told[lapsed].tolist():
            self._told.pop(key, None)
        anew = self._write_totals({key: self._totals[key] for key in told[~lapsed].tolist()})
        old = Intervals.of(np.array([record.key for record in mine], np.int64))
        return anew | self._supersede(old, anew)

    def correct(self, scan: int, transform: Tensor, moved: Intervals) -> Intervals:
        """A scan of this robot's, whose components these are, belongs elsewhere."""
        if not self._mine.covers(moved):
            raise InvalidArgumentError(f"A robot corrects its own components; robot={self._robot}.")
        before = [
            record
            for record in self._records.of(CorrectionMessage)
            if record.scan == scan and record.key in self._mine
        ]
        version = 1 + max((record.version for record in before), default=0)
        record = CorrectionMessage(self._first + self._n, scan, version, moved, pose_of(transform))
        if len(encode_record(record)) > RECORD_BYTES:
            raise InvalidArgumentError(
                f"The components of scan={scan} are {len(moved)} runs of ids, too many for a datagram. "
                "Number a scan's components one after another."
            )
        self._numbers(1)
        written = self._records.add_record(record, bounded=False)
        old = Intervals.of(np.array([r.key for r in before], np.int64))
        return written | self._supersede(old, written)

    def _write_totals(self, totals: Mapping[int, float]) -> Intervals:
        names = sorted(totals)

        def part(begin: int, end: int) -> bytes:
            return encode_record(counters_message(self._last, {key: totals[key] for key in names[begin:end]}))

        written = Intervals.empty()
        for datagram in split(len(names), part, "total", RECORD_BYTES):
            message = decode(datagram)
            assert isinstance(message, CountersMessage)  # `part` wrote it
            written |= self._write(replace(message, key=self._first + self._n))
            self._told.update(zip(message.components.tolist(), message.steps.tolist(), strict=True))
        return written

    # -- superseding ------------------------------------------------------------------------------

    def _supersede(self, old: Intervals, new: Intervals) -> Intervals:
        """Records that say that `new` stands for `old`.

        What superseded nothing but what is superseded now is superseded with it, and what it superseded, too:
        so that no robot has to know of it any more. See docs/replica.md.
        """
        if not old:
            return Intervals.empty()
        closed, dead = old, self._records.dead | old
        for record in reversed(self._records.effective()):
            if record.key in self._mine and record.new and dead.covers(record.new):
                closed |= record.old | Intervals.span(record.key, record.key + 1)
                dead |= closed
        written = Intervals.empty()
        whole = self._supersession(closed, new)
        if len(encode_record(whole)) <= RECORD_BYTES:
            written = self._write(whole)
        else:
            # In parts only without those: a robot that got one part would forget what the other says.
            def part(begin: int, end: int) -> bytes:
                return encode_record(SupersessionMessage(self._last, _some(old, begin, end), new))

            for datagram in split(len(old), part, "supersession", RECORD_BYTES):
                message = decode(datagram)
                assert isinstance(message, SupersessionMessage)
                written |= self._write(replace(message, key=self._first + self._n))
        return written | self._fold()

    def _supersession(self, old: Intervals, new: Intervals) -> SupersessionMessage:
        return SupersessionMessage(self._first + self._n, old, new)

    def _fold(self) -> Intervals:
        """Many supersessions of this life become few, so that what is superseded takes bounded room."""
        mine = [record for record in self._records.effective() if record.key in self.life]
        if len(mine) <= self._fold_at:
            return Intervals.empty()
        written = self._folded(mine)
        left = sum(record.key in self.life for record in self._records.effective())
        self._fold_at = 2 * left + _MOST_SUPERSESSIONS
        return written

    def _folded(self, records: Sequence[SupersessionMessage]) -> Intervals:
        if len(records) < 2:
            return Intervals.empty()
        old = new = Intervals.empty()
        for record in records:
            old |= record.old | Intervals.span(record.key, record.key + 1)
            new |= record.new
        # Successors that are dead by now are others' to vouch for: none waits for what it supersedes itself.
        together = self._supersession(old, new - old - self._records.dead)
        if len(encode_record(together)) <= RECORD_BYTES:
            return self._write(together)
        half = len(records) // 2
        return self._folded(records[:half]) | self._folded(records[half:])

    def _write(self, record: RecordMessage) -> Intervals:
        assert record.key == self._first + self._n
        self._numbers(1)
        return self._records.add_record(record, bounded=False)

    def _numbers(self, n: int) -> int:
        """The first of n keys that nobody has given."""
        if self._n + n > MOST_RECORDS:
            raise InvalidArgumentError(
                f"{MOST_RECORDS} records are the most of one life; start a new Replica."
            )
        self._n += n
        return self._first + self._n - n

    # -- keeping ----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        return {
            "incarnation": self._incarnation,
            "n": self._n,
            "fold_at": self._fold_at,
            "totals": [[key, total] for key, total in self._totals.items()],
            "told": [[key, step] for key, step in self._told.items()],
            "published": [[number, key] for number, key in self._published.items()],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on; but what another life numbered and counted is that life's."""
        self._published = {int(number): int(key) for number, key in state["published"]}
        if state["incarnation"] == self._incarnation:
            self._n, self._fold_at = int(state["n"]), int(state["fold_at"])
            self._totals = {int(key): float(total) for key, total in state["totals"]}
            self._told = {int(key): int(step) for key, step in state["told"]}


def _some(intervals: Intervals, begin: int, end: int) -> Intervals:
    return Intervals(intervals.edges[2 * begin : 2 * end])
