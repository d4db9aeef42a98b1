"""Where a bag's scans get their poses: TF, a topic, a trajectory file, or a sensor that stands still.

One pass over the bag collects the headers of the sensor and all transforms.
"""

from __future__ import annotations

import logging
from array import array
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gmmtorch.datasets.ros.bag_reader import BagReader, RawMessage
from gmmtorch.datasets.ros.bag_topics import CLOUD, LIST, POSE_TYPES, TF_TYPES, Sensor, listed
from gmmtorch.datasets.ros.transform_tree import (
    TransformTree,
    frame_name,
    pose_numbers,
    stamp_of,
    trajectory_of,
)
from gmmtorch.datasets.trajectory import NANOSECONDS, PosesAt, Trajectory, read_trajectory
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.pose import Pose


class PoseSource:
    """Poses of a sensor in a fixed frame; here, of one that does not move: its frame is the world."""

    can_deskew = False

    def at(self, times: np.ndarray, frame: str) -> PosesAt:
        """Poses of the sensor frame at times (M,) in ns."""
        return PosesAt(Pose.identity(3, len(times)), np.ones(len(times), bool))

    def explain(self, time: int, frame: str) -> str:
        """Why the pose at a time is unknown, for messages."""
        return "all poses are known"


class TfPoses(PoseSource):
    """Poses from TF.

    top: the fixed frame; None: the root of the tree of the sensor's frame. where: the topic, for messages.
    """

    can_deskew = True

    def __init__(self, tree: TransformTree, top: str | None, max_gap: float, where: str) -> None:
        self._tree, self._max_gap, self._where = tree, max_gap, where
        self._top = None if top is None else frame_name(top)
        self._chains: dict[str, list[str]] = {}

    @property
    def top(self) -> str | None:
        """The fixed frame: the one that was chosen, or the root above a sensor."""
        return self._top or next((chain[-1] for chain in self._chains.values()), None)

    def chain(self, frame: str) -> list[str]:
        """Frames from the sensor's to the fixed one. Raises `DataError` if TF does not connect them."""
        if frame not in self._chains:
            if frame not in self._tree.frames:
                raise DataError(
                    f"{self._where}: TF has no frame {frame or '(unnamed)'}, in which the sensor measures; "
                    f"its frames are {self._tree.describe()}. State which of them is the sensor's: "
                    "‹sensor_frame›=NAME, or choose other poses: ‹poses›=TOPIC, FILE or standing."
                )
            try:
                self._chains[frame] = self._tree.chain(frame, self._top)
            except DataError as error:
                raise DataError(f"{self._where}: {error}") from error
        return self._chains[frame]

    def at(self, times: np.ndarray, frame: str) -> PosesAt:
        return self._tree.lookup(self.chain(frame), times, self._max_gap)

    def explain(self, time: int, frame: str) -> str:
        return self._tree.unknown_step(self.chain(frame), time, self._max_gap)


class BodyPoses(PoseSource):
    """Poses of a body from a trajectory (world ← body), and those of sensors on it (body ← sensor) by frame.

    max_gap: see `Trajectory.at`. name: for messages.
    """

    can_deskew = True

    def __init__(self, trajectory: Trajectory, mounts: dict[str, Pose], max_gap: float, name: str) -> None:
        self._trajectory, self._mounts, self._max_gap, self._name = trajectory, mounts, max_gap, name

    def at(self, times: np.ndarray, frame: str) -> PosesAt:
        poses = self._trajectory.at(times, self._max_gap)
        return poses._replace(poses=poses.poses @ self._mounts[frame])

    def explain(self, time: int, frame: str) -> str:
        times = self._trajectory.times / NANOSECONDS
        if len(times) == 0:
            return f"{self._name} has no pose"
        return f"{self._name} has poses from {times[0]:.3f} to {times[-1]:.3f} s"


