"""Records: the replicated set, to which records are added, and in which some supersede others."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import replace
from typing import TypeVar, cast

import numpy as np
import torch

from gmmtorch.errors import DataError
from gmmtorch.mapping import Attributes, Channel, Components, Labels, encode, has_channels
from gmmtorch.scan import MOST_CHANNELS
from gmmtorch.team.sharing.messages.component_messages import read_batch
from gmmtorch.team.sharing.messages.record_messages import (
    RECORD_BYTES,
    CorrectionMessage,
    CountersMessage,
    FrameMessage,
    RecordMessage,
    SupersessionMessage,
    encode_record,
)
from gmmtorch.team.sharing.replica.materialized_view import (
    ChangeLog,
    Changes,
    ComponentTable,
    Counters,
    Frames,
    corrected,
    fingerprints,
    is_same,
    most_viewpoints,
    with_gains,
)
from gmmtorch.team.sharing.replica.record_keys import (
    CHANNELS,
    WORLD,
    Intervals,
    Ints,
    authors,
    keys_of,
    robot_of,
)

MOST_VIEWPOINTS = 48
"""Viewpoints of a component. One component then fits into `RECORD_BYTES`, so that every robot can send it."""
MOST_COMPONENTS = 1 << 20
MOST_OTHERS = 1 << 12
"""Records other than components."""
MOST_ENTRIES = 1 << 19
"""Counters and intervals of these records: 16 bytes each, counters twice. 16 MiB: eight thousand counters
of each of 64 robots."""
MOST_INTERVALS = 1 << 14
"""Intervals of held keys, with those that waiting supersessions may add. A team that loses datagrams has
fewer."""
MOST_LABELS = 256
"""Of a channel of classes, as a view of the map has a column for each: 2 kB for each component."""
_BATCH = 2048  # components of a stored batch
_PIECE = 128
"""Components of a batch in the table, unless a datagram brought it: to drop one takes time in proportion to
its batch."""

_log = logging.getLogger(__name__)
_Record = TypeVar("_Record", bound=RecordMessage)


class RefusedError(DataError):
    """A valid message is refused. reason: one of a few words; robot: the author of its records."""

    def __init__(self, reason: str, robot: int, message: str) -> None:
        super().__init__(message)
        self.reason, self.robot = reason, robot


class Records:
    """The records of a shared map at one robot. The set of held keys only grows.

    A supersession takes effect when all of its successors are held. Its old records are then dropped,
    because a robot that lacks them needs only the supersession and the successors. So the records that
    count depend on the set of held keys, and not on the order of arrival. Limits on memory apply to other
    robots' records only.

    Args:
        dim: 2 or 3; None: that of the first components.
        author: number of the author from whose frame the map is seen.

    Attributes:
        held: keys that are or were here, and keys that are superseded: they need not be sent here.
        dead: keys of `held` whose records no longer count.
        complete: keys of components that came with their channels; a component may have none.
        hears_channels: whether a robot of the team knows channels.
        unfit: names of channels that are left out; see `fitting`.
        frames: where the frames of the authors are.
        others, datagrams: records other than components that count, decoded and encoded, by key.
        version: rises with every change.
    """

    def __init__(
        self, dim: int | None = None, most_components: int = MOST_COMPONENTS, author: int = WORLD
    ) -> None:
        self.dim = dim
        self._author = author
        self._most = most_components
        self.held = Intervals.empty()
        self.dead = Intervals.empty()
        self.complete = Intervals.empty()
        self.hears_channels = False
        self.unfit: set[str] = set()
        self._channels: dict[str, tuple[int, frozenset[int]]] = {}  # columns and labels
        self.table = ComponentTable(dim or 3)
        self.counters = Counters()
        self.others: dict[int, RecordMessage] = {}
        self.datagrams: dict[int, bytes] = {}  # all robots encode a record equally
        self.version = 0
        self._kinds: dict[type, dict[int, RecordMessage]] = {}  # `others` by type
        self._n_entries = 0  # see `MOST_ENTRIES`
        self._waiting: dict[int, SupersessionMessage] = {}  # some of their successors are not held
        self.frames = Frames([], dim or 3)
        self._log = ChangeLog()
        self._view: tuple[int, Components] | None = None

    @property
    def known(self) -> Intervals:
        """The held keys, with those of channels if a robot of the team knows channels."""
        return self._with_channels(self.held, self.complete | self.dead)

    @property
    def known_dead(self) -> Intervals:
        """The dead keys, with those of channels, as `known`."""
        return self._with_channels(self.dead, self.dead)

    def _with_channels(self, keys: Intervals, of: Intervals) -> Intervals:
        return Intervals.union([of.shifted(CHANNELS), keys]) if self.hears_channels else keys

    def fitting(self, components: Components) -> Components:
        """The components without channels of another kind than those held, or beyond `MOST_CHANNELS` and
        `MOST_LABELS`: other robots' channels never hinder the exchange of geometry."""
        if not components.attributes:
            return components
        fit: dict[str, Channel] = {}
        for name, c in components.attributes.present().channels.items():
            columns = 0 if isinstance(c, Labels) else c.mean.shape[1]
            before = self._channels.get(name, (columns, frozenset()))
            labels = before[1].union(c.labels.tolist() if isinstance(c, Labels) else ())
            n = len(self._channels.keys() | {name})
            if before[0] == columns and len(labels) <= MOST_LABELS and n <= MOST_CHANNELS:
                self._channels[name], fit[name] = (columns, labels), c
            elif name not in self.unfit and len(self.unfit) < MOST_CHANNELS:
                self.unfit.add(name)
                _log.warning(
                    "Channel %r is left out of the shared map: it has other columns in another robot, or "
                    "there are more than %d channels or %d labels.",
                    name,
                    MOST_CHANNELS,
                    MOST_LABELS,
                )
        return replace(components, attributes=Attributes(fit))

    def add_components(
        self, components: Components, bounded: bool = True, complete: bool = False
    ) -> Intervals:
        """Add all of the components, which the codec has rounded, or none; returns their keys.

        A held component that lacks its channels gets them. bounded: whether the limits on memory apply.
        complete: whether the components have their channels. Raises `RefusedError`: "duplicate_id" (a key is
        held with another content), "full", or "unfit" (another dimension, or more than `MOST_VIEWPOINTS`
        viewpoints).
        """
        keys = keys_of(components.ids)
        if not len(keys):
            return Intervals.empty()
        if components.dim != (self.dim or components.dim) or most_viewpoints(components) > MOST_VIEWPOINTS:
            message = (
                f"Components in {components.dim}D with up to {most_viewpoints(components)} viewpoints; this "
                f"map is in {self.dim or components.dim}D, and {MOST_VIEWPOINTS} viewpoints are the most."
            )
            raise RefusedError("unfit", robot_of(int(keys[0])), message)
        components = self.fitting(components)
        fresh = ~self.held.contains(keys)
        again = components.selected(torch.from_numpy(np.flatnonzero(~fresh)))
        if not fresh.all():
            self._check_same(keys[~fresh], again)
            components = components.selected(torch.from_numpy(np.flatnonzero(fresh)))
        if bounded and len(self.table) + len(components) > self._most:
            raise _full(int(keys[0]))
        added = Intervals.of(keys)
        held = self._with(added, bounded)
        self.table.add(keys[fresh], components)
        if complete:
            self._complete(keys[~fresh], again)
            self.complete |= added
            self.hears_channels = True
        self._hold(held)
        self.dim = components.dim
        return added | added.shifted(CHANNELS) if complete else added

    def add_pieces(self, components: Components, bounded: bool, complete: bool) -> Intervals:
        """`add_components` in pieces of the table."""
        pieces = torch.arange(len(components)).split(_PIECE)
        return Intervals.union(
            [self.add_components(components.selected(rows), bounded, complete) for rows in pieces]
        )

    def _complete(self, keys: Ints, components: Components) -> None:
        """Give held components (K,) the channels that they lack."""
        rows = np.flatnonzero(self.table.contains(keys) & ~self.complete.contains(keys))
        if len(rows):
            self.table.drop(keys[rows])
            self.table.add(keys[rows], components.selected(torch.from_numpy(rows)))
            self._log.invalidate()
            self.version += 1

    def add_record(self, record: RecordMessage, bounded: bool = True) -> Intervals:
        """Add another record; returns its key. Raises `RefusedError`, as `add_components` does."""
        key, robot, datagram = record.key, robot_of(record.key), encode_record(record)
        span = Intervals.span(key, key + 1)
        if key in self.held:
            if key in self.table or self.datagrams.get(key, datagram) != datagram:
                raise _duplicate_id(key)
            return span
        dim = record.dim if isinstance(record, CorrectionMessage | FrameMessage) else None
        unfit = None not in (dim, self.dim) and dim != self.dim
        if unfit or len(datagram) > RECORD_BYTES:
            message = f"Record {key} is too long, or has another dimension than this map."
            raise RefusedError("unfit", robot, message)
        if bounded and not self._has_room(record):
            raise _full(key)
        held = self._with(span, bounded)
        self.others[key], self.datagrams[key] = record, datagram
        self._kinds.setdefault(type(record), {})[key] = record
        self._n_entries += _n_entries(record)
        if isinstance(record, SupersessionMessage):
            self._waiting[key] = record
        elif isinstance(record, CountersMessage):
            self.counters.add(record)
            self._log.counted(record.components)
        elif isinstance(record, CorrectionMessage):
            self._moved(record)
        elif isinstance(record, FrameMessage):
            self._place_frames()
        self._hold(held)
        return span

    def _has_room(self, record: RecordMessage) -> bool:
        if len(self.others) >= MOST_OTHERS or self._n_entries + _n_entries(record) > MOST_ENTRIES:
            return False
        if not isinstance(record, SupersessionMessage):
            return True
        waiting = sum(len(one.old) for one in self._waiting.values())
        return len(self.held) + waiting + len(record.old) <= MOST_INTERVALS

    def _with(self, added: Intervals, bounded: bool) -> Intervals:
        """The held keys with those added. Raises `RefusedError` if they take too many intervals."""
        held = self.held | added
        if bounded and len(held) > max(len(self.held), MOST_INTERVALS):
            raise _full(added.pairs()[0][0])
        return held

    def _check_same(self, keys: Ints, again: Components) -> None:
        """Raise `RefusedError` if components with held keys (K,) have another content than before."""
        for key, print_ in zip(keys.tolist(), fingerprints(again), strict=True):
            if key in self.others or (
                key in self.table and not is_same(self.table.fingerprints([key])[0], print_)
            ):
                raise _duplicate_id(key)

    def _hold(self, held: Intervals) -> None:
        """Set the held keys to a larger set, and drop the records that are superseded by now."""
        if held == self.held:
            return
        self.version += 1
        here, superseded = held, Intervals.empty()
        while effective := [s for s in self._waiting.values() if held.covers(s.new)]:
            for supersession in effective:
                del self._waiting[supersession.key]
                superseded |= supersession.old
            held |= superseded
        if superseded:
            self._drop((here & superseded) - self.dead)
        self.held, self.dead = held, self.dead | superseded

    def _drop(self, dropped: Intervals) -> None:
        """Remove records that are here."""
        keys = dropped.numbers()
        is_component = self.table.contains(keys)
        if is_component.any():
            self.table.drop(keys[is_component])
            self._log.invalidate()
        counters, n_frames = [], len(self.of(FrameMessage))
        for key in keys[~is_component].tolist():
            record = self.others.pop(key)
            del self.datagrams[key], self._kinds[type(record)][key]
            self._n_entries -= _n_entries(record)
            self._waiting.pop(key, None)
            if isinstance(record, CountersMessage):
                counters.append(record)
                self._log.counted(record.components)
            elif isinstance(record, CorrectionMessage):
                self._moved(record)
        self.counters.drop(counters)
        if len(self.of(FrameMessage)) < n_frames:
            self._place_frames()

    def _moved(self, correction: CorrectionMessage) -> None:
        """A correction was added or dropped."""
        if (correction.moved & self.held) - self.dead:
            self._log.invalidate()

    def _place_frames(self) -> None:
        """Records of frames were added or dropped."""
        before, self.frames = self.frames, Frames(self.of(FrameMessage), self.dim or 3)
        reported = {self._author, *np.unique(authors(self.table.keys())).tolist()}
        if not all(before.place(one).equals(self.frames.place(one)) for one in reported):
            self._log.invalidate()

    def of(self, kind: type[_Record]) -> list[_Record]:
        """The stored records of a type, by key."""
        found = self._kinds.get(kind, {})
        return [cast(_Record, found[key]) for key in sorted(found)]

    def effective(self) -> list[SupersessionMessage]:
        """Supersessions whose successors are all held."""
        return [record for record in self.of(SupersessionMessage) if record.key not in self._waiting]

    @property
    def root(self) -> int:
        """The root of the author's frame."""
        return self.frames.place(self._author).root

    def components(self, root: int | None = None) -> Components:
        """The components that count and are in frames of a root, by key, with the points of all counters,
        moved by the corrections, in the root frame. None: that of the author."""
        if root is not None and root != self.root:
            return self._seen_in(root)
        if self._view is None or self._view[0] != self.version:
            self._view = self.version, self._seen_in(self.root)
        return self._view[1]

    def _seen_in(self, root: int) -> Components:
        keys = self.table.keys()
        keys = keys[self.frames.are_in(keys, root)]
        if not len(keys):
            return Components.empty(self.dim or 3)
        gain = torch.from_numpy(self.counters.sums(keys))
        return self._placed(with_gains(self.table.selected(keys), gain), keys)

    def _placed(self, components: Components, keys: Ints) -> Components:
        return self.frames.placed(corrected(components, keys, self.of(CorrectionMessage)), keys)

    def changes(self) -> Changes:
        """The changes since the last call."""

        def placed(components: Components, keys: Ints) -> Components:
            inside = self.frames.are_in(keys, self.root)
            if not inside.all():
                components = components.selected(torch.from_numpy(np.flatnonzero(inside)))
            return self._placed(components, keys[inside])

        return self._log.read(self.table, self.counters, placed)

    def digest(self) -> bytes:
        """16 bytes, equal if and only if the held keys and the records that count are equal to the bit."""
        digest = hashlib.blake2b(self.held.edges.astype("<i8").tobytes(), digest_size=16)
        keys = self.table.keys()
        key_bytes = keys.astype("<i8").tobytes()
        for row, print_ in enumerate(self.table.fingerprints(keys.tolist())):
            digest.update(key_bytes[8 * row : 8 * row + 8] + print_)
        for key in sorted(self.others):
            digest.update(self.datagrams[key])
        return digest.digest()

    def stored(self) -> tuple[list[bytes], list[bytes]]:
        """Codec batches of all components that count, and the datagrams of the other records that count."""
        keys, batches = self.table.keys(), []
        has = self.complete.contains(keys)
        for some, channels in ((keys[~has], False), (keys[has], True)):
            for part in np.split(some, range(_BATCH, len(some), _BATCH)):
                batches += [encode(self.table.selected(part), channels)] if len(part) else []
        return batches, [self.datagrams[key] for key in sorted(self.others)]

    def load_batch(self, data: bytes, own: int) -> None:
        """Add the components of a batch of `stored`. The limits on memory do not apply to those of robot
        `own`. Raises as `add_components` does, and `DataError` for a damaged batch."""
        components = read_batch(data)
        is_own = components.ids[:, 0] == own
        for rows, bounded in ((is_own, False), (~is_own, True)):
            part = components.selected(rows.nonzero().squeeze(1))
            self.add_pieces(part, bounded=bounded, complete=has_channels(data))


def _n_entries(record: RecordMessage) -> int:
    """The entries of a record that count towards `MOST_ENTRIES`."""
    if isinstance(record, CountersMessage):
        return len(record.components)
    if isinstance(record, SupersessionMessage):
        return len(record.old) + len(record.new)
    return len(record.moved) if isinstance(record, CorrectionMessage) else 1


def _duplicate_id(key: int) -> RefusedError:
    robot = robot_of(key)
    message = f"Record {key} of robot {robot} has two contents: two robots use the id {robot}."
    return RefusedError("duplicate_id", robot, f"{message} Give each robot an id of its own.")


def _full(key: int) -> RefusedError:
    return RefusedError("full", robot_of(key), f"Record {key} needs more memory than a map may take.")
