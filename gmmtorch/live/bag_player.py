"""BagPlayer: publishes the messages of a bag with the times between them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

from gmmtorch.datasets import NANOSECONDS, TF_TYPES, BagReader, RawMessage
from gmmtorch.errors import DataError, check_number
from gmmtorch.export import time_fields
from gmmtorch.live.ros import Node
from gmmtorch.live.ros.node import CLOCK, TRANSFORMS

_CLOCK_PERIOD = 0.01  # s between two messages on /clock
_AFTER_MATCH = 0.5  # s in which both sides learn of each other


class BagPlayer:
    """Plays a bag of ROS 1 or ROS 2.

    Args:
        node: publishes the topics under their names, remapped.
        path: see `BagReader`.
        rate: of the recording's speed.

    Attributes:
        n_played: messages so far.
        unknown: topics that are left out, because their type is not one of ROS 2 Jazzy.

    Raises `DataError` if the bag has no topic of a known type.
    """

    def __init__(self, node: Node, path: str | Path, rate: float = 1.0) -> None:
        check_number("rate", rate, above=True)
        self._node, self._rate = node, rate
        self._reader = BagReader(Path(path).expanduser())
        found = [topic for topic in self._reader.topics if topic.n_messages and topic.name != "/clock"]
        known = [topic for topic in found if _played_type(topic.type) in node.types.definitions]
        self.unknown = [topic for topic in found if topic not in known]
        if not known:
            raise DataError(f"{path} has no message of a type that ROS 2 Jazzy knows.")
        self.n_played = 0
        self._send = {topic: node.publisher(topic.name, _played_type(topic.type)) for topic in known}
        self._send_clock = node.publisher("/clock", CLOCK)

    @property
    def n_messages(self) -> int:
        """Messages that are played."""
        return sum(topic.n_messages for topic in self._send)

    def wait_for_subscriber(self, seconds: float) -> bool:
        """Waits until another node subscribes to a played topic; returns whether one did."""
        names = {self._node.names.resolve(topic.name) for topic in self._send if topic.type not in TF_TYPES}
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if any(subscriber.topic in names for subscriber in self._node.subscribers()):
                time.sleep(_AFTER_MATCH)
                return True
            time.sleep(0.1)
        return False

    def play(self) -> Iterator[RawMessage]:
        """Publishes the messages, each at its time, and yields it afterwards."""
        begin, first = time.monotonic(), None
        send = {(topic.name, topic.type): publish for topic, publish in self._send.items()}
        for message in self._reader.messages({topic.name for topic in self._send}):
            publish = send.get((message.topic, message.type))
            if publish is None:
                continue
            first = message.time if first is None else first
            self._wait(begin, first, message.time)
            self._tick(message.time)
            if self._reader.is_ros1:
                publish(self._node.types.from_ros1(message.data, _played_type(message.type)))
            else:
                publish(message.data)
            self.n_played += 1
            yield message

    def _wait(self, begin: float, first: int, until: int) -> None:
        """Waits for the time of a message (ns), and publishes the clock meanwhile."""
        due = begin + (until - first) / NANOSECONDS / self._rate
        while (left := due - time.monotonic()) > _CLOCK_PERIOD:
            time.sleep(_CLOCK_PERIOD)
            self._tick(until - int((left - _CLOCK_PERIOD) * self._rate * NANOSECONDS))
        time.sleep(max(0.0, due - time.monotonic()))

    def _tick(self, now: int) -> None:
        self._send_clock({"clock": time_fields(max(now, 0))})


def _played_type(message_type: str) -> str:
    return TRANSFORMS if message_type in TF_TYPES else message_type
