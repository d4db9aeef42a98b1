"""UDP datagrams in network captures: .pcap of tcpdump, and .pcapng of Wireshark.

Captures are hostile input: nothing is allocated for a length that the file does not have, and parts of
datagrams wait for the others within `_MOST_WAITING` bytes.
"""

from __future__ import annotations

import struct
from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from gmmtorch.datasets.packets.sweeps import PACKET, is_lidar
from gmmtorch.datasets.ros.bag_files import Connection
from gmmtorch.datasets.trajectory import NANOSECONDS
from gmmtorch.errors import DataError

SUFFIXES = (".pcap", ".pcapng")
_PCAP = {b"\xd4\xc3\xb2\xa1": ("<", 6), b"\xa1\xb2\xc3\xd4": (">", 6)}
_PCAP |= {b"\x4d\x3c\xb2\xa1": ("<", 9), b"\xa1\xb2\x3c\x4d": (">", 9)}
"""Byte order, and decimal places of the seconds, by the first bytes of a .pcap file."""
_SECTION, _INTERFACE, _PACKET = 0x0A0D0D0A, 1, 6  # blocks of .pcapng
_ORDERS = {b"\x4d\x3c\x2b\x1a": "<", b"\x1a\x2b\x3c\x4d": ">"}
_RESOLUTION = 9  # option of an interface
_MOST_FRAME_BYTES, _MOST_INTERFACES = 1 << 18, 1 << 10
_MOST_WAITING = 1 << 24
_INDEX_STEP = 256  # frames
_LINKS = {0: 4, 1: 14, 101: 0, 113: 16, 228: 0, 276: 20}
"""Bytes before the IP packet by the type of link: loopback, Ethernet, IP, Linux cooked, IPv4, cooked v2."""
_ETHERNET, _VLAN, _IPV4 = 1, (b"\x81\x00", b"\x88\xa8"), b"\x08\x00"
_UDP = 17
_CUT = "the file is cut off there"
_DAMAGED = "the blocks after it contradict each other"
_MOST_TOPICS = 256
_DATAGRAMS = "UDP datagrams"  # the type of datagrams that are not of a lidar, which are not read

_Frame = tuple[int, int, int, bytes]
"""A frame in a file: its first byte, its time (ns), the type of its link, and its content."""


class Datagram(NamedTuple):
    """A UDP datagram. time: of capture, ns. topic: the address of its sender and the port of its receiver."""

    time: int
    topic: str
    data: bytes


