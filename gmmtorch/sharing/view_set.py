"""ViewSet: one robot's copy of a set of views that a team shares over networks that lose datagrams."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, check_whole
from gmmtorch.sharing.messages.envelope import MAX_BYTES
from gmmtorch.sharing.messages.message_registry import Message, ViewsHeldMessage, ViewsMessage, encode_views
from gmmtorch.sharing.messages.record_messages import check_size
from gmmtorch.sharing.replica.intervals import Intervals, Ints
from gmmtorch.sharing.replica.record_keys import (
    LARGEST_INCARNATION,
    LARGEST_ROBOT,
    MOST_RECORDS,
    drawn_incarnation,
    first_key,
    keys_of,
)
from gmmtorch.sharing.replica.rejections import RefusedError, merged
from gmmtorch.sharing.view_announcements import PRINT_BYTES, encode_views_held
from gmmtorch.sharing.view_peers import Peers
from gmmtorch.sharing.view_table import View, ViewTable

MOST_VIEWS = 1 << 14
"""Alive; more are not taken from others."""
MOST_INTERVALS = 1 << 14
"""Of dead ones; more are not taken from others. Nor are more taken to be on their way."""
MOST_DATAGRAMS = 8
"""Of views in one call: who lacks a whole set gets it bit by bit."""
_RUN = 96
"""Views, or intervals of dead ones, that go together: about a datagram."""


class ViewSet:
    """Views by key, and the keys of those that are dead, for good: all who have heard the same hold the same.

        key = views.add(pose, value, now)                              # and views.revalue, views.remove
        for datagram in views.datagrams(): broadcast(datagram)         # often
        for datagram in views.announcements(): broadcast(datagram)     # every second or so
        for datagram in heard: views.receive(decode(datagram))

    Keys are those of `record_ids`, numbered one after another. Nearly all views of long ago are dead: a few
    intervals of keys, however long the mission. What is lost is sent again where digests differ for two
    rounds of announcements: see `Peers`.

    Attributes:
        refused: how many messages were not merged, by reason: "other" (none of a set's), "conflict", "full",
            "own" (of this robot's own announcements), "damaged" (that no decoder made).
        conflicts: by robot, how often it was found that two robots use its number.
    """

    def __init__(self, robot: int, *, incarnation: int | None = None) -> None:
        """Args:
        robot: whose it is, up to 1023; no two robots of a team have the same.
        incarnation: of this life of the robot, up to 2²⁴ − 1. None: drawn, so that no key is given twice
            whatever was saved. Who gives it gives each only once, or goes on from the last state of it.
        """
        if check_whole("robot", robot, 0) > LARGEST_ROBOT:
            raise InvalidArgumentError(f"robot={robot} must be at most {LARGEST_ROBOT}.")
        life = drawn_incarnation() if incarnation is None else incarnation
        if check_whole("incarnation", life, 0) > LARGEST_INCARNATION:
            raise InvalidArgumentError(f"incarnation={life} must be at most {LARGEST_INCARNATION}.")
        self.robot, self.incarnation = int(robot), int(life)
        self.refused: Counter[str] = Counter()
        self.conflicts: Counter[int] = Counter()
        self._table = ViewTable()
        self._peers = Peers(self.robot)
        self._n = 0  # keys that this life has given
        self._n_details = 0
        self._due = Intervals.empty()
        self._passing = Intervals.empty()  # heard, or sent by the last call

    # -- what is held -----------------------------------------------------------------------------

    @property
    def views(self) -> dict[int, View]:
        """Those alive, by key: to be read only."""
        return self._table.views

    @property
    def dead(self) -> Intervals:
        """The keys of all others."""
        return self._table.dead

    @property
    def differs(self) -> bool:
        """Whether a teammate, when last heard, held other views."""
        return self._peers.differ()

    @property
    def version(self) -> int:
        """Rises with every change, made here or heard of."""
        return self._table.version

    def digest(self) -> bytes:
        """8 bytes: equal for equal contents, whatever the order in which they came."""
        return self._table.digest()

    # -- changes made here ------------------------------------------------------------------------

    def add(self, pose: Tensor, value: float, now: float) -> int:
        """A new view of this robot's from pose (4,), found at `now` (s); returns its key."""
        if self._n == MOST_RECORDS:
            raise InvalidArgumentError(f"{MOST_RECORDS} views are the most of one life; start a new ViewSet.")
        view = View.of(pose, value, now)
        key = first_key(self.robot, self.incarnation) + self._n
        self._n += 1
        self._table.put(key, view)
        self._due |= Intervals.span(key, key + 1)
        return key

    def revalue(self, key: int, value: float, now: float) -> None:
        """A view of anybody's is worth this now, if it is alive."""
        if key in self.views:
            self._table.put(key, self.views[key].revalued(value, now))
            self._due |= Intervals.span(key, key + 1)

    def remove(self, keys: Iterable[int]) -> None:
        """Views of anybody's are dead, for good. What is not alive is passed over."""
        gone = Intervals.of(np.array([key for key in keys if key in self.views], np.int64))
        self._table.bury(gone)
        self._due |= gone

    # -- what is sent -----------------------------------------------------------------------------

    def datagrams(self, max_bytes: int = MAX_BYTES, budget: int | None = None) -> list[bytes]:
        """What is due: what has changed here, and what others lack. `MOST_DATAGRAMS` at most; the rest waits.

        Args:
            max_bytes: of each datagram, from 1000 to 1200.
            budget: bytes of all of them. None: no limit.
        """
        check_size(max_bytes)
        left = math.inf if budget is None else check_whole("budget", budget, 0)
        alive, dead = self._told()
        sent: list[bytes] = []
        said, begin, n = Intervals.empty(), 0, _RUN
        while begin < len(dead) + len(alive) and len(sent) < MOST_DATAGRAMS:
            gone = Intervals(dead.edges[2 * begin : 2 * (begin + n)])
            seen = alive[max(begin - len(dead), 0) : max(begin + n - len(dead), 0)]
            written = encode_views(self._table.message(seen, gone), max_bytes)
            if len(written) > 1 or len(written[0]) > left:
                if n == 1:
                    break
                n //= 2
                continue
            sent += written
            left -= len(written[0])
            said |= gone | Intervals.of(seen)
            begin += n
        self._note_sent(said)
        return sent

    def announcements(self, max_bytes: int = MAX_BYTES) -> list[bytes]:
        """What is held: a digest; or which views, where others' digests have differed for a while.

        A round begins with it: see `Peers`.
        """
        check_size(max_bytes)
        if not self._peers.next_round(self.digest()):
            return encode_views_held(self.robot, self.digest())
        self._n_details += 1
        detail = self._table.detail(self._n_details % PRINT_BYTES)
        return encode_views_held(self.robot, self.digest(), detail, max_bytes)

    def _told(self) -> tuple[Ints, Intervals]:
        """Views that are due, and intervals of dead ones: the whole of each of which any is due.

        That takes no more bytes, and tells again of those that died before.
        """
        if not self._due:
            return np.zeros(0, np.int64), Intervals.empty()
        alive = self._table.alive()
        edges, begins = self.dead.edges.reshape(-1, 2), self._due.edges[::2]
        n_before, n_by_end = np.searchsorted(begins, edges).T
        meets = self._due.contains(edges[:, 0]) | (n_by_end > n_before)
        return alive[self._due.contains(alive)], Intervals(edges[meets].reshape(-1))

    def _note_sent(self, said: Intervals) -> None:
        self._peers.holds(self.digest())
        self._due -= said
        self._passing = said

    # -- what is heard ----------------------------------------------------------------------------

    def receive(self, message: Message) -> bool:
        """Merge what a decoded message says; whether it was taken in. Never raises."""
        return merged(lambda: self._take(message), self.refused, self.conflicts)

    def _take(self, message: Message) -> None:
        if isinstance(message, ViewsMessage):
            self._take_views(message)
        elif isinstance(message, ViewsHeldMessage):
            self._take_announcement(message)
        else:
            raise RefusedError("other", -1, f"{type(message).__name__} says nothing of views.")

    def _take_views(self, message: ViewsMessage) -> None:
        keys = keys_of(message.ids)
        self._check_names(Intervals.of(keys) | message.removed)
        n_new = sum(key not in self.views for key in keys.tolist())
        if n_new and len(self.views) + n_new > MOST_VIEWS:
            raise RefusedError("full", -1, "More views than are allowed.")
        self._check_room(message.removed)
        said = self._table.merge(message)
        self._due -= said
        self._passing = (self._passing | said).up_to(MOST_INTERVALS)
        self._peers.holds(self.digest())

    def _take_announcement(self, message: ViewsHeldMessage) -> None:
        detail = message.detail
        if detail is not None:
            self._check_names(detail.known)
        if message.sender == self.robot:
            raise RefusedError("own", self.robot, "An announcement of this robot's own.")
        self._peers.holds(self.digest())
        self._peers.announced(message.sender, message.digest)
        if detail is not None:
            self._check_room(detail.dead)
            self._table.bury(detail.dead)
            gap = self._table.missing(detail)
            self._answer(self._peers.lacking(message.sender, detail.scope, gap) - self._passing)
            self._peers.holds(self.digest())

    def _answer(self, lacking: Intervals) -> None:
        """Send this to who lacks it; not now, where more is due already than a set of views comes to."""
        due = self._due | lacking
        if len(due) <= MOST_VIEWS + MOST_INTERVALS:
            self._due = due

    def _check_names(self, keys: Intervals) -> None:
        """Nobody but this robot numbers views in its life."""
        first = first_key(self.robot, self.incarnation)
        if keys & Intervals.span(first + self._n, first + MOST_RECORDS):
            raise RefusedError("conflict", self.robot, f"Another robot says that it is robot {self.robot}.")

    def _check_room(self, dead: Intervals) -> None:
        if len(self.dead | dead) > max(len(self.dead), MOST_INTERVALS):
            raise RefusedError("full", -1, "More intervals of dead views than are allowed.")

    # -- keeping ----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Everything, for a file."""
        return {
            "robot": self.robot,
            "incarnation": self.incarnation,
            "n": self._n,
            "n_details": self._n_details,
            "due": self._due.stored(),
            "passing": self._passing.stored(),
            "table": self._table.state(),
            "peers": self._peers.state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what was saved. The incarnation stays that of this set: in another one it numbers anew.

        Raises `DataError` for a state that is damaged, or another robot's; nothing has changed then.
        """
        try:
            if state["robot"] != self.robot:
                raise DataError(f"The state is of robot {state['robot']}, this is robot={self.robot}.")
            if damaged := [name for name in ("table", "peers") if not isinstance(state[name], dict)]:
                raise DataError(f"{damaged[0]!r} of the saved views is no table: the state is damaged.")
            fresh = ViewSet(self.robot, incarnation=self.incarnation)
            fresh._table.restore(state["table"])
            fresh._peers.restore(state["peers"])
            fresh._due = Intervals.loaded(state["due"])
            fresh._passing = Intervals.loaded(state["passing"])
            fresh._n_details = int(state["n_details"])
            fresh._n = int(state["n"]) if state["incarnation"] == self.incarnation else 0
            fresh.refused, fresh.conflicts = self.refused, self.conflicts
            if not 0 <= fresh._n <= MOST_RECORDS:
                raise DataError(f"A life that has given {fresh._n} keys: the state is damaged.")
        except DataError:
            raise
        except (GmmTorchError, LookupError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            raise DataError(f"The views of robot {self.robot} are damaged ({error}).") from error
        vars(self).update(vars(fresh))
