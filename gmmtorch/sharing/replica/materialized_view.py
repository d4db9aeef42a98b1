"""The map that follows from the records, and its changes since the last call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gmmtorch.mapping.components import Components
from gmmtorch.sharing.messages.record_messages import CorrectionMessage
from gmmtorch.sharing.replica.component_table import ComponentTable, Counters
from gmmtorch.sharing.replica.record_keys import Ints, keys_of, robot_of
from gmmtorch.sharing.replica.robot_frames import moved


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


def information(components: Components) -> Tensor:
    """The approximate space (K,), m³ or m², that each component shows: its face times its sensor distance.

    Large components seen from afar leave the largest hole in a map that lacks them.
    """
    deviation = torch.linalg.eigvalsh(components.covariances).clamp_min(0).sqrt()
    face = deviation[:, 1:].prod(1)
    apart = components.means[components.seen_by] - components.origins[components.seen_from]
    reach = face.new_zeros(len(face)).scatter_reduce_(0, components.seen_by, apart.norm(dim=1), "amax")
    return face * reach


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