class Capture:
    """The UDP datagrams in a capture file as messages. Each sender and port is a topic.

    The file is read once when it is opened.

    Attributes:
        connections: of lidars, and of other senders.
        damage: why the file could not be read to its end, or "".

    Raises `DataError` if it is not a capture, or has no UDP datagram.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.damage = path, ""
        self._length = path.stat().st_size
        self._interfaces: list[tuple[int, int]] = []  # type of link, units of time in a second
        with path.open("rb") as file:
            start = file.read(24)
        self._is_next = start[:4] == _SECTION.to_bytes(4, "big") and start[8:12] in _ORDERS
        if self._is_next:
            self._order = _ORDERS[start[8:12]]
            self._begin = struct.unpack_from(self._order + "I", start, 4)[0]
        elif start[:4] in _PCAP and len(start) == 24:
            self._order, digits = _PCAP[start[:4]]
            self._begin = 24
            self._interfaces.append(
                (struct.unpack_from(self._order + "I", start, 20)[0] & 0xFFFF, 10**digits)
            )
        else:
            raise DataError(f"{path} is not a network capture of tcpdump or Wireshark; capture it again.")
        starts, latest, time, n = array("q", [self._begin]), array("q", [-1]), -1, 0
        parts, counts, lidars = _Parts(), Counter[str](), set[str]()
        for n, frame in enumerate(self._frames(self._begin, is_first=True), 1):
            if n % _INDEX_STEP == 0:
                starts.append(frame[0])
                latest.append(time)
            time = max(time, frame[1])
            found = parts.added(frame)
            if found is not None and (found.topic in counts or len(counts) < _MOST_TOPICS):
                counts[found.topic] += 1
                if is_lidar(found.data):
                    lidars.add(found.topic)
        self._places, self._latest = np.array(starts), np.array(latest)
        if self.damage:
            self.damage = f"{n:,} frames are intact; {self.damage}"
        if not counts:
            raise DataError(f"{path} contains no UDP datagram over IPv4; capture the port of the lidar.")
        self.connections = [
            Connection(number, topic, PACKET if topic in lidars else _DATAGRAMS, n_messages=n)
            for number, (topic, n) in enumerate(counts.items())
        ]

    def messages(
        self, connections: Collection[Connection], start: int | None = None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """(connection, time in ns, content) of the datagrams of some topics, from a time on."""
        wanted, parts = {one.topic: one for one in connections}, _Parts()
        row = 0 if start is None else max(0, int(np.searchsorted(self._latest, start)) - 1)
        for frame in self._frames(int(self._places[row])):
            found = parts.added(frame)
            if found is not None and found.topic in wanted and (start is None or found.time >= start):
                yield wanted[found.topic], found.time, found.data

    def _frames(self, place: int, is_first: bool = False) -> Iterator[_Frame]:
        """The frames from a place of the file on. The first time, interfaces and damage are noted."""
        with self.path.open("rb") as file:
            file.seek(place)
            while file.tell() < self._length:
                try:
                    frame = self._block(file, is_first) if self._is_next else self._record(file)
                except (struct.error, DataError) as error:
                    self.damage = str(error) if isinstance(error, DataError) else _CUT
                    return
                if frame is not None:
                    yield frame

    def _record(self, file: BinaryIO) -> _Frame:
        here = file.tell()
        seconds, fraction, size, _ = struct.unpack(self._order + "4I", file.read(16))
        link, units = self._interfaces[0]
        time = seconds * NANOSECONDS + fraction * (NANOSECONDS // units)
        return here, time, link, self._content(file, size)

    def _content(self, file: BinaryIO, size: int) -> bytes:
        """The next bytes of the file."""
        if size > _MOST_FRAME_BYTES:
            raise DataError(f"a frame of {size:,} bytes is announced after it")
        data = file.read(size)
        if len(data) < size:
            raise DataError(_CUT)
        return data

    def _block(self, file: BinaryIO, is_first: bool) -> _Frame | None:
        """The frame in the next block of a .pcapng file; None if it has none."""
        here = file.tell()
        kind, length = struct.unpack(self._order + "2I", file.read(8))
        if length < 12 or length % 4:
            raise DataError(_DAMAGED)
        if kind == _SECTION:
            raise DataError("a second section begins there, which is not read")
        if kind not in (_INTERFACE, _PACKET):
            file.seek(here + length)
            return None
        body = self._content(file, length - 8)[:-4]
        if kind == _INTERFACE:
            if is_first and len(self._interfaces) < _MOST_INTERFACES:
                self._interfaces.append(self._interface(body))
            return None
        number, high, low, size = struct.unpack_from(self._order + "4I", body)
        if number >= len(self._interfaces) or size > len(body) - 20:
            raise DataError(_DAMAGED)
        link, units = self._interfaces[number]
        time = (high << 32 | low) * NANOSECONDS // units
        return here, min(time, (1 << 63) - 1), link, body[20 : 20 + size]

    def _interface(self, body: bytes) -> tuple[int, int]:
        """Type of link, and units of time in a second."""
        (link,), at = struct.unpack_from(self._order + "H", body), 8
        while at + 4 <= len(body):
            code, length = struct.unpack_from(self._order + "2H", body, at)
            if code == _RESOLUTION and length == 1 and at + 4 < len(body):
                value = body[at + 4]
                return link, int(2 ** (value & 127) if value & 128 else 10 ** (value & 127))
            at += 4 + -(-length // 4) * 4
        return link, 10**6


class _Parts:
    """Puts datagrams together that were sent in several IP packets, as those of large lidars are."""

    def __init__(self) -> None:
        self._waiting: dict[bytes, tuple[int, dict[int, bytes]]] = {}
        self._n_bytes = 0

    def added(self, frame: _Frame) -> Datagram | None:
        """The datagram that a frame completes; None if it is not UDP over IPv4, or parts are missing."""
        _, time, link, data = frame
        packet = _ip_packet(link, data)
        if packet is None:
            return None
        words = int.from_bytes(packet[6:8], "big")
        place, has_more = (words & 0x1FFF) * 8, bool(words & 0x2000)
        payload: bytes = packet[(packet[0] & 15) * 4 :]
        joined: bytes | None = payload
        if place or has_more:
            time, joined = self._joined(time, packet[4:6] + packet[12:20], place, has_more, payload)
        if joined is None or len(joined) < 8:
            return None
        length = int.from_bytes(joined[4:6], "big")
        if not 8 <= length <= len(joined):
            return None
        topic = f"/{'.'.join(map(str, packet[12:16]))}/{int.from_bytes(joined[2:4], 'big')}"
        return Datagram(time, topic, joined[8:length])

    def _joined(
        self, now: int, key: bytes, place: int, has_more: bool, payload: bytes
    ) -> tuple[int, bytes | None]:
        """The time of the first part and all parts of a packet, if this is the last one that is missing."""
        time, parts = self._waiting.get(key, (now, {}))
        if abs(now - time) > NANOSECONDS:  # another packet with this number
            self._drop(key)
            time, parts = now, {}
        self._waiting[key] = time, parts
        if place not in parts:
            parts[place] = payload
            self._n_bytes += len(payload)
        if not has_more:
            parts[place + len(payload)] = b""  # the end
        joined = 0
        while part := parts.get(joined):
            joined += len(part)
        if joined in parts:
            content = b"".join(parts[at] for at in sorted(parts) if at < joined)
            self._drop(key)
            return time, content
        while self._n_bytes > _MOST_WAITING:
            self._drop(next(iter(self._waiting)))
        return time, None

    def _drop(self, key: bytes) -> None:
        _, parts = self._waiting.pop(key, (0, {}))
        self._n_bytes -= sum(map(len, parts.values()))


def _ip_packet(link: int, data: bytes) -> bytes | None:
    """The IPv4 packet with UDP in the content of a frame; None if it has none."""
    at = _LINKS.get(link)
    if at is None:
        return None
    if link == _ETHERNET:
        while data[at - 2 : at] in _VLAN:
            at += 4
        if data[at - 2 : at] != _IPV4:
            return None
    packet = data[at:]
    if len(packet) < 20 or packet[0] >> 4 != 4 or packet[9] != _UDP or (packet[0] & 15) < 5:
        return None
    length = int.from_bytes(packet[2:4], "big")  # Ethernet pads short frames
    return packet[:length] if length >= 20 else packet
