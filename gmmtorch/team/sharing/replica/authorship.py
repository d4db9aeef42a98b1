"""Author: writes the records of one incarnation of a robot; MovedMap: how corrected poses moved a map."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping import NO_COUNT, Components, order_of, quantize, quantized
from gmmtorch.occupancy import Calibration
from gmmtorch.team.sharing.messages.component_messages import check_quantized
from gmmtorch.team.sharing.messages.datagrams import pose_of, split
from gmmtorch.team.sharing.messages.message_registry import decode
from gmmtorch.team.sharing.messages.record_messages import (
    RECORD_BYTES,
    CalibrationMessage,
    CorrectionMessage,
    CountersMessage,
    FrameMessage,
    RecordMessage,
    SupersessionMessage,
    counters_message,
    encode_record,
)
from gmmtorch.team.sharing.replica.materialized_view import fingerprints, latest, most_viewpoints
from gmmtorch.team.sharing.replica.record_keys import (
    MOST_RECORDS,
    Intervals,
    Ints,
    author_of,
    authors,
    first_key,
    ids_of,
    keys_of_author,
    keys_of_robot,
)
from gmmtorch.team.sharing.replica.records import MOST_VIEWPOINTS, Records

_MOST_RUNS = 128  # intervals of keys in a correction, which then fits into a datagram


class MovedMap(NamedTuple):
    """How corrected poses have moved a map of K components.

    before: the components where they would be without corrections. scans (K,): the number of the scan, or of
    the window of scans, of each; −1: of none. motions: of each scan, from number 0 on, (D+1, D+1), from
    `before` to the map; the identity to the bit for those that were not corrected.
    """

    before: Components
    scans: Tensor
    motions: Sequence[Tensor]

    def corrected(self, keys: Ints, live: Ints, known: Collection[int]) -> dict[int, Intervals]:
        """The keys that the correction of each corrected scan moves, and some of dead records, so that
        intervals are few. Keys beyond `_MOST_RUNS` intervals of a scan are set to −1: publish them again.

        keys: (K,) of the components that were published where they were before; −1 for others. live: (L,)
        rising keys of all components of the robot. known: scans that have a correction already.
        """
        scans = np.full(len(live), -1)
        scans[np.searchsorted(live, keys[keys >= 0])] = self.scans.cpu().numpy()[keys >= 0]
        is_first = np.ones(len(live), np.bool_)  # key of an interval of one scan and one author
        is_first[1:] = (scans[1:] != scans[:-1]) | (authors(live[1:]) != authors(live[:-1]))
        is_last = np.append(is_first[1:], True)[: len(live)]
        edges, scans = np.stack([live[is_first], live[is_last] + 1], 1), scans[is_first]
        found = {}
        for scan, motion in enumerate(self.motions):
            runs = edges[scans == scan]
            is_identity = torch.equal(motion, torch.eye(len(motion), dtype=motion.dtype))
            if scan in known or (len(runs) and not is_identity):
                found[scan] = Intervals(runs[:_MOST_RUNS].reshape(-1))
                for begin, end in runs[_MOST_RUNS:].tolist():
                    keys[(begin <= keys) & (keys < end)] = -1
        return found


_MOST_SUPERSESSIONS = 32  # effective supersessions of this author before they are merged
_MOST_OUTDATED = 64
"""Outdated entries in records of counters, beyond as many as are current, before all are rewritten."""
_MOST_SHORT = 16  # records of counters shorter than `_SHORT` before they are merged
_SHORT = 64  # bytes, of which a third says whose counters follow
_MOST_POINTS = 2.0**40
_MORE_PREDICTIONS = 1.5  # growth of the number of predictions after which a calibration is written again


Published = tuple[Ints, Intervals]
"""Keys (K,) of the given components; keys of all new records."""


class Author:
    """Writes the records of one incarnation of a robot, and adds them to `records`.

    Attributes:
        keys: all keys that this author can give.
    """

    def __init__(self, records: Records, robot: int, incarnation: int) -> None:
        self._records, self._robot = records, robot
        self._first = first_key(robot, incarnation)
        self._last = self._first + MOST_RECORDS - 1  # no key of this author takes more bytes
        self._keys_of_robot, self.keys = keys_of_robot(robot), keys_of_author(robot, incarnation)
        self._n = 0
        self._points: dict[int, float] = {}  # exact counters, by key of the component
        self._written_steps: dict[int, int] = {}  # counters as written last
        self._published: set[int] = set()  # keys of the components that `publish_map` keeps
        self._merge_at = _MOST_SUPERSESSIONS

    @property
    def written(self) -> Intervals:
        """The keys that this author has given."""
        return Intervals.span(self._first, self._first + self._n)

    def publish(self, components: Components, old: Intervals) -> Published:
        """Write new components, which supersede the records `old` of this robot."""
        if most_viewpoints(components) > MOST_VIEWPOINTS:
            raise InvalidArgumentError(
                f"A component has {most_viewpoints(components)} viewpoints; a datagram has room for "
                f"{MOST_VIEWPOINTS}. Keep fewer: mapping.learning.merging.limit_origins."
            )
        if not self._keys_of_robot.covers(old):
            raise InvalidArgumentError(f"A robot supersedes its own records only; robot={self._robot}.")
        if not len(components) and not old:
            return np.zeros(0, np.int64), Intervals.empty()
        values = quantize(self._records.fitting(components))
        order = order_of(values.places)
        numbered = self._first + self._n + np.arange(len(order))
        values = replace(values.arranged(torch.from_numpy(order)), ids=ids_of(numbered))
        check_quantized(values)
        self._numbers(len(order))
        added = self._records.add_pieces(values.restored(), bounded=False, complete=bool(values.attributes))
        keys = np.empty_like(numbered)
        keys[order] = numbered
        successors = Intervals.of(numbered)
        superseded = self._supersede((old & self._records.held) - self._records.dead, successors)
        return keys, superseded | added

    def publish_map(self, components: Components, whole: bool, moved: MovedMap | None = None) -> Published:
        """Write what is new in a map, by content, and supersede what it no longer has. Keys are rising.

        whole: whether the map continues those of earlier incarnations, whose records are superseded, too, if
        the map lacks them. moved: components that were published where they were before are corrected.
        """
        components = self._records.fitting(components)
        table, own = self._records.table, self._own_components()
        published = self._published & set(own)
        earlier = [key for key in own if key not in published and key not in self.keys]
        candidates = [*earlier, *sorted(published)]
        available: dict[bytes, list[int]] = {}
        for key, print_ in zip(candidates, table.fingerprints(candidates), strict=True):
            available.setdefault(print_, []).append(key)
        keys, runs = np.full(len(components), -1), {}
        if moved is not None:
            _match(available, moved.before, keys)
            runs = moved.corrected(keys, np.array(own, np.int64), self._corrections())
        _match(available, components, keys)
        gone = set(candidates if whole else published) - set(keys.tolist())
        rows = np.flatnonzero(keys < 0)
        new = components.selected(torch.from_numpy(rows))
        made, written = self.publish(new, Intervals.of(np.array(sorted(gone), np.int64)))
        self._published = {*keys[keys >= 0].tolist(), *made.tolist()}
        corrected = [] if moved is None else self._correct_map(runs, moved.motions)
        return np.sort(made), Intervals.union([written, *corrected])

    def _correct_map(self, runs: Mapping[int, Intervals], motions: Sequence[Tensor]) -> list[Intervals]:
        """Write the corrections of scans that have changed; returns the new records."""
        live, before = Intervals.of(np.array(self._own_components(), np.int64)), self._corrections()
        written = []
        for scan, moved in runs.items():
            record = before.get(scan)
            is_same = record is not None and torch.equal(record.pose, pose_of(motions[scan]))
            if record is None or not is_same or record.moved & live != moved & live:
                written.append(self.correct(scan, motions[scan], moved))
        return written

    def _corrections(self) -> dict[int, CorrectionMessage]:
        """The corrections of this robot that move a component, by scan."""
        mine = Intervals.of(np.array(self._own_components(), np.int64))
        records = latest(self._records.of(CorrectionMessage))
        return {r.scan: r for r in records if r.key in self._keys_of_robot and r.moved & mine}

    def _own_components(self) -> list[int]:
        """The keys, rising, of this robot's components that count."""
        keys = self._records.table.keys()
        return keys[self._keys_of_robot.contains(keys)].tolist()

    def count(self, gains: Mapping[int, float]) -> Intervals:
        """Add points to this author's counters, by keys of components of any robot; returns the new
        records."""
        for key, gain in gains.items():
            if not 0 <= gain <= _MOST_POINTS:
                raise InvalidArgumentError(f"A component gained {gain} points; counts go from 0 to 2⁴⁰.")
            self._points[key] = min(self._points.get(key, 0.0) + float(gain), _MOST_POINTS)
        rounded = counters_message(self._first, {key: self._points[key] for key in gains})
        is_dead = self._records.dead.contains(rounded.components)
        risen = {
            key: self._points[key]
            for key, step, dead in zip(
                rounded.components.tolist(), rounded.steps.tolist(), is_dead.tolist(), strict=True
            )
            if step > self._written_steps.get(key, NO_COUNT) and not dead
        }
        return self._write_counters(risen) | self._rewrite_counters()

    def _rewrite_counters(self) -> Intervals:
        """Rewrite all counters if most entries are outdated; else the short records if there are many."""
        own = list(self._records.counters.of(author_of(self._first)).values())
        if sum(len(record.components) for record in own) <= 2 * len(self._written_steps) + _MOST_OUTDATED:
            own = [r for r in own if len(self._records.datagrams[r.key]) < _SHORT]
            if len(own) <= _MOST_SHORT:
                return Intervals.empty()
        keys = np.unique(np.concatenate([record.components for record in own]))
        is_dead = self._records.dead.contains(keys)
        for key in keys[is_dead].tolist():
            self._written_steps.pop(key, None)
        rewritten = self._write_counters({key: self._points[key] for key in keys[~is_dead].tolist()})
        return self._replace(own, rewritten)

    def correct(self, scan: int, transform: Tensor, moved: Intervals) -> Intervals:
        """Write a correction of a scan with the components `moved`; returns the new records."""
        if not self._keys_of_robot.covers(moved):
            raise InvalidArgumentError(f"A robot corrects its own components only; robot={self._robot}.")
        records = self._records.of(CorrectionMessage)
        before = [r for r in records if r.scan == scan and r.key in self._keys_of_robot]
        version = 1 + max((record.version for record in before), default=0)
        record = CorrectionMessage(self._first + self._n, scan, version, moved, pose_of(transform))
        if len(encode_record(record)) > RECORD_BYTES:
            raise InvalidArgumentError(
                f"The components of scan={scan} are {len(moved)} runs of ids, too many for a datagram. "
                "Number a scan's components consecutively."
            )
        self._numbers(1)
        return self._replace(before, self._records.add_record(record, bounded=False))

    def place_frame(self, frame: int, anchor: int, transform: Tensor | None) -> Intervals:
        """Write where a frame of this robot is; returns the new records.

        transform: anchor ← frame; None: the frame has no other anchor than itself.
        """
        before = [record for record in self._records.of(FrameMessage) if record.frame == frame]
        version = 1 + max((record.version for record in before), default=0)
        pose = None if transform is None else pose_of(transform)
        return self._replace(
            before, self._write(FrameMessage(self._first + self._n, frame, version, anchor, pose))
        )

    def calibrate(self, calibration: Calibration) -> Intervals:
        """Write the calibration of this robot's map, if it rests on many more predictions than the one that
        was written before; returns the new records."""
        before = [r for r in self._records.of(CalibrationMessage) if r.key in self._keys_of_robot]
        known = max((r.calibration.n_predicted for r in before), default=0)
        if calibration.n_predicted <= _MORE_PREDICTIONS * known:
            return Intervals.empty()
        return self._replace(before, self._write(CalibrationMessage(self._first + self._n, calibration)))

    def _write_counters(self, points: Mapping[int, float]) -> Intervals:
        keys = sorted(points)

        def part(begin: int, end: int) -> bytes:
            return encode_record(counters_message(self._last, {key: points[key] for key in keys[begin:end]}))

        written = Intervals.empty()
        for datagram in split(len(keys), part, "counter", RECORD_BYTES):
            message = decode(datagram)
            assert isinstance(message, CountersMessage)  # `part` encoded it
            written |= self._write(replace(message, key=self._first + self._n))
            self._written_steps.update(zip(message.components.tolist(), message.steps.tolist(), strict=True))
        return written

    def _replace(self, before: Sequence[RecordMessage], written: Intervals) -> Intervals:
        """Supersede records by those that were written for them; returns all new records."""
        old = Intervals.of(np.array([record.key for record in before], np.int64))
        return written | self._supersede(old, written)

    def _supersede(self, old: Intervals, new: Intervals) -> Intervals:
        """Write supersessions of `old` by `new`; returns their keys. A supersession whose successors are all
        superseded is superseded with them: its old records become those of the new one, so that no robot
        needs it any more. See docs/replica.md."""
        if not old:
            return Intervals.empty()
        closed, dead = old, self._records.dead | old
        for record in reversed(self._records.effective()):
            if record.key in self._keys_of_robot and record.new and dead.covers(record.new):
                closed |= record.old | Intervals.span(record.key, record.key + 1)
                dead |= closed
        written = Intervals.empty()
        whole = SupersessionMessage(self._first + self._n, closed, new)
        if len(encode_record(whole)) <= RECORD_BYTES:
            written = self._write(whole)
        else:
            # Parts do not supersede others: a robot with one part would drop the old records of the other.
            def part(begin: int, end: int) -> bytes:
                some = Intervals(old.edges[2 * begin : 2 * end])
                return encode_record(SupersessionMessage(self._last, some, new))

            for datagram in split(len(old), part, "supersession", RECORD_BYTES):
                message = decode(datagram)
                assert isinstance(message, SupersessionMessage)
                written |= self._write(replace(message, key=self._first + self._n))
        return written | self._merge_supersessions()

    def _merge_supersessions(self) -> Intervals:
        """If this author has many effective supersessions, merge them, so that their memory stays bounded."""
        own = [record for record in self._records.effective() if record.key in self.keys]
        if len(own) <= self._merge_at:
            return Intervals.empty()
        written = self._merged(own)
        left = sum(record.key in self.keys for record in self._records.effective())
        self._merge_at = 2 * left + _MOST_SUPERSESSIONS
        return written

    def _merged(self, records: Sequence[SupersessionMessage]) -> Intervals:
        if len(records) < 2:
            return Intervals.empty()
        old = new = Intervals.empty()
        for record in records:
            old |= record.old | Intervals.span(record.key, record.key + 1)
            new |= record.new
        # Dead successors are covered by other supersessions. So none waits for what it supersedes itself.
        union = SupersessionMessage(self._first + self._n, old, new - old - self._records.dead)
        if len(encode_record(union)) <= RECORD_BYTES:
            return self._write(union)
        half = len(records) // 2
        return self._merged(records[:half]) | self._merged(records[half:])

    def _write(self, record: RecordMessage) -> Intervals:
        assert record.key == self._first + self._n
        self._numbers(1)
        return self._records.add_record(record, bounded=False)

    def _numbers(self, n: int) -> int:
        """The first of n new keys."""
        if self._n + n > MOST_RECORDS:
            raise InvalidArgumentError(
                f"{MOST_RECORDS} records are the most of one incarnation; make a new Replica."
            )
        self._n += n
        return self._first + self._n - n


def _match(available: Mapping[bytes, list[int]], components: Components, keys: Ints) -> None:
    """Take a key with the content of each component (K,) that has none, −1, as far as there are some."""
    prints = fingerprints(quantized(components))
    for row in np.flatnonzero(keys < 0).tolist():
        if available.get(prints[row]):
            keys[row] = available[prints[row]].pop()  # of equal ones, those that this author published first
