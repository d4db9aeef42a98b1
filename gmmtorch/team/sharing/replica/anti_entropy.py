"""Backlog: the records that are due because others lack them, and the order in which they are sent."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from gmmtorch.mapping import Components, quantize
from gmmtorch.team.sharing.messages.component_messages import fitted
from gmmtorch.team.sharing.messages.record_messages import AnnouncementMessage, CountersMessage
from gmmtorch.team.sharing.replica.record_keys import (
    CHANNELS,
    END,
    Intervals,
    Ints,
    authors,
    evict,
    keys_of,
    keys_of_robot,
)
from gmmtorch.team.sharing.replica.records import Records

_CALLS_IN_FLIGHT = 3
"""Calls of `sent` after which a datagram has arrived. A robot that sends, then receives, each tick announces
before it has received the datagrams of the last tick, and its announcement arrives a tick later."""
MOST_PEERS = 64
"""Largest number of robots whose gaps are stored: those that announced last."""
MOST_REMEMBERED = 1 << 16
"""Intervals of what these robots lack, all together, and of what they hold: 1 MiB each, for hundreds of
robots usually. The robot with most of them is forgotten until it announces again."""
MOST_IN_FLIGHT = 1 << 14
"""Intervals of keys in flight. If there are more, they are forgotten, and some records are sent twice."""
PATIENCE = 1 << 7
"""Announcements made here after which a silent robot counts as gone, with the records that only it announced:
two minutes if urgent."""


class Backlog:
    """Keys of records that are due.

    A robot's own records are sent at once to robots that lack them. Records of others are sent if they are
    still lacking in the next announcement, as otherwise all robots would answer at once. Records that were
    just sent are in flight, and not due: the announcement may be older than them. A component that is due
    with its channels has two keys here, of which robots of earlier versions announce one.
    """

    def __init__(self, robot: int) -> None:
        own = keys_of_robot(robot)
        self._own = Intervals.union([own.shifted(CHANNELS), own])
        self.due = Intervals.empty()
        self.is_asked = False  # whether some of `due` were lost
        self._in_flight = [Intervals.empty()] * _CALLS_IN_FLIGHT  # since the last call of `sent`, and before
        self._gaps: OrderedDict[int, Intervals] = OrderedDict()  # what others lack, by robot
        self._theirs: OrderedDict[int, Intervals] = OrderedDict()  # what others hold and this robot lacked
        self._waited: dict[int, int] = {}  # announcements made here since those others announced
        self._know_channels: list[int] = []  # robots that announced channels

    def add(self, keys: Intervals) -> None:
        """New records."""
        self.due |= keys

    def received(self, keys: Intervals) -> None:
        """Another robot sent these records, or an echo of this robot's arrived."""
        self.due -= keys
        self._in_flight[0] = (self._in_flight[0] | keys).up_to(MOST_IN_FLIGHT)

    def sent(self, keys: Intervals) -> None:
        """All records that this robot has sent since the last call."""
        self.due -= keys
        self.is_asked &= not keys
        self._in_flight = [keys.up_to(MOST_IN_FLIGHT), *self._in_flight[:-1]]

    def announcing(self) -> None:
        """This robot announces what it holds. Robots that did not announce for `PATIENCE` calls are
        forgotten."""
        self._waited = {robot: self._waited.get(robot, 0) + 1 for robot in self._theirs}
        for robot, n in self._waited.items():
            if n >= PATIENCE:
                del self._theirs[robot]

    def announced(self, message: AnnouncementMessage, held: Intervals, dead: Intervals) -> None:
        """Another robot announced what it holds. held, dead: of this robot's `Records`."""
        gap = (held & message.scope) - message.held
        before = self._gaps.get(message.sender, Intervals.empty())
        lacking = (gap & self._own) | (gap & before)
        if message.begin < 0:
            others = [robot for robot in self._know_channels if robot != message.sender]
            self._know_channels = [message.sender, *others][:MOST_PEERS]
        elif message.sender in self._know_channels:
            lacking |= lacking.shifted(CHANNELS) & held
        for keys in self._in_flight:
            lacking -= keys
        self.is_asked |= bool(lacking - self.due - dead)
        self.due = (self.due | lacking) - dead
        self._waited.pop(message.sender, None)
        for table, now in ((self._gaps, gap), (self._theirs, message.held - held)):
            known = table.pop(message.sender, Intervals.empty())
            table[message.sender] = (known - message.scope) | now
            while len(table) > MOST_PEERS:
                table.popitem(last=False)
            for robot in evict(table, MOST_REMEMBERED):
                del table[robot]

    def missing(self, held: Intervals) -> Intervals:
        """Records that others announced and that are not held here."""
        return Intervals.union(self._theirs.values()) - held


