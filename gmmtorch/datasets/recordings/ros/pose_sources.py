"""Where scans get their poses: TF, a topic of poses, a trajectory file, or a sensor that stands still."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from gmmtorch.datasets.recordings.ros.transform_tree import (
    TransformTree,
    frame_name,
    stamp_of,
    transform_matrix,
)
from gmmtorch.datasets.recordings.trajectory import NANOSECONDS, Poses, Trajectory, pose_matrix
from gmmtorch.errors import DataError, InvalidArgumentError


class PoseSource(Protocol):
    """Poses of the sensor in a fixed frame."""

    can_deskew: bool

    def at(self, times: np.ndarray, frame: str) -> Poses:
        """Poses of the sensor frame at times (M,) in ns."""

    def explain(self, time: int, frame: str) -> str:
        """Why the pose at a time is unknown, for messages."""


class Standing:
    """A sensor that does not move: its frame is the world."""

    can_deskew = False

    def at(self, times: np.ndarray, frame: str) -> Poses:
        return Poses(np.tile(np.eye(4), (len(times), 1, 1)), np.ones(len(times), bool))

    def explain(self, time: int, frame: str) -> str:
        return "all poses are known"


class TfPoses:
    """Poses from TF.

    top: the fixed frame; None: the root of the tree of the sensor's frame. where: the topic, for messages.
    """

    can_deskew = True

    def __init__(self, tree: TransformTree, top: str | None, max_gap: float, where: str) -> None:
        self._tree, self._max_gap, self._where = tree, max_gap, where
        self._top = None if top is None else frame_name(top)
        self._chains: dict[str, list[str]] = {}

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

    def at(self, times: np.ndarray, frame: str) -> Poses:
        return self._tree.lookup(self.chain(frame), times, self._max_gap)

    def explain(self, time: int, frame: str) -> str:
        return self._tree.unknown_step(self.chain(frame), time, self._max_gap)


class BodyPoses:
    """Poses of a body from a trajectory, and the sensor's pose on it.

    Args:
        trajectory: world ← body.
        mounts: body ← sensor, (4, 4), for each frame of a sensor.
        max_gap: longest time in seconds between two poses to interpolate.
        name: of the trajectory, for messages.
    """

    can_deskew = True

    def __init__(
        self, trajectory: Trajectory, mounts: dict[str, np.ndarray], max_gap: float, name: str
    ) -> None:
        self._trajectory, self._mounts, self._max_gap, self._name = trajectory, mounts, max_gap, name

    def at(self, times: np.ndarray, frame: str) -> Poses:
        poses = self._trajectory.at(times, self._max_gap)
        return poses._replace(matrices=poses.matrices @ self._mounts[frame])

    def explain(self, time: int, frame: str) -> str:
        times = self._trajectory.times / NANOSECONDS
        if len(times) == 0:
            return f"{self._name} has no pose"
        return f"{self._name} has poses from {times[0]:.3f} to {times[-1]:.3f} s"


class RegisteredPoses:
    """Poses of a sensor whose points are in a fixed frame already, as SLAM systems publish them.

    source: poses of the sensor. sensor: its frame. fixed: poses of the frame of the points.
    """

    can_deskew = False

    def __init__(self, source: PoseSource, sensor: str, fixed: PoseSource) -> None:
        self.sensor, self._source, self._fixed = sensor, source, fixed

    def at(self, times: np.ndarray, frame: str) -> Poses:
        poses = self._source.at(times, self.sensor)
        return poses._replace(known=poses.known & self._fixed.at(times, frame).known)

    def of_points(self, time: int, frame: str) -> np.ndarray:
        """The pose (4, 4) at a known time (ns) of the frame of the points."""
        matrix: np.ndarray = self._fixed.at(np.array([time]), frame).matrices[0]
        return matrix

    def explain(self, time: int, frame: str) -> str:
        return self._source.explain(time, self.sensor)


class PosesByIndex:
    """Poses of a file without times. poses: time (ns) → world ← body; mount: body ← sensor."""

    can_deskew = False

    def __init__(self, poses: dict[int, np.ndarray], mount: np.ndarray) -> None:
        self._poses, self._mount = poses, mount

    def at(self, times: np.ndarray, frame: str) -> Poses:
        found = [self._poses[time] for time in times.tolist()]
        return Poses(np.array(found).reshape(-1, 4, 4) @ self._mount, np.ones(len(times), bool))

    def explain(self, time: int, frame: str) -> str:
        return "all poses are known"


def pose_sample(message: dict[str, Any]) -> tuple[int, np.ndarray, str, str]:
    """(time in ns, world ← body (4, 4), frames of world and body or "") of a message of a pose topic.

    Raises `ValueError` if it is not a pose.
    """
    time = stamp_of(message["header"])
    if "transform" in message:
        content = message["transform"]
        matrix = transform_matrix(content["translation"], content["rotation"])
    else:
        content = message["pose"]
        content = content.get("pose", content)  # with covariance
        matrix = transform_matrix(content["position"], content["orientation"])
    world, body = message["header"]["frame_id"], message.get("child_frame_id", "")
    return time, matrix, frame_name(world), frame_name(body)


def mount_matrix(extrinsic: list[float] | None) -> np.ndarray | None:
    """body ← sensor (4, 4) from x, y, z, qx, qy, qz, qw. Raises `InvalidArgumentError`."""
    if extrinsic is None:
        return None
    try:
        numbers = np.array([float(value) for value in extrinsic])
        if numbers.shape != (7,):
            raise ValueError
        return pose_matrix(numbers[:3], numbers[3:])
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(
            f"‹extrinsic›={extrinsic} is not the sensor's pose on the body: give x, y, z (m), qx, qy, qz, qw."
        ) from error
