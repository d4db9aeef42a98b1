"""The topics of a bag: their rates, gaps and clocks, what each is good for, and the choice of a sensor."""

from __future__ import annotations

import math
import re
import struct
from array import array
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from gmmtorch.datasets.packets.sweeps import SINGLE_PACKETS, is_lidar
from gmmtorch.datasets.ros.bag_reader import BagReader, Topic
from gmmtorch.datasets.ros.message_decoder import ARRAY, BASE, NAME, SEQUENCE
from gmmtorch.datasets.trajectory import NANOSECONDS
from gmmtorch.errors import DataError, InvalidArgumentError

TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
POSE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
INFO_TYPE = "sensor_msgs/msg/CameraInfo"
IMU_TYPE = "sensor_msgs/msg/Imu"
_LISTS = {"sensor_msgs/msg/PointCloud": "points"}
_IMAGE, _COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_REALSENSE = re.compile(r"/device_\d+/sensor_\d+(?=/)")  # the name of a sensor in the files of librealsense
_DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1")

CLOUD, LIST, PACKETS, LASER, ECHOES, DEPTH, COMPRESSED = (
    "cloud",
    "list of points",
    "lidar packets",
    "laser",
    "laser with echoes",
    "depth image",
    "compressed depth image",
)
LASERS = (LASER, ECHOES)
_PREFERENCE = (CLOUD, LIST, PACKETS, *LASERS, DEPTH, COMPRESSED)
_KINDS = {
    "sensor_msgs/msg/PointCloud2": CLOUD,
    "sensor_msgs/msg/LaserScan": LASER,
    "sensor_msgs/msg/MultiEchoLaserScan": ECHOES,
}


class Sensor(NamedTuple):
    """A topic of a sensor. kind: one of the constants above. field: of the list, for `LIST`."""

    topic: Topic
    kind: str
    field: str = ""

    @property
    def is_camera(self) -> bool:
        """Whether its messages are depth images."""
        return self.kind in (DEPTH, COMPRESSED)


def choose_sensor(reader: BagReader, wanted: str | None) -> Sensor:
    """The topic `wanted`, or else the only one of the most preferred kind that the bag has.

    Kinds in order: clouds, lists of points, packets of lidars, lasers, depth images. Raises `DataError` or
    `InvalidArgumentError`, which list the topics, if there is none, or a choice.
    """
    named = [topic for topic in reader.topics if topic.name == wanted]
    if wanted is not None and not named:
        raise InvalidArgumentError(
            f"‹topic›={wanted} is not in {reader.path}, whose topics are {listed(reader.topics)}. "
            "Choose another ‹topic›."
        )
    if len(named) > 1:
        raise DataError(
            f"{reader.path}: topic {wanted} has messages of {len(named)} types: {listed(named)}. Choose "
            "another ‹topic›, or write each type to a topic of its own."
        )
    found = sensors(reader, named)
    if not found:
        what = f"‹topic›={wanted} is not" if wanted else "has no topic of"
        remedy = "Choose another ‹topic›." if wanted else "Record such a topic."
        raise DataError(
            f"{reader.path} {what} a range sensor with messages (PointCloud2, LaserScan, depth Image, a "
            f"list of points, or packets of a lidar). Its topics are {listed(reader.topics)}. {remedy}"
        )
    kind = min((sensor.kind for sensor in found), key=_PREFERENCE.index)
    found = [sensor for sensor in found if sensor.kind == kind]
    if len(found) > 1:
        topics = [sensor.topic for sensor in found]
        raise InvalidArgumentError(
            f"{reader.path} has {len(found)} topics of a range sensor: {listed(topics)}. Choose one: "
            f"‹topic›={topics[0].name}, or several of one robot: "
            f"‹topic›=[{','.join(topic.name for topic in topics)}]."
        )
    return found[0]


def sensors(reader: BagReader, topics: Sequence[Topic] = ()) -> list[Sensor]:
    """The range sensors with messages among some topics, or among all."""
    chosen = [topic for topic in topics or reader.topics if topic.n_messages]
    return [sensor for topic in chosen if (sensor := _sensor(reader, topic)) is not None]


def listed(topics: list[Topic]) -> str:
    """Topics with types and counts, for messages."""
    return "; ".join(f"{t.name} ({t.type}, {t.n_messages} messages)" for t in topics) or "none"


