"""Raw packets of Velodyne lidars in bags, decoded by the package velodyne-decoder."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from gmmtorch.datasets.ros.sensor_messages import Reading, reading
from gmmtorch.errors import DataError
from gmmtorch.optional_packages import needs_extra

VELODYNE = "velodyne_msgs/msg/VelodyneScan"
DEFINITION = SimpleNamespace(
    format=SimpleNamespace(name="MSG"),
    data="std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets\n"
    + "=" * 80
    + "\nMSG: velodyne_msgs/VelodynePacket\nbuiltin_interfaces/Time stamp\nuint8[1206] data\n",
)
"""For SQLite bags of older ROS 2, which contain no definitions."""
_PACKET_BYTES = 1206


class VelodynePackets:
    """Decodes the messages of one lidar. Its first packet states the model, except for the HDL-64E."""

    def __init__(self) -> None:
        with needs_extra("Velodyne packets need", "velodyne-decoder", "packets"):
            import velodyne_decoder
        self._package: Any = velodyne_decoder
        self._decoder = velodyne_decoder.ScanDecoder(velodyne_decoder.Config())

    def points(self, message: dict[str, Any]) -> Reading:
        """The points of a VelodyneScan, with times in seconds from its stamp. Raises `DataError`."""
        packets = []
        for packet in message["packets"]:
            stamp, data = packet["stamp"], bytes(packet["data"])
            if len(data) != _PACKET_BYTES:
                raise DataError(f"a packet has {len(data)} bytes instead of {_PACKET_BYTES}")
            packets.append((int(stamp["sec"]) + int(stamp["nanosec"]) * 1e-9, list(data)))
        if not packets:  # the decoder would end the process
            return reading(np.empty((0, 3)), None, None)
        try:
            made = [self._package.VelodynePacket(*packet) for packet in packets]
            _, table = self._decoder.decode(made, as_pcl_structs=True)
        except (RuntimeError, TypeError, ValueError) as error:
            raise DataError(f"the packets cannot be decoded: {str(error).splitlines()[0]}") from error
        return reading(np.stack([table[axis].astype(np.float64) for axis in "xyz"], 1), None, table["time"])
