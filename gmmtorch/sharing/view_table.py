"""Views by key, and the keys of those that are dead: what merges, whatever the order and however often."""

from __future__ import annotations

import hashlib
import math
import struct
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.sharing.messages.fields import LATEST, TICKS, quantized_poses
from gmmtorch.sharing.messages.view_messages import ViewsMessage
from gmmtorch.sharing.replica.intervals import Intervals, Ints
from gmmtorch.sharing.replica.record_keys import END, ids_of, keys_of
from gmmtorch.sharing.view_announcements import DIGEST_BYTES, PRINT_BYTES, ViewsDetail

_LARGEST_VALUE = float(np.finfo(np.float16).max)


class View(NamedTuple):
    """stamp: seconds when the value was found; of two views of one key the greater tuple counts."""

    stamp: float
    value: float
    pose: tuple[float, float, float, float]

    @classmethod
    def of(cls, pose: Tensor, value: float, now: float) -> View:
        """A view as messages carry it: pose (4,) to 1 cm and 1/256 of a turn, float16, time to 1 ms."""
        x, y, z, yaw = quantized_poses(pose[None])[0].tolist()
        return cls(*_rounded(value, now), (x, y, z, yaw))

    def revalued(self, value: float, now: float) -> View:
        """The same with another value, and later, also where the clock that it came from is ahead."""
        at, half = _rounded(value, now)
        return View(max(at, min(_milliseconds(self.stamp + 1 / TICKS), LATEST)), half, self.pose)


class ViewTable:
    """A set of views that only moves on: a dead one stays dead, and a view gives way to a greater one.

    Two are joined by the union of the dead, and, for each key that is not dead, the greater view. So
    merging is commutative, associative and idempotent.

    Attributes:
        views: those alive, by key. dead: the keys of the others.
        version: rises with every change.
    """

    def __init__(self) -> None:
        self.views: dict[int, View] = {}
        self.dead = Intervals.empty()
        self.version = 0
        self._sum = 0  # exclusive or of the fingerprints of all views
        self._digest = (-1, b"")  # of which version

    # -- changing ---------------------------------------------------------------------------------

    def put(self, key: int, view: View) -> None:
        """Take in a view, if its key is not dead and no greater one is here."""
        known = self.views.get(key)
        if key not in self.dead and (known is None or view > known):
            self._sum ^= _fingerprint(key, view) ^ (0 if known is None else _fingerprint(key, known))
            self.views[key] = view
            self.version += 1

    def bury(self, keys: Intervals) -> None:
        """These are dead, alive or not, known or not."""
        if self.dead.covers(keys):
            return
        self.dead |= keys
        self.version += 1
        alive = self.alive()
        for key in alive[keys.contains(alive)].tolist():
            self._sum ^= _fingerprint(key, self.views.pop(key))

    def merge(self, message: ViewsMessage) -> Intervals:
        """Take in what others say; returns the keys of which it says what is held here now."""
        self.bury(message.removed)
        keys = keys_of(message.ids)
        said = []
        rows = (message.stamps + 0.0, message.values + 0.0, message.poses + 0.0)  # no −0
        for key, stamp, value, pose in zip(keys.tolist(), *(row.tolist() for row in rows), strict=True):
            view = View(stamp, value, tuple(pose))
            self.put(key, view)
            if self.views.get(key) == view:
                said.append(key)
        return message.removed | Intervals.of(np.array(said, np.int64))

    # -- reading ----------------------------------------------------------------------------------

    def alive(self) -> Ints:
        """The keys (V,) of all views, rising."""
        return np.sort(np.fromiter(self.views, np.int64, len(self.views)))

    def message(self, alive: Ints, dead: Intervals) -> ViewsMessage:
        """What there is to say of these."""
        views = [self.views[key] for key in alive.tolist()]
        return ViewsMessage(
            ids=ids_of(alive),
            poses=torch.tensor([view.pose for view in views], dtype=torch.float64).reshape(-1, 4),
            values=torch.tensor([view.value for view in views], dtype=torch.float64),
            stamps=torch.tensor([view.stamp for view in views], dtype=torch.float64),
            removed=dead,
        )

    def digest(self) -> bytes:
        """8 bytes: equal for equal views and equal dead."""
        if self._digest[0] != self.version:
            data = self._sum.to_bytes(PRINT_BYTES, "little") + self.dead.edges.astype("<i8").tobytes()
            self._digest = self.version, hashlib.blake2b(data, digest_size=DIGEST_BYTES).digest()
        return self._digest[1]

    def detail(self, byte: int) -> ViewsDetail:
        """All that is known, with one byte of the fingerprint of each view."""
        alive = self.alive()
        return ViewsDetail(0, END, self.dead | Intervals.of(alive), alive, byte, self._checks(alive, byte))

    def missing(self, detail: ViewsDetail) -> Intervals:
        """The keys of what another does not hold as it is held here, of those that it speaks of.

        Of a view that both hold otherwise nobody knows which is the greater: it is among them.
        """
        alive = self.alive()
        alive = alive[detail.scope.contains(alive)]
        place = np.searchsorted(detail.alive, alive)
        shared = np.isin(alive, detail.alive)
        other = ~detail.known.contains(alive)
        other[shared] = self._checks(alive[shared], detail.byte) != detail.checks[place[shared]]
        return Intervals.of(alive[other]) | ((self.dead & detail.scope) - detail.dead)

    def _checks(self, keys: Ints, byte: int) -> Ints:
        prints = (_fingerprint(key, self.views[key]) for key in keys.tolist())
        return np.array([print_ >> 8 * byte & 255 for print_ in prints], np.int64)

    # -- keeping ----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        message = self.message(self.alive(), self.dead)
        rows = {name: getattr(message, name) for name in ("ids", "poses", "values", "stamps")}
        return {**rows, "dead": self.dead.stored(), "version": self.version}

    def restore(self, state: dict[str, Any]) -> None:
        fresh = ViewTable()
        rows = {name: state[name] for name in ("ids", "poses", "values", "stamps")}
        fresh.merge(ViewsMessage(**rows, removed=Intervals.loaded(state["dead"])))
        if len(fresh.views) != len(rows["ids"]):
            raise DataError("Views are dead and alive: the state is damaged.")
        fresh.version, fresh._digest = int(state["version"]), (-1, b"")
        vars(self).update(vars(fresh))


def _fingerprint(key: int, view: View) -> int:
    data = struct.pack("<q6d", key, view.stamp, view.value, *view.pose)
    return int.from_bytes(hashlib.blake2b(data, digest_size=PRINT_BYTES).digest(), "little")


def _rounded(value: float, now: float) -> tuple[float, float]:
    """Time and value as messages carry them."""
    if not (math.isfinite(value) and abs(now) <= LATEST):
        raise InvalidArgumentError(
            f"value={value} and now={now} s must be finite, the time up to {LATEST:g}."
        )
    half = float(np.float16(max(-_LARGEST_VALUE, min(value, _LARGEST_VALUE))))
    return _milliseconds(now), half + 0.0  # no −0


def _milliseconds(seconds: float) -> float:
    return round(seconds * TICKS) / TICKS
