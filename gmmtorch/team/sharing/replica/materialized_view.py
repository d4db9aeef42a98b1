"""The map that follows from the records: counters, corrections and frames applied, and its changes.

Each record of a frame says where the frame is in another one, its anchor. The chain of anchors ends at a
frame without an anchor, its root. Frames of one root are placed relative to each other. Records of an author
without a frame are in the frame `WORLD`. A chain that returns to itself, which no sound robot writes, places
nothing.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.linalg import pack_symmetric
from gmmtorch.mapping import Components, rows_of
from gmmtorch.team.sharing.messages.component_messages import counts_of
from gmmtorch.team.sharing.messages.datagrams import matrix_of
from gmmtorch.team.sharing.messages.record_messages import CorrectionMessage, CountersMessage, FrameMessage
from gmmtorch.team.sharing.replica.record_keys import (
    NUMBER_BITS,
    SEQUENCE_BITS,
    WORLD,
    Ints,
    author_of,
    authors,
    keys_of,
    robot_of,
)

_FINGERPRINT_BYTES = 16


class ComponentTable:
    """Components that are added and dropped, but never changed. Batches are numbered in the order of arrival;
    `end` is the number of the next. If components of a batch are dropped, the rest becomes a new batch. dim:
    2 or 3."""

    def __init__(self, dim: int = 3) -> None:
        self.dim = dim
        self.end = 0
        self._places: dict[int, tuple[int, int]] = {}  # batch and row, by key
        self._batches: dict[int, tuple[Ints, Components]] = {}  # keys by row, and components
        self._fingerprints: dict[int, list[bytes]] = {}  # by batch, when needed
        self._keys: Ints | None = None

    def __len__(self) -> int:
        return len(self._places)

    def __contains__(self, key: int) -> bool:
        return key in self._places

    def contains(self, keys: Ints) -> NDArray[np.bool_]:
        """Which of the keys (K,) are in the table."""
        return np.array([key in self._places for key in keys.tolist()], np.bool_)

    def fingerprints(self, keys: Sequence[int]) -> list[bytes]:
        """`fingerprints` of the components with these keys (K,)."""
        places = [self._places[key] for key in keys]
        for batch in {batch for batch, _ in places} - self._fingerprints.keys():
            self._fingerprints[batch] = fingerprints(self._batches[batch][1])
        return [self._fingerprints[batch][row] for batch, row in places]

    def keys(self) -> Ints:
        """The keys of all components, rising."""
        if self._keys is None:
            self._keys = np.sort(np.fromiter(self._places, np.int64, len(self._places)))
        return self._keys

    def add(self, keys: Ints, components: Components) -> None:
        """Add a batch of components (K,) with new keys (K,)."""
        if not len(keys):
            return
        self._places.update((key, (self.end, row)) for row, key in enumerate(keys.tolist()))
        self._batches[self.end] = keys, components
        self.end += 1
        self.dim, self._keys = components.dim, None

    def drop(self, keys: Ints) -> None:
        """Remove the components with these keys, which are in the table."""
        batches = {self._places.pop(key)[0] for key in keys.tolist()}
        for batch in sorted(batches):
            members, components = self._batches.pop(batch)
            self._fingerprints.pop(batch, None)
            left = np.flatnonzero(~np.isin(members, keys))
            self.add(members[left], _normalized(components.selected(torch.from_numpy(left))))
        self._keys = None

    def since(self, batch: int) -> list[tuple[Ints, Components]]:
        """Keys and components of each batch from number `batch` on, in the order of arrival."""
        numbers = range(batch, self.end)
        return [self._batches[number] for number in numbers if number in self._batches]

    def selected(self, keys: Ints) -> Components:
        """The components with these keys (K,), in that order, each origin once."""
        if not len(keys):
            return Components.empty(self.dim)
        by_batch: dict[int, list[tuple[int, int]]] = {}
        for rank, key in enumerate(keys.tolist()):
            batch, row = self._places[key]
            by_batch.setdefault(batch, []).append((rank, row))
        parts, ranks = [], []
        for batch, members in by_batch.items():
            parts.append(self._batches[batch][1].selected(torch.tensor([row for _, row in members])))
            ranks += [rank for rank, _ in members]
        return _normalized(Components.concatenate(parts).rearranged(torch.tensor(ranks).argsort()))


def fingerprints(components: Components) -> list[bytes]:
    """A hash (BLAKE2b, 16 bytes) of each component (K,), without its id, in any batch; followed by one of its
    attributes, if it has some."""
    c = components
    flags = c.max_range.double()[:, None]
    rows = _bits(torch.cat([c.means, pack_symmetric(c.covariances), c.support[:, None], flags], 1))
    order = torch.argsort(c.seen_by, stable=True)
    seen = _bits(torch.cat([c.origins[c.seen_from[order]], c.seen_count[order, None]], 1))
    ends = torch.bincount(c.seen_by, minlength=len(c)).cumsum(0).tolist()
    begins = [0, *ends][: len(ends)]
    found = [
        hashlib.blake2b(row.tobytes() + seen[begin:end].tobytes(), digest_size=_FINGERPRINT_BYTES).digest()
        for row, begin, end in zip(rows, begins, ends, strict=True)
    ]
    return [own + more for own, more in zip(found, _of_attributes(c), strict=True)] if c.attributes else found


def _of_attributes(components: Components) -> list[bytes]:
    """A hash of the attributes of each component (K,); empty if it has none."""
    channels = rows_of(components.attributes, components.covariances)
    known = {name.encode() + b"\0": rows.numpy().astype("<i8") for name, rows in channels.items()}
    found = []
    for k in range(len(components)):
        content = b"".join(name + rows[k].tobytes() for name, rows in known.items() if rows[k, 0])
        found.append(hashlib.blake2b(content, digest_size=_FINGERPRINT_BYTES).digest() if content else b"")
    return found


def is_same(one: bytes, other: bytes) -> bool:
    """Whether two fingerprints are of one component, whose attributes one of both may lack."""
    geometry, attributes = slice(_FINGERPRINT_BYTES), slice(_FINGERPRINT_BYTES, None)
    known = {one[attributes], other[attributes]} - {b""}
    return one[geometry] == other[geometry] and len(known) < 2


def most_viewpoints(components: Components) -> int:
    """The largest number of viewpoints of a component."""
    return int(torch.bincount(components.seen_by).max()) if len(components.seen_by) else 0


def _bits(values: Tensor) -> np.ndarray:
    return (values.double().cpu() + 0.0).numpy().astype("<f8")  # −0 becomes 0


def _normalized(components: Components) -> Components:
    """Viewpoints sorted by component, and distinct, rising origins: independent of the batches."""
    order = torch.argsort(components.seen_by, stable=True)
    seen_from = components.seen_from[order]
    origins, which = torch.unique(components.origins[seen_from] + 0.0, dim=0, return_inverse=True)
    return replace(
        components,
        origins=origins,
        seen_by=components.seen_by[order],
        seen_from=which,
        seen_count=components.seen_count[order],
    )


_Row = tuple[Ints, Ints]  # keys of components (N,), rising, and the largest counter of each, in steps
_EMPTY: _Row = np.zeros(0, np.int64), np.zeros(0, np.int64)


class Counters:
    """The records of counters. The largest counter of a component counts for each author, and authors are
    summed in rising order. So the sums depend neither on the order of the records nor on repetitions."""

    def __init__(self) -> None:
        self._records: dict[int, dict[int, CountersMessage]] = {}  # by author and key
        self._largest: dict[int, _Row] = {}  # by author

    def of(self, author: int) -> Mapping[int, CountersMessage]:
        """The records of an author, by key."""
        return self._records.get(author, {})

    def add(self, record: CountersMessage) -> None:
        author = author_of(record.key)
        self._records.setdefault(author, {})[record.key] = record
        self._largest[author] = _raised(self._largest.get(author, _EMPTY), record.components, record.steps)

    def drop(self, records: Iterable[CountersMessage]) -> None:
        """Remove records that were added."""
        dropped = {record.key: author_of(record.key) for record in records}
        for key, author in dropped.items():
            del self._records[author][key]
        for author in set(dropped.values()):
            if left := self._records[author]:
                self._largest[author] = _largest_of(left.values())
            else:
                del self._records[author], self._largest[author]

    def keys(self) -> Ints:
        """Keys (N,), rising, of all components that have counters, held or not."""
        return np.unique(np.concatenate([_EMPTY[0], *(keys for keys, _ in self._largest.values())]))

    def sums(self, keys: Ints) -> NDArray[np.float64]:
        """Points (K,) that all authors have assigned to components (K,)."""
        total = np.zeros(len(keys))
        for author in sorted(self._largest):
            known_keys, steps = self._largest[author]
            place, is_known = _places(known_keys, keys)
            total[is_known] += counts_of(steps[place[is_known]])
        return total


def _places(rising: Ints, keys: Ints) -> tuple[Ints, NDArray[np.bool_]]:
    """Where each key (K,) is, or would be inserted, among rising keys; and which are there."""
    place = np.searchsorted(rising, keys)
    is_known = place < len(rising)
    is_known[is_known] = rising[place[is_known]] == keys[is_known]
    return place, is_known


def _raised(row: _Row, keys: Ints, steps: Ints) -> _Row:
    """The row with the counters of distinct keys (K,), where those are larger."""
    known_keys, largest = row
    place, is_known = _places(known_keys, keys)
    raised = largest.copy()
    raised[place[is_known]] = np.maximum(largest[place[is_known]], steps[is_known])
    order = np.argsort(keys[~is_known])  # keys inserted at one place keep this order
    new, value = keys[~is_known][order], steps[~is_known][order]
    at = place[~is_known][order]
    return np.insert(known_keys, at, new), np.insert(raised, at, value)


def _largest_of(records: Iterable[CountersMessage]) -> _Row:
    """The largest counter of each component in these records, at least one."""
    keys, steps = (np.concatenate(x) for x in zip(*((r.components, r.steps) for r in records), strict=True))
    order = np.lexsort((steps, keys))
    keys, steps = keys[order], steps[order]
    is_largest = np.append(np.diff(keys) != 0, True)[: len(keys)]
    return keys[is_largest], steps[is_largest]


def gains(components: Components, gain: Tensor) -> Components:
    """Components (K,) whose support and counts are the points (K,) that they gain. The points are distributed
    over a component's viewpoints in proportion to their counts."""
    ratio = torch.where(components.support > 0, gain / components.support, 0.0)
    several = torch.bincount(components.seen_by, minlength=len(components)).clamp_min(1)
    equal = torch.where(components.support > 0, 0.0, gain / several)  # for components without support
    seen_count = components.seen_count * ratio[components.seen_by] + equal[components.seen_by]
    return replace(components, support=gain, seen_count=seen_count)