def _sensor(reader: BagReader, topic: Topic) -> Sensor | None:
    if topic.type in _KINDS:
        return Sensor(topic, _KINDS[topic.type])
    if topic.type in _LISTS:
        return Sensor(topic, LIST, _LISTS[topic.type])
    if topic.type in (_IMAGE, _COMPRESSED_IMAGE):
        return _camera(reader, topic)
    if topic.type in SINGLE_PACKETS:  # also of the IMU in the lidar
        return Sensor(topic, PACKETS) if next(reader.messages([topic.name]), None) else None
    if not topic.type.startswith(("sensor_msgs/", "std_msgs/", "geometry_msgs/", "nav_msgs/")):
        for name, desc in reader.fields(topic.type) if _has_header(reader, topic.type) else ():
            inner = _fields_in_list(reader, desc)
            are_numbers = all(kind == BASE and content[0] != "string" for kind, content in inner.values())
            if are_numbers and {"x", "y", "z"} <= inner.keys():
                return Sensor(topic, LIST, name)
            kind, content = inner.get("data", (BASE, ("string", 0)))
            are_bytes = kind in (ARRAY, SEQUENCE) and content[0] == (BASE, ("uint8", 0))
            if name == "packets" and "stamp" in inner and are_bytes:
                return Sensor(topic, PACKETS) if _is_of_known_lidar(reader, topic) else None
    return None


def _is_of_known_lidar(reader: BagReader, topic: Topic) -> bool:
    """Whether the first message has packets of a lidar that is read, or none or a damaged one."""
    first = next(reader.messages([topic.name]), None)
    try:
        packets = reader.decode(first)["packets"] if first is not None else []
    except DataError:
        return True
    return not packets or is_lidar(bytes(packets[0]["data"][: packets[0].get("size")]))


def _fields_in_list(reader: BagReader, desc: Any) -> dict[str, Any]:
    """The fields of the messages in a list; empty if a field is none."""
    is_list = desc[0] == SEQUENCE and desc[1][0][0] == NAME
    return dict(reader.fields(desc[1][0][1])) if is_list else {}


def _has_header(reader: BagReader, message_type: str) -> bool:
    return [kind for _, kind in reader.fields(message_type)[:1]] == [(NAME, "std_msgs/msg/Header")]


def _camera(reader: BagReader, topic: Topic) -> Sensor | None:
    """A camera whose first image is a depth."""
    first = next(reader.messages([topic.name]), None)
    if first is None:
        return None
    try:
        message = reader.decode(first)
    except DataError:
        return None
    if topic.type == _IMAGE:
        return Sensor(topic, DEPTH) if message["encoding"] in _DEPTH_ENCODINGS else None
    return Sensor(topic, COMPRESSED) if "compressedDepth" in message["format"] else None


def choose_camera_info(reader: BagReader, image: str) -> str:
    """The topic of the camera parameters: the one that shares most of the image topic's name."""
    infos = [topic.name for topic in reader.topics if topic.type == INFO_TYPE and topic.n_messages]
    best = nearest_names(infos, image)
    if len(best) != 1:
        raise InvalidArgumentError(
            f"{reader.path}: the camera of the images of {image} is not clear; topics of type CameraInfo are "
            f"{', '.join(infos) or 'none'}. State ‹intrinsics›=[fx,fy,cx,cy] in pixels, without distortion."
        )
    return best[0]


def stated_unit(reader: BagReader, image: str) -> float | None:
    """Metres per unit of depth images that a RealSense camera's own recorder wrote, which states it as an
    option of the sensor; None for others. Raises `DataError` if it is no length."""
    sensor = _REALSENSE.match(image)
    topics = [f"{sensor[0]}/option/{name}/value" for name in ("Depth_Units", "Depth Units")] if sensor else []
    message = next(reader.messages(topics), None)
    if message is None:
        return None
    unit = reader.decode(message).get("data")
    if not isinstance(unit, float) or not 0 < unit < math.inf:
        raise DataError(
            f"{reader.path}: {message.topic} states {unit} as the metres per unit of depth images; state "
            "‹depth_scale›."
        )
    return unit


