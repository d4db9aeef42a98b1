"""ViewLibrary: camera poses worth visiting, which a team shares as best-effort hints (thesis 4.3)."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.team.sharing.messages.mission_messages import (
    LATEST,
    STAMP_TICKS,
    ViewsMessage,
    encode_views,
    quantized_value,
    quantized_views,
)
from gmmtorch.team.sharing.replica.record_keys import (
    LARGEST_INCARNATION,
    LARGEST_ROBOT,
    MOST_RECORDS,
    Intervals,
    first_key,
    ids_of,
    keys_of,
    robot_of,
)

_TURN = math.pi / 4
"""Radians. A view is not added if another one is nearer than that and than `ViewLibrary.spacing`."""
MOST_OWN_VIEWS = 256
"""Views of one robot; the least valuable are removed."""
TIME_TO_LIVE = 1800.0
"""Seconds without a new value after which a view is removed: the length of a mission, for distant views."""
REPEAT_AFTER, STAGGER = 120.0, 8.0
"""Seconds of silence about a view until its finder repeats it; and the further wait of each next robot."""
MOST_REPEATED = 4
"""Views that are repeated in one call."""
MOST_VIEWS = 1 << 14
"""Views, and intervals of removed keys. More are not accepted from other robots."""
MOST_DATAGRAMS = 8
"""Datagrams of one call; the rest waits."""
_RUN = 96  # views, or intervals of removed keys, that are encoded together: about a datagram
_VISITED = 0.8, math.pi / 5  # metres and radians within which a view counts as visited
_FRESH = 10.0  # seconds for which a value needs no new evaluation
_SMALL_CHANGE = 0.2  # change of a value, relative to it, that is not sent
_LARGEST_VALUE = float(np.finfo(np.float16).max)


class View(NamedTuple):
    """stamp: seconds at which the value was found, by the clock of the robot that found it. Of two versions
    of a view the greater tuple counts."""

    stamp: float
    value: float
    pose: tuple[float, float, float, float]


class Candidates(NamedTuple):
    """Views that a robot may visit: keys, poses (V, 4), values (V,)."""

    keys: list[int]
    poses: Tensor
    values: Tensor


class ViewLibrary:
    """Views by key, as of records (see `record_keys`), and the keys of removed views, which never come back.

    The library is best-effort: a stale or missing view costs a detour, but never changes the map. Changes
    made here are sent once, in the next `datagrams`. After two minutes without messages of a view, its finder
    sends it again, or another robot if the finder is gone: for losses, and for robots that join late. If a
    robot sends a view that was removed here, the removal is sent again. Views are stored as messages carry
    them (`encode_views`), so that without losses all libraries are equal.

    Args:
        robot, incarnation: id and start of the robot, so that no key is given twice.

    Attributes:
        refused: number of messages that were not accepted, by reason: "duplicate_id", "full".
        version: rises with every change.
    """

    spacing = 1.5
    """Metres between views of one direction, at least."""

    def __init__(self, robot: int, *, incarnation: int = 0) -> None:
        check_whole("robot", robot, 0, LARGEST_ROBOT)
        check_whole("incarnation", incarnation, 0, LARGEST_INCARNATION)
        self.refused: Counter[str] = Counter()
        self.version = 0
        self._robot, self._first = robot, first_key(robot, incarnation)
        self._n = 0  # keys that were given
        self._views: dict[int, View] = {}
        self._removed = Intervals.empty()
        self._valued_at: dict[int, float] = {}  # by this robot's clock: when a value was found or received
        self._heard_at: dict[int, float] = {}  # when a view was last sent or received
        self._due: set[int] = set()
        self._removed_due = Intervals.empty()
        self._now = 0.0  # of the last call
        self._cached: Candidates | None = None

    def __len__(self) -> int:
        return len(self._views)

    def candidates(self) -> Candidates:
        """All views, by key."""
        if self._cached is None:
            keys = sorted(self._views)
            self._cached = Candidates(keys, *self._tensors(keys)[:2])
        return self._cached

    def _tensors(self, keys: list[int]) -> tuple[Tensor, Tensor, Tensor]:
        """Poses (V, 4), values (V,) and stamps (V,) of views."""
        views = [self._views[key] for key in keys]
        poses, values, stamps = (
            torch.tensor([getattr(view, name) for view in views], dtype=torch.float64)
            for name in ("pose", "value", "stamp")
        )
        return poses.reshape(-1, 4), values, stamps

    def add(self, poses: Tensor, values: Tensor, now: float, least: float, most: int = 8) -> list[int]:
        """Add the best `most` of views (N, 4) with values (N,) of at least `least`; return their keys."""
        added: list[int] = []
        rows, worth = quantized_views(poses).numpy(), values.detach().cpu().double().numpy()
        order = np.argsort(-worth, kind="stable")
        order = order[worth[order] >= max(least, 1e-6)]
        near = self.candidates().poses.numpy()
        for row in order.tolist():
            if len(added) == most:
                break
            if _is_near(rows[row], near, self.spacing, _TURN).any():
                continue
            if self._n == MOST_RECORDS:
                raise InvalidArgumentError(f"{MOST_RECORDS} views are the most of one incarnation.")
            near = np.concatenate([near, rows[row][None]])
            x, y, z, yaw = rows[row].tolist()
            added.append(self._first + self._n)
            self._n += 1
            self._put(added[-1], View(*_rounded(worth[row], now), (x, y, z, yaw)), now)
        self._due.update(added)
        own = sorted((view.value, key) for key, view in self._views.items() if robot_of(key) == self._robot)
        self._remove(key for _, key in own[: max(0, len(own) - MOST_OWN_VIEWS)])
        return [key for key in added if key in self._views]

    def revalue(self, keys: list[int], values: Tensor, now: float, least: float) -> None:
        """Set the values of views at the time `now` (s); those below `least` are removed. A small change is
        not sent, because it changes no plan; but once in half the time to live the view is, so that it is not
        removed."""
        for key, value in zip(keys, values.tolist(), strict=True):
            known = self._views.get(key)
            if value < least:
                self._remove([key])
            elif known is not None:
                is_small = abs(value - known.value) <= _SMALL_CHANGE * known.value
                if is_small and abs(now - known.stamp) <= TIME_TO_LIVE / 2:
                    self._valued_at[key] = now
                    continue
                # Later than the known version, even if that comes from a clock that is ahead.
                at, rounded = _rounded(value, now)
                after = min(_in_ticks(known.stamp + 1 / STAMP_TICKS), LATEST)
                self._put(key, View(max(at, after), rounded, known.pose), now)
                self._due.add(key)

    def remove(self, keys: list[int], now: float) -> None:
        """Remove views for good."""
        self._now = now
        self._remove(keys)

    def visit(self, poses: Tensor, now: float) -> None:
        """Remove the views near poses (N, 4), from which a robot has just observed."""
        known = self.candidates()
        seen = _is_near(poses[:, None].cpu().numpy(), known.poses.numpy(), *_VISITED).any(0)
        self.remove([known.keys[row] for row in np.flatnonzero(seen).tolist()], now)

    def covered(self, is_near: Callable[[Tensor], Tensor], now: float, most: int) -> list[int]:
        """At most `most` views where `is_near`, of places (V, 3), whose value is no longer fresh, the oldest
        first."""
        known = self.candidates()
        inside = is_near(known.poses[:, :3]).nonzero()[:, 0].tolist()
        due = sorted((self._valued_at[known.keys[row]], known.keys[row]) for row in inside)
        return [key for valued, key in due[:most] if valued <= now - _FRESH]

    def best(self, metres: Tensor, *, least: float = 0.0) -> int | None:
        """Row of `candidates` that maximizes value / (1 + metres (V,) to it); None if no view is in reach."""
        known = self.candidates()
        score = torch.where(known.values >= least, known.values / (1 + metres), 0.0)
        if not len(score) or not float(score.max()) > 0:
            return None
        return int(score.argmax())

    def digest(self) -> bytes:
        """8 bytes, equal for equal views. Robots that lost messages may differ."""
        digest = hashlib.blake2b(digest_size=8)
        for key in sorted(self._views):
            digest.update(repr((key, self._views[key])).encode())
        return digest.digest()

    def datagrams(self, now: float | None = None, budget: int | None = None) -> list[bytes]:
        """Datagrams of changes made here, of removals that others lack, and of repeated views.

        now: time (s) by this robot's clock; None: the time of the last call with one. budget: largest size of
        all together; None: no limit. The rest stays due, as does what exceeds `MOST_DATAGRAMS`.
        """
        left = math.inf if budget is None else check_whole("budget", budget, 0)
        now = self._now if now is None else now
        self._expire(now)
        removed = self._whole(self._removed_due)
        keys = [*sorted(self._due), *self._repeated(now)]
        sent: list[bytes] = []
        begin, n = 0, _RUN
        while begin < len(removed) + len(keys) and len(sent) < MOST_DATAGRAMS:
            some = Intervals(removed.edges[2 * begin : 2 * (begin + n)])
            views = keys[max(begin - len(removed), 0) : max(begin + n - len(removed), 0)]
            written = encode_views(self._message(views, some))
            if len(written) > 1 or len(written[0]) > left:
                if n == 1:
                    break
                n //= 2
                continue
            sent += written
            left -= len(written[0])
            begin += n
            self._removed_due -= some
            self._due.difference_update(views)
            self._heard_at.update(dict.fromkeys(views, now))
        return sent

    def receive(self, message: ViewsMessage, now: float) -> bool:
        """Merge the views of another robot at the time `now` (s); returns whether they were accepted. Never
        raises for a decoded message."""
        self._now = now if math.isfinite(now) else self._now
        keys = keys_of(message.ids)
        named = Intervals.of(keys) | message.removed
        n_new = sum(key not in self._views for key in keys.tolist())
        removed = self._removed | message.removed
        reason = ""
        if named & Intervals.span(self._first + self._n, self._first + MOST_RECORDS):
            reason = "duplicate_id"  # only this robot gives keys of its incarnation
        elif (n_new and len(self._views) + n_new > MOST_VIEWS) or len(removed) > max(
            len(self._removed), MOST_VIEWS
        ):
            reason = "full"
        if reason:
            self.refused[reason] += 1
            return False
        self._removed = removed
        self._drop([key for key in self._views if key in message.removed] if message.removed else [])
        self._removed_due -= message.removed
        rows = (message.stamps + 0.0, message.values + 0.0, message.poses + 0.0)  # −0 becomes 0
        for key, stamp, value, pose in zip(keys.tolist(), *(row.tolist() for row in rows), strict=True):
            view = View(stamp, value, tuple(pose))
            if key in self._removed:
                self._removed_due |= self._whole(Intervals.span(key, key + 1))
                continue
            known = self._views.get(key)
            if known is None or view > known:
                self._put(key, view, now)
            if self._views[key] == view:
                self._heard_at[key] = now
                self._due.discard(key)
        return True

    def _message(self, keys: list[int], removed: Intervals) -> ViewsMessage:
        return ViewsMessage(ids_of(np.array(keys, np.int64)), *self._tensors(keys), removed)

    def _repeated(self, now: float) -> list[int]:
        """The keys to repeat, the longest unheard first. The finder waits least."""
        n_robots = LARGEST_ROBOT + 1
        silent = sorted(
            (heard, key)
            for key, heard in self._heard_at.items()
            if now - heard >= REPEAT_AFTER + STAGGER * ((self._robot - robot_of(key)) % n_robots % 8)
        )
        return [key for _, key in silent if key not in self._due][:MOST_REPEATED]

    def _expire(self, now: float) -> None:
        """Remove the views that were not valued for the time to live."""
        limit = now - TIME_TO_LIVE
        self._remove([key for key, valued in self._valued_at.items() if valued < limit])

    def _put(self, key: int, view: View, now: float) -> None:
        self._views[key], self._valued_at[key] = view, now
        self._heard_at.setdefault(key, now)
        self.version += 1
        self._cached = None

    def _remove(self, keys: Iterable[int]) -> None:
        """Remove the keys that have views, and queue the removals for sending."""
        known = [key for key in keys if key in self._views]
        gone = Intervals.of(np.array(known, np.int64))
        self._removed |= gone
        self._removed_due |= gone
        self._drop(known)

    def _drop(self, keys: list[int]) -> None:
        for key in keys:
            del self._views[key], self._valued_at[key], self._heard_at[key]
            self._due.discard(key)
            self.version += 1
            self._cached = None

    def _whole(self, keys: Intervals) -> Intervals:
        """The intervals of removed keys that contain any of `keys`, as a whole. This takes no more bytes, and
        repeats earlier removals, which may have been lost."""
        if not keys:
            return keys
        edges, begins = self._removed.edges.reshape(-1, 2), keys.edges[::2]
        n_before, n_by_end = np.searchsorted(begins, edges).T
        meets = keys.contains(edges[:, 0]) | (n_by_end > n_before)
        return Intervals(edges[meets].reshape(-1))


def _rounded(value: float, now: float) -> tuple[float, float]:
    """Time and value as messages carry them."""
    if not (math.isfinite(value) and abs(now) <= LATEST):
        raise InvalidArgumentError(
            f"value={value} and now={now} s must be finite, the time up to {LATEST:g}."
        )
    rounded = quantized_value(max(-_LARGEST_VALUE, min(value, _LARGEST_VALUE)))
    return _in_ticks(now), rounded + 0.0  # −0 becomes 0


def _in_ticks(seconds: float) -> float:
    return round(seconds * STAMP_TICKS) / STAMP_TICKS


def _is_near(one: np.ndarray, others: np.ndarray, spacing: float, turn: float) -> np.ndarray:
    """Which of poses (…, 4) are nearer than `spacing` metres and `turn` radians."""
    step = one[..., :3] - others[..., :3]
    angle = (one[..., 3] - others[..., 3] + math.pi) % (2 * math.pi) - math.pi
    near: np.ndarray = ((step * step).sum(-1) < spacing**2) & (np.abs(angle) < turn)
    return near