def with_gains(components: Components, gain: Tensor) -> Components:
    """Components (K,) with points (K,) added to their support and counts."""
    more = gains(components, gain)
    return replace(
        components,
        support=components.support + more.support,
        seen_count=components.seen_count + more.seen_count,
    )


def latest(records: Sequence[CorrectionMessage]) -> list[CorrectionMessage]:
    """The correction of each scan with the highest version, then key; sorted by robot and scan."""
    found: dict[tuple[int, int], CorrectionMessage] = {}
    for record in sorted(records, key=lambda r: (r.version, r.key)):
        found[robot_of(record.key), record.scan] = record
    return [found[scan] for scan in sorted(found)]


def corrected(components: Components, keys: Ints, records: Sequence[CorrectionMessage]) -> Components:
    """Components (K,) moved by the corrections of their scans, with their origins. A component of two scans
    is moved by the correction of the scan with the higher number."""
    motions = [record for record in latest(records) if record.dim == components.dim]
    which = np.full(len(keys), -1)
    for number, record in enumerate(motions):
        which[record.moved.contains(keys)] = number
    if not (which >= 0).any():
        return components
    identity = torch.eye(components.dim + 1, dtype=torch.float64)
    motion = torch.stack([*(record.transform() for record in motions), identity])[which]  # (K, D+1, D+1)
    return moved(components, motion, torch.from_numpy(which >= 0))


