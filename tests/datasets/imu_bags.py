"""Messages of an IMU for the bags of tests, at the rates of a known motion."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from scipy.spatial.transform import Rotation
from sensor_bags import BagWriter

Motion = Callable[[float], Rotation]
"""World ← body at a time (s)."""


def rate(motion: Motion, time: float) -> np.ndarray:
    """The angular velocity (3,) in the frame of the body, rad/s, by central differences."""
    step = 1e-5
    turn: np.ndarray = (motion(time - step).inv() * motion(time + step)).as_rotvec()
    return turn / (2 * step)


def write_imu(
    bag: BagWriter,
    times: Iterable[float],
    rates: np.ndarray,
    frame: str = "imu",
    topic: str = "/imu",
    received: Iterable[float] | None = None,
    **fields: object,
) -> None:
    """Writes angular velocities (N, 3), rad/s. An orientation is not stated.

    times: stamps, s. received: times of recording; None: the stamps.
    """
    times = list(times)
    unknown = np.array([-1.0, *[0.0] * 8])
    for time, at, one in zip(times, times if received is None else received, rates, strict=True):
        velocity = dict(zip("xyz", map(float, one), strict=True))
        header = {"frame_id": frame}
        content = {"header": header, "angular_velocity": velocity, "orientation_covariance": unknown}
        bag.message(topic, "sensor_msgs/msg/Imu", float(time), {**content, **fields}, float(at))
