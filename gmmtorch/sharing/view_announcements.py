"""What a robot says of the views that it holds: all of them in eight bytes, or each. See docs/messages.md."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mapping.codec.bitstream import BitReader, BitWriter, Ints
from gmmtorch.sharing.messages.envelope import MAX_BYTES, Kind, make_datagram, split
from gmmtorch.sharing.messages.fields import (
    read_intervals,
    read_keys,
    read_number,
    write_intervals,
    write_keys,
    write_number,
)
from gmmtorch.sharing.replica.intervals import Intervals
from gmmtorch.sharing.replica.record_keys import END, LARGEST_ROBOT

DIGEST_BYTES = 8
PRINT_BYTES = 8
"""Of a fingerprint of a view, of which a detailed announcement shows one."""
_CHECK_BITS = 8


@dataclass(frozen=True, eq=False)
class ViewsDetail:
    """Of the keys from `begin` to `end` − 1: those of views that are, or were, `known`, and those `alive`.

    alive (V,): rising. checks (V,): byte number `byte` of the fingerprint of each, from the low end.
    """

    begin: int
    end: int
    known: Intervals
    alive: Ints
    byte: int
    checks: Ints

    @property
    def scope(self) -> Intervals:
        return Intervals.span(self.begin, self.end)

    @property
    def dead(self) -> Intervals:
        return self.known - Intervals.of(self.alive)


@dataclass(frozen=True, eq=False)
class ViewsHeldMessage:
    """The digest (8 bytes) of all views that `sender` holds, dead ones included; and, if asked, which."""

    sender: int
    digest: bytes
    detail: ViewsDetail | None = None


def encode_views_held(
    sender: int, digest: bytes, detail: ViewsDetail | None = None, max_bytes: int = MAX_BYTES
) -> list[bytes]:
    """The datagram of a digest; or, with the detail of all keys, as many as it takes.

    Each of these speaks of a part of all keys, so that any of them may get lost. Raises
    `InvalidArgumentError` for what is out of range, or does not match.
    """
    _check_sender(sender)
    if len(digest) != DIGEST_BYTES:
        raise InvalidArgumentError(f"digest has {len(digest)} bytes; {DIGEST_BYTES} are told.")

    def head() -> BitWriter:
        writer = BitWriter()
        write_number(writer, "sender", sender)
        writer.fixed(np.frombuffer(digest, np.uint8).astype(np.int64), 8)
        return writer

    if detail is None:
        return [make_datagram(Kind.VIEWS_HELD, head().to_bytes())]
    _check_detail(detail)
    cuts = np.union1d(detail.known.edges[::2], detail.alive)

    def part(first: int, last: int) -> bytes:
        begin = int(cuts[first]) if first else 0
        end = int(cuts[last]) if last < len(cuts) else END
        seen = slice(*np.searchsorted(detail.alive, [begin, end]).tolist())
        writer = head()
        writer.number(detail.byte)
        writer.number(begin)
        writer.number(END - end)
        write_intervals(writer, detail.known & Intervals.span(begin, end), begin)
        write_keys(writer, detail.alive[seen])
        writer.fixed(detail.checks[seen], _CHECK_BITS)
        return make_datagram(Kind.VIEWS_HELD, writer.to_bytes())

    return split(len(cuts), part, "view", max_bytes) if len(cuts) else [part(0, 0)]


def read_views_held(body: bytes) -> ViewsHeldMessage:
    reader = BitReader(body)
    sender = read_number(reader)
    _check_sender(sender)
    digest = reader.fixed(DIGEST_BYTES, 8).astype(np.uint8).tobytes()
    detail = _read_detail(reader) if reader.left else None
    reader.finish()
    return ViewsHeldMessage(sender, digest, detail)


def _read_detail(reader: BitReader) -> ViewsDetail:
    byte, begin, end = reader.number(), reader.number(), END - reader.number()
    if not 0 <= begin < end <= END:
        raise DataError(f"An announcement of the views from {begin} to {end}: it is damaged.")
    known = read_intervals(reader, begin, end)
    alive = read_keys(reader)
    detail = ViewsDetail(begin, end, known, alive, byte, reader.fixed(len(alive), _CHECK_BITS))
    _check_detail(detail)
    return detail


# Who writes asks the same as who reads, so that nobody says what nobody takes.


def _check_sender(sender: int) -> None:
    if sender > LARGEST_ROBOT:
        raise InvalidArgumentError(f"sender={sender} must be at most {LARGEST_ROBOT}.")


def _check_detail(detail: ViewsDetail) -> None:
    known, alive, checks = detail.known, detail.alive, detail.checks
    if not 0 <= detail.byte < PRINT_BYTES:
        raise InvalidArgumentError(f"byte={detail.byte} must be from 0 to {PRINT_BYTES - 1}.")
    if not (Intervals.span(0, END).covers(known) and known.contains(alive).all()):
        raise InvalidArgumentError("Views are known that no robot can have named, or alive and not known.")
    if (np.diff(alive) < 1).any() or len(checks) != len(alive) or (checks >> _CHECK_BITS).any():
        raise InvalidArgumentError("Views alive must rise, and have a byte of its fingerprint each.")