class Placement(NamedTuple):
    """root: the frame at the end of the chain. transform: (D+1, D+1), root ← frame; None: the identity."""

    root: int
    transform: Tensor | None

    def equals(self, other: Placement) -> bool:
        if self.root != other.root or self.transform is None or other.transform is None:
            return self.root == other.root and self.transform is other.transform
        return torch.equal(self.transform, other.transform)


class Frames:
    """The placement of each author's records, by the latest record of each frame.

    Args:
        records: of frames, in any order. dim: 2 or 3; records of the other dimension are ignored.
    """

    def __init__(self, records: Sequence[FrameMessage], dim: int) -> None:
        self._latest: dict[int, FrameMessage] = {}
        for record in sorted(records, key=lambda r: (r.version, r.key)):
            if record.dim in (None, dim):
                self._latest[record.frame] = record
        self._anchors = {record.anchor for record in self._latest.values()}
        self._placed: dict[int, Placement] = {}

    def place(self, frame: int) -> Placement:
        """Where the frame of an author is."""
        if frame not in self._placed:
            self._placed[frame] = self._follow(frame)
        return self._placed[frame]

    def anchor(self, frame: int) -> int | None:
        """The anchor of a frame; None if it has none."""
        record = self._latest.get(frame)
        return None if record is None or record.anchor == frame else record.anchor

    def _follow(self, frame: int) -> Placement:
        if frame not in self._latest and frame not in self._anchors:
            return Placement(WORLD, None)
        at, transform, passed = frame, None, set()
        while (record := self._latest.get(at)) is not None and record.pose is not None:
            if at in passed:
                return Placement(frame, None)
            passed.add(at)
            step = matrix_of(record.pose)
            transform = step if transform is None else step @ transform
            at = record.anchor
        return Placement(at, transform)

    def are_in(self, keys: Ints, root: int) -> NDArray[np.bool_]:
        """Which records (K,) are in frames of a root."""
        if not self._latest:
            return np.full(len(keys), root == WORLD)
        numbers, which = np.unique(authors(keys), return_inverse=True)
        return np.array([self.place(n).root == root for n in numbers.tolist()], np.bool_)[which]

    def placed(self, components: Components, keys: Ints) -> Components:
        """Components (K,) with keys (K,), which are in frames of one root, in the root frame."""
        numbers, which = np.unique(authors(keys), return_inverse=True)
        motions = [self.place(number).transform for number in numbers.tolist()]
        if all(motion is None for motion in motions):
            return components
        identity = torch.eye(components.dim + 1, dtype=torch.float64)
        table = torch.stack([identity if motion is None else motion for motion in motions])
        moves = np.array([motion is not None for motion in motions])[which]
        return moved(components, table[torch.from_numpy(which)], torch.from_numpy(moves))

    def roots(self, keys: Ints) -> set[int]:
        """The roots of the frames of records (K,)."""
        return {self.place(number).root for number in np.unique(authors(keys)).tolist()}


