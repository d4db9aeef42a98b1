"""Which live topic is the sensor, and its subscription."""

from __future__ import annotations

import time

from gmmtorch.datasets import CLOUD, COMPRESSED, DEPTH, INFO_TYPE, LASER, Ranges, Sensor, Topic, nearest_names
from gmmtorch.errors import GmmTorchError, InvalidArgumentError, arg
from gmmtorch.live.mapper.live_scans import LiveOptions, LiveScans
from gmmtorch.live.ros import Node
from gmmtorch.live.ros.node import reading

_KINDS = {
    "sensor_msgs/msg/PointCloud2": CLOUD,
    "sensor_msgs/msg/LaserScan": LASER,
    "sensor_msgs/msg/Image": DEPTH,
    "sensor_msgs/msg/CompressedImage": COMPRESSED,
}
_RANKS = list(_KINDS)
_POLL = 0.2  # s


def find_sensor(node: Node, wanted: str | None, wait: float) -> Sensor:
    """The topic `wanted`, or the only one of a range sensor; it is waited for up to `wait` seconds.

    Clouds come before lasers, and these before depth images, whose names contain "depth". Raises
    `GmmTorchError`, which lists the topics, if there is none, and `InvalidArgumentError` for another type or
    several topics.
    """
    name = None if wanted is None else node.names.resolve(wanted)
    end = time.monotonic() + wait
    while not (found := _sensors(node, name)) and time.monotonic() < end:
        node.spin_once(_POLL)
    topics = node.topics()
    listed = "; ".join(f"{topic} ({', '.join(types)})" for topic, types in topics.items()) or "none"
    if not found:
        what = "no topic of a range sensor" if name is None else f"no topic {name}"
        if name in topics:
            raise InvalidArgumentError(
                f"{arg('topic')}={name} has messages of type {', '.join(topics[name])}; give a topic of a "
                f"PointCloud2, a LaserScan or a depth Image. Published topics: {listed}."
            )
        raise GmmTorchError(
            f"there is {what} after {wait:g} s. Published topics: {listed}. If it is published, check "
            "ROS_DOMAIN_ID, the middleware, and that it is published on the interface of this node."
        )
    best = min(_RANKS.index(sensor.topic.type) for sensor in found)
    found = [sensor for sensor in found if _RANKS.index(sensor.topic.type) == best]
    if len(found) > 1:
        names = ", ".join(sensor.topic.name for sensor in found)
        raise InvalidArgumentError(
            f"there are {len(found)} topics of a range sensor: {names}. Choose one: "
            f"{arg('topic')}={found[0].topic.name}."
        )
    return found[0]


def _sensors(node: Node, name: str | None) -> list[Sensor]:
    return [
        Sensor(Topic(topic, message_type, 0), _KINDS[message_type])
        for topic, types in node.topics().items()
        for message_type in types
        if message_type in _KINDS and (topic == name if name else not _is_colour(topic, message_type))
    ]


def _is_colour(topic: str, message_type: str) -> bool:
    return message_type.endswith("Image") and "depth" not in topic.lower()


def open_scans(
    node: Node, sensor: Sensor, ranges: Ranges, options: LiveOptions, camera_info: str | None = None
) -> LiveScans:
    """The scans of a sensor, with the subscriptions that they need."""
    scans = LiveScans(sensor, node.transforms, ranges, options)
    if options.poses != "standing":
        node.listen_to_transforms()
    if sensor.is_camera and options.intrinsics is None:
        info = camera_info or _camera_info(node, sensor.topic.name)
        node.subscribe(info, INFO_TYPE, reading(scans.note_camera))
    node.subscribe(
        sensor.topic.name,
        sensor.topic.type,
        reading(lambda message: scans.receive(message, node.arrival.time, node.arrival.monotonic)),
    )
    return scans


def _camera_info(node: Node, image: str) -> str:
    infos = [topic for topic, types in node.topics().items() if INFO_TYPE in types]
    best = nearest_names(infos, image) if infos else []
    if len(best) != 1:
        raise InvalidArgumentError(
            f"{arg('camera_info')} is not clear for the images of {image}; topics of type CameraInfo are "
            f"{', '.join(infos) or 'none'}. Choose one, or state {arg('intrinsics')}=[fx,fy,cx,cy] in "
            "pixels, without distortion."
        )
    return best[0]
