"""What every robot's map offers to the mission, whatever it is made of."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from gmmtorch.errors import check_whole
from gmmtorch.exploration.robot.radio import ReceivedMessage
from gmmtorch.exploration.world.scoring import BeliefMap
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.novelty import beam_novelty
from gmmtorch.mapping.learning.rules import NoveltyRule
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.cell_evidence import CellEvidence
from gmmtorch.occupancy.voxels.rolling_window import RollingWindow
from gmmtorch.sharing.messages.message_registry import Message, decode
from gmmtorch.sharing.replica.intervals import Intervals
from gmmtorch.simulation.sensors.depth_camera import DepthFrame

T = TypeVar("T")
_BLOCK = 3  # pixels along the side of those that one beam speaks for


class FrameUpdate(NamedTuple):
    """What a frame has brought.

    evidence: what it adds to the robot's own map, in parts.
    novel: (N,) bool, the beams of the frame that the map learned from.
    """

    evidence: list[CellEvidence]
    novel: Tensor


class Memo:
    """Values of a pure function that several robots of a simulation would work out alike: kept a while.

    Robots that hear the same datagram get the same evidence from it, so one of them does the work. The
    least recently used of more than `size` are forgotten.
    """

    def __init__(self, size: int) -> None:
        self._size = check_whole("size", size, 1)
        self._values: OrderedDict[Hashable, Any] = OrderedDict()

    def __call__(self, key: Hashable, make: Callable[[], T]) -> T:
        """The value for `key`, made if it is not known."""
        if key in self._values:
            self._values.move_to_end(key)
        else:
            self._values[key] = make()
            if len(self._values) > self._size:
                self._values.popitem(last=False)
        value: T = self._values[key]
        return value

    def decoded(self, datagram: bytes) -> Message:
        """What a datagram says."""
        return self(("message", datagram), lambda: decode(datagram))


class Mapper(ABC):
    """One robot's map: a window of voxels to plan in, and behind it all that the robot knows.

    local: the window. belief: the map that the evaluator reads. What `sense` and `receive` take in is in
    both already when they return.

    Args:
        robot: its number. width: of its images, pixels. novelty: when a beam is novel.
        memo: of evidence; shared by the robots of a simulation.
    """

    def __init__(
        self,
        robot: int,
        local: RollingWindow,
        belief: BeliefMap,
        width: int,
        novelty: NoveltyRule,
        memo: Memo,
    ) -> None:
        self.local, self.belief = local, belief
        self._robot, self._width, self._novelty, self._memo = robot, width, novelty, memo

    @abstractmethod
    def center_on(self, position: Tensor) -> None:
        """Move the window along with the robot at (3,), and fill what it uncovers from what is known."""

    @abstractmethod
    def sense(self, frame: DepthFrame) -> FrameUpdate:
        """Learn from a frame of the robot's own camera."""

    @abstractmethod
    def receive(self, heard: Sequence[ReceivedMessage]) -> list[bytes]:
        """Learn from what teammates sent; returns the datagrams that were understood."""

    @abstractmethod
    def datagrams(self, budget: int | None = None) -> list[bytes]:
        """What is due to be sent to the team, in so many bytes at most; what does not fit stays due."""

    def announcements(self) -> list[bytes]:
        """What this robot holds, for those who have more or less."""
        return []

    @property
    def version(self) -> int:
        """Changes with what is announced."""
        return 0

    @property
    def held(self) -> Intervals:
        """Names of the records that the map is of, where it is of any."""
        return Intervals.empty()

    @property
    def is_behind(self) -> bool:
        """Whether it is known that others hold more."""
        return False

    def digest(self) -> bytes:
        """Equal for robots whose maps are the same, where they can tell."""
        return b""

    @abstractmethod
    def components(self) -> Components | None:
        """The mixture, of maps that are one."""

    def state(self) -> dict[str, Any]:
        """What `restore` of a mapper made alike needs to go on as this one."""
        return {"local": self.local.state(), "belief": self.belief.state()}

    def restore(self, state: dict[str, Any]) -> None:
        """Take the place of the mapper whose `state` is given; this one must be new."""
        self.local.restore(state["local"])
        self.belief.restore(state["belief"])

    def _add(self, evidence: CellEvidence) -> None:
        self.local.add(evidence)
        self.belief.add(evidence)


def novel_beams(
    local: RollingWindow,
    frame: DepthFrame,
    width: int,
    rule: NoveltyRule,
    within: Box,
    short: float = 0.0,
) -> Tensor:
    """Which beams (N,) of a frame tell the map something new; `width` of the image, pixels.

    The first beam of every three by three pixels speaks for all nine: neighbouring pixels are much closer
    to one another than the cells are large. `within`, `short`: see
    `beam_novelty`.
    """
    n, across = len(frame.pixel), -(-width // _BLOCK)
    block = frame.pixel // (_BLOCK * width) * across + frame.pixel % width // _BLOCK
    first = block.new_full((int(block.max()) + 1 if n else 0,), n)
    first.scatter_reduce_(0, block, torch.arange(n, device=block.device), "amin")
    present = first < n
    number = torch.cumsum(present, 0) - 1
    first = first[present]
    bits, unobserved = beam_novelty(
        local, frame.origin, frame.ends[first], frame.is_hit[first], rule, short=short, within=within
    )
    return (unobserved | (bits >= rule.threshold))[number[block]]
