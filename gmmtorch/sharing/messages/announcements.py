"""Announcements of the records that a replica holds, as datagrams. See docs/messages.md."""

from __future__ import annotations

from dataclasses import dataclass

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mapping.codec.bitstream import BitReader, BitWriter
from gmmtorch.sharing.messages.envelope import MAX_BYTES, Kind, make_datagram, split
from gmmtorch.sharing.messages.fields import read_intervals, read_number, write_intervals, write_number
from gmmtorch.sharing.replica.record_keys import END, LARGEST_INCARNATION, LARGEST_ROBOT, Intervals


@dataclass(frozen=True, eq=False)
class AnnouncementMessage:
    """Of the keys from `begin` to `end` − 1, incarnation `incarnation` of robot `sender` holds exactly
    `held`."""

    sender: int
    incarnation: int
    begin: int
    end: int
    held: Intervals

    @property
    def scope(self) -> Intervals:
        return Intervals.span(self.begin, self.end)


def encode_announcements(
    sender: int, incarnation: int, held: Intervals, max_bytes: int = MAX_BYTES
) -> list[bytes]:
    """Datagrams of all keys that are held, at least one.

    Each speaks of another range of keys, so that any of them may get lost. Raises `InvalidArgumentError` for
    values out of range.
    """
    _check_sender(sender, incarnation)
    if not Intervals.span(0, END).covers(held):
        raise InvalidArgumentError(f"held={held!r} goes beyond the largest key, {END - 1}.")
    n = len(held)

    def part(begin: int, end: int) -> bytes:
        first = int(held.edges[2 * begin]) if begin else 0
        last = int(held.edges[2 * end]) - 1 if end < n else END - 1
        writer = BitWriter()
        for name, value in (("sender", sender), ("incarnation", incarnation)):
            write_number(writer, name, value)
        writer.number(first)
        writer.number(last - first)
        write_intervals(writer, Intervals(held.edges[2 * begin : 2 * end]), first)
        return make_datagram(Kind.ANNOUNCEMENT, writer.to_bytes())

    return split(n, part, "interval", max_bytes) if n else [part(0, 0)]


def read_announcement(body: bytes) -> AnnouncementMessage:
    reader = BitReader(body)
    sender, incarnation = read_number(reader), read_number(reader)
    _check_sender(sender, incarnation)
    begin = reader.number()
    end = begin + reader.number() + 1
    if not 0 <= begin < end <= END:
        raise DataError(f"An announcement of the keys from {begin} to {end}: it is damaged.")
    held = read_intervals(reader, begin, end)
    reader.finish()
    return AnnouncementMessage(sender, incarnation, begin, end, held)


def _check_sender(sender: int, incarnation: int) -> None:
    if sender > LARGEST_ROBOT or incarnation > LARGEST_INCARNATION:
        raise InvalidArgumentError(
            f"sender={sender}, incarnation={incarnation}: robots go up to {LARGEST_ROBOT}, incarnations "
            f"up to {LARGEST_INCARNATION}."
        )
