"""The replicated set: records that are added, and forgotten when others supersede them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np
import torch

from gmmtorch.errors import DataError
from gmmtorch.mapping.codec import quantized
from gmmtorch.mapping.components import Components
from gmmtorch.sharing.announce_messages import (
    RECORD_BYTES,
    CorrectionMessage,
    RecordMessage,
    SupersessionMessage,
    TotalsMessage,
    encode_record,
)
from gmmtorch.sharing.component_table import ComponentTable, fingerprints, most_sightings
from gmmtorch.sharing.intervals import Intervals
from gmmtorch.sharing.messages import decode
from gmmtorch.sharing.record_ids import keys_of, robot_of
from gmmtorch.sharing.record_view import corrected, with_totals

MOST_SIGHTINGS = 48
"""Of a component: so one by itself fits into `RECORD_BYTES`, and can be passed on."""
MOST_COMPONENTS = 1 << 20
MOST_OTHERS = 1 << 12
"""Records that are no components."""
MOST_INTERVALS = 1 << 14
"""Of what is held: more than a team leaves where datagrams are lost, and a bound on memory."""

_Record = TypeVar("_Record", bound=RecordMessage)


class RefusedError(DataError):
    """What came is sound, and not taken in; `reason` is one of few, `robot` whose it is."""

    def __init__(self, reason: str, robot: int, message: str) -> None:
        super().__init__(message)
        self.reason, self.robot = reason, robot


class Records:
    """All that a robot knows of a shared map: a set of records that only grows.

    held: every key that is or was here, and every one that is superseded: what need not be sent here.
    A supersession takes effect where all of its successors are held. Its old records are forgotten at
    once then, as who lacks them needs only the supersession and the successors, which are here. So
    what counts depends on what is held, and not on the order in which it came.

    dim: 2 or 3; None: that of the first components.
    """

    def __init__(self, dim: int | None = None, most_components: int = MOST_COMPONENTS) -> None:
        self.dim, self._most = dim, most_components
        self.held = Intervals.empty()
        self.dead = Intervals.empty()
        self.table = ComponentTable()
        self.others: dict[int, RecordMessage] = {}
        self.datagrams: dict[int, bytes] = {}  # of the others, as all robots write them
        self.version = 0
        """Rises with every change."""
        self._waiting: dict[int, SupersessionMessage] = {}  # for successors
        self._view: tuple[int, Components] | None = None

    # -- growing ----------------------------------------------------------------------------------

    def add_components(self, components: Components) -> Intervals:
        """Take in components that are on the codec's lattice; returns their keys. All or none.

        Raises `RefusedError`: "conflict", where a key is held with other content; "full"; "unfit", where they
        are of another dimension, or seen from more than `MOST_SIGHTINGS` places.
        """
        keys = keys_of(components.ids)
        if not len(keys):
            return Intervals.empty()
        if components.dim != (self.dim or components.dim) or most_sightings(components) > MOST_SIGHTINGS:
            raise RefusedError(
                "unfit",
                robot_of(int(keys[0])),
                f"Components in {components.dim}D, seen from up to {most_sightings(components)} places; "
                f"this map is in {self.dim or components.dim}D, and {MOST_SIGHTINGS} places are the most.",
            )
        prints, fresh = fingerprints(components), ~self.held.contains(keys)
        for key, print_ in zip(keys[~fresh].tolist(), _chosen(prints, ~fresh), strict=True):
            if key in self.others or (key in self.table and self.table.print_of(key) != print_):
                raise _conflict(key)
        added = Intervals.of(keys[fresh])
        if len(self.table) + int(fresh.sum()) > self._most:
            raise _full(int(keys[0]))
        rows = torch.from_numpy(np.flatnonzero(fresh))
        self._check_room(added)
        self.table.add(keys[fresh], components.selected(rows), _chosen(prints, fresh))
        self._hold(added)
        self.dim = components.dim
        return Intervals.of(keys)

    def add_record(self, record: RecordMessage) -> Intervals:
        """Take in another record; returns its key. Raises `RefusedError`, as `add_components` does."""
        key, robot, datagram = record.key, robot_of(record.key), encode_record(record)
        span = Intervals.span(key, key + 1)
        if key in self.held:
            if key in self.table or self.datagrams.get(key, datagram) != datagram:
                raise _conflict(key)
            return span
        unfit = isinstance(record, CorrectionMessage) and record.dim != (self.dim or record.dim)
        if unfit or len(datagram) > RECORD_BYTES:
            raise RefusedError(
                "unfit", robot, f"Record {key} is too long, or of another dimension than this map."
            )
        room = MOST_INTERVALS - len(self.held) - sum(len(s.old) for s in self._waiting.values())
        if len(self.others) >= MOST_OTHERS or (
            isinstance(record, SupersessionMessage) and len(record.old) > room
        ):
            raise _full(key)
        self._check_room(span)
        self.others[key], self.datagrams[key] = record, datagram
        if isinstance(record, SupersessionMessage):
            self._waiting[key] = record
        self._hold(span)
        return span

    def _check_room(self, added: Intervals) -> None:
        if len(self.held | added) > max(len(self.held), MOST_INTERVALS):
            raise _full(added.pairs()[0][0])

    def _hold(self, added: Intervals) -> None:
        held = self.held | added
        if held == self.held:
            return
        self.version += 1
        buried = Intervals.empty()
        while ready := [s for s in self._waiting.values() if held.covers(s.new)]:
            for supersession in ready:
                del self._waiting[supersession.key]
                buried |= supersession.old
            held |= buried
        self.held, self.dead = held, self.dead | buried
        if buried:
            self.table.drop(buried)
            for key in [key for key in self.others if key in buried]:
                del self.others[key], self.datagrams[key]
                self._waiting.pop(key, None)

    # -- reading ----------------------------------------------------------------------------------

    def of(self, kind: type[_Record]) -> list[_Record]:
        """The records of a kind that count, by key."""
        found = (self.others[key] for key in sorted(self.others))
        return [record for record in found if isinstance(record, kind)]

    def effective(self) -> list[SupersessionMessage]:
        """Supersessions whose successors are all held."""
        return [record for record in self.of(SupersessionMessage) if record.key not in self._waiting]

    def live(self) -> Intervals:
        """Keys whose records are here."""
        return Intervals.of(np.concatenate([self.table.keys(), np.array(list(self.others), np.int64)]))

    def components(self) -> Components:
        """All components that count, by key, with all counts, where they belong."""
        if self._view is None or self._view[0] != self.version:
            keys = self.table.keys()
            if not len(keys):
                return Components.empty(self.dim or 3)
            plain = with_totals(self.table.taken(keys), keys, self.of(TotalsMessage))
            self._view = self.version, corrected(plain, keys, self.of(CorrectionMessage))
        return self._view[1]

    def digest(self) -> bytes:
        """16 bytes: equal if all that is held, and all that counts, is equal to the bit."""
        digest = hashlib.blake2b(self.held.edges.astype("<i8").tobytes(), digest_size=16)
        for key in self.table.keys().tolist():
            digest.update(key.to_bytes(8, "little") + self.table.print_of(key))
        for key in sorted(self.others):
            digest.update(self.datagrams[key])
        return digest.digest()

    # -- keeping ----------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        keys = self.table.keys()
        components = self.table.taken(keys) if len(keys) else Components.empty(self.dim or 3)
        datagrams = [self.datagrams[key] for key in sorted(self.others)]
        return {
            "dim": self.dim,
            "held": torch.from_numpy(self.held.edges.copy()),
            "components": dict(vars(components)),
            "record_bytes": torch.tensor([len(datagram) for datagram in datagrams], dtype=torch.int64),
            "records": torch.frombuffer(bytearray(b"".join(datagrams) or b"\0"), dtype=torch.uint8),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Hold what `state` says. Raises `DataError` where it is damaged; nothing has changed then."""
        fresh = Records(state["dim"], self._most)
        components = Components(**state["components"]).checked()
        if fingerprints(quantized(components)) != fingerprints(components):
            raise DataError("Components are not as the codec leaves them: the state is damaged.")
        fresh.add_components(components)
        data, at = state["records"].numpy().tobytes(), 0
        for n_bytes in state["record_bytes"].tolist():
            fresh.add_record(_record(data[at : at + n_bytes]))
            at += n_bytes
        held = Intervals(state["held"].numpy().astype(np.int64))
        fresh.dead = held - fresh.live()
        fresh._hold(held)
        fresh.version = self.version + 1
        fresh._view = None
        vars(self).update(vars(fresh))


def _record(datagram: bytes) -> RecordMessage:
    message = decode(datagram)
    if not isinstance(message, SupersessionMessage | TotalsMessage | CorrectionMessage):
        raise DataError("A record is none: the state is damaged.")
    return message


def _chosen(prints: Iterable[bytes], which: np.ndarray) -> list[bytes]:
    return [print_ for print_, chosen in zip(prints, which.tolist(), strict=True) if chosen]


def _conflict(key: int) -> RefusedError:
    robot = robot_of(key)
    return RefusedError(
        "conflict",
        robot,
        f"Record {key} of robot {robot} has come with two contents: two robots say that they are "
        f"robot {robot}. Give each a number of its own.",
    )


def _full(key: int) -> RefusedError:
    return RefusedError("full", robot_of(key), f"Record {key} would take more memory than a map is allowed.")
