"""ZenohMiddleware: ROS 2 topics over Zenoh, as rmw_zenoh carries them."""

from __future__ import annotations

import itertools
import json
import time
import uuid
from collections.abc import Callable
from typing import Any

from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.live.ros import zenoh_keys
from gmmtorch.live.ros.message_types import MessageTypes
from gmmtorch.live.ros.middleware import MAX_MESSAGE_BYTES, Endpoint
from gmmtorch.live.ros.quality import Quality
from gmmtorch.live.ros.topic_names import TopicNames
from gmmtorch.optional_packages import needs_extra

ROUTER = "tcp/127.0.0.1:7447"
_ANY_VERSION = "*"
_TIMEOUT = 2.0  # s, for the tokens of other nodes


class ZenohMiddleware:
    """One client of a Zenoh router. The router is the only address that is contacted.

    Args:
        types: of the messages.
        domain: number of the domain, ROS_DOMAIN_ID.
        names: name and namespace of the node, which others can list.
        router: endpoint of the router, such as that of `ros2 run rmw_zenoh_cpp rmw_zenohd`.

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
        token = zenoh_keys.node_token(domain, self._id, names.namespace, names.node)
        self._entities.append(self._session.liveliness().declare_token(token))

    def publisher(self, topic: str, message_type: str, quality: Quality) -> Callable[[bytes], None]:
        ext = self._zenoh.ext
        key = self._key(topic, message_type, self._types.type_hash(message_type))
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
            tag = zenoh_keys.attachment(next(sequence), time.time_ns(), source)
            try:
                publisher.put(message, attachment=tag)
            except self._zenoh.ZError as error:
                raise GmmTorchError(f"Zenoh did not send a message on {topic}: {error}.") from error

        return send

    def subscribe(
        self, topic: str, message_type: str, quality: Quality, on_message: Callable[[bytes], None]
    ) -> None:
        key = self._key(topic, message_type, _ANY_VERSION)

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
        tokens = self._session.liveliness().get(zenoh_keys.all_tokens(self._domain), timeout=_TIMEOUT)
        found = [zenoh_keys.parsed_token(str(reply.ok.key_expr)) for reply in tokens if reply.ok is not None]
        return [endpoint for endpoint in found if endpoint is not None]

    def close(self) -> None:
        self._session.close()
        self._entities.clear()

    def _key(self, topic: str, message_type: str, type_hash: str) -> str:
        self._types.check(message_type)
        return zenoh_keys.message_key(self._domain, topic, message_type, type_hash)

    def _declared(self, entity: Any, endpoint: Endpoint) -> None:
        """Announces an endpoint to other nodes."""
        token = zenoh_keys.endpoint_token(
            self._domain,
            self._id,
            next(self._numbers),
            self._names.namespace,
            self._names.node,
            endpoint,
            self._types.type_hash(endpoint.type),
        )
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
