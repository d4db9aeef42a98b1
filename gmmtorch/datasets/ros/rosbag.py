"""ROS bags as data sets: scans of one topic or of several, with poses from TF, a topic, or a file."""

from __future__ import annotations

import logging
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.base import NO_POSE, Dataset, Ranges, require_path
from gmmtorch.datasets.packets.lidar_packets import LidarPackets
from gmmtorch.datasets.point_files.channels import check_channels
from gmmtorch.datasets.ros.bag_poses import BagSurvey, Record, RegisteredPoses, TfPoses
from gmmtorch.datasets.ros.bag_reader import BagReader, RawMessage
from gmmtorch.datasets.ros.bag_topics import (
    IMU_TYPE,
    Sensor,
    choose_camera_info,
    choose_imu,
    choose_sensor,
    stated_unit,
)
from gmmtorch.datasets.ros.image_camera import ImageCamera
from gmmtorch.datasets.ros.point_times import Rate
from gmmtorch.datasets.ros.scan_conversion import ScanConversion
from gmmtorch.datasets.ros.sensor_messages import Reading
from gmmtorch.datasets.ros.transform_tree import TransformTree, frame_name, stamp_of
from gmmtorch.datasets.trajectory import NANOSECONDS, increasing, strictly_increasing
from gmmtorch.errors import DataError, InvalidArgumentError, check_choice
from gmmtorch.pose import Pose
from gmmtorch.scan import FARTHEST, Scan

HEADER = "std_msgs/msg/Header"
_SHORT_SKIP = 16
_log = logging.getLogger(__name__)


