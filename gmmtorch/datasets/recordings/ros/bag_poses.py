"""The poses of a bag's scans: one pass over the bag collects the headers of the sensor and all transforms."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gmmtorch.datasets.recordings.ros.bag_reader import BagReader, RawMessage
from gmmtorch.datasets.recordings.ros.bag_topics import CLOUD, LIST, POSE_TYPES, TF_TYPES, Sensor, listed
from gmmtorch.datasets.recordings.ros.pose_sources import (
    BodyPoses,
    PosesByIndex,
    PoseSource,
    RegisteredPoses,
    Standing,
    TfPoses,
    mount_matrix,
    pose_sample,
)
from gmmtorch.datasets.recordings.ros.transform_tree import TransformTree
from gmmtorch.datasets.recordings.trajectory import Trajectory, read_trajectory
from gmmtorch.errors import DataError, InvalidArgumentError

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
        self._extrinsic = mount_matrix(extrinsic)
        self._pose_topic = poses if poses in {t.name for t in reader.topics} else None
        self._file = None
        transforms = [t.name for t in reader.topics if t.type in TF_TYPES and t.n_messages]
        if poses in (None, "tf"):
            if not transforms:
                raise DataError(
                    f"{reader.path} has no TF, so the sensor's poses are unknown. {self._remedy()}"
                )
        elif self._pose_topic is not None:
            self._check_pose_topic()
        elif poses != "standing":
            self._file = Path(str(poses)).expanduser()
            if not self._file.is_file():
                raise InvalidArgumentError(
                    f"‹poses›={poses} is neither tf, standing, a topic of the bag, nor a file. "
                    f"{self._remedy()}"
                )
        self.heads: list[tuple[int, bytes]] = []
        self.tree = TransformTree()
        self._samples: list[tuple[int, np.ndarray]] = []
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
            time, matrix, *pose_frames = pose_sample(content)
        except (DataError, ValueError, KeyError, TypeError):  # also a definition in the bag that is damaged
            return  # a transform that is missed leaves a gap, which `max_gap` notices
        self._samples.append((time, matrix))
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

    def _check_pose_topic(self) -> None:
        types = [t.type for t in self._reader.topics if t.name == self._pose_topic]
        if not set(types) <= set(POSE_TYPES):
            raise InvalidArgumentError(
                f"‹poses›={self._pose_topic} has messages of type {', '.join(types)}, which are not "
                f"poses. {self._remedy()}"
            )

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
            times, matrices = [list(column) for column in zip(*self._samples, strict=True)] or ([], [])
            stamps, poses = np.array(times, np.int64), np.array(matrices).reshape(-1, 4, 4)
            trajectory = Trajectory.from_samples(stamps, poses)
            sensors = frames if seen_from is None else [seen_from]
            mounts = {frame: self._mount(frame, where) if mount is None else mount for frame in sensors}
            source = BodyPoses(trajectory, mounts, self.max_gap, f"topic {self._pose_topic}")
            return source if seen_from is None else RegisteredPoses(source, seen_from, Standing())
        if len(frames) > 1:
            best = next(frame for frame, _ in frames.most_common() if frame)
            raise InvalidArgumentError(
                f"{where}: several sensors share the topic, with frames {_counted(frames)}; choose one: "
                f"‹sensor_frame›={best}."
            )
        if self._file is None:
            return Standing()
        if seen_from is not None:
            raise InvalidArgumentError(
                f"‹poses›={self._poses} would move the points of {where} again: they are in the fixed "
                f"frame {first} already. Choose ‹poses›=tf, or ‹sensor_frame›={first} if that is "
                "the frame of the sensor."
            )
        fixed = np.eye(4) if mount is None else mount
        trajectory = read_trajectory(self._file, len(self.heads))
        if not trajectory.has_times:
            return PosesByIndex({r.stamp: trajectory.matrices[r.number] for r in records}, fixed)
        return BodyPoses(trajectory, dict.fromkeys(frames, fixed), self.max_gap, str(self._file))

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

    def _mount(self, frame: str, where: str) -> np.ndarray:
        """body ← sensor from the static transforms."""
        body = self._frames.most_common(1)[0][0][1] if self._frames else ""
        if body in ("", frame):
            return np.eye(4)
        try:
            chain = self.tree.chain(frame, body) if frame in self.tree.frames else []
        except DataError:
            chain = []
        if not chain or self.tree.is_moving(chain):
            raise DataError(
                f"{where}: ‹poses›={self._pose_topic} states poses of frame {body}, but TF has no "
                f"static transform from there to the sensor's frame {frame or '(unnamed)'}. State the "
                "sensor's pose on the body: ‹extrinsic›=[x,y,z,qx,qy,qz,qw], which is [0,0,0,0,0,0,1] "
                "if they are the same."
            )
        matrix: np.ndarray = self.tree.lookup(chain, np.zeros(1, np.int64), np.inf).matrices[0]
        return matrix


def _counted(frames: Counter[str]) -> str:
    """Frames with the numbers of their messages, for errors."""
    return ", ".join(f"{frame or '(unnamed)'} ({n} scans)" for frame, n in frames.most_common())
