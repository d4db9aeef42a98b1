"""Node: publishes and subscribes to ROS 2 topics without an installation of ROS."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from gmmtorch.datasets import TransformTree
from gmmtorch.errors import DataError, InvalidArgumentError, check_choice, told
from gmmtorch.live.ros import dds, zenoh_middleware
from gmmtorch.live.ros.topics import (
    MAX_MESSAGE_BYTES,
    Endpoint,
    MessageTypes,
    Quality,
    TopicNames,
    mismatch,
    published,
    subscribed,
)

logger = logging.getLogger("gmmtorch")
MIDDLEWARE = ("dds", "zenoh")
TRANSFORMS = "tf2_msgs/msg/TFMessage"
CLOCK = "rosgraph_msgs/msg/Clock"
_WAITING_BYTES = 4 * MAX_MESSAGE_BYTES
_REPEAT = 10.0  # s between two warnings of one kind
_TRANSFORM_SECONDS = 30.0

Callback = Callable[[dict[str, Any]], None]


class Arrival(NamedTuple):
    """When a message arrived: its number, the time of the node (ns), and of this machine's clock (s)."""

    number: int
    time: int
    monotonic: float
    data: bytes


@dataclass
class Subscription:
    """A subscribed topic, and its messages that wait for `Node.spin_once`.

    n_received: messages so far. n_dropped: of these, the oldest ones that did not fit into the queue.
    n_malformed: messages that could not be decoded.
    """

    topic: str
    type: str
    callback: Callback
    depth: int
    waiting: deque[Arrival] = field(default_factory=deque)
    waiting_bytes: int = 0
    n_received: int = 0
    n_dropped: int = 0
    n_malformed: int = 0


