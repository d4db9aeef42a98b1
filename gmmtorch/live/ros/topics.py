"""ROS 2 topics: their names, types and quality of service, and endpoints."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from gmmtorch.datasets import MessageDecoder
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.export import built_message
from gmmtorch.optional_packages import needs_extra


@dataclass(frozen=True)
class Quality:
    """How a topic is delivered.

    reliable: lost messages are sent again; else best effort. latched: the last messages are also sent to
    subscribers that come later (transient local); else volatile. depth: number of messages that are kept.
    """

    reliable: bool = True
    latched: bool = False
    depth: int = 10


LATCHED = Quality(latched=True, depth=1)


def subscribed(topic: str, message_type: str) -> Quality:
    """What a subscriber asks for: best effort for sensor data and /clock, latched for /tf_static."""
    if topic.endswith("/tf_static"):
        return Quality(latched=True, depth=100)
    if topic.endswith("/tf"):
        return Quality(depth=1000)
    is_sensor = message_type.startswith("sensor_msgs/")
    if topic == "/clock" or is_sensor:
        return Quality(reliable=False, depth=1000 if is_sensor else 1)
    return Quality()


def published(topic: str, message_type: str) -> Quality:
    """What a publisher offers: latched for static transforms and maps, and reliable, which serves both kinds
    of subscribers."""
    is_map = message_type in ("nav_msgs/msg/OccupancyGrid", "visualization_msgs/msg/MarkerArray")
    if is_map or topic.endswith("/tf_static"):
        return LATCHED
    return Quality(depth=1000 if topic.endswith("/tf") else 50)


def mismatch(offered: Quality, requested: Quality) -> str | None:
    """Why a subscriber receives nothing from a publisher, and which side must change; None if it does."""
    if requested.reliable and not offered.reliable:
        return "it is published best effort, but reliable delivery is requested: publish it reliable"
    if requested.latched and not offered.latched:
        return "it is published volatile, but transient local is requested: publish it transient local"
    return None


_TOKEN = r"[A-Za-z_][A-Za-z0-9_]*"
_TOPIC = re.compile(rf"(~/|/)?{_TOKEN}(/{_TOKEN})*|~")
_NODE = re.compile(_TOKEN)


class TopicNames:
    """Resolves the names that a node uses, in a namespace, such as robot1; "" or "/": none.

    remap: name → other name, both resolved in the namespace before they are compared. Raises
    `InvalidArgumentError` for names that ROS 2 does not allow.
    """

    def __init__(self, node: str, namespace: str = "", remap: Mapping[str, str] | None = None) -> None:
        if _NODE.fullmatch(node) is None:
            raise InvalidArgumentError(f"name={node!r} is not a name of a node: use letters, digits and _.")
        path = namespace.strip("/")
        if path and _TOPIC.fullmatch(path) is None:
            raise InvalidArgumentError(
                f"namespace={namespace!r} is not one of ROS: use letters, digits, _ and /."
            )
        self.node = node
        self.namespace = f"/{path}"
        self._remap = {self._absolute(old): self._absolute(new) for old, new in (remap or {}).items()}

    def resolve(self, name: str) -> str:
        """The absolute, remapped name of a topic: /name, name in the namespace, or ~/name of the node."""
        whole = self._absolute(name)
        return self._remap.get(whole, whole)

    def _absolute(self, name: str) -> str:
        if _TOPIC.fullmatch(name) is None:
            raise InvalidArgumentError(
                f"topic={name!r} is not a name of ROS: letters, digits and _, in parts separated by /."
            )
        if name.startswith("/"):
            return name
        base = self.namespace.rstrip("/")
        return f"{base}/{self.node}{name[1:]}" if name.startswith("~") else f"{base}/{name}"


_NAME = re.compile(r"(\w+)/msg/(\w+)")
_DDS_NAME = re.compile(r"(\w+)::msg::dds_::(\w+)_")
_MORE = {
    "map_msgs/msg/OccupancyGridUpdate": "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\n"
    "uint32 height\nint8[] data\n"
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


MAX_MESSAGE_BYTES = 1 << 26
"""Longer messages are not received; a scan of a million points with eight fields has half of it."""


class Endpoint(NamedTuple):
    """A publisher or subscriber on the network, also one of this process.

    topic: absolute name. type: pkg/msg/Name. quality: what it offers or requests.
    """

    topic: str
    type: str
    quality: Quality
    is_publisher: bool