def open_rosbag(
    path: str | Path,
    ranges: Ranges,
    stride: int = 1,
    topic: str | Sequence[str] | None = None,
    poses: str | None = None,
    frame: str | None = None,
    sensor_frame: str | None = None,
    extrinsic: list[float] | None = None,
    max_gap: float = 2.0,
    clock: str = "header",
    deskew: bool = True,
    pixel_stride: int = 1,
    depth_scale: float | None = None,
    intrinsics: list[float] | None = None,
    calibration: str | None = None,
    attributes: Iterable[str] = (),
) -> Dataset:
    """The scans of one topic of a bag or of a network capture, or of several; see docs/recordings.md.

    Args:
        path: .bag (ROS 1), .db3 or .mcap (ROS 2), the folder of a ROS 2 bag, or .pcap or .pcapng.
        ranges, stride: see `Dataset`.
        topic: of the sensor, or topics of several sensors of one robot; None: the only one of its kind.
        poses: "tf", "standing", a topic of poses, or a trajectory file; None: TF.
        frame: the fixed frame of TF; None: the root of the sensor's tree.
        sensor_frame: only messages of this frame are read; those without a frame are taken to be in it.
        extrinsic: x, y, z, qx, qy, qz, qw of the sensor on the body whose poses a topic or file states.
        max_gap: longest time (s) between two poses that are interpolated.
        clock: "header", the stamps of the messages, or "received", the times of recording.
        deskew: whether points with times get the pose of their own time.
        pixel_stride: every n-th pixel of every n-th row of depth images is used.
        depth_scale: metres per unit of depth images; None: as a RealSense's bag states, otherwise
            0.001 for whole numbers, 1 for floating ones.
        intrinsics: fx, fy, cx, cy in pixels of depth images without distortion; None: of the
            CameraInfo topic that is nearest by name.
        calibration: file of the lidar whose packets are read, see `LidarPackets`.
        attributes: channels of points that are read, such as "intensity" and "colour".
    """
    source = "A bag of ROS 1 is a file; one of ROS 2 is a file or its folder."
    content = "a ROS bag (.bag, .mcap, .db3) or a network capture (.pcap, .pcapng)"
    file = require_path(path, "file or folder", content, source)
    check_choice("clock", clock, ("header", "received"))
    if not max_gap > 0:
        raise InvalidArgumentError(f"‹max_gap›={max_gap} must be a time above zero seconds.")

    topics = [topic] if topic is None or isinstance(topic, str) else list(dict.fromkeys(map(str, topic)))
    if not topics:
        raise InvalidArgumentError("‹topic›=[] names no topic; leave it out to read the only sensor.")

    reader = BagReader(file)
    if damage := reader.damage:
        _log.warning("%s is damaged: %s.", file, damage)

    def opened(name: str | None) -> RosBag:
        sensor = choose_sensor(reader, name)
        info = None
        if sensor.is_camera and intrinsics is None:
            info = choose_camera_info(reader, sensor.topic.name)
        survey = BagSurvey(reader, sensor, info, poses, frame, extrinsic, max_gap)
        if len(topics) > 1 and not survey.places_sensor:
            raise InvalidArgumentError(
                f"‹topic›={', '.join(map(str, topics))} would all be at the same place, because "
                f"‹poses›={poses} does not say where on the robot each sensor is. Use the poses of TF or of "
                "an odometry without ‹extrinsic›, or choose one ‹topic›."
            )
        unit = stated_unit(reader, sensor.topic.name) if depth_scale is None else depth_scale
        camera = ImageCamera(sensor, survey.camera_info(), pixel_stride, unit, intrinsics)
        packets = LidarPackets(calibration, reader)
        options = sensor_frame, clock, deskew, check_channels(attributes), packets
        if sensor.is_camera:
            return DepthBag(reader, sensor, survey, ranges, stride, *options, camera)
        return RosBag(reader, sensor, survey, ranges, stride, *options)

    bags = [opened(name) for name in topics]
    return bags[0] if len(bags) == 1 else SeveralSensors(bags)


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
        sensor: Sensor,
        survey: BagSurvey,
        ranges: Ranges,
        stride: int,
        sensor_frame: str | None,
        clock: str,
        deskew: bool,
        attributes: tuple[str, ...],
        packets: LidarPackets,
        camera: ImageCamera | None = None,
    ) -> None:
        super().__init__(reader.path.stem, ranges, stride)
        self._reader, self._camera, self._clock = reader, camera, clock
        self._tree, self._max_gap = survey.tree, survey.max_gap
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
        # The longest series of messages whose stamps do not run backwards.
        kept = [records[i] for i in increasing(np.array([record.stamp for record in records])).tolist()]
        left_out = {record.number for record in records} - {record.number for record in kept}
        self._skip("stamp out of order (the clock jumped)", *left_out)
        records = kept
        self._source = survey.source(records, self._where, sensor_frame)
        self._conversion = ScanConversion(sensor, ranges, self._source, deskew, camera, attributes, packets)
        self._records, self._in_space = self._posed(records)
        self._samples = self._first_readings()
        rate = Rate.of(records, clock)
        for index, found in self._samples.items():
            self._conversion.learn_times(found, self._records[index].stamp, rate)
        self._is_flat = self._conversion.is_flat(self._in_space, self._samples.values())
        self._poses = (self._in_space.in_plane() if self._is_flat else self._in_space).matrix
        seconds = [record.stamp / NANOSECONDS for record in self._records]
        self._times = torch.tensor(seconds, dtype=torch.float64)

    @property
    def fixed_frame(self) -> str | None:
        """The frame of TF that poses are in; None if they are from elsewhere."""
        return self._source.top if isinstance(self._source, TfPoses) else None

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

    def _posed(self, records: list[Record]) -> tuple[list[Record], Pose]:
        """The messages whose pose is known, and their poses in space (N)."""
        poses, known = Pose.identity(3, len(records)), np.empty(len(records), bool)
        for frame in dict.fromkeys(record.frame for record in records):
            of_frame = np.array([i for i, record in enumerate(records) if record.frame == frame])
            times = np.array([records[i].stamp for i in of_frame])
            found, known[of_frame] = self._source.at(times, frame)
            poses.rotation[of_frame], poses.translation[of_frame] = found.parts
        known &= (poses.translation.abs() <= FARTHEST).all(1).numpy()
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
        self._skip(NO_POSE, *unknown)
        return [records[i] for i in np.flatnonzero(known)], poses[known]

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
        records, poses = self._records[:: self.stride], self._in_space[:: self.stride]
        gyroscope = read_gyroscope(self._reader, self._clock)
        stamps = np.array([record.stamp for record in records])
        source = self._source
        frames = [source.sensor if isinstance(source, RegisteredPoses) else r.frame for r in records]
        turns = sensor_turns(gyroscope, self._tree, frames, stamps, self._max_gap)
        if self._is_flat:  # as the heading changes in the plane, also of a sensor on its head
            turned = Pose(poses.rotation[:-1] @ turns[1:], poses.translation[:-1])
            motions = poses[:-1].in_plane().inverse() @ turned.in_plane()
            turns = torch.cat([torch.eye(2)[None].double(), motions.rotation])
        return turns

    def _count(self) -> int:
        return len(self._records)

    def _read(self, index: int) -> Scan:
        record, pose = self._records[index], self._in_space[index]

        def skip(reason: str) -> None:
            self._skip(reason, record.number)

        try:
            found = self._samples.pop(index, None) or self._reading(index)
        except DataError:
            skip("message that cannot be decoded")
            origin = pose.translation[: 2 if self._is_flat else 3].clone()
            return Scan(origin.new_empty(0, len(origin)), origin)
        self._conversion.keeps_times = self.keeps_point_times
        return self._conversion.scan(found, record.stamp, record.frame, pose, self._is_flat, skip)

    def _reading(self, index: int) -> Reading:
        record = self._records[index]
        message = self._message(index)
        try:
            return self._conversion.points(message)
        except (DataError, ValueError, KeyError, OverflowError) as error:
            raise DataError(
                f"{self._where}, frame {record.frame or '(unnamed)'}, "
                f"stamp {record.stamp / NANOSECONDS:.3f} s: {f'{error}'.removesuffix('.')}."
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


class SeveralSensors(Dataset):
    """The scans of the topics of a bag in the order of their times, each with the pose of its own sensor.

    A scan has one origin, so a scan of one sensor stays a scan; the map joins them. The stride of each topic
    is its own, so that no sensor is left out. `topic` lists the topics.

    Raises `InvalidArgumentError` if the scans of some are 2D and of others 3D, or TF does not connect them.
    """

    def __init__(self, bags: Sequence[RosBag]) -> None:
        super().__init__(bags[0].name, bags[0].ranges)
        self.topic = ", ".join(bag.topic for bag in bags)
        self.n_sensors, self._bags = len(bags), list(bags)
        frames = {bag.fixed_frame: bag.topic for bag in bags}
        if len(frames) > 1:
            raise InvalidArgumentError(
                f"‹topic›={self.topic} have poses in different frames: "
                f"{', '.join(f'{topic} in {frame}' for frame, topic in frames.items())}; choose sensors "
                "that TF connects, or the ‹frame› that all are in."
            )
        if len({len(pose) for bag in bags if (pose := bag.pose(0)) is not None}) > 1:
            raise InvalidArgumentError(
                f"‹topic›={self.topic} have scans in 2D and in 3D, which no map has together; choose those "
                "of one kind."
            )
        known = [times for bag in bags if (times := bag.times) is not None]
        times = torch.cat(known)
        order = times.argsort(stable=True)
        self._times = times[order]
        numbers = torch.cat([torch.arange(len(one)) for one in known])
        sensors = torch.arange(len(known)).repeat_interleave(torch.tensor([len(one) for one in known]))
        self._places = torch.stack([sensors, numbers], 1)[order].tolist()

    def sensor_of(self, index: int) -> int:
        return int(self._places[index][0])

    @property
    def skipped(self) -> dict[str, int]:
        return dict(sum((Counter(bag.skipped) for bag in self._bags), Counter()))

    def _count(self) -> int:
        return len(self._places)

    def _read(self, index: int) -> Scan:
        sensor, number = self._places[index]
        return self._bags[sensor][number]

    def _known_pose(self, index: int) -> Tensor | None:
        sensor, number = self._places[index]
        return self._bags[sensor].pose(number)


IMU_GAP = 0.2
"""Longest time (s) between two messages over which rates are interpolated. If the rate changes by 10 rad/s²,
the turn over such a gap is wrong by at most 3°."""
_FASTEST = 100.0  # largest rate (rad/s) that a gyroscope of a robot measures


@dataclass(frozen=True)
class Gyroscope:
    """Angular velocities of one IMU.

    topic: of the IMU, with its bag. frame: in which it measures. n_bad: messages without a usable rate.
    times: (N,) int64, increasing, ns, at least two. rates: (N, 3) rad/s.
    """

    topic: str
    frame: str
    n_bad: int
    times: np.ndarray
    rates: np.ndarray

    def turns(self, stamps: np.ndarray) -> Tensor:
        """Rotations (M, 3, 3) of the IMU since the stamp before, before ← now, at stamps (M,), ns, in order.

        Rates are linear between messages, and each interval is one turn by their mean. The first rotation is
        the identity. A rotation is NaN if a stamp is outside the times of the messages, or if messages
        between the two stamps are more than `IMU_GAP` apart.
        """
        seconds, rise = np.diff(self.times) / NANOSECONDS, np.diff(self.rates, axis=0)
        is_gap = seconds > IMU_GAP
        means = np.where(is_gap[:, None], 0, self.rates[:-1] + rise / 2)
        steps = Pose.from_turn(torch.from_numpy(means * seconds[:, None])).rotation
        starts = _products(torch.cat([torch.eye(3)[None].double(), steps]))
        at = (np.searchsorted(self.times, stamps, side="right") - 1).clip(0, len(seconds) - 1)
        since = ((stamps - self.times[at]) / NANOSECONDS).clip(0, seconds[at])
        rates = self.rates[at] + rise[at] * (since / seconds[at] / 2)[:, None]
        found = starts[at] @ Pose.from_turn(torch.from_numpy(rates * since[:, None])).rotation
        turns = torch.cat([starts[:1], found[:-1].mT @ found[1:]])
        inside = (self.times[0] <= stamps) & (stamps <= self.times[-1])
        begun = np.searchsorted(self.times[:-1][is_gap], stamps[1:])
        ended = np.searchsorted(self.times[1:][is_gap], stamps[:-1], side="right")
        turns[1:][~(inside[:-1] & inside[1:]) | (begun > ended)] = torch.nan
        return turns


def _products(turns: Tensor) -> Tensor:
    """Products R₀, R₀R₁, R₀R₁R₂, … (N, 3, 3) of rotations (N, 3, 3), by batches of N/2, N/4, … pairs."""
    if len(turns) < 2:
        return turns
    found = turns.clone()
    found[1::2] = _products(turns[:-1:2] @ turns[1::2])
    if len(found) > 2:
        found[2::2] = found[1:-1:2] @ turns[2::2]
    return found


def read_gyroscope(reader: BagReader, clock: str) -> Gyroscope:
    """The angular velocities of a bag's IMU; the clock is that of `open_rosbag`.

    Messages that cannot be decoded or that state no usable rate are left out. If the clock jumps, the longest
    series of messages in order is used. Raises `InvalidArgumentError`, with the remedy.
    """
    name = choose_imu(reader)
    where = f"{reader.path}, topic {name}"
    times, rates = array("q"), array("d")
    frames: Counter[str] = Counter()
    faults: Counter[str] = Counter()
    for message in reader.messages([name]):
        if message.type != IMU_TYPE:
            continue
        try:
            content = reader.decode(message)
            velocity = content["angular_velocity"]
            rate = [velocity[axis] for axis in "xyz"]
            stamp = stamp_of(content["header"]) if clock == "header" else message.time
            if content["angular_velocity_covariance"][0] == -1:
                faults["state that they have no angular velocity (angular_velocity_covariance[0] is -1)"] += 1
            elif not all(abs(value) <= _FASTEST for value in rate):  # also for NaN
                faults[f"have an angular velocity that is not finite or above {_FASTEST:g} rad/s"] += 1
            else:
                times.append(stamp)
                rates.extend(rate)
                frames[frame_name(content["header"]["frame_id"])] += 1
        except (DataError, OverflowError):
            faults["cannot be decoded"] += 1
    kept = strictly_increasing(np.array(times, np.int64))
    if len(kept) < 2:
        reasons = "; ".join(f"{n} {reason}" for reason, n in faults.items()) or "their stamps are equal"
        raise _unusable(
            f"{where} has {len(kept)} usable angular velocities in {faults.total() + len(times)} messages "
            f"({reasons})",
            "Record another IMU",
        )
    if len(frames) > 1:
        counts = ", ".join(f"{frame or '(unnamed)'} ({n} messages)" for frame, n in frames.most_common(5))
        raise _unusable(f"{where} has several IMUs, with frames {counts}", "Write each to a topic of its own")
    samples = np.array(rates).reshape(-1, 3)[kept]
    return Gyroscope(where, next(iter(frames)), faults.total(), np.array(times, np.int64)[kept], samples)


def sensor_turns(
    gyroscope: Gyroscope, tree: TransformTree, frames: list[str], stamps: np.ndarray, max_gap: float
) -> Tensor:
    """Rotations (M, 3, 3) of a sensor since the scan before, before ← now; the first is the identity.

    Where the rotation of the IMU or of its mounting is unknown, they are NaN, and a warning states how many.
    frames: of the sensor at each scan (M). stamps: of the scans (M,), ns, in order. max_gap: longest time (s)
    between two transforms that are interpolated, if the mounting moves.

    Raises `InvalidArgumentError` if TF does not connect the frames, or if no rotation is known.
    """
    mounts = Pose.identity(3, len(stamps)).rotation  # IMU ← sensor
    for frame in set(frames) - {gyroscope.frame}:
        rows = np.array([row for row, name in enumerate(frames) if name == frame])
        try:
            found = tree.between(gyroscope.frame, frame, stamps[rows], max_gap)
        except DataError as error:
            raise _unusable(
                f"the IMU of {gyroscope.topic} must be mounted beside the sensor, but {error}",
                "Record /tf_static with both frames",
            ) from error
        found.poses.rotation[~found.known] = torch.nan
        mounts[rows] = found.poses.rotation
    turns = gyroscope.turns(stamps)
    turns[1:] = mounts[:-1].mT @ turns[1:] @ mounts[1:]
    n, n_unknown = len(turns) - 1, int(turns.isnan().flatten(1).any(1).sum())
    if n and n_unknown == n:
        first, last = gyroscope.times[[0, -1]] / NANOSECONDS
        raise _unusable(
            f"{gyroscope.topic} has rotations from {first:.3f} to {last:.3f} s, with gaps of at most "
            f"{IMU_GAP} s, and none between two scans, which are from {stamps[0] / NANOSECONDS:.3f} to "
            f"{stamps[-1] / NANOSECONDS:.3f} s",
            "If the sensors have clocks of their own, use the times of recording: ‹clock›=received",
        )
    if n_unknown or gyroscope.n_bad:
        _log.warning(
            "%s: %d of %d motions between scans are predicted without the IMU, because it has no message for "
            "more than %s s there, or TF does not state its mounting. %d of its messages state no usable "
            "angular velocity.",
            *(gyroscope.topic, n_unknown, n, IMU_GAP, gyroscope.n_bad),
        )
    return turns


def _unusable(reason: str, remedy: str) -> InvalidArgumentError:
    return InvalidArgumentError(
        f"motion=imu cannot be used: {reason}. {remedy}, or predict with ‹motion›=constant."
    )
