"""Replica: one robot's copy of a map that a team shares over networks that lose datagrams."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, check_whole
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.scan import ArrayLike
from gmmtorch.sharing.messages.announcements import AnnouncementMessage, encode_announcements
from gmmtorch.sharing.messages.envelope import MAX_BYTES
from gmmtorch.sharing.messages.message_registry import ComponentsMessage, Message, decode
from gmmtorch.sharing.messages.record_messages import (
    CorrectionMessage,
    CountersMessage,
    SupersessionMessage,
    check_size,
)
from gmmtorch.sharing.replica.anti_entropy import Backlog
from gmmtorch.sharing.replica.authorship import Author
from gmmtorch.sharing.replica.changes import Changes
from gmmtorch.sharing.replica.intervals import Intervals, Ints
from gmmtorch.sharing.replica.record_keys import (
    LARGEST_INCARNATION,
    LARGEST_ROBOT,
    drawn_incarnation,
    ids_of,
    keys_of,
    robot_of,
)
from gmmtorch.sharing.replica.records import MOST_COMPONENTS, Records
from gmmtorch.sharing.replica.rejections import RefusedError, merged
from gmmtorch.sharing.replica.send_queue import packets


class Replica:
    """A set of records that merges with others' in any order, any number of times: all end up the same.

        replica.add(map)                                      # when the map has learned
        for datagram in replica.datagrams(): broadcast(datagram)        # often
        for datagram in replica.announcements(): broadcast(datagram)    # every second or so
        for datagram in heard: replica.receive(datagram)
        replica.map()

    What is lost is sent again once an announcement shows that it is missing, by whoever has it. See
    docs/replica.md.

    Attributes:
        refused: how many datagrams were not merged, by reason: "damaged", "other" (sound, but none
            of a replica's), "conflict", "full", "unfit" (another dimension, or too large to be passed on),
            "own" (of this robot's own announcements).
        conflicts: by robot, how often it was found that two robots use its number.
    """

    def __init__(
        self,
        robot: int,
        *,
        dim: int | None = None,
        incarnation: int | None = None,
        most_components: int = MOST_COMPONENTS,
    ) -> None:
        """Args:
        robot: whose replica it is, up to 1023; no two robots of a team have the same.
        dim: 2 or 3; None: that of the first components.
        incarnation: of this life of the robot, up to 2²⁴ − 1. None: drawn, which is safe whatever
            was saved. Who gives it gives each only once, or goes on from the last state of it.
        most_components: beyond so many none are taken from others; this robot's own always are.
        """
        if check_whole("robot", robot, 0) > LARGEST_ROBOT:
            raise InvalidArgumentError(f"robot={robot} must be at most {LARGEST_ROBOT}.")
        life = drawn_incarnation() if incarnation is None else incarnation
        if check_whole("incarnation", life, 0) > LARGEST_INCARNATION:
            raise InvalidArgumentError(f"incarnation={life} must be at most {LARGEST_INCARNATION}.")
        if dim not in (None, 2, 3):
            raise InvalidArgumentError(f"dim={dim} must be 2 or 3, or None.")
        self.robot, self.incarnation = int(robot), int(life)
        self._records = Records(dim, check_whole("most_components", most_components, 1))
        self._author = Author(self._records, self.robot, self.incarnation)
        self._backlog = Backlog(self.robot)
        self._max_bytes = MAX_BYTES  # as last asked for
        self.refused: Counter[str] = Counter()
        self.conflicts: Counter[int] = Counter()

    # -- what this robot says ---------------------------------------------------------------------

    def add(self, new: GaussianMap | Components, supersedes: ArrayLike | None = None) -> Tensor:
        """New records of this robot; returns their ids (K, 2).

        Of a map: what it holds that was not said yet, or was said otherwise; what it no longer holds is
        superseded. Of components: all of them, whatever their ids; they take the place of this
        robot's components `supersedes` (J, 2), wherever all of them have come.

        Raises `InvalidArgumentError` for what cannot be stored, and for others' records.
        """
        if isinstance(new, GaussianMap):
            if supersedes is not None:
                raise InvalidArgumentError("supersedes: a map itself says what it no longer holds.")
            if new.dim is None:
                return ids_of(np.zeros(0, np.int64))
            published = self._author.publish_map(_on_cpu(self._of_dim(new.components())), self._max_bytes)
            self._backlog.add(published.written, published.packets)
            return ids_of(np.sort(published.keys))
        old = Intervals.empty() if supersedes is None else Intervals.of(_keys("supersedes", supersedes))
        published = self._author.publish(_on_cpu(self._of_dim(new)), old, self._max_bytes)
        self._backlog.add(published.written, published.packets)
        return ids_of(published.keys)

    def count(self, gains: Mapping[tuple[int, int], float]) -> None:
        """Points that components (robot, sequence), of whomever, have gained since the last call."""
        keys = _keys("gains", torch.tensor(list(gains), dtype=torch.int64).reshape(-1, 2))
        self._backlog.add(self._author.count(dict(zip(keys.tolist(), gains.values(), strict=True))))

    def correct(self, scan: int, transform: ArrayLike, ids: ArrayLike) -> None:
        """A correction of the pose of a scan of this robot: its components `ids` (J, 2) are moved.

        transform: (D+1, D+1), rigid, from where they were added to where they belong: the
        last one of a scan counts, not the product of all.
        """
        check_whole("scan", scan, 0)
        matrix = torch.as_tensor(transform, dtype=torch.float64)
        if self._records.dim not in (None, len(matrix) - 1):
            raise InvalidArgumentError(
                f"transform has shape {tuple(matrix.shape)}; the map is {self._records.dim}-dimensional."
            )
        self._backlog.add(self._author.correct(scan, matrix, Intervals.of(_keys("ids", ids))))

    # -- what is sent and heard -------------------------------------------------------------------

    def datagrams(self, max_bytes: int = MAX_BYTES, budget: int | None = None) -> list[bytes]:
        """What is due: what is new, and what others lack.

        Args:
            max_bytes: of each datagram, from 1000 to 1200.
            budget: bytes of all of them; what does not fit stays due. What supersedes or moves others goes
                first, then components, the most informative first, then counts. None: no limit.
        """
        check_size(max_bytes)
        self._max_bytes = max_bytes
        left = np.inf if budget is None else check_whole("budget", budget, 0)
        sent: list[bytes] = []
        said = Intervals.empty()
        self._backlog.buried(self._records.dead)
        waiting = packets(
            self._records,
            self._backlog.due,
            self._backlog.ready,
            max_bytes,
            by_information=budget is not None,
        )
        for datagram, keys in waiting:
            left -= len(datagram)
            if left < 0:
                break
            sent.append(datagram)
            said |= keys
        self._backlog.sent(said)
        return sent

    def announcements(self, max_bytes: int = MAX_BYTES) -> list[bytes]:
        """What this robot holds: who hears it sends what is missing. Of each datagram so many bytes."""
        check_size(max_bytes)
        self._backlog.asks()
        return encode_announcements(self.robot, self.incarnation, self._records.held, max_bytes)

    def receive(self, datagram: bytes, message: Message | None = None) -> bool:
        """Merge what a datagram says; whether it was understood, and merged. Never raises.

        message: what `decode` makes of it, for those who have that already.
        """
        return merged(lambda: self._take(datagram, message), self.refused, self.conflicts)

    def _take(self, datagram: bytes, message: Message | None) -> None:
        if not isinstance(datagram, bytes):
            raise RefusedError("damaged", -1, f"A datagram is {type(datagram).__name__}, not bytes.")
        message = decode(datagram) if message is None else message
        if isinstance(message, AnnouncementMessage):
            self._check_sender(message)
            self._backlog.announced(message, self._records.held, self._records.dead)
        elif isinstance(message, ComponentsMessage) and datagram[:1] == _QUANTIZED:
            self._check_names(keys_of(message.components.ids))
            self._backlog.heard(self._records.add_components(message.components))
        elif isinstance(message, SupersessionMessage | CountersMessage | CorrectionMessage):
            self._check_names(np.array([message.key]))
            if isinstance(message, SupersessionMessage) and message.key not in self._author.written:
                self._check_untouched(message)
            self._backlog.heard(self._records.add_record(message))
        else:
            raise RefusedError("other", -1, f"{type(message).__name__} is no record.")

    def _check_sender(self, message: AnnouncementMessage) -> None:
        """Who announces as this robot is an echo, or late from its last life; or a second robot of this
        number, if it has heard of this life."""
        if message.sender != self.robot:
            return
        if message.incarnation != self.incarnation and message.held & self._author.written:
            raise self._twin()
        raise RefusedError("own", self.robot, "An announcement of this robot's own.")

    def _check_names(self, keys: Ints) -> None:
        """Nobody but this robot numbers records in its life."""
        if bool((self._author.life - self._author.written).contains(keys).any()):
            raise self._twin()

    def _check_untouched(self, message: SupersessionMessage) -> None:
        """No earlier life of this robot can know what this one writes."""
        if (message.old | message.new) & self._author.life:
            raise self._twin()

    def _twin(self) -> RefusedError:
        return RefusedError("conflict", self.robot, f"Another robot says that it is robot {self.robot}.")

    # -- what is known ----------------------------------------------------------------------------

    def digest(self) -> bytes:
        """16 bytes: equal for equal contents, whatever the order in which they came."""
        return self._records.digest()

    def components(self) -> Components:
        """All components that count, by id, with what everybody counted, where corrections put them."""
        return self._records.components()

    def changes(self) -> Changes:
        """What has become known since the last call: by this robot's doing, or heard.

        All `added` and `gained` together are `components()`, unless `rebuilt` says that this is to be
        looked at anew. The first call tells all that there is. Takes time by what has changed.
        """
        return self._records.changes()

    def map(self, **options: Any) -> GaussianMap:
        """The components as a map, of its own; `options` as for `GaussianMap`."""
        if not len(self._records.table):
            return GaussianMap(robot=self.robot, **options)
        return GaussianMap.of(self.components(), robot=self.robot, **options)

    @property
    def held(self) -> Intervals:
        """Names of all records that are here, or were superseded: what is announced."""
        return self._records.held

    @property
    def missing(self) -> Intervals:
        """Names of the records that others have announced they hold, and that are not here; but not those of
        robots that have not been heard for long, or never were there: see `anti_entropy.PATIENCE`."""
        return self._backlog.missing(self._records.held)

    @property
    def version(self) -> int:
        """Rises with what is held."""
        return self._records.version

    @property
    def n_components(self) -> int:
        return len(self._records.table)

    # -- keeping ----------------------------------------------------------------------------------

    def stored(self) -> tuple[list[bytes], list[bytes]]:
        """All that counts, for a `Store`: codec batches of components, and the datagrams of other records."""
        return self._records.stored()

    def load(self, batches: Iterable[bytes], datagrams: Iterable[bytes]) -> int:
        """Add what `stored` returned in an earlier life, and datagrams that were sent or merged since.

        Returns how many batches and datagrams were refused, as damaged or for want of room. Nothing becomes
        due: teammates that lack something announce so. What is superseded counts as held again.
        """
        takes = [partial(self._records.load_batch, data, self.robot) for data in batches]
        takes += [partial(self._load_datagram, data) for data in datagrams]
        return sum(not merged(take, Counter(), Counter()) for take in takes)

    def _load_datagram(self, datagram: bytes) -> None:
        if datagram[:1] == _QUANTIZED:
            self._records.load_batch(datagram[1:], self.robot)
            return
        message = decode(datagram)
        if not isinstance(message, SupersessionMessage | CountersMessage | CorrectionMessage):
            raise DataError(f"{type(message).__name__} is no record.")
        self._records.add_record(message, bounded=robot_of(message.key) != self.robot)

    def state(self) -> dict[str, Any]:
        """Everything, for a file, and what `changes` has told of it. What was sent before it is saved
        survives with those who heard it."""
        return {
            "robot": self.robot,
            "records": self._records.state(),
            "author": self._author.state(),
            "backlog": self._backlog.state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Hold what was saved, in place of what is held. The incarnation stays that of this replica.

        In that incarnation `changes` goes on from where it was; in another one it says `rebuilt`.

        Raises `DataError` for a state that is damaged, or another robot's.
        """
        try:
            if state["robot"] != self.robot:
                raise DataError(f"The state is of robot {state['robot']}, this is robot={self.robot}.")
            self._records.restore(state["records"], self.robot)
            self._author.restore(state["author"])
            self._backlog.restore(state["backlog"])
            if state["author"]["incarnation"] != self.incarnation:
                self._records.break_off()
                self._backlog.forget_others()
        except DataError:
            raise
        except (GmmTorchError, KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            raise DataError(f"The state of robot {self.robot} is damaged ({error}).") from error

    def _of_dim(self, components: Components) -> Components:
        components = components.checked()
        if self._records.dim not in (None, components.dim):
            raise InvalidArgumentError(
                f"The components are {components.dim}-dimensional; this map is in {self._records.dim}D."
            )
        return components


_QUANTIZED = b"\x11"
"""First byte of components that can be passed on without change."""


def _keys(name: str, ids: ArrayLike) -> Ints:
    rows = torch.as_tensor(ids)
    rows = rows if rows.numel() else rows.reshape(0, 2)
    if rows.ndim != 2 or rows.shape[1] != 2 or rows.is_floating_point():
        raise InvalidArgumentError(f"{name} has shape {tuple(rows.shape)}; expected (J, 2) whole numbers.")
    try:
        return keys_of(rows.long())
    except DataError as error:
        raise InvalidArgumentError(f"{name}: {error}") from error


def _on_cpu(components: Components) -> Components:
    return Components(**{name: value.detach().cpu() for name, value in vars(components).items()})