class RegisteredPoses(PoseSource):
    """Poses of a sensor whose points are in a fixed frame already, as SLAM systems publish them.

    source: poses of the sensor. sensor: its frame. fixed: poses of the frame of the points.
    """

    def __init__(self, source: PoseSource, sensor: str, fixed: PoseSource) -> None:
        self.sensor, self._source, self._fixed = sensor, source, fixed

    def at(self, times: np.ndarray, frame: str) -> PosesAt:
        poses = self._source.at(times, self.sensor)
        return poses._replace(known=poses.known & self._fixed.at(times, frame).known)

    def of_points(self, time: int, frame: str) -> Pose:
        """The pose at a known time (ns) of the frame of the points."""
        return self._fixed.at(np.array([time]), frame).poses[0]

    def explain(self, time: int, frame: str) -> str:
        return self._source.explain(time, self.sensor)


def pose_sample(message: dict[str, Any]) -> tuple[int, list[float], str, str]:
    """(time in ns, `pose_numbers` of world ← body, frames of world and body or "") of a message of a pose
    topic.
    """
    time = stamp_of(message["header"])
    if "transform" in message:
        content = message["transform"]
        numbers = pose_numbers(content["translation"], content["rotation"])
    else:
        content = message["pose"]
        content = content.get("pose", content)  # with covariance
        numbers = pose_numbers(content["position"], content["orientation"])
    world, body = message["header"]["frame_id"], message.get("child_frame_id", "")
    return time, numbers, frame_name(world), frame_name(body)


def mount_of(extrinsic: list[float] | None) -> Pose | None:
    """body ← sensor from x, y, z, qx, qy, qz, qw. Raises `InvalidArgumentError`."""
    if extrinsic is None:
        return None
    try:
        numbers = [float(value) for value in extrinsic]
        if len(numbers) != 7:
            raise ValueError
        return Pose.from_quaternion(numbers[:3], numbers[3:])
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(
            f"‹extrinsic›={extrinsic} is not the sensor's pose on the body: give x, y, z (m), qx, qy, qz, qw."
        ) from error


_log = logging.getLogger(__name__)
_HEAD_BYTES = 1024
_STAMP_BYTES = 12  # in which headers differ: the CDR head and the stamp, or the number and the stamp of ROS 1


class Record(NamedTuple):
    """A message of the sensor. number: in its topic. time: of recording; stamp: of measurement, in ns."""

    number: int
    time: int
    stamp: int
    frame: str


