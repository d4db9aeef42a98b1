"""SeveralSensors: the scans of several sensors of one robot, as one data set."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import torch
from torch import Tensor

from gmmtorch.datasets.base import Dataset
from gmmtorch.datasets.ros.rosbag import RosBag
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.scan import Scan


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
