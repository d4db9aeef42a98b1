"""Rotations between times from the angular velocities of an IMU (`sensor_msgs/Imu`) in a bag.

Accelerations and the orientation that some IMUs estimate are not used. The bias is not estimated: a bias of
1 °/s turns the prediction of a scan 0.1 s after the last one by 0.1°, and odometry searches 10° around it.
"""

from __future__ import annotations

import logging
from array import array
from collections import Counter
from dataclasses import dataclass

import numpy as np

from gmmtorch.datasets.recordings.ros.bag_reader import BagReader
from gmmtorch.datasets.recordings.ros.bag_topics import IMU_TYPE, choose_imu
from gmmtorch.datasets.recordings.ros.transform_tree import TransformTree, frame_name, stamp_of
from gmmtorch.datasets.recordings.trajectory import NANOSECONDS, strictly_increasing
from gmmtorch.errors import DataError, InvalidArgumentError

MAX_GAP = 0.2
"""Longest time (s) between two messages over which rates are interpolated. If the rate changes by 10 rad/s²,
the turn over such a gap is wrong by at most 3°."""
_FASTEST = 100.0
"""Largest rate (rad/s) that a gyroscope of a robot measures."""
_log = logging.getLogger(__name__)


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

    def turns(self, stamps: np.ndarray) -> np.ndarray:
        """Rotations (M, 3, 3) of the IMU since the stamp before, before ← now, at stamps (M,), ns, in order.

        Rates are linear between messages, and each interval is one turn by their mean. The first rotation is
        the identity. A rotation is NaN if a stamp is outside the times of the messages, or if messages
        between the two stamps are more than `MAX_GAP` apart.
        """
        from scipy.spatial.transform import Rotation

        seconds, rise = np.diff(self.times) / NANOSECONDS, np.diff(self.rates, axis=0)
        is_gap = seconds > MAX_GAP
        means = np.where(is_gap[:, None], 0, self.rates[:-1] + rise / 2)
        steps = Rotation.from_rotvec(means * seconds[:, None]).as_quat()
        starts = Rotation.from_quat(_products(np.concatenate([[[0.0, 0.0, 0.0, 1.0]], steps])))
        at = (np.searchsorted(self.times, stamps, side="right") - 1).clip(0, len(seconds) - 1)
        since = ((stamps - self.times[at]) / NANOSECONDS).clip(0, seconds[at])
        rates = self.rates[at] + rise[at] * (since / seconds[at] / 2)[:, None]
        found = starts[at] * Rotation.from_rotvec(rates * since[:, None])
        turns = np.tile(np.eye(3), (len(stamps), 1, 1))
        turns[1:] = (found[:-1].inv() * found[1:]).as_matrix()
        inside = (self.times[0] <= stamps) & (stamps <= self.times[-1])
        begun = np.searchsorted(self.times[:-1][is_gap], stamps[1:])
        ended = np.searchsorted(self.times[1:][is_gap], stamps[:-1], side="right")
        turns[1:][~(inside[:-1] & inside[1:]) | (begun > ended)] = np.nan
        return turns


def _products(quaternions: np.ndarray) -> np.ndarray:
    """Products q₀, q₀q₁, q₀q₁q₂, … (N, 4) of unit quaternions (N, 4), with arrays of N/2, N/4, … pairs."""
    if len(quaternions) < 2:
        return quaternions
    found = quaternions.copy()
    found[1::2] = _products(_product(quaternions[:-1:2], quaternions[1::2]))
    if len(found) > 2:
        found[2::2] = _product(found[1:-1:2], quaternions[2::2])
    return found


def _product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    found: np.ndarray = (Rotation.from_quat(first) * Rotation.from_quat(second)).as_quat()
    return found


def read_gyroscope(reader: BagReader, topic: str | None, clock: str) -> Gyroscope:
    """The angular velocities of a bag's IMU; topic and clock are those of `open_rosbag`.

    Messages that cannot be decoded or that state no usable rate are left out. If the clock jumps, the longest
    series of messages in order is used. Raises `InvalidArgumentError`, with the remedy.
    """
    name = choose_imu(reader, topic)
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
            "Choose another ‹imu_topic›",
        )
    if len(frames) > 1:
        counts = ", ".join(f"{frame or '(unnamed)'} ({n} messages)" for frame, n in frames.most_common(5))
        raise _unusable(f"{where} has several IMUs, with frames {counts}", "Write each to a topic of its own")
    samples = np.array(rates).reshape(-1, 3)[kept]
    return Gyroscope(where, next(iter(frames)), faults.total(), np.array(times, np.int64)[kept], samples)


def sensor_turns(
    gyroscope: Gyroscope, tree: TransformTree, frames: list[str], stamps: np.ndarray, max_gap: float
) -> np.ndarray:
    """Rotations (M, 3, 3) of a sensor since the scan before, before ← now; the first is the identity.

    Where the rotation of the IMU or of its mounting is unknown, they are NaN, and a warning states how many.

    Args:
        gyroscope: of the IMU. tree: TF, with the mounting of both.
        frames: of the sensor at each scan (M). stamps: of the scans (M,), ns, in order.
        max_gap: longest time (s) between two transforms that are interpolated, if the mounting moves.

    Raises `InvalidArgumentError` if TF does not connect the frames, or if no rotation is known.
    """
    mounts = np.tile(np.eye(3), (len(stamps), 1, 1))  # IMU ← sensor
    for frame in set(frames) - {gyroscope.frame}:
        rows = np.array([row for row, name in enumerate(frames) if name == frame])
        try:
            found = tree.between(gyroscope.frame, frame, stamps[rows], max_gap)
        except DataError as error:
            raise _unusable(
                f"the IMU of {gyroscope.topic} must be mounted beside the sensor, but {error}",
                "Record /tf_static with both frames",
            ) from error
        mounts[rows] = np.where(found.known[:, None, None], found.matrices[:, :3, :3], np.nan)
    turns = gyroscope.turns(stamps)
    turns[1:] = np.swapaxes(mounts[:-1], 1, 2) @ turns[1:] @ mounts[1:]
    n, n_unknown = len(turns) - 1, int(np.isnan(turns).any((1, 2)).sum())
    if n and n_unknown == n:
        first, last = gyroscope.times[[0, -1]] / NANOSECONDS
        raise _unusable(
            f"{gyroscope.topic} has rotations from {first:.3f} to {last:.3f} s, with gaps of at most "
            f"{MAX_GAP} s, and none between two scans, which are from {stamps[0] / NANOSECONDS:.3f} to "
            f"{stamps[-1] / NANOSECONDS:.3f} s",
            "If the sensors have clocks of their own, use the times of recording: ‹clock›=received",
        )
    if n_unknown or gyroscope.n_bad:
        _log.warning(
            "%s: %d of %d motions between scans are predicted without the IMU, because it has no message for "
            "more than %s s there, or TF does not state its mounting. %d of its messages state no usable "
            "angular velocity.",
            *(gyroscope.topic, n_unknown, n, MAX_GAP, gyroscope.n_bad),
        )
    return turns


def _unusable(reason: str, remedy: str) -> InvalidArgumentError:
    return InvalidArgumentError(
        f"motion=imu cannot be used: {reason}. {remedy}, or predict with motion=constant."
    )
