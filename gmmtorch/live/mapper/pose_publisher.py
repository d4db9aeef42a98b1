"""PosePublisher: the pose of a live sensor as Odometry and as a transform."""

from __future__ import annotations

import time

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets import in_space
from gmmtorch.errors import DataError
from gmmtorch.export import odometry_fields, transform_fields
from gmmtorch.live.mapper.live_scans import SETTLING, LiveScan
from gmmtorch.live.ros import Node
from gmmtorch.localization import Location

_PLANAR = (0, 1, 5)
"""Rows of x, y and the heading among those of a pose's covariance in ROS."""


class PosePublisher:
    """Publishes poses on the topic pose, and transforms on /tf, each with the stamp of a scan.

    Args:
        node: whose names are resolved in its namespace and remapped.
        frame: in which the poses are.
    """

    def __init__(self, node: Node, frame: str) -> None:
        self._node, self._frame = node, frame
        self._robot: str | None = None  # the frame that moves with the sensor, and has no parent
        self._candidate: tuple[list[str], float] = ([], 0.0)
        self._send_pose = node.publisher("pose", "nav_msgs/msg/Odometry")
        self._send_transform = node.publisher("/tf", "tf2_msgs/msg/TFMessage")

    def publish(self, location: Location, newest: LiveScan, child: str, below: np.ndarray) -> None:
        """Publishes the pose of a scan's sensor, and the transform from the frame to `child`.

        below: (4, 4) child ← sensor.
        """
        pose = in_space(location.pose.cpu().numpy()[None])[0]
        fields = odometry_fields(self._frame, newest.frame, pose)
        fields["pose"]["covariance"] = _covariance(location.covariance.cpu())
        self._send_pose(fields, newest.stamp)
        if child != self._frame:  # TF of somebody else has a frame of this name
            above = pose @ np.linalg.inv(below)
            self._send_transform(transform_fields({(self._frame, child): above}), newest.stamp)

    def publish_odometry(self, location: Location, newest: LiveScan) -> None:
        """Publishes a pose, and the transform to the robot's frame: the root of those fixed to the sensor.

        The transform is published once the root has not changed for half a second, and only if no other node
        moves it.
        """
        tree, child, below = self._node.transforms, self._frame, np.eye(4)
        try:
            chain = tree.chain(newest.frame)
            fixed = tree.static_part(chain)
            if self._robot is None and len(fixed) < len(chain):
                raise DataError(f"TF of another node moves {fixed[-1]} in {chain[len(fixed)]}")
            if fixed != self._candidate[0]:
                self._candidate = fixed, time.monotonic()
            if self._robot is not None or time.monotonic() - self._candidate[1] >= SETTLING:
                self._robot = child = fixed[-1]
                below = tree.lookup(fixed, np.array([newest.stamp]), 0.0).matrices[0]
        except DataError as error:
            self._node.warn("odometry", f"{error!s}; only the topic pose is published.")
        self.publish(location, newest, child, below)


def _covariance(of_pose: Tensor) -> np.ndarray:
    """The covariance (36,) of x, y, z and turns about them, from one of a pose, (3, 3) or (6, 6); zeros if
    it is unknown (NaN), as ROS has it.
    """
    found = np.zeros((6, 6))
    rows = list(_PLANAR) if len(of_pose) == len(_PLANAR) else list(range(6))
    found[np.ix_(rows, rows)] = torch.nan_to_num(of_pose).numpy()
    return found.ravel()
