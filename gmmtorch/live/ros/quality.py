"""Quality of service of topics, as ROS 2 uses it by default."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Quality:
    """How a topic is delivered.

    reliable: lost messages are sent again; else best effort. latched: the last messages are also sent to
    subscribers that come later (transient local); else volatile. depth: number of messages that are kept.
    """

    reliable: bool = True
    latched: bool = False
    depth: int = 10


SENSOR = Quality(reliable=False, depth=1000)
CLOCK = Quality(reliable=False, depth=1)
TRANSFORMS = Quality(depth=1000)
LATCHED = Quality(latched=True, depth=1)
LATCHED_TRANSFORMS = Quality(latched=True, depth=100)

_SENSOR_PACKAGE = "sensor_msgs/"


def subscribed(topic: str, message_type: str) -> Quality:
    """What a subscriber asks for: best effort for sensor data and /clock, latched for /tf_static."""
    if topic.endswith("/tf_static"):
        return LATCHED_TRANSFORMS
    if topic.endswith("/tf"):
        return TRANSFORMS
    if topic == "/clock":
        return CLOCK
    if message_type.startswith(_SENSOR_PACKAGE):
        return SENSOR
    return Quality()


def published(topic: str, message_type: str) -> Quality:
    """What a publisher offers: latched for static transforms and maps, and reliable, which serves both kinds
    of subscribers."""
    if topic.endswith("/tf_static") or message_type in (
        "nav_msgs/msg/OccupancyGrid",
        "visualization_msgs/msg/MarkerArray",
    ):
        return LATCHED
    return TRANSFORMS if topic.endswith("/tf") else Quality(depth=50)


def mismatch(offered: Quality, requested: Quality) -> str | None:
    """Why a subscriber receives nothing from a publisher, and which side must change; None if it does."""
    if requested.reliable and not offered.reliable:
        return "it is published best effort, but reliable delivery is requested: publish it reliable"
    if requested.latched and not offered.latched:
        return "it is published volatile, but transient local is requested: publish it transient local"
    return None
