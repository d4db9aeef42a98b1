"""ZenohMiddleware: ROS 2 topics over Zenoh, as rmw_zenoh carries them.

Messages of a topic have the key DOMAIN/TOPIC/TYPE/HASH. Each endpoint declares a liveliness token,
@ros2_lv/DOMAIN/SESSION/NODE/ENTITY/KIND/ENCLAVE/NAMESPACE/NAME/TOPIC/TYPE/HASH/QOS, where % stands for /.
"""

from __future__ import annotations

import itertools
import json
import struct
import time
import uuid
from collections.abc import Callable
from typing import Any

from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.live.ros.topics import (
    MAX_MESSAGE_BYTES,
    Endpoint,
    MessageTypes,
    Quality,
    TopicNames,
    dds_type,
    ros_type,
)
from gmmtorch.optional_packages import needs_extra

ROUTER = "tcp/127.0.0.1:7447"
_ANY_VERSION = "*"
_TIMEOUT = 2.0  # s, for the tokens of other nodes
_NODE, _PUBLISHER, _SUBSCRIBER = "NN", "MP", "MS"
_SPACE = "@ros2_lv"
_DEPTH = 42  # of rmw_zenoh's default quality
_BEST_EFFORT, _TRANSIENT_LOCAL = "2", "1"
_N_PARTS = 13


class ZenohMiddleware:
    """One client of a Zenoh router, whose endpoint is the only address that is contacted.

    names: name and namespace of the node, which others can list.

    Raises `InvalidArgumentError` if the router does not answer, and `GmmTorchError` if eclipse-zenoh is not
    installed.
    """

    def __init__(self, types: MessageTypes, domain: int, names: TopicNames, router: str = ROUTER) -> None:
        self._types, self._domain, self._names = types, domain, names
        self._zenoh = _load()
        try:
            self._session: Any = self._zenoh.open(_settings(self._zenoh, "client", connect=[router]))
        except self._zenoh.ZError as error:
            raise InvalidArgumentError(
                f"router={router} does not answer; start one (`ros2 run rmw_zenoh_cpp rmw_zenohd`, or "
                "zenohd), or give its endpoint, such as tcp/10.0.0.3:7447."
            ) from error
        self._id = str(self._session.zid())
        self._numbers = itertools.count(1)
        self._entities: list[Any] = []
        token = f"{_SPACE}/{domain}/{self._id}/0/0/{_NODE}/%/{names.namespace.replace('/', '%')}/{names.node}"
        self._entities.append(self._session.liveliness().declare_token(token))

    def publisher(self, topic: str, message_type: str, quality: Quality) -> Callable[[bytes], None]:
        ext = self._zenoh.ext
        key = message_key(self._domain, topic, message_type, self._types.type_hash(message_type))
        blocking = self._zenoh.CongestionControl.BLOCK if quality.reliable else None
        if quality.latched:
            publisher: Any = ext.declare_advanced_publisher(
                self._session,
                key,
                cache=ext.CacheConfig(max_samples=quality.depth),
                publisher_detection=True,
                congestion_control=blocking,
            )
        else:
            publisher = self._session.declare_publisher(key, congestion_control=blocking)
        source, sequence = uuid.uuid4().bytes, itertools.count(1)
        self._declared(publisher, Endpoint(topic, message_type, quality, True))

        def send(message: bytes) -> None:
            tag = attachment(next(sequence), time.time_ns(), source)
            try:
                publisher.put(message, attachment=tag)
            except self._zenoh.ZError as error:
                raise GmmTorchError(f"Zenoh did not send a message on {topic}: {error}.") from error

        return send

    def subscribe(
        self, topic: str, message_type: str, quality: Quality, on_message: Callable[[bytes], None]
    ) -> None:
        key = message_key(self._domain, topic, message_type, _ANY_VERSION)

        def receive(sample: Any) -> None:
            on_message(sample.payload.to_bytes())

        if quality.latched:
            ext = self._zenoh.ext
            history = ext.HistoryConfig(detect_late_publishers=True, max_samples=quality.depth)
            subscriber: Any = ext.declare_advanced_subscriber(self._session, key, receive, history=history)
        else:
            subscriber = self._session.declare_subscriber(key, receive)
        self._declared(subscriber, Endpoint(topic, message_type, quality, False))

    def endpoints(self) -> list[Endpoint]:
        tokens = self._session.liveliness().get(f"{_SPACE}/{self._domain}/**", timeout=_TIMEOUT)
        found = [parsed_token(str(reply.ok.key_expr)) for reply in tokens if reply.ok is not None]
        return [endpoint for endpoint in found if endpoint is not None]

    def close(self) -> None:
        self._session.close()
        self._entities.clear()

    def _declared(self, entity: Any, endpoint: Endpoint) -> None:
        """Announces an endpoint to other nodes."""
        who = self._domain, self._id, next(self._numbers), self._names.namespace, self._names.node
        token = endpoint_token(*who, endpoint, self._types.type_hash(endpoint.type))
        self._entities += [entity, self._session.liveliness().declare_token(token)]


def open_router(endpoint: str = ROUTER) -> Any:
    """A Zenoh router in this process, which listens at one endpoint; close it with its `close()`.

    Raises `InvalidArgumentError` if the endpoint cannot be listened on.
    """
    zenoh = _load()
    try:
        return zenoh.open(_settings(zenoh, "router", listen=[endpoint]))
    except zenoh.ZError as error:
        raise InvalidArgumentError(
            f"router={endpoint} cannot be opened: another one may run there."
        ) from error


def _load() -> Any:
    with needs_extra("middleware=zenoh needs", "eclipse-zenoh", "ros"):
        import zenoh
        import zenoh.ext
    return zenoh


def _settings(
    zenoh: Any, mode: str, listen: list[str] | None = None, connect: list[str] | None = None
) -> Any:
    """A configuration without scouting: only the given endpoints are used."""
    config = zenoh.Config()
    settings = {
        "mode": mode,
        "listen/endpoints": listen or [],
        "connect/endpoints": connect or [],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "timestamping/enabled": True,
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        "transport/shared_memory/enabled": False,
    }
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return config


def message_key(domain: int, topic: str, message_type: str, type_hash: str) -> str:
    """The key of a topic's messages; hash "*": of any version of the type."""
    return f"{domain}/{topic.strip('/')}/{dds_type(message_type)}/{type_hash}"


def endpoint_token(
    domain: int, session: str, entity: int, namespace: str, name: str, endpoint: Endpoint, type_hash: str
) -> str:
    """The liveliness token of a publisher or subscriber of a node."""
    kind = _PUBLISHER if endpoint.is_publisher else _SUBSCRIBER
    space, topic = (path.replace("/", "%") for path in (namespace, endpoint.topic))
    return (
        f"{_SPACE}/{domain}/{session}/0/{entity}/{kind}/%/{space}/{name}/"
        f"{topic}/{dds_type(endpoint.type)}/{type_hash}/{quality_text(endpoint.quality)}"
    )


def parsed_token(token: str) -> Endpoint | None:
    """The endpoint of a liveliness token; None if it is not one of a ROS topic."""
    parts = token.split("/")
    if len(parts) != _N_PARTS or parts[5] not in (_PUBLISHER, _SUBSCRIBER):
        return None
    kind = ros_type(parts[10])
    if kind is None:
        return None
    return Endpoint(parts[9].replace("%", "/"), kind, parsed_quality(parts[12]), parts[5] == _PUBLISHER)


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
