"""Keys of rmw_zenoh: how ROS 2 topics and endpoints are named in Zenoh.

Messages of a topic have the key DOMAIN/TOPIC/TYPE/HASH. Each endpoint declares a liveliness token,
@ros2_lv/DOMAIN/SESSION/NODE/ENTITY/KIND/ENCLAVE/NAMESPACE/NAME/TOPIC/TYPE/HASH/QOS, where % stands for /.
"""

from __future__ import annotations

import struct

from gmmtorch.live.ros.message_types import dds_type, ros_type
from gmmtorch.live.ros.middleware import Endpoint
from gmmtorch.live.ros.quality import Quality

NODE, PUBLISHER, SUBSCRIBER = "NN", "MP", "MS"
_SPACE = "@ros2_lv"
_DEPTH = 42  # of rmw_zenoh's default quality
_BEST_EFFORT, _TRANSIENT_LOCAL = "2", "1"
_N_PARTS = 13


def message_key(domain: int, topic: str, message_type: str, type_hash: str) -> str:
    """The key of a topic's messages; hash "*": of any version of the type."""
    return f"{domain}/{topic.strip('/')}/{dds_type(message_type)}/{type_hash}"


def all_tokens(domain: int) -> str:
    """A key that matches all liveliness tokens of a domain."""
    return f"{_SPACE}/{domain}/**"


def node_token(domain: int, session: str, namespace: str, name: str) -> str:
    """The liveliness token of a node."""
    return f"{_SPACE}/{domain}/{session}/0/0/{NODE}/%/{_mangled(namespace)}/{name}"


def endpoint_token(
    domain: int, session: str, entity: int, namespace: str, name: str, endpoint: Endpoint, type_hash: str
) -> str:
    """The liveliness token of a publisher or subscriber of a node."""
    kind = PUBLISHER if endpoint.is_publisher else SUBSCRIBER
    return (
        f"{_SPACE}/{domain}/{session}/0/{entity}/{kind}/%/{_mangled(namespace)}/{name}/"
        f"{_mangled(endpoint.topic)}/{dds_type(endpoint.type)}/{type_hash}/{quality_text(endpoint.quality)}"
    )


def parsed_token(token: str) -> Endpoint | None:
    """The endpoint of a liveliness token; None if it is not one of a ROS topic."""
    parts = token.split("/")
    if len(parts) != _N_PARTS or parts[5] not in (PUBLISHER, SUBSCRIBER):
        return None
    kind = ros_type(parts[10])
    if kind is None:
        return None
    return Endpoint(parts[9].replace("%", "/"), kind, parsed_quality(parts[12]), parts[5] == PUBLISHER)


def quality_text(quality: Quality) -> str:
    """reliability:durability:history,depth:deadline:lifespan:liveliness; what equals the default is empty."""
    reliability = "" if quality.reliable else _BEST_EFFORT
    durability = _TRANSIENT_LOCAL if quality.latched else ""
    depth = "" if quality.depth == _DEPTH else str(quality.depth)
    return f"{reliability}:{durability}:,{depth}:,:,:,,"


def parsed_quality(text: str) -> Quality:
    """The inverse of `quality_text`; what is missing or unknown is the default."""
    reliability, durability, history, *_ = [*text.split(":"), "", "", ""]
    depth = history.rpartition(",")[2]
    return Quality(
        reliability != _BEST_EFFORT,
        durability == _TRANSIENT_LOCAL,
        int(depth) if depth.isascii() and depth.isdecimal() else _DEPTH,
    )


def attachment(sequence: int, time: int, source: bytes) -> bytes:
    """What a message carries beside its content: number, time (ns), and id (16 bytes) of its publisher."""
    return struct.pack("<qqB", sequence, time, len(source)) + source


def _mangled(name: str) -> str:
    return name.replace("/", "%")
