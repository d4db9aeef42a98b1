"""The datagrams of records that are due, in the order in which they are sent."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from gmmtorch.mapping.codec.quantization import quantize
from gmmtorch.sharing.messages.component_messages import fitted
from gmmtorch.sharing.messages.record_messages import CountersMessage
from gmmtorch.sharing.replica.anti_entropy import Packet
from gmmtorch.sharing.replica.intervals import Intervals, Ints
from gmmtorch.sharing.replica.materialized_view import information
from gmmtorch.sharing.replica.record_keys import authors, keys_of
from gmmtorch.sharing.replica.records import Records

_RUN = 96
"""Components with consecutive keys that are sent together: about one datagram."""


def packets(
    records: Records, due: Intervals, ready: Sequence[Packet], max_bytes: int, by_information: bool
) -> Iterator[Packet]:
    """Datagrams with the keys of their records: supersessions and corrections, then components, then
    counters.

    Args:
        due: keys of records to send, none of them superseded.
        ready: datagrams of components that were encoded before; they are sent unchanged.
        max_bytes: largest size of a datagram.
        by_information: False: components in the order of their keys, which takes the fewest bytes. True: in
            runs of consecutive keys, the runs with most `information` first, which takes few more.
    """
    due &= records.held
    if not due:
        return
    ready = [packet for packet in ready if len(packet[0]) <= max_bytes and due.covers(packet[1])]
    for _, keys in ready:
        due -= keys
    due_keys = due.numbers()
    is_component = records.table.contains(due_keys)
    others = [records.others[key] for key in due_keys[~is_component].tolist()]
    for record in others:
        if not isinstance(record, CountersMessage):
            yield records.datagrams[record.key], Intervals.span(record.key, record.key + 1)
    for run in _in_order(records, due_keys[is_component], ready, by_information):
        if isinstance(run, tuple):
            yield run
        else:
            for datagram, part in fitted(quantize(records.table.selected(run)), max_bytes):
                yield datagram, Intervals.of(keys_of(part.ids))
    for record in others:
        if isinstance(record, CountersMessage):
            yield records.datagrams[record.key], Intervals.span(record.key, record.key + 1)


def _in_order(
    records: Records, keys: Ints, ready: Sequence[Packet], by_information: bool
) -> list[Packet | Ints]:
    """Ready packets, and runs of the other keys, in the order in which they are sent."""
    runs = _runs(keys, _RUN if by_information else None)
    found: list[Packet | Ints] = [*ready, *runs]
    members = [*(packet[1].numbers() for packet in ready), *runs]
    if by_information:
        rank = [-float(information(records.table.selected(one)).sum()) for one in members]
    else:
        rank = [float(one[0]) for one in members]
    return [found[row] for row in np.argsort(np.array(rank), kind="stable")]


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
