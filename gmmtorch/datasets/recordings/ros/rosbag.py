"""ROS bags as data sets: the scans of one topic, with poses from TF, a topic of poses, or a file."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.base import Dataset, Ranges
from gmmtorch.datasets.recordings.ros import bag_topics, sensor_messages
from gmmtorch.datasets.recordings.ros.bag_poses import BagSurvey, PoseOptions
from gmmtorch.datasets.recordings.ros.bag_reader import BagReader, RawMessage
from gmmtorch.datasets.recordings.ros.sensor_messages import Reading
from gmmtorch.datasets.recordings.ros.transform_tree import frame_name, stamp_of
from gmmtorch.datasets.recordings.trajectory import NANOSECONDS, in_plane, increasing
from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError, check_choice, check_whole
from gmmtorch.pinhole import back_project
from gmmtorch.scan import FARTHEST, Scan

HEADER = "std_msgs/msg/Header"
_LEVEL = math.cos(math.radians(10))
_SHORT_SKIP = 16
_MIN_PLANAR = 16
"""Fewer points at one height do not show that a cloud is the scan of a laser."""
_KNOTS = 1024
"""Poses per sweep for deskewing: of a sweep of 0.1 s, one for every 0.1 ms."""


class _Record(NamedTuple):
    """A message of the sensor. number: in its topic. time: of recording; stamp: of measurement, in ns."""

    number: int
    time: int
    stamp: int
    frame: str


def open_rosbag(
    path: str | Path,
    ranges: Ranges,
    stride: int = 1,
    topic: str | None = None,
    poses: str | None = None,
    frame: str | None = None,
    sensor_frame: str | None = None,
    extrinsic: list[float] | None = None,
    max_gap: float = 2.0,
    clock: str = "header",
    deskew: bool = True,
    camera_info: str | None = None,
    pixel_stride: int = 1,
) -> RosBag:
    """The scans of one topic of a bag; see docs/recordings.md.

    Args:
        path: .bag (ROS 1), .db3 or .mcap (ROS 2), or the folder of a ROS 2 bag.
        ranges, stride: see `Dataset`.
        topic: of the sensor; None: the only one of its kind.
        poses: "tf", "standing", a topic of poses, or a trajectory file; None: TF.
        frame: the fixed frame of TF; None: the root of the sensor's tree.
        sensor_frame: only messages of this frame are read.
        extrinsic: x, y, z, qx, qy, qz, qw of the sensor on the body whose poses a topic or file states.
        max_gap: longest time (s) between two poses that are interpolated.
        clock: "header", the stamps of the messages, or "received", the times of recording.
        deskew: whether points with times get the pose of their own time.
        camera_info: topic of the camera parameters of depth images.
        pixel_stride: every n-th pixel of every n-th row of depth images is used.
    """
    if path is None or str(path) == "":
        raise InvalidArgumentError(
            "dataset.path is not set; give a .bag, .mcap or .db3 file, or a bag's folder."
        )
    file = Path(path).expanduser()
    if not file.exists():
        raise MissingDataError(
            f"dataset.path={path} does not exist; looked for a ROS bag (.bag, .mcap, .db3)."
        )
    check_choice("dataset.clock", clock, ("header", "received"))
    if not max_gap > 0:
        raise InvalidArgumentError(f"dataset.max_gap={max_gap} must be a time above zero seconds.")
    reader = BagReader(file)
    sensor = bag_topics.choose_sensor(reader, topic)
    options = PoseOptions(poses, frame, extrinsic, max_gap)
    arguments = (reader, sensor, ranges, stride, options, sensor_frame, clock, deskew)
    if sensor.kind in (bag_topics.DEPTH, bag_topics.COMPRESSED):
        info = bag_topics.choose_camera_info(reader, sensor.topic.name, camera_info)
        return DepthBag(*arguments, camera_info=info, pixel_stride=pixel_stride)
    return RosBag(*arguments)


class RosBag(Dataset):
    """Scans of a topic in the order of recording; made by `open_rosbag`.

    The whole bag is read once when it is opened, for stamps and poses. Messages without a pose, out of order,
    or of another frame are left out and counted in `skipped`. A damaged message gives a scan without points.
    Scans of a level laser are 2D, and so are clouds of a level sensor whose points have one height. `topic`
    is the sensor's topic.
    """

    def __init__(
        self,
        reader: BagReader,
        sensor: bag_topics.Sensor,
        ranges: Ranges,
        stride: int,
        options: PoseOptions,
        sensor_frame: str | None,
        clock: str,
        deskew: bool,
    ) -> None:
        super().__init__(reader.path.stem, ranges, stride)
        self._reader, self._sensor, self._clock = reader, sensor, clock
        self.topic = sensor.topic.name
        self._where = f"{reader.path}, topic {self.topic}"
        self._stream: Iterator[RawMessage] | None = None
        self._next = 0  # number of the message that the stream yields next
        survey = BagSurvey(reader, self.topic, options)
        self._received = np.array([time for time, _ in survey.heads])
        records = self._ordered(self._of_frame(self._read_headers(survey.heads), sensor_frame))
        self._source = survey.source(records, self._where)
        self._deskew = deskew and self._source.can_deskew
        self._delay = float(np.median([record.time - record.stamp for record in records]))
        self._records, matrices = self._posed(records)
        level = bool((np.abs(matrices[:, 2, 2]) > _LEVEL).all())
        self._matrices = matrices
        first = self._first_reading()
        self._is_flat = level and (sensor.kind == bag_topics.LASER or _is_planar(first, _MIN_PLANAR))
        self._poses = torch.from_numpy(in_plane(matrices) if self._is_flat else matrices)

    def _read_headers(self, messages: list[tuple[int, bytes]]) -> list[_Record]:
        records = []
        for number, (time, head) in enumerate(messages):
            try:
                header = self._reader.decode(RawMessage(self.topic, HEADER, time, head))
            except DataError:
                self._skip("message that cannot be decoded", number)
                continue
            stamp = stamp_of(header) if self._clock == "header" else time
            records.append(_Record(number, time, stamp, frame_name(header["frame_id"])))
        if not records:
            raise DataError(f"{self._where}: none of {len(messages)} messages can be decoded; it is damaged.")
        return records

    def _of_frame(self, records: list[_Record], frame: str | None) -> list[_Record]:
        if frame is None:
            return records
        wanted = frame_name(frame)
        kept = [record for record in records if record.frame == wanted]
        if not kept:
            frames = ", ".join(f"{name} ({n} times)" for name, n in Counter(r.frame for r in records).items())
            raise InvalidArgumentError(
                f"dataset.sensor_frame={frame} is not a frame of {self._where}, whose frames are {frames}."
            )
        for record in records:
            if record.frame != wanted:
                self._skip("message of another frame", record.number)
        return kept

    def _ordered(self, records: list[_Record]) -> list[_Record]:
        """The longest series of messages whose stamps do not run backwards."""
        kept = set(increasing(np.array([record.stamp for record in records])).tolist())
        for position, record in enumerate(records):
            if position not in kept:
                self._skip("stamp out of order (the clock jumped)", record.number)
        return [record for position, record in enumerate(records) if position in kept]

    def _posed(self, records: list[_Record]) -> tuple[list[_Record], np.ndarray]:
        """The messages whose pose is known, and their poses (N, 4, 4)."""
        matrices, known = np.empty((len(records), 4, 4)), np.empty(len(records), bool)
        for frame in dict.fromkeys(record.frame for record in records):
            of_frame = np.array([i for i, record in enumerate(records) if record.frame == frame])
            times = np.array([records[i].stamp for i in of_frame])
            matrices[of_frame], known[of_frame] = self._source.at(times, frame)
        known &= (np.abs(matrices[:, :3, 3]) <= FARTHEST).all(1)
        if not known.any():
            first, last = records[0], records[-1]
            raise DataError(
                f"{self._where}: no scan has a pose. Frame {first.frame or '(unnamed)'}, stamps from "
                f"{first.stamp / NANOSECONDS:.3f} to {last.stamp / NANOSECONDS:.3f} s; "
                f"{self._source.explain(first.stamp, first.frame)}. If the sensor has a clock "
                "of its own, use "
                "the times of recording: dataset.clock=received; if poses are rare, raise dataset.max_gap."
            )
        for record, is_known in zip(records, known, strict=True):
            if not is_known:
                self._skip("no pose at the time of the scan", record.number)
        return [record for record, is_known in zip(records, known, strict=True) if is_known], matrices[known]

    def _first_reading(self) -> Reading:
        """The first of ten readings that has points. Raises `DataError` if none of them can be decoded."""
        empty, failures = [], []
        for index in range(min(len(self._records), 10)):
            try:
                found = self._reading(index)
            except DataError as error:
                failures.append(error)
                continue
            if len(found.points):
                return found
            empty.append(found)
        if not empty:
            raise failures[0]
        return empty[0]

    def _count(self) -> int:
        return len(self._records)

    def _known_pose(self, index: int) -> Tensor:
        return self._poses[index]

    def _known_times(self) -> Tensor:
        return torch.tensor([record.stamp / NANOSECONDS for record in self._records], dtype=torch.float64)

    def _read(self, index: int) -> Scan:
        dim = 2 if self._is_flat else 3
        origin = torch.from_numpy(self._matrices[index, :dim, 3].copy())
        try:
            found = self._reading(index)
        except DataError:
            self._skip("message that cannot be decoded", self._records[index].number)
            return Scan(origin.new_empty(0, dim), origin)
        if len(found.points) == 0:
            self._skip("message without a valid point", self._records[index].number)
        elif self._is_flat and not _is_planar(found):
            self._skip("points of several heights among planar scans", self._records[index].number)
            return Scan(origin.new_empty(0, dim), origin)
        ends = self._in_world(index, found)
        ends[(ends.abs() > FARTHEST).any(1)] = torch.nan  # no sensor measures them
        return self.ranges.scan(ends[:, :dim].contiguous(), origin, torch.from_numpy(found.no_return))

    def _in_world(self, index: int, found: Reading) -> Tensor:
        """The points (N, 3) in the world frame, each with the pose of its own time if that is known."""
        points = torch.from_numpy(found.points)
        record, matrix = self._records[index], torch.from_numpy(self._matrices[index])
        if self._deskew and found.offsets is not None and len(points):
            offsets = self._causal(found.offsets)
            first, last = int(offsets.min()), int(offsets.max())
            n_knots = min(_KNOTS, len(points)) if last > first else 1
            knots = np.linspace(first, last, n_knots).round().astype(np.int64)
            poses = self._source.at(record.stamp + knots, record.frame)
            if poses.known.all():
                nearest = np.round((offsets - first) * ((n_knots - 1) / max(last - first, 1)))
                own = torch.from_numpy(poses.matrices)[torch.from_numpy(nearest.astype(np.int64))]
                return (own[:, :3, :3] @ points[:, :, None])[:, :, 0] + own[:, :3, 3]
            self._skip("points not deskewed: no poses during the sweep", record.number)
        return points @ matrix[:3, :3].T + matrix[:3, 3]

    def _causal(self, offsets: np.ndarray) -> np.ndarray:
        """Times of points as ns after the stamp, all before the message was received.

        A message that arrives sooner after its stamp than its sweep lasts has the stamp of the sweep's end,
        as some drivers write it. If both times are equal, the bag does not state when it was received.
        """
        last = int(offsets.max())
        at_end = self._clock == "received" or 0 < self._delay < last / 2
        return offsets - last if at_end and last > 0 else offsets

    def _reading(self, index: int) -> Reading:
        record = self._records[index]
        message = self._message(index)
        try:
            return self._points(message, record.stamp)
        except (DataError, ValueError, KeyError, OverflowError) as error:
            raise DataError(
                f"{self._where}, frame {record.frame}, stamp {record.stamp / NANOSECONDS:.3f} s: {error}."
            ) from error

    def _points(self, message: dict[str, Any], stamp: int) -> Reading:
        """The points of a decoded message of a laser or lidar, measured at a stamp in ns."""
        if self._sensor.kind == bag_topics.CLOUD:
            return sensor_messages.cloud_points(message, stamp)
        if self._sensor.kind == bag_topics.LIST:
            return sensor_messages.listed_points(message, self._sensor.field, stamp)
        return sensor_messages.laser_points(message)

    def _message(self, index: int) -> dict[str, Any]:
        """The decoded message of scan `index` of the source. Reading in order does not search the bag."""
        record = self._records[index]
        if self._stream is None or not 0 <= record.number - self._next <= self.stride + _SHORT_SKIP:
            self._stream = self._reader.messages([self.topic], start=record.time)
            self._next = int(np.searchsorted(self._received, record.time))
        for message in self._stream:
            self._next += 1
            if self._next > record.number:
                return self._reader.decode(message)
        raise DataError(
            f"{self._where}: message {record.number} is missing; the bag changed while it was read."
        )


def _is_planar(found: Reading, n_least: int = 1) -> bool:
    """Whether a reading has at least `n_least` points, all at one height of the sensor's frame."""
    return len(found.points) >= n_least and bool(np.ptp(found.points[:, 2]) == 0)


