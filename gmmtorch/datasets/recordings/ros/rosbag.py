"""ROS bags as data sets: the scans of one topic, with poses from TF, a topic of poses, or a file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.base import Dataset, Ranges, require_path
from gmmtorch.datasets.recordings.ros import bag_topics
from gmmtorch.datasets.recordings.ros.bag_poses import BagSurvey, Record
from gmmtorch.datasets.recordings.ros.bag_reader import BagReader, RawMessage
from gmmtorch.datasets.recordings.ros.gyroscope import read_gyroscope, sensor_turns
from gmmtorch.datasets.recordings.ros.image_camera import ImageCamera
from gmmtorch.datasets.recordings.ros.point_times import Rate
from gmmtorch.datasets.recordings.ros.pose_sources import RegisteredPoses
from gmmtorch.datasets.recordings.ros.scan_conversion import ScanConversion
from gmmtorch.datasets.recordings.ros.sensor_messages import Reading
from gmmtorch.datasets.recordings.ros.transform_tree import frame_name, stamp_of
from gmmtorch.datasets.recordings.trajectory import NANOSECONDS, in_plane, increasing
from gmmtorch.errors import DataError, InvalidArgumentError, check_choice
from gmmtorch.scan import FARTHEST, Scan

HEADER = "std_msgs/msg/Header"
_SHORT_SKIP = 16


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
    depth_scale: float | None = None,
    intrinsics: list[float] | None = None,
    imu_topic: str | None = None,
) -> RosBag:
    """The scans of one topic of a bag; see docs/recordings.md.

    Args:
        path: .bag (ROS 1), .db3 or .mcap (ROS 2), or the folder of a ROS 2 bag.
        ranges, stride: see `Dataset`.
        topic: of the sensor; None: the only one of its kind.
        poses: "tf", "standing", a topic of poses, or a trajectory file; None: TF.
        frame: the fixed frame of TF; None: the root of the sensor's tree.
        sensor_frame: only messages of this frame are read; those without a frame are taken to be in it.
        extrinsic: x, y, z, qx, qy, qz, qw of the sensor on the body whose poses a topic or file states.
        max_gap: longest time (s) between two poses that are interpolated.
        clock: "header", the stamps of the messages, or "received", the times of recording.
        deskew: whether points with times get the pose of their own time.
        camera_info: topic of the camera parameters of depth images.
        pixel_stride: every n-th pixel of every n-th row of depth images is used.
        depth_scale: metres per unit of depth images; None: 0.001 for whole numbers, 1 for floating ones.
        intrinsics: fx, fy, cx, cy in pixels of depth images without distortion; None: of `camera_info`.
        imu_topic: of the IMU of `RosBag.turns`; None: the only one.
    """
    source = "A bag of ROS 1 is a file; one of ROS 2 is a file or its folder."
    file = require_path(path, "file or folder", "a ROS bag (.bag, .mcap, .db3)", source)
    check_choice("clock", clock, ("header", "received"))
    if not max_gap > 0:
        raise InvalidArgumentError(f"‹max_gap›={max_gap} must be a time above zero seconds.")
    reader = BagReader(file)
    sensor = bag_topics.choose_sensor(reader, topic)
    info = None
    if sensor.is_camera and intrinsics is None:
        info = bag_topics.choose_camera_info(reader, sensor.topic.name, camera_info)
    survey = BagSurvey(reader, sensor, info, poses, frame, extrinsic, max_gap)
    camera = ImageCamera(sensor, survey.camera_info(), pixel_stride, depth_scale, intrinsics)
    options = sensor_frame, clock, deskew, imu_topic
    if sensor.is_camera:
        return DepthBag(reader, sensor, survey, ranges, stride, *options, camera)
    return RosBag(reader, sensor, survey, ranges, stride, *options)


class RosBag(Dataset):
    """Scans of a topic in the order of recording; made by `open_rosbag`.

    The whole bag is read once when it is opened, for stamps and poses. Messages without a pose, out of order,
    or of another frame are left out and counted in `skipped`. A damaged message gives a scan without points.
    Scans of a level laser are 2D, and so are clouds of a level sensor if the points of most of the first
    clouds have one height. `topic` is the sensor's topic.
    """

    _poses: Tensor

    def __init__(
        self,
        reader: BagReader,
        sensor: bag_topics.Sensor,
        survey: BagSurvey,
        ranges: Ranges,
        stride: int,
        sensor_frame: str | None,
        clock: str,
        deskew: bool,
        imu_topic: str | None,
        camera: ImageCamera | None = None,
    ) -> None:
        super().__init__(reader.path.stem, ranges, stride)
        self._reader, self._camera, self._clock = reader, camera, clock
        self._imu_topic, self._tree, self._max_gap = imu_topic, survey.tree, survey.max_gap
        self.topic = sensor.topic.name
        self._where = f"{reader.path}, topic {self.topic}"
        self._stream: Iterator[RawMessage] | None = None
        self._next = 0  # number of the message that the stream yields next
        self._received = np.array([time for time, _ in survey.heads])
        records = self._read_headers(survey.heads)
        if sensor_frame is not None:
            sensor_frame = frame_name(sensor_frame)
            kept = survey.of_frame(records, sensor_frame, self._where)
            self._skip("message of another frame", *({r.number for r in records} - {r.number for r in kept}))
            records = kept
        records = self._ordered(records)
        self._source = survey.source(records, self._where, sensor_frame)
        self._conversion = ScanConversion(sensor, ranges, self._source, deskew, camera)
        self._records, self._matrices = self._posed(records)
        self._samples = self._first_readings()
        rate = Rate.of(records, clock)
        for index, found in self._samples.items():
            self._conversion.learn_times(found, self._records[index].stamp, rate)
        self._is_flat = self._conversion.is_flat(self._matrices, self._samples.values())
        self._poses = torch.from_numpy(in_plane(self._matrices) if self._is_flat else self._matrices)
        seconds = [record.stamp / NANOSECONDS for record in self._records]
        self._times = torch.tensor(seconds, dtype=torch.float64)

    def _read_headers(self, messages: list[tuple[int, bytes]]) -> list[Record]:
        records = []
        for number, (time, head) in enumerate(messages):
            try:
                header = self._reader.decode(RawMessage(self.topic, HEADER, time, head))
            except DataError:
                self._skip("message that cannot be decoded", number)
                continue
            stamp = stamp_of(header) if self._clock == "header" else time
            records.append(Record(number, time, stamp, frame_name(header["frame_id"])))
        if not records:
            raise DataError(f"{self._where}: none of {len(messages)} messages can be decoded; it is damaged.")
        return records

    def _ordered(self, records: list[Record]) -> list[Record]:
        """The longest series of messages whose stamps do not run backwards."""
        kept = [records[i] for i in increasing(np.array([record.stamp for record in records])).tolist()]
        left_out = {record.number for record in records} - {record.number for record in kept}
        self._skip("stamp out of order (the clock jumped)", *left_out)
        return kept

    def _posed(self, records: list[Record]) -> tuple[list[Record], np.ndarray]:
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
                f"{self._source.explain(first.stamp, first.frame)}. If the sensor has a clock of its own, "
                "use the times of recording: ‹clock›=received; if poses are rare, raise "
                "‹max_gap›."
            )
        unknown = (records[i].number for i in np.flatnonzero(~known))
        self._skip("no pose at the time of the scan", *unknown)
        return [records[i] for i in np.flatnonzero(known)], matrices[known]

    def _first_readings(self) -> dict[int, Reading]:
        """The first readings with points of ten, by index. Raises `DataError` if none can be decoded."""
        found, failures = {}, []
        for index in range(0, len(self._records), self.stride)[:10]:
            try:
                found[index] = self._reading(index)
            except DataError as error:
                failures.append(error)
            if sum(len(each.points) > 0 for each in found.values()) == self._conversion.n_samples:
                break
        if not found:
            raise failures[0]
        return found

    def turns(self) -> Tensor:
        """Rotations (N, D, D) of the sensor since the scan before, from the gyroscope of the bag's IMU.

        See `Dataset.turns`. TF states how the IMU is mounted. Where the IMU has no messages, rotations are
        NaN, and a warning states how many. Raises `InvalidArgumentError`, with the remedy, if all are.
        """
        records, matrices = self._records[:: self.stride], self._matrices[:: self.stride]
        gyroscope = read_gyroscope(self._reader, self._imu_topic, self._clock)
        stamps = np.array([record.stamp for record in records])
        source = self._source
        frames = [source.sensor if isinstance(source, RegisteredPoses) else r.frame for r in records]
        turns = sensor_turns(gyroscope, self._tree, frames, stamps, self._max_gap)
        if self._is_flat:  # as the heading changes in the plane, also of a sensor on its head
            motions = np.tile(np.eye(4), (len(turns) - 1, 1, 1))
            motions[:, :3, :3] = turns[1:]
            before, now = in_plane(matrices[:-1]), in_plane(matrices[:-1] @ motions)
            turns = np.concatenate([np.eye(2)[None], (np.swapaxes(before, 1, 2) @ now)[:, :2, :2]])
        return torch.from_numpy(turns)

    def _count(self) -> int:
        return len(self._records)

    def _read(self, index: int) -> Scan:
        record, matrix = self._records[index], self._matrices[index]

        def skip(reason: str) -> None:
            self._skip(reason, record.number)

        try:
            found = self._samples.pop(index, None) or self._reading(index)
        except DataError:
            skip("message that cannot be decoded")
            origin = torch.from_numpy(matrix[: 2 if self._is_flat else 3, 3].copy())
            return Scan(origin.new_empty(0, len(origin)), origin)
        return self._conversion.scan(found, record.stamp, record.frame, matrix, self._is_flat, skip)

    def _reading(self, index: int) -> Reading:
        record = self._records[index]
        message = self._message(index)
        try:
            return self._conversion.points(message)
        except (DataError, ValueError, KeyError, OverflowError) as error:
            raise DataError(
                f"{self._where}, frame {record.frame}, stamp {record.stamp / NANOSECONDS:.3f} s: "
                f"{f'{error}'.removesuffix('.')}."
            ) from error

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


class DepthBag(RosBag):
    """Scans from depth images of a bag. `intrinsics` is the pinhole matrix (3, 3) in pixels.

    `image` returns the full depth image of a scan, without lens distortion.
    """

    _camera: ImageCamera

    @property
    def intrinsics(self) -> Tensor:
        return self._camera.intrinsics

    def image(self, index: int) -> tuple[Tensor, Tensor]:
        """Depth (H, W) in metres, 0 for invalid pixels, and pose (4, 4), world ← camera, of a scan."""
        position = self._position(index)
        return self._camera.image(self._message(position)), self._poses[position]