def robot_of_frame(frame: int) -> int:
    """The robot of a frame; −1 for `WORLD`."""
    return frame >> (SEQUENCE_BITS - NUMBER_BITS)


def moved(components: Components, motions: Tensor, moves: Tensor) -> Components:
    """Components (K,) and their origins, moved by rigid motions (K, D+1, D+1); exactly the same where not
    `moves` (K,)."""
    means, seen_at = components.means, components.origins[components.seen_from]
    turn = motions[:, :-1, :-1]
    covariances = turn @ components.covariances @ turn.transpose(1, 2)
    at = _at(motions[components.seen_by], seen_at)
    at = torch.where(moves[components.seen_by, None], at, seen_at)
    origins, seen_from = torch.unique(at, dim=0, return_inverse=True)
    return replace(
        components,
        means=torch.where(moves[:, None], _at(motions, means), means),
        covariances=torch.where(
            moves[:, None, None], (covariances + covariances.transpose(1, 2)) / 2, components.covariances
        ),
        origins=origins,
        seen_from=seen_from,
    )


def _at(motions: Tensor, points: Tensor) -> Tensor:
    """Points (N, D) transformed by motions (N, D+1, D+1)."""
    return (motions[:, :-1, :-1] @ points[:, :, None]).squeeze(2) + motions[:, :-1, -1]