_OF_CHANNELS = Intervals.span(CHANNELS, CHANNELS + END)
ABOUT_A_DATAGRAM = 160  # components
FEW = 32  # components: 128 bytes of a datagram, to which 20 are added, and 28 of UDP and IPv4
_RUN = 32  # components with consecutive keys whose information is compared


def packets(
    records: Records, due: Intervals, max_bytes: int, by_information: bool
) -> Iterator[tuple[bytes, Intervals]]:
    """Datagrams with the keys of their records: supersessions and corrections, components, then counters.

    Args:
        due: keys of records to send, none superseded; keys of channels, for components with channels.
        max_bytes: largest size of a datagram.
        by_information: False: components in the order of their keys, which takes the fewest bytes. True: in
            runs of consecutive keys, those with most `_information` first, which takes few more.
    """
    due &= records.known
    if not due:
        return
    complete = (due & _OF_CHANNELS).shifted(-CHANNELS)
    due_keys = (due - _OF_CHANNELS - complete).numbers()
    is_component = records.table.contains(due_keys)
    others = [records.others[key] for key in due_keys[~is_component].tolist()]
    for record in others:
        if not isinstance(record, CountersMessage):
            yield records.datagrams[record.key], Intervals.span(record.key, record.key + 1)
    for numbers, channels in ((due_keys[is_component], False), (complete.numbers(), True)):
        for some in _in_order(records, numbers, by_information):
            for datagram, part in fitted(quantize(records.table.selected(some)), max_bytes, channels):
                keys = Intervals.of(keys_of(part.ids))
                yield datagram, keys | keys.shifted(CHANNELS) if channels else keys
    for record in others:
        if isinstance(record, CountersMessage):
            yield records.datagrams[record.key], Intervals.span(record.key, record.key + 1)


def _in_order(records: Records, keys: Ints, by_information: bool) -> list[Ints]:
    """Rising keys (N,) in the parts that are encoded together."""
    runs = _runs(keys, _RUN if by_information else None)
    if not by_information or not runs:
        return runs
    worth = [float(_information(records.table.selected(run)).mean()) for run in runs]
    return [np.concatenate([runs[row] for row in np.argsort(-np.array(worth), kind="stable")])]


def _information(components: Components) -> Tensor:
    """The approximate space (K,), m³ or m², that each component shows: its face times its sensor distance.
    Large components seen from afar leave the largest hole in a map that lacks them."""
    deviation = torch.linalg.eigvalsh(components.covariances).clamp_min(0).sqrt()
    face = deviation[:, 1:].prod(1)
    apart = components.means[components.seen_by] - components.origins[components.seen_from]
    reach = face.new_zeros(len(face)).scatter_reduce_(0, components.seen_by, apart.norm(dim=1), "amax")
    return face * reach


def _runs(keys: Ints, most: int | None) -> list[Ints]:
    """Rising keys (N,) in runs of one author each; with `most`, of at most so many consecutive keys."""
    if not len(keys):
        return []
    breaks = np.diff(authors(keys)) != 0  # keys of two authors are far apart: many bits
    if most is not None:
        breaks |= np.diff(keys) != 1
    parts = np.split(keys, np.flatnonzero(breaks) + 1)
    step = most or len(keys)
    return [part[begin : begin + step] for part in parts for begin in range(0, len(part), step)]
