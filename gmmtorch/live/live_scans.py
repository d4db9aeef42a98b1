"""The scans of a live topic as a data set that grows, and the topic that is the sensor's."""

from __future__ import annotations

import itertools
import time
from array import array
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets import (
    CLOUD,
    COMPRESSED,
    DEPTH,
    INFO_TYPE,
    LASER,
    NANOSECONDS,
    NO_POSE,
    POINT_TIMES,
    Dataset,
    ImageCamera,
    PoseSource,
    Ranges,
    Rate,
    Reading,
    Record,
    ScanConversion,
    Sensor,
    TfPoses,
    Topic,
    TransformTree,
    frame_name,
    nearest_names,
    stamp_of,
    without_point_times,
)
from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, arg, text_of
from gmmtorch.live.live_options import LiveOptions
from gmmtorch.live.ros import Node
from gmmtorch.live.ros.node import reading
from gmmtorch.localization import METHODS, Location, Odometry, Tracker, composed, odometry_of
from gmmtorch.mapping import GaussianMap
from gmmtorch.pose import Pose
from gmmtorch.scan import FARTHEST, Scan

DROPPED = "dropped, because mapping is slower than the sensor"
SETTLING = 0.5  # s without a new frame above the sensor's, after which the root of TF is the world
_PATIENCE = 10.0  # s that a scan waits for its pose if there is no limit of the latency
_WAITING_BYTES = 1 << 28
_BACKWARDS = 30 * NANOSECONDS  # a clock that is set back further starts again
_N_FIRST = 101  # messages whose stamps and receipt show how the sensor keeps time


@dataclass
class _Waiting:
    """A message that waits for its pose. since: this machine's clock, s. needed: see `_last_needed`."""

    message: dict[str, Any]
    stamp: int
    frame: str
    since: float
    needed: int | None = None


class LiveScan(NamedTuple):
    """The newest scan. pose: fixed frame ← sensor, in 3D. stamp: ns. frame: of the sensor. location: of
    odometry.
    """

    scan: Scan
    pose: Pose
    stamp: int
    frame: str
    location: Location | None = None


