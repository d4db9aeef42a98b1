"""The map that follows from the records: counters, corrections and frames applied, and its changes.

Each record of a frame says where the frame is in another one, its anchor. The chain of anchors ends at a
frame without an anchor, its root. Frames of one root are placed relative to each other. Records of an author
without a frame are in the frame `WORLD`. A chain that returns to itself, which no sound robot writes, places
nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.mapping import Components
from gmmtorch.team.sharing.messages.fields import matrix_of
from gmmtorch.team.sharing.messages.record_messages import CorrectionMessage, FrameMessage
from gmmtorch.team.sharing.replica.component_table import ComponentTable, Counters
from gmmtorch.team.sharing.replica.record_keys import (
    NUMBER_BITS,
    SEQUENCE_BITS,
    WORLD,
    Ints,
    authors,
    keys_of,
    robot_of,
)

# -- points ---------------------------------------------------------------------------------------------


def gains(components: Components, gain: Tensor) -> Components:
    """Components (K,) whose support and counts are the points (K,) that they gain.

    The points are distributed over a component's viewpoints in proportion to their counts.
    """
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


# -- corrections and frames -----------------------------------------------------------------------------


def latest(records: Sequence[CorrectionMessage]) -> list[CorrectionMessage]:
    """The correction of each scan with the highest version, then key; sorted by robot and scan."""
    found: dict[tuple[int, int], CorrectionMessage] = {}
    for record in sorted(records, key=lambda r: (r.version, r.key)):
        found[robot_of(record.key), record.scan] = record
    return [found[scan] for scan in sorted(found)]


def corrected(components: Components, keys: Ints, records: Sequence[CorrectionMessage]) -> Components:
    """Components (K,) moved by the corrections of their scans, with their origins.

    A component of two scans is moved by the correction of the scan with the higher number.
    """
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

    def __len__(self) -> int:
        return len(self._latest)

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


# -- changes --------------------------------------------------------------------------------------------

_MOST_KEYS = 1 << 16
"""Keys of components with new counters that are remembered between two calls; of more, all counters are
read."""
_NO_KEYS = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Changes:
    """What a replica added to its map.

    added: batches of new components in frames of this robot's root, its own included, one for each datagram
    in the order of arrival, with their own counts.
    gained: components whose counters rose, by id; support and counts are the rise. Points that were
    assigned to a component before it arrived are included when it arrives.
    rebuilt: components were superseded or corrected, or frames were placed, so that everything must be
    derived from `components()` again. `added` and `gained` are empty then; later changes continue from there.
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
        they are in it.
        """
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