def choose_imu(reader: BagReader) -> str:
    """The topic of an IMU with most messages: every one that TF connects with the sensor has its turns."""
    found = [topic for topic in reader.topics if topic.type == IMU_TYPE and topic.n_messages]
    if not found:
        raise InvalidArgumentError(
            f"motion=imu cannot be used: {reader.path} has no topic of type sensor_msgs/Imu with messages. "
            "Record one, or predict with ‹motion›=constant or ‹motion›=dataset."
        )
    return max(found, key=lambda topic: topic.n_messages).name


def nearest_names(names: list[str], topic: str) -> list[str]:
    """The names that share most of a topic's name: its first parts."""

    def shared(name: str) -> int:
        pairs = zip(name.split("/"), topic.split("/"), strict=False)
        return next((i for i, (a, b) in enumerate(pairs) if a != b), 0)

    return [name for name in names if shared(name) == max(map(shared, names))]


_HEADER_STAMP, _TF_STAMP = 4, 8  # bytes before the stamp of a header, and of the first transform


class TopicFacts(NamedTuple):
    """A topic of a bag.

    topic: its name, type and number of messages. use: what gmmtorch can do with it; "" if nothing.
    rate: messages per second; None with fewer than two. gap: the longest time (s) between two messages.
    offset: seconds from the stamp of a message to its recording, the median; None without stamps.
    """

    topic: Topic
    use: str
    rate: float | None
    gap: float | None
    offset: float | None


class BagFacts(NamedTuple):
    """The topics of a bag by name, times (ns) of its first and last message, and what damage has taken."""

    topics: list[TopicFacts]
    first: int
    last: int
    damage: str


def bag_facts(reader: BagReader) -> BagFacts:
    """The facts of a bag, from one pass over all of its messages. Raises `DataError` if it is damaged."""
    keys = [(topic.name, topic.type) for topic in reader.topics]
    places = {(name, kind): _stamp_place(reader, name, kind) for name, kind in keys}
    times = {key: array("q") for key in keys}
    offsets = {key: array("q") for key in keys}
    for message in reader.messages({name for name, _ in keys}):
        key = message.topic, message.type
        times[key].append(message.time)
        place, data = places[key], message.data
        if place is not None and len(data) >= place + 8:
            order = ">" if not reader.is_ros1 and data[1] == 0 else "<"
            seconds, nanoseconds = struct.unpack_from(f"{order}II", data, place)
            offsets[key].append(message.time - seconds * NANOSECONDS - nanoseconds)
    uses = _uses(reader)
    found = [
        _facts(topic, uses.get(topic, ""), times[key], offsets[key])
        for topic, key in zip(reader.topics, keys, strict=True)
    ]
    ends = [(min(one), max(one)) for one in times.values() if one]
    first, last = (min(end[0] for end in ends), max(end[1] for end in ends)) if ends else (0, 0)
    return BagFacts(found, first, last, reader.damage)


def _facts(topic: Topic, use: str, times: array[int], offsets: array[int]) -> TopicFacts:
    steps = np.diff(np.sort(np.array(times, np.int64))) / NANOSECONDS
    total = float(steps.sum())
    rate = len(steps) / total if total > 0 else None
    offset = float(np.median(np.array(offsets, np.int64))) / NANOSECONDS if offsets else None
    return TopicFacts(topic, use, rate, float(steps.max()) if rate else None, offset)


def _stamp_place(reader: BagReader, topic: str, message_type: str) -> int | None:
    """The byte at which messages have the stamp of a measurement; None if they have none."""
    if topic.endswith("static"):
        return None
    if message_type in TF_TYPES:
        return _TF_STAMP
    return _HEADER_STAMP if _has_header(reader, message_type) else None


def _uses(reader: BagReader) -> dict[Topic, str]:
    """What each topic with messages is for."""
    uses = {**dict.fromkeys(TF_TYPES, "poses (TF)"), **dict.fromkeys(POSE_TYPES, "poses, if ‹poses›={}")}
    uses |= {IMU_TYPE: "turns, if ‹motion›=imu", INFO_TYPE: "camera of depth images"}
    found = {sensor.topic: f"scans ({sensor.kind})" for sensor in sensors(reader)}
    known = [topic for topic in reader.topics if topic.n_messages and topic.type in uses]
    return {**found, **{topic: uses[topic.type].format(topic.name) for topic in known}}
