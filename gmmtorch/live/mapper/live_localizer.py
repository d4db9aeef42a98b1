"""LiveLocalizer: the pose of a live sensor in a map that is known."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets import NANOSECONDS, in_space
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.live.mapper.diagnostics import Diagnostics
from gmmtorch.live.mapper.live_mapper import handle_messages
from gmmtorch.live.mapper.live_scans import LiveScan, LiveScans
from gmmtorch.live.mapper.pose_publisher import PosePublisher
from gmmtorch.live.ros import Node
from gmmtorch.localization import Tracker
from gmmtorch.mapping import GaussianMap

MAP = "map"
"""Frame of the map."""


class LiveLocalizer:
    """Localises the scans of a live topic in a map, which stays as it is, with a `Tracker`.

    Publishes the sensor's pose as Odometry on the topic pose, and the transform from `map` to the fixed frame
    of TF, each with the stamp of the scan. The motion between scans is that of TF, if it is known.

    Args:
        node: receives the messages of `scans`.
        scans: the scans.
        known: the map.
        has_motion: whether the poses of scans are those of TF.
        device: of the computation.

    Attributes:
        poses, times: of the scans that were found: (D+1, D+1) map ← sensor, and seconds.
        n_scans, n_lost: scans so far, and those of them that were not found.
    """

    def __init__(
        self,
        node: Node,
        scans: LiveScans,
        known: GaussianMap,
        has_motion: bool = True,
        device: str | torch.device = "cpu",
    ) -> None:
        self.diagnostics = Diagnostics(node, scans, "gmmtorch localisation")
        self.poses: list[Tensor] = []
        self.times: list[float] = []
        self.n_scans = self.n_lost = 0
        self._node, self._scans, self._has_motion, self._device = node, scans, has_motion, device
        self._tracker = Tracker(known.to(device))
        self._n_components, self._nbytes = known.n_components, known.nbytes
        self._last: Tensor | None = None
        self._poses = PosePublisher(node, MAP)

    def step(self, timeout: float = 0.1) -> bool:
        """Handles the messages that wait, and localises at most one scan; returns whether it did."""
        handle_messages(self._node, timeout if not self._scans.n_waiting else min(timeout, 0.01))
        did = self._scans.advance()
        newest = self._scans.newest
        if did and newest is not None:
            self._locate(newest, self._scans.pose(len(self._scans) - 1))
        if self.diagnostics.is_due():
            self.diagnostics.publish(self.n_scans, self._n_components, self._nbytes)
        return did

    def _locate(self, newest: LiveScan, placed: Tensor | None) -> None:
        """Localises a scan that was measured at the pose `placed`, (D+1, D+1) fixed frame ← sensor."""
        assert placed is not None
        dim = newest.scan.dim
        if dim != self._tracker.dim:
            raise InvalidArgumentError(
                f"localize has a map in {self._tracker.dim}D, but topic {self._scans.name} has scans in "
                f"{dim}D; give a map of this kind of sensor."
            )
        points = (newest.scan.points - placed[:dim, dim]) @ placed[:dim, :dim]
        motion = None if self._last is None or not self._has_motion else torch.linalg.inv(self._last) @ placed
        self._last = placed
        location = self._tracker.locate(points.to(self._device), motion)
        self.n_scans += 1
        if not location.found:
            self.n_lost += 1
            counts = f"{self.n_lost} of {self.n_scans} scans were not found in the map"
            self._node.warn("lost", f"{counts}: {'; '.join(location.doubts)}")
            return
        self.poses.append(location.pose.cpu())
        self.times.append(newest.stamp / NANOSECONDS)
        child = self._scans.world_frame if self._has_motion else newest.frame
        below = in_space(placed.cpu().numpy()[None])[0] if self._has_motion else np.eye(4)
        self._poses.publish(location, newest, child, below)
        self.diagnostics.note_latency((self._node.now() - newest.stamp) / NANOSECONDS)
