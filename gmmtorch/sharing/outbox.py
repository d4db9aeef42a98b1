"""Datagrams of the records that are due, in the order in which they matter."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gmmtorch.sharing.announce_messages import TotalsMessage
from gmmtorch.sharing.component_messages import encode_components
from gmmtorch.sharing.intervals import Intervals, Ints
from gmmtorch.sharing.record_ids import lives
from gmmtorch.sharing.record_view import information
from gmmtorch.sharing.records import Records

_RUN = 96
"""Components with consecutive numbers that go, or wait, together: about a datagram."""

_FILL = 0.95
"""Of a datagram, as components are not all of the same size."""

Packet = tuple[bytes, Intervals]
"""A datagram, and the keys of the records in it."""


def packets(records: Records, due: Intervals, max_bytes: int, by_information: bool) -> Iterator[Packet]:
    """What supersedes or moves others, then components, then counts.

    Components go by their keys, which takes the fewest bytes; or the most informative first, by short
    runs of consecutive keys, which takes few more.
    """
    if not due:
        return
    others = [records.others[key] for key in sorted(records.others) if key in due]
    for record in others:
        if not isinstance(record, TotalsMessage):
            yield records.datagrams[record.key], Intervals.span(record.key, record.key + 1)
    keys = records.table.keys()
    runs = _runs(keys[due.contains(keys)], _RUN if by_information else None)
    if by_information:
        worth = [float(information(records.table.taken(run)).sum()) for run in runs]
        runs = [runs[row] for row in np.argsort(-np.array(worth), kind="stable")]
    for run in runs:
        yield from _of_components(records, run, max_bytes)
    for record in others:
        if isinstance(record, TotalsMessage):
            yield records.datagrams[record.key], Intervals.span(record.key, record.key + 1)


def _of_components(records: Records, keys: Ints, max_bytes: int) -> Iterator[Packet]:
    """As many in each datagram as the one before lets expect to fit, rather than halves of all."""
    begin, n = 0, _RUN
    while begin < len(keys):
        chosen = keys[begin : begin + n]
        datagrams = encode_components(records.table.taken(chosen), max_bytes=max_bytes)
        if len(datagrams) == 1:
            yield datagrams[0], Intervals.of(chosen)
            begin += len(chosen)
        n_bytes = sum(map(len, datagrams))
        n = max(1, int(_FILL * len(chosen) * max_bytes / n_bytes))
        n = n if len(datagrams) == 1 else min(n, len(chosen) - 1)


def _runs(keys: Ints, most: int | None) -> list[Ints]:
    """Rising keys (N,) in runs of one life each; where `most` is given, of so many consecutive ones."""
    if not len(keys):
        return []
    breaks = np.diff(lives(keys)) != 0  # their sequences are far apart: together they take many bits
    if most is not None:
        breaks |= np.diff(keys) != 1
    parts = np.split(keys, np.flatnonzero(breaks) + 1)
    step = most or len(keys)
    return [part[begin : begin + step] for part in parts for begin in range(0, len(part), step)]