class BagSurvey:
    """What one pass over a bag finds. The options are those of `open_rosbag`.

    Attributes:
        heads: (time of recording in ns, first bytes) of each message of the sensor.
        tree: the transforms of TF.
        max_gap: longest time in seconds between two of them that are interpolated.

    Raises `DataError` or `InvalidArgumentError` if the bag cannot have the poses that the options choose.
    """

    def __init__(
        self,
        reader: BagReader,
        sensor: Sensor,
        info_topic: str | None,
        poses: str | None,
        frame: str | None,
        extrinsic: list[float] | None,
        max_gap: float,
    ) -> None:
        topic = sensor.topic.name
        self._reader, self._topic, self._info_topic = reader, topic, info_topic
        self._is_cloud = sensor.kind in (CLOUD, LIST)
        self._infos: dict[bytes, dict[str, Any]] = {}
        self._poses, self._frame, self.max_gap = poses, frame, max_gap
        self._extrinsic = mount_of(extrinsic)
        self._pose_topic = poses if poses in {t.name for t in reader.topics} else None
        self._file = None
        transforms = [t.name for t in reader.topics if t.type in TF_TYPES and t.n_messages]
        if poses in (None, "tf"):
            if not transforms:
                raise DataError(
                    f"{reader.path} has no TF, so the sensor's poses are unknown. {self._remedy()}"
                )
        elif self._pose_topic is not None:
            types = [t.type for t in reader.topics if t.name == poses]
            if not set(types) <= set(POSE_TYPES):
                raise InvalidArgumentError(
                    f"‹poses›={poses} has messages of type {', '.join(types)}, which are not poses. "
                    f"{self._remedy()}"
                )
        elif poses != "standing":
            self._file = Path(str(poses)).expanduser()
            if not self._file.is_file():
                raise InvalidArgumentError(
                    f"‹poses›={poses} is neither tf, standing, a topic of the bag, nor a file. "
                    f"{self._remedy()}"
                )
        self.heads: list[tuple[int, bytes]] = []
        self.tree = TransformTree()
        self._samples = array("q"), array("d")  # as of TF: a list of poses would take far more memory
        self._frames: Counter[tuple[str, str]] = Counter()  # of world and body
        for message in reader.messages(
            {topic, *transforms, *(name for name in (info_topic, self._pose_topic) if name)}
        ):
            self._note(message)

    def _note(self, message: RawMessage) -> None:
        if message.topic == self._topic:
            self.heads.append((message.time, message.data[:_HEAD_BYTES]))
            return
        try:
            if message.topic == self._info_topic:
                without_stamp = message.data[_STAMP_BYTES:]
                if without_stamp not in self._infos and len(self._infos) < 2:
                    self._infos[without_stamp] = self._reader.decode(message)
                return
            content = self._reader.decode(message)
            if message.type in TF_TYPES:
                self.tree.add(content, static=message.topic.endswith("tf_static"))
                return
            time, numbers, *pose_frames = pose_sample(content)
        except (DataError, ValueError, KeyError, TypeError):  # also a definition in the bag that is damaged
            return  # a transform that is missed leaves a gap, which `max_gap` notices
        self._samples[0].append(time)
        self._samples[1].extend(numbers)
        self._frames[pose_frames[0], pose_frames[1]] += 1

    def camera_info(self) -> dict[str, Any] | None:
        """The decoded CameraInfo; None without its topic. Raises `DataError` if it changes."""
        if self._info_topic is not None and len(self._infos) != 1:
            what = "changes" if self._infos else "cannot be decoded"
            raise DataError(
                f"{self._reader.path}: the camera info of {self._info_topic} {what}. State the images' own: "
                "‹intrinsics›=[fx,fy,cx,cy] in pixels, without distortion."
            )
        return next(iter(self._infos.values()), None)

    @property
    def _body(self) -> str:
        """The frame whose poses the topic states; "" if it does not name it."""
        return self._frames.most_common(1)[0][0][1] if self._frames else ""

    @property
    def places_sensor(self) -> bool:
        """Whether TF says where on the robot the sensor is. Otherwise the poses are those of any sensor."""
        if self._poses in (None, "tf"):
            return True
        return self._pose_topic is not None and self._extrinsic is None and self._body != ""

    def _remedy(self) -> str:
        topics = [t for t in self._reader.topics if t.type in POSE_TYPES and t.n_messages]
        return (
            "Choose ‹poses›=standing for a sensor that does not move, ‹poses›=FILE for a TUM or "
            f"KITTI trajectory, or ‹poses›=TOPIC; topics of poses: {listed(topics)}."
        )

    def of_frame(self, records: list[Record], wanted: str, where: str) -> list[Record]:
        """The messages of the frame of the sensor that is stated.

        If none has it, those without a frame, or of the only one that TF does not have, are taken to be in
        it. Points in a fixed frame above it stay there. Raises `InvalidArgumentError`.
        """
        frames = Counter(record.frame for record in records)
        if wanted in frames:
            return [record for record in records if record.frame == wanted]
        if len(frames) == 1 and self._seen_from(next(iter(frames)), wanted) is not None:
            return records
        unknown = {""} if "" in frames else frames.keys() - set(self.tree.frames)
        if "" in unknown or (len(unknown) == 1 and wanted in self.tree.frames):
            return [record._replace(frame=wanted) for record in records if record.frame in unknown]
        best = frames.most_common(1)[0][0]
        raise InvalidArgumentError(
            f"‹sensor_frame›={wanted} is not a frame of {where}, whose frames are {_counted(frames)}; "
            f"choose one: ‹sensor_frame›={best}."
        )

    def _seen_from(self, frame: str, wanted: str | None) -> str | None:
        """The frame of the sensor if points of `frame` are in a fixed frame already, otherwise None.

        wanted: the frame of the sensor that is stated.
        """
        if not self._is_cloud or frame in ("", wanted):
            return None
        if self._pose_topic is not None:
            world, body = self._frames.most_common(1)[0][0] if self._frames else ("", "")
            return (body if wanted is None else wanted) if frame == world != body else None
        if wanted is None:
            return self.tree.traveller(frame)
        above = self.tree.above(wanted)
        is_seen = frame in above and self.tree.is_moving(above[: above.index(frame) + 1])
        return wanted if is_seen else None

    def source(self, records: Sequence[Record], where: str, sensor_frame: str | None = None) -> PoseSource:
        """The poses of the sensor, whose frame may be stated.

        Raises `DataError` if the sensor's frames are not connected to them.
        """
        frames = Counter(record.frame for record in records)
        mount, first = self._extrinsic, next(iter(frames))
        seen_from = self._seen_from(first, sensor_frame) if len(frames) == 1 else None
        if seen_from is not None and sensor_frame is None and self._poses != "standing":
            _log.warning(
                "%s: points are in the fixed frame %s already, and seen from %s. If %s is the frame of the "
                "sensor instead, choose sensor_frame=%s.",
                *(where, first, seen_from or "the poses", first, first),
            )
        if self._poses in (None, "tf"):
            return self._from_tf(frames, where, seen_from, first if sensor_frame is None else None)
        if self._pose_topic is not None:
            trajectory = trajectory_of(*self._samples)
            sensors = frames if seen_from is None else [seen_from]
            mounts = {frame: self._mount(frame, where) if mount is None else mount for frame in sensors}
            source = BodyPoses(trajectory, mounts, self.max_gap, f"topic {self._pose_topic}")
            return source if seen_from is None else RegisteredPoses(source, seen_from, PoseSource())
        if len(frames) > 1:
            best = next(frame for frame, _ in frames.most_common() if frame)
            raise InvalidArgumentError(
                f"{where}: several sensors share the topic, with frames {_counted(frames)}; choose one: "
                f"‹sensor_frame›={best}."
            )
        if self._file is None:
            return PoseSource()
        if seen_from is not None:
            raise InvalidArgumentError(
                f"‹poses›={self._poses} would move the points of {where} again: they are in the fixed "
                f"frame {first} already. Choose ‹poses›=tf, or ‹sensor_frame›={first} if that is "
                "the frame of the sensor."
            )
        mounts = dict.fromkeys(frames, Pose.identity(3) if mount is None else mount)
        trajectory = read_trajectory(self._file, len(self.heads))
        if not trajectory.has_times:
            rows, stamps = [r.number for r in records], np.array([r.stamp for r in records])
            trajectory = Trajectory.from_samples(stamps, trajectory.poses[rows])
            source = BodyPoses(trajectory, mounts, np.inf, str(self._file))
            source.can_deskew = False  # poses are known at the stamps of scans only
            return source
        return BodyPoses(trajectory, mounts, self.max_gap, str(self._file))

    def _from_tf(
        self, frames: Counter[str], where: str, seen_from: str | None, fixed: str | None
    ) -> PoseSource:
        if seen_from is not None:
            source = TfPoses(self.tree, self._frame or fixed, self.max_gap, where)
            return RegisteredPoses(source, seen_from, source)
        source = TfPoses(self.tree, self._frame, self.max_gap, where)
        chains = [source.chain(frame) for frame in frames]
        chosen = self._poses is not None or self._frame is not None
        if not chosen and not any(self.tree.is_moving(chain) for chain in chains):
            raise DataError(
                f"{where}: TF has only static transforms from frame {chains[0][0]} up to {chains[0][-1]}, so "
                f"the sensor's motion is unknown. {self._remedy()} If points are in {chains[0][0]} already, "
                "as SLAM systems publish them, state the frame of the sensor: ‹sensor_frame›=NAME."
            )
        return source

    def _mount(self, frame: str, where: str) -> Pose:
        """body ← sensor from the static transforms."""
        body, chain = self._body, list[str]()
        if body in ("", frame):
            return Pose.identity(3)
        with suppress(DataError):
            chain = self.tree.chain(frame, body) if frame in self.tree.frames else []
        if not chain or self.tree.is_moving(chain):
            raise DataError(
                f"{where}: ‹poses›={self._pose_topic} states poses of frame {body}, but TF has no "
                f"static transform from there to the sensor's frame {frame or '(unnamed)'}. State the "
                "sensor's pose on the body: ‹extrinsic›=[x,y,z,qx,qy,qz,qw], which is [0,0,0,0,0,0,1] "
                "if they are the same."
            )
        return self.tree.lookup(chain, np.zeros(1, np.int64), np.inf).poses[0]


def _counted(frames: Counter[str]) -> str:
    """Frames with the numbers of their messages, for errors."""
    return ", ".join(f"{frame or '(unnamed)'} ({n} scans)" for frame, n in frames.most_common())
