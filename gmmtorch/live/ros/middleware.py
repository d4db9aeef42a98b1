"""Middleware: what a node needs of a wire protocol."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from gmmtorch.live.ros.quality import Quality

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


class Middleware(Protocol):
    """Carries CDR messages by topic. Callbacks run in threads of the middleware."""

    def publisher(self, topic: str, message_type: str, quality: Quality) -> Callable[[bytes], None]:
        """Declares a publisher; the result sends a message."""

    def subscribe(
        self, topic: str, message_type: str, quality: Quality, on_message: Callable[[bytes], None]
    ) -> None:
        """Declares a subscriber, whose messages go to the callback."""

    def endpoints(self) -> list[Endpoint]:
        """All known publishers and subscribers of ROS topics."""

    def close(self) -> None:
        """Leaves the network."""