class LiveScans(Dataset):
    """Converts messages to scans as soon as their poses are known.

    `receive` takes a message; `advance` converts the oldest one that is ready. Only the newest scan is kept,
    `newest`; reading an older one is an error.

    Args:
        sensor: topic and kind.
        tree: the transforms that arrive meanwhile.
        ranges: how range readings are interpreted.
    """

    def __init__(self, sensor: Sensor, tree: TransformTree, ranges: Ranges, options: LiveOptions) -> None:
        super().__init__(sensor.topic.name, ranges)
        self.newest: LiveScan | None = None
        self.n_dropped = 0
        camera = options.pixel_stride, options.depth_scale, options.intrinsics
        self._camera = ImageCamera(sensor, None, *camera) if sensor.is_camera else None
        self._sensor, self._tree, self._options = sensor, tree, options
        self._waiting: deque[_Waiting] = deque()
        self._waiting_bytes = 0
        self._counts: Counter[str] = Counter()
        self._first_records: list[Record] = []
        self._conversion: ScanConversion | None = None
        self._candidate: tuple[list[str], float] = ([], 0.0)
        self._odometry = odometry_of(options.poses) if options.poses in METHODS else None
        self.has_odometry = self._odometry is not None
        """Whether poses are estimated from the scans."""
        self._start: Location | None = None  # of odometry in the map of an earlier run
        self._tracker: Tracker | None = None  # of the map of an earlier run
        self._posed: list[int] = []  # numbers of the scans in odometry, which also has those left out
        self._n_added = 0  # scans of odometry
        self._is_corrected = False
        self._is_flat: bool | None = None
        self._last_stamp: int | None = None
        self._n_posed = 0
        self._first = 0  # scans of earlier runs
        self._stamps = array("d")
        self.trouble = ""
        """Why the last scan without a pose has none."""

    def receive(self, message: dict[str, Any], received: int, since: float | None = None) -> None:
        """Queues a decoded message of the sensor.

        received: ns, on the clock of the node. since: s, on the clock of this machine; None: now.
        """
        header = message["header"]
        since = time.monotonic() if since is None else since
        stamp = stamp_of(header) if self._options.clock == "header" else received
        frame = frame_name(self._options.sensor_frame or header["frame_id"])
        if len(self._first_records) < _N_FIRST:
            self._first_records.append(Record(len(self._first_records), received, stamp, frame))
        self._waiting.append(_Waiting(message, stamp, frame, since))
        self._waiting_bytes += _size(message)
        while self._waiting_bytes > _WAITING_BYTES:
            self._pop()
            self._drop()

    def note_camera(self, message: dict[str, Any]) -> None:
        """Takes a CameraInfo."""
        if self._camera is not None:
            self._camera.take(message)

    @property
    def n_waiting(self) -> int:
        """Messages that wait for their poses, or to be converted."""
        return len(self._waiting)

    def advance(self, is_last: bool = False) -> bool:
        """Converts the oldest message whose poses are known to `newest`; returns whether there is one.

        is_last: no message and no transform will follow.
        """
        while self._waiting:
            oldest = self._waiting[0]
            age = time.monotonic() - oldest.since
            limit = self._options.max_latency
            if not self._is_ready(oldest) and not is_last:
                if age <= (_PATIENCE if limit is None else limit):
                    return False
                self._pop()
                self._note(NO_POSE)
                continue
            self._pop()
            if limit is not None and age > limit and not is_last:
                self._drop()
            elif self._convert(oldest):
                return True
        return False

    def _pop(self) -> None:
        self._waiting_bytes -= _size(self._waiting.popleft().message)

    def _drop(self) -> None:
        self.n_dropped += 1
        self._note(DROPPED)

    def _note(self, reason: str) -> None:
        self._counts[reason] += 1

    def _is_ready(self, item: _Waiting) -> bool:
        """Whether everything that the conversion of a message needs has arrived, or never will."""
        if self._camera is not None and not self._camera.is_known:
            self.trouble = "no CameraInfo has arrived"
            return False
        try:
            if self._conversion is None:
                source = self._settled(item.frame)
                if source is None:
                    return False
                arguments = source, self._options.deskew, self._camera
                self._conversion = ScanConversion(self._sensor, self.ranges, *arguments)
                self._conversion.keeps_times = self._odometry is not None and self._options.deskew
            if not isinstance(self._conversion.source, TfPoses):
                if self._conversion.keeps_times:
                    self._last_needed(item)
                return True
            chain = self._conversion.source.chain(item.frame)
            latest = self._tree.latest(chain)
            item.needed = self._last_needed(item) if item.needed is None else item.needed
            is_ready = latest is None or latest >= item.needed
            if not is_ready:
                self.trouble = self._tree.unknown_step(chain, item.stamp, self._options.max_gap)
            return is_ready
        except DataError as error:
            self.trouble = text_of(error)
            return False

    def _last_needed(self, item: _Waiting) -> int:
        """The last time (ns) at which a pose is needed."""
        assert self._conversion is not None
        try:
            found = self._conversion.points(item.message)
        except (DataError, ValueError, KeyError, OverflowError):
            return item.stamp
        self._conversion.learn_times(found, item.stamp, Rate.of(self._first_records, self._options.clock))
        return self._conversion.times(found, item.stamp)[1]

    def _settled(self, frame: str) -> PoseSource | None:
        """The source of poses once the fixed frame is clear."""
        if self._options.poses != "tf":
            return PoseSource()
        top = self._options.frame
        source = TfPoses(self._tree, top, self._options.max_gap, f"topic {self.name}")
        chain = source.chain(frame)
        if top is None:
            if not self._tree.is_moving(chain):
                self.trouble = (
                    f"TF has only static transforms from frame {chain[0]} up to {chain[-1]}; choose "
                    f"{arg('poses')}=standing for a sensor that does not move"
                )
                return None
            if chain != self._candidate[0]:
                self._candidate = chain, time.monotonic()
            if time.monotonic() - self._candidate[1] < SETTLING:
                return None
        return source

    @property
    def world_frame(self) -> str:
        """The fixed frame of the map; "map" before it is known and for a standing sensor."""
        if self._odometry is not None:
            return self._options.frame or "odom"
        if self._conversion is None or not isinstance(self._conversion.source, TfPoses):
            return "map"
        return self._options.frame or self._candidate[0][-1]

    def _convert(self, item: _Waiting) -> bool:
        """Makes a message the newest scan, unless it is left out."""
        conversion = self._conversion
        if conversion is None:
            self._note(NO_POSE)
            return False
        last = self._last_stamp
        if last is not None and last - _BACKWARDS < item.stamp < last:
            self._note("stamp out of order")
            return False
        self._last_stamp = item.stamp
        try:
            poses = conversion.source.at(np.array([item.stamp]), item.frame)
            if not poses.known[0] or bool((poses.poses.translation[0].abs() > FARTHEST).any()):
                self._note(NO_POSE)
                return False
            found = conversion.points(item.message)
        except (DataError, ValueError, KeyError, OverflowError) as error:
            self.trouble = text_of(error)
            self._note("message that cannot be decoded")
            return False
        self._n_posed += 1
        return (self._n_posed - 1) % self._options.stride == 0 and self._keep(item, found, poses.poses[0])

    def _keep(self, item: _Waiting, found: Reading, pose: Pose) -> bool:
        conversion = self._conversion
        assert conversion is not None
        if self._is_flat is None:
            if not len(found.points):
                self._note("message without a valid point")
                return False
            self._is_flat = conversion.is_flat(pose, [found, *self._readings_ahead()])
        if self._is_flat and not conversion.is_level(pose):
            self._note("tilted sensor among planar scans")
            return False
        scan = conversion.scan(found, item.stamp, item.frame, pose, self._is_flat, self._note)
        if scan.n_beams == 0:
            return False
        location = None
        if self._odometry is not None:
            location, scan = self._located(scan, item.stamp)
            if not location.found:
                self.trouble = "; ".join(location.doubts)
                self._note("no pose was found by odometry")
                return False
            scan, pose = scan.transformed(location.pose), Pose.from_matrix(location.pose).in_space()
        self.newest = LiveScan(scan, pose, item.stamp, item.frame, location)
        self._stamps.append(item.stamp / NANOSECONDS)
        self._posed.append(self._n_added - 1)
        return True

    def _readings_ahead(self) -> Iterator[Reading]:
        """The points of the next messages that wait."""
        assert self._conversion is not None
        for item in itertools.islice(self._waiting, self._conversion.n_samples):
            with suppress(DataError, ValueError, KeyError, OverflowError):
                yield self._conversion.points(item.message)

    def _located(self, scan: Scan, stamp: int) -> tuple[Location, Scan]:
        """Where odometry finds a scan, which is in the frame of its sensor, in the fixed frame; and the scan,
        deskewed if it has times of points."""
        assert self._odometry is not None
        points, times = scan.points.double(), scan.attributes.get(POINT_TIMES)
        seconds = None if times is None else times[:, 0]
        if self._tracker is not None:
            first = self._tracker.locate(points)
            if not first.found:
                return first, scan
            self._start, self._tracker = first, None
        location = self._odometry.add(points, stamp / NANOSECONDS, seconds=seconds)
        if seconds is not None:
            deskewed = self._odometry.deskewed if isinstance(self._odometry, Odometry) else None
            scan = without_point_times(scan, deskewed and deskewed(points, seconds))
        self._n_added += 1
        if isinstance(self._odometry, Odometry) and self._options.loops and self._odometry.close_loops():
            self._is_corrected = True
            location = replace(location, pose=self._odometry.poses[-1])
        return location if self._start is None else composed(self._start, location), scan

    def corrected_poses(self) -> tuple[Tensor, int] | None:
        """Poses (N, D+1, D+1) of the scans of this run, and the number of the first of them, if odometry has
        closed a loop since the last call; otherwise None."""
        if not self._is_corrected or not isinstance(self._odometry, Odometry):
            return None
        self._is_corrected = False
        poses = self._odometry.poses[self._posed]
        return (poses if self._start is None else self._start.pose @ poses), self._first

    def continue_in(self, known: GaussianMap) -> None:
        """Odometry begins where the next scan is found in a map; scans that are not found are left out."""
        if self._odometry is not None:
            self._tracker = Tracker(known)

    @property
    def skipped(self) -> dict[str, int]:
        return dict(self._counts)

    def can_continue(self, n_read: int) -> bool:
        self._first = n_read
        return not self._stamps

    def _count(self) -> int:
        return self._first + len(self._stamps)

    def _newest(self, index: int) -> LiveScan:
        if self.newest is None or index != len(self) - 1:
            raise IndexError(f"scan {index} of a live topic is no longer stored")
        return self.newest

    def _read(self, index: int) -> Scan:
        return self._newest(index).scan

    def _known_pose(self, index: int) -> Tensor | None:
        newest = self._newest(index)
        return (newest.pose.in_plane() if newest.scan.dim == 2 else newest.pose).matrix

    def _known_time(self, index: int) -> float:
        return self._newest(index).stamp / NANOSECONDS

    def _known_times(self) -> Tensor | None:
        return None if self._first else torch.tensor(self._stamps, dtype=torch.float64)


def _size(message: dict[str, Any]) -> int:
    """Bytes of a message's arrays."""
    return sum(value.nbytes for value in message.values() if isinstance(value, np.ndarray))


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
        if message_type in _KINDS
        # Images without "depth" in their name have colours.
        and (topic == name if name else not message_type.endswith("Image") or "depth" in topic.lower())
    ]


def open_scans(node: Node, sensor: Sensor, ranges: Ranges, options: LiveOptions) -> LiveScans:
    """The scans of a sensor, with the subscriptions that they need."""
    scans = LiveScans(sensor, node.transforms, ranges, options)
    if options.poses != "standing":
        node.listen_to_transforms()
    if sensor.is_camera and options.intrinsics is None:
        node.subscribe(_camera_info(node, sensor.topic.name), INFO_TYPE, reading(scans.note_camera))
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
            f"The camera parameters of the images of {image} are not clear; topics of type CameraInfo are "
            f"{', '.join(infos) or 'none'}. State {arg('intrinsics')}=[fx,fy,cx,cy] in pixels, without "
            "distortion."
        )
    return best[0]
