"""Sweeps: packets of a lidar that come one by one, as messages with one turn each.

Drivers of Velodyne and Hesai lidars record such messages. That of Ouster records single packets, and so does
a network capture.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from gmmtorch.datasets.packets import hesai, ouster
from gmmtorch.datasets.trajectory import NANOSECONDS

VELODYNE_BYTES = 1206
_BACK = 36.0  # a turn ends where the azimuth jumps back by more degrees: packets can overtake each other
_MOST_PACKETS, _MOST_BYTES = 1 << 14, 1 << 26  # of a sweep

SWEEP = "lidar_packets/msg/Sweep"
DEFINITION = (
    f"std_msgs/Header header\nlidar_packets/Packet[] packets\n{'=' * 80}\n"
    "MSG: lidar_packets/Packet\nbuiltin_interfaces/Time stamp\nuint8[] data\n"
)

PACKET = "lidar_packets/msg/Datagram"
"""The type of datagrams in a capture."""
SINGLE_PACKETS = {
    "ouster_ros/msg/PacketMsg": "os_sensor",
    "ouster_sensor_msgs/msg/PacketMsg": "os_sensor",
    PACKET: "",
}
"""Messages with one packet and no header, which are read as sweeps, and the frame of their lidars."""


def is_lidar(data: bytes) -> bool:
    """Whether a datagram is a packet of a lidar that is read."""
    return len(data) == VELODYNE_BYTES or hesai.model_of(data) is not None or ouster.is_packet(data)


def packet_of(message: bytes, kind: str, is_ros1: bool) -> bytes:
    """The packet in a message of `SINGLE_PACKETS`."""
    if kind == PACKET:
        return message
    at = 0 if is_ros1 else 4
    is_big = not is_ros1 and message[1:2] == b"\0"
    return message[at + 4 :][: int.from_bytes(message[at : at + 4], "big" if is_big else "little")]


class Sweeps:
    """Collects packets until a turn of the lidar is complete."""

    def __init__(self) -> None:
        self._packets: list[tuple[int, bytes]] = []
        self._n_bytes = 0
        self._last: bytes | float | None = None

    def add(self, time: int, data: bytes) -> list[tuple[int, bytes]]:
        """Adds a packet and its time (ns); returns the turn before it if it begins the next, or nothing."""
        place = _place(data)
        if isinstance(place, float) and isinstance(self._last, float):
            begins = place < self._last - _BACK
        else:
            begins = self._last is not None and place != self._last
        self._last = place
        is_full = len(self._packets) >= _MOST_PACKETS or self._n_bytes + len(data) > _MOST_BYTES
        done = self.rest() if begins or is_full else []
        self._packets.append((time, data))
        self._n_bytes += len(data)
        return done

    def rest(self) -> list[tuple[int, bytes]]:
        """The packets of the last turn, which may be incomplete."""
        found, self._packets, self._n_bytes = self._packets, [], 0
        return found


def _place(data: bytes) -> bytes | float:
    """The azimuth of a packet in degrees, or what changes with the number of the turn."""
    if len(data) == VELODYNE_BYTES:
        return int.from_bytes(data[2:4], "little") / 100
    model = hesai.model_of(data)
    if model is not None:
        return hesai.azimuth_of(data, model)
    return ouster.turn_of(data)


def packed(sweep: Sequence[tuple[int, bytes]], frame: str, is_ros1: bool) -> bytes:
    """A `SWEEP` message with the time of its first packet, in the packed form of ROS 1 or in CDR."""
    pad, name = (1, frame.encode()) if is_ros1 else (4, frame.encode() + b"\0")
    found = bytearray(4 if is_ros1 else 0)  # the number of the message, which only ROS 1 has
    found += struct.pack("<III", *divmod(sweep[0][0], NANOSECONDS), len(name)) + name
    found += bytes(-len(found) % pad) + struct.pack("<I", len(sweep))
    for time, data in sweep:
        found += bytes(-len(found) % pad) + struct.pack("<III", *divmod(time, NANOSECONDS), len(data)) + data
    return bytes(found) if is_ros1 else b"\0\1\0\0" + found