class Node:
    """A ROS 2 node over DDS or Zenoh.

    Usage::

        with Node("listener") as node:
            node.subscribe("/scan", "sensor_msgs/msg/LaserScan", print)
            node.spin(seconds=10)

    Messages are dictionaries of their fields. Callbacks run in the thread that calls `spin` or `spin_once`.
    It speaks only to this machine, unless `interface`, `peers` or `router` name another.

    Args:
        name: of the node.
        middleware: "dds" (rmw_fastrtps, rmw_cyclonedds) or "zenoh" (rmw_zenoh).
        domain: ROS_DOMAIN_ID; None: of the environment, else 0.
        namespace: of relative topic names.
        remap: topic → other topic.
        interface: of DDS: name or address of a network interface.
        peers: of DDS: addresses of other machines, where multicast does not reach them.
        router: of Zenoh: endpoint of the router.
        use_sim_time: `now` is the time of /clock.

    Attributes:
        subscriptions: all subscriptions.
        arrival: when the message arrived whose callback runs.
        transforms: of the last 30 s, after `listen_to_transforms`.

    Raises `InvalidArgumentError` for arguments that cannot be used, and `GmmTorchError` if a package is
    missing.
    """

    def __init__(
        self,
        name: str = "gmmtorch",
        *,
        middleware: str = "dds",
        domain: int | None = None,
        namespace: str = "",
        remap: Mapping[str, str] | None = None,
        interface: str = dds.LOOPBACK,
        peers: Sequence[str] = (),
        router: str = zenoh_middleware.ROUTER,
        use_sim_time: bool = False,
    ) -> None:
        check_choice("middleware", middleware, MIDDLEWARE)
        self.names = TopicNames(name, namespace, remap)
        self.types = MessageTypes()
        number = _environment_domain() if domain is None else domain
        self._middleware = (
            dds.DdsMiddleware(self.types, number, interface, peers)
            if middleware == "dds"
            else zenoh_middleware.ZenohMiddleware(self.types, number, self.names, router)
        )
        self.transforms = TransformTree(keep=_TRANSFORM_SECONDS)
        self._arrived = threading.Condition()
        self._n_arrived = 0
        self.subscriptions: list[Subscription] = []
        self._warned: dict[str, float] = {}
        self.option_names: Mapping[str, str] = {}  # of arguments that are marked in warnings
        self.arrival = Arrival(0, 0, 0.0, b"")
        self._clock = 0
        self._clock_topic: Subscription | None = None
        if use_sim_time:
            self._clock_topic = self.subscribe("/clock", CLOCK, lambda _: None)

    def __enter__(self) -> Node:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leaves the network."""
        self._middleware.close()

    def publisher(self, topic: str, message_type: str, offered: Quality | None = None) -> Callable[..., None]:
        """Declares a publisher; the result publishes a message from nested fields and a stamp (ns).

        The stamp goes into headers that have none; without one it is `now`. Fields that are not given are
        zero or empty. Bytes are a message that is encoded already.
        """
        name = self.names.resolve(topic)
        self.types.check(message_type)
        send = self._middleware.publisher(name, message_type, offered or published(name, message_type))

        def publish(message: Mapping[str, Any] | bytes, stamp: int | None = None) -> None:
            if not isinstance(message, bytes):
                message = self.types.encode(message_type, message, self.now() if stamp is None else stamp)
            send(message)

        return publish

    def subscribe(
        self, topic: str, message_type: str, callback: Callback, requested: Quality | None = None
    ) -> Subscription:
        """Calls `callback` with each message of a topic."""
        name = self.names.resolve(topic)
        self.types.check(message_type)
        asked = requested or subscribed(name, message_type)
        made = Subscription(name, message_type, callback, max(asked.depth, 1))
        self.subscriptions.append(made)
        self._middleware.subscribe(name, message_type, asked, lambda data: self._receive(made, data))
        return made

    def topics(self) -> dict[str, list[str]]:
        """The published topics with their types."""
        found: dict[str, set[str]] = {}
        for endpoint in self.publishers():
            found.setdefault(endpoint.topic, set()).add(endpoint.type)
        return {topic: sorted(found[topic]) for topic in sorted(found)}

    def publishers(self) -> list[Endpoint]:
        """The publishers of all topics."""
        return [endpoint for endpoint in self._middleware.endpoints() if endpoint.is_publisher]

    def subscribers(self) -> list[Endpoint]:
        """The subscribers of all topics."""
        return [endpoint for endpoint in self._middleware.endpoints() if not endpoint.is_publisher]

    def explain_silence(self, subscription: Subscription) -> str:
        """Why a subscription receives nothing: no publisher, another type, or a quality that cannot match."""
        publishers = self.publishers()
        named = [endpoint for endpoint in publishers if endpoint.topic == subscription.topic]
        if not named:
            listed = "; ".join(f"{topic} ({', '.join(types)})" for topic, types in self.topics().items())
            return f"topic {subscription.topic} has no publisher. Published topics: {listed or 'none'}"
        if all(endpoint.type != subscription.type for endpoint in named):
            types = ", ".join(sorted({endpoint.type for endpoint in named}))
            return f"topic {subscription.topic} has messages of type {types}, not {subscription.type}"
        asked = subscribed(subscription.topic, subscription.type)
        for endpoint in named:
            if reason := mismatch(endpoint.quality, asked):
                return f"topic {subscription.topic} cannot be received: {reason}"
        return f"topic {subscription.topic} has a publisher, which sends nothing"

    def now(self) -> int:
        """The time in ns: of the system, or of /clock (0 before its first message)."""
        return time.time_ns() if self._clock_topic is None else self._clock

    def listen_to_transforms(self) -> tuple[Subscription, Subscription]:
        """Collects /tf and /tf_static in `transforms`, whose last 30 s are kept."""
        return (
            self.subscribe("/tf", TRANSFORMS, reading(lambda tf: self.transforms.add(tf, static=False))),
            self.subscribe(
                "/tf_static", TRANSFORMS, reading(lambda tf: self.transforms.add(tf, static=True))
            ),
        )

    def _note_clock(self, subscription: Subscription, data: bytes) -> None:
        try:
            message = self.types.decode(data, CLOCK)
        except DataError as error:
            self._note_malformed(subscription, error)
            return
        self._clock = int(message["clock"]["sec"]) * 1_000_000_000 + int(message["clock"]["nanosec"])

    def spin(self, seconds: float | None = None) -> None:
        """Calls callbacks for some seconds; None: until it is interrupted."""
        end = None if seconds is None else time.monotonic() + seconds
        while end is None or time.monotonic() < end:
            self.spin_once(0.1 if end is None else max(0.0, min(0.1, end - time.monotonic())))

    def spin_once(self, timeout: float = 0.0) -> bool:
        """Calls the callback of the oldest waiting message; returns whether one came in `timeout` (s)."""
        with self._arrived:
            if not self._arrived.wait_for(lambda: any(s.waiting for s in self.subscriptions), timeout):
                return False
            waiting = (s for s in self.subscriptions if s.waiting)
            subscription = min(waiting, key=lambda s: s.waiting[0].number)
            self.arrival = subscription.waiting.popleft()
            subscription.waiting_bytes -= len(self.arrival.data)
        try:
            subscription.callback(self.types.decode(self.arrival.data, subscription.type))
        except DataError as error:
            self._note_malformed(subscription, error)
        return True

    def warn(self, kind: str, text: str) -> None:
        """Logs a warning, and no other one of this kind for ten seconds."""
        now = time.monotonic()
        if now - self._warned.get(kind, -_REPEAT) >= _REPEAT:
            self._warned[kind] = now
            logger.warning("%s", told(text, self.option_names))

    @property
    def counts(self) -> dict[str, Counter[str]]:
        """Messages received, dropped and malformed, by topic."""
        return {
            s.topic: Counter(received=s.n_received, dropped=s.n_dropped, malformed=s.n_malformed)
            for s in self.subscriptions
        }

    def _receive(self, subscription: Subscription, data: bytes) -> None:
        """Queues a message; called by threads of the middleware."""
        with self._arrived:
            self._n_arrived += 1
            subscription.n_received += 1
            if subscription is self._clock_topic:  # counts from now on, also for messages that wait
                self._note_clock(subscription, data)
                return
            if len(data) > MAX_MESSAGE_BYTES:
                size = f"{len(data):,} bytes are more than {MAX_MESSAGE_BYTES:,}, the most of a message"
                self._note_malformed(subscription, DataError(size))
                return
            subscription.waiting.append(Arrival(self._n_arrived, self.now(), time.monotonic(), data))
            subscription.waiting_bytes += len(data)
            while (
                len(subscription.waiting) > subscription.depth or subscription.waiting_bytes > _WAITING_BYTES
            ):
                subscription.waiting_bytes -= len(subscription.waiting.popleft().data)
                subscription.n_dropped += 1
            self._arrived.notify()

    def _note_malformed(self, subscription: Subscription, error: Exception) -> None:
        subscription.n_malformed += 1
        self.warn(
            f"malformed {subscription.topic}",
            f"{subscription.n_malformed} messages of {subscription.topic} cannot be used; the last: "
            f"{error!s}",
        )


def reading(callback: Callback) -> Callback:
    """The callback, which raises `DataError` for a message whose contents it cannot use.

    The node counts such messages as malformed. Every other error of a callback ends `spin`.
    """

    def read(message: dict[str, Any]) -> None:
        try:
            callback(message)
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            raise DataError(f"{type(error).__name__}: {error}") from error

    return read


def _environment_domain() -> int:
    text = os.environ.get("ROS_DOMAIN_ID", "") or "0"
    if not (text.isascii() and text.isdecimal()):
        raise InvalidArgumentError(f"ROS_DOMAIN_ID={text!r} must be a whole number 0 … {dds.MAX_DOMAIN}.")
    return int(text)
