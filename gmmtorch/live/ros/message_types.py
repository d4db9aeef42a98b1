"""MessageTypes: encodes and decodes ROS 2 messages (CDR) by the definitions of the package rosbags."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from gmmtorch.datasets import MessageDecoder
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.export import built_message
from gmmtorch.optional_packages import needs_extra

_NAME = re.compile(r"(\w+)/msg/(\w+)")
_DDS_NAME = re.compile(r"(\w+)::msg::dds_::(\w+)_")
_MORE = {
    "map_msgs/msg/OccupancyGridUpdate": "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\n"
    "uint32 height\nint8[] data\n",
}
"""Types that rosbags does not have, in the form of .msg files."""


class MessageTypes:
    """The message types of ROS 2 Jazzy. A type is named pkg/msg/Name.

    Raises `GmmTorchError` if rosbags is not installed.
    """

    def __init__(self) -> None:
        with needs_extra("ROS messages need", "rosbags", "ros"):
            from rosbags import typesys
        self._store: Any = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
        for name, definition in _MORE.items():
            self._store.register(typesys.get_types_from_msg(definition, name))
        self._decoder = MessageDecoder(dict(self._store.fielddefs), packed=False)

    @property
    def definitions(self) -> dict[str, Any]:
        """Type name → (constants, fields), as rosbags parses them."""
        return self._decoder.definitions

    def check(self, name: str) -> str:
        """The name of a type. Raises `InvalidArgumentError` if it is not known."""
        if name not in self.definitions:
            raise InvalidArgumentError(
                f"type={name!r} is not a message type of ROS 2 Jazzy; give one such as "
                "sensor_msgs/msg/PointCloud2."
            )
        return name

    def encode(self, name: str, fields: Mapping[str, Any], stamp: int = 0) -> bytes:
        """CDR, little endian with its head, of a message from nested fields.

        Headers without a stamp get `stamp` (ns). Fields that are not given are zero or empty.
        """
        return bytes(
            self._store.serialize_cdr(built_message(self._store, self.check(name), fields, stamp), name)
        )

    def decode(self, data: bytes, name: str) -> dict[str, Any]:
        """The fields of a message. Raises `DataError` if the data is shorter than it announces."""
        return self._decoder.decode(data, name)

    def from_ros1(self, data: bytes, name: str) -> bytes:
        """CDR of a message in the packed form of ROS 1."""
        return bytes(self._store.ros1_to_cdr(data, self.check(name)))

    def type_hash(self, name: str) -> str:
        """The hash of a type's definition, RIHS01_… (REP 2016)."""
        return str(self._store.hash_rihs01(self.check(name)))


def dds_type(name: str) -> str:
    """The name of a type on the wire: sensor_msgs/msg/Image is sensor_msgs::msg::dds_::Image_."""
    found = _NAME.fullmatch(name)
    if found is None:
        raise InvalidArgumentError(f"type={name!r} is not a message type; give PACKAGE/msg/NAME.")
    return f"{found[1]}::msg::dds_::{found[2]}_"


def ros_type(name: str) -> str | None:
    """The inverse of `dds_type`; None if the name is not one of a ROS message."""
    found = _DDS_NAME.fullmatch(name)
    return None if found is None else f"{found[1]}/msg/{found[2]}"