_MOST_KEYS = 1 << 16
"""Keys of components with new counters that are remembered between two calls; of more, all counters are
read."""
_NO_KEYS = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Changes:
    """What a replica added to its map.

    added: batches of new components in frames of this robot's root, its own included, one for each datagram
    in the order of arrival, with their own counts. gained: components whose counters rose, by id; support
    and counts are the rise, with what was assigned to a component before it arrived.
    rebuilt: components were superseded or corrected, or frames were placed: derive everything from
    `components()` again. `added` and `gained` are empty then; later changes continue from there.
    """

    added: list[Components]
    gained: Components
    rebuilt: bool


class ChangeLog:
    """Which components and counters were reported. It costs nothing until the first call of `read`."""

    def __init__(self) -> None:
        self._batch = 0  # the first batch that was not reported
        # Points reported, by component; None: before the first call.
        self._reported: dict[int, float] | None = None
        self._touched: list[Ints] | None = None  # components whose counters changed; None: any
        self._n_touched = 0
        self._rebuilt = False

    def counted(self, keys: Ints) -> None:
        """Counters of these components were added or dropped."""
        if self._touched is not None:
            self._touched.append(keys)
            self._n_touched += 1 + len(keys)
            if self._n_touched > _MOST_KEYS:
                self._touched = None

    def invalidate(self) -> None:
        """Components that were reported have changed."""
        self._rebuilt = self._reported is not None

    def read(
        self, table: ComponentTable, counters: Counters, placed: Callable[[Components, Ints], Components]
    ) -> Changes:
        """The changes since the last call. placed: the components with these keys that are in the map, where
        they are in it."""
        if self._touched == [] and self._batch == table.end and not self._rebuilt:
            return Changes([], Components.empty(table.dim), False)
        before = {} if self._rebuilt or self._reported is None else self._reported
        batches = table.since(self._batch)
        if self._touched is None or self._rebuilt:
            keys = counters.keys()
        else:
            keys = np.unique(np.concatenate([_NO_KEYS, *self._touched, *(keys for keys, _ in batches)]))
        keys = keys[table.contains(keys)]  # others are read when the component arrives
        sums = counters.sums(keys)
        rise = sums - np.array([before.get(key, 0.0) for key in keys.tolist()])
        rebuilt = self._rebuilt or bool((rise < 0).any())
        before.update(zip(keys[rise != 0].tolist(), sums[rise != 0].tolist(), strict=True))
        self._batch, self._reported, self._rebuilt = table.end, before, False
        self._touched, self._n_touched = [], 0
        if rebuilt:
            return Changes([], Components.empty(table.dim), True)
        added = [there for keys, batch in batches if len(there := placed(batch, keys))]
        risen = keys[rise > 0]
        held = placed(table.selected(risen), risen) if len(risen) else Components.empty(table.dim)
        is_held = np.isin(risen, keys_of(held.ids))
        return Changes(added, gains(held, torch.from_numpy(rise[rise > 0][is_held])), False)
