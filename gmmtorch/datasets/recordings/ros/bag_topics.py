"""Which topics of a bag are sensors or an IMU, and the choice between them."""

from __future__ import annotations

from typing import Any, NamedTuple

from gmmtorch.datasets.recordings.ros.bag_reader import BagReader, Topic
from gmmtorch.datasets.recordings.ros.message_decoder import BASE, NAME, SEQUENCE
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
_IMAGE, _COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1")

CLOUD, LIST, LASER, DEPTH, COMPRESSED = (
    "cloud",
    "list of points",
    "laser",
    "depth image",
    "compressed depth image",
)
_PREFERENCE = (CLOUD, LIST, LASER, DEPTH, COMPRESSED)


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

    Kinds in order: clouds, lists of points, lasers, depth images. Raises `DataError` or
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
    found = [
        sensor for topic in named or reader.topics if topic.n_messages and (sensor := _sensor(reader, topic))
    ]
    if not found:
        what = f"‹topic›={wanted} is not" if wanted else "has no topic of"
        remedy = "Choose another ‹topic›." if wanted else "Record such a topic."
        raise DataError(
            f"{reader.path} {what} a range sensor with messages (PointCloud2, LaserScan, depth Image, or a "
            f"list of points). Its topics are {listed(reader.topics)}. {remedy}"
        )
    kind = min((sensor.kind for sensor in found), key=_PREFERENCE.index)
    found = [sensor for sensor in found if sensor.kind == kind]
    if len(found) > 1:
        raise InvalidArgumentError(
            f"{reader.path} has {len(found)} topics of a range sensor: "
            f"{listed([sensor.topic for sensor in found])}. Choose one: ‹topic›={found[0].topic.name}."
        )
    return found[0]


def listed(topics: list[Topic]) -> str:
    """Topics with types and counts, for messages."""
    return "; ".join(f"{t.name} ({t.type}, {t.n_messages} messages)" for t in topics) or "none"


def _sensor(reader: BagReader, topic: Topic) -> Sensor | None:
    if topic.type == "sensor_msgs/msg/PointCloud2":
        return Sensor(topic, CLOUD)
    if topic.type == "sensor_msgs/msg/LaserScan":
        return Sensor(topic, LASER)
    if topic.type in (_IMAGE, _COMPRESSED_IMAGE):
        return _camera(reader, topic)
    if not topic.type.startswith(("sensor_msgs/", "std_msgs/", "geometry_msgs/", "nav_msgs/")):
        fields = reader.fields(topic.type)
        if fields and fields[0][1] == (NAME, "std_msgs/msg/Header"):
            for name, desc in fields:
                if _is_list_of_points(reader, desc):
                    return Sensor(topic, LIST, name)
    return None


def _is_list_of_points(reader: BagReader, desc: Any) -> bool:
    if desc[0] != SEQUENCE or desc[1][0][0] != NAME:
        return False
    fields = dict(reader.fields(desc[1][0][1]))
    numbers = all(inner[0] == BASE and inner[1][0] != "string" for inner in fields.values())
    return numbers and {"x", "y", "z"} <= fields.keys()


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


def choose_camera_info(reader: BagReader, image: str, wanted: str | None) -> str:
    """The topic of the camera parameters: `wanted`, or the one that shares most of the image topic's name."""
    infos = [topic.name for topic in reader.topics if topic.type == INFO_TYPE and topic.n_messages]
    if wanted in infos:
        return wanted
    best = nearest_names(infos, image)
    if wanted is not None or len(best) != 1:
        choice = f"Choose one: ‹camera_info›={best[0]}, or state" if best else "State"
        raise InvalidArgumentError(
            f"{reader.path}: ‹camera_info›={wanted} is not clear for the images of {image}; topics of "
            f"type CameraInfo are {', '.join(infos) or 'none'}. {choice} ‹intrinsics›=[fx,fy,cx,cy] in "
            "pixels, without distortion."
        )
    return best[0]


def choose_imu(reader: BagReader, wanted: str | None) -> str:
    """The topic `wanted`, or else the only one of an IMU. Raises `InvalidArgumentError`, which lists them."""
    found = [topic for topic in reader.topics if topic.type == IMU_TYPE and topic.n_messages]
    if wanted is None and len(found) > 1:
        raise InvalidArgumentError(
            f"{reader.path} has {len(found)} topics of an IMU: {listed(found)}. Choose one: "
            f"‹imu_topic›={found[0].name}."
        )
    chosen = [topic.name for topic in found if wanted in (None, topic.name)]
    if not chosen:
        what = "has no topic" if wanted is None else f"has no topic ‹imu_topic›={wanted}"
        raise InvalidArgumentError(
            f"motion=imu cannot be used: {reader.path} {what} of type sensor_msgs/Imu with messages, only "
            f"{listed(found)}. Record one, or predict with motion=constant or motion=dataset."
        )
    return chosen[0]


def nearest_names(names: list[str], topic: str) -> list[str]:
    """The names that share most of a topic's name: its first parts."""

    def shared(name: str) -> int:
        pairs = zip(name.split("/"), topic.split("/"), strict=False)
        return next((i for i, (a, b) in enumerate(pairs) if a != b), 0)

    return [name for name in names if shared(name) == max(map(shared, names))]