class DepthBag(RosBag):
    """Scans from depth images of a bag. `intrinsics` is the pinhole matrix (3, 3) in pixels.

    `image` returns the full depth image of a scan. Lens distortion is not removed: record rectified images.
    """

    def __init__(self, *arguments: Any, camera_info: str, pixel_stride: int) -> None:
        self.pixel_stride = check_whole("dataset.pixel_stride", pixel_stride, 1)
        reader = arguments[0]
        message = next(reader.messages([camera_info]))
        self.intrinsics = sensor_messages.camera_matrix(reader.decode(message))
        super().__init__(*arguments)

    def _points(self, message: dict[str, Any], stamp: int) -> Reading:
        points = back_project(self._depth(message), self.intrinsics, self.pixel_stride)
        return sensor_messages.reading(points.numpy(), None, None)

    def _depth(self, message: dict[str, Any]) -> Tensor:
        if self._sensor.kind == bag_topics.DEPTH:
            return sensor_messages.depth_image(message)
        return sensor_messages.compressed_depth_image(message)

    def image(self, index: int) -> tuple[Tensor, Tensor]:
        """Depth (H, W) in metres, 0 for invalid pixels, and pose (4, 4), world ← camera, of a scan."""
        position = self._position(index)
        return self._depth(self._message(position)), self._poses[position]
