"""E1 and E2: maps of voxels; the novel points of each frame are shared as they are, or nothing is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.exploration.robot.mapper import FrameUpdate, Mapper, Memo, novel_beams
from gmmtorch.exploration.robot.radio import ReceivedMessage
from gmmtorch.exploration.world.scoring import BeliefMap
from gmmtorch.mapping.learning.rules import NoveltyRule
from gmmtorch.occupancy.voxels.cell_evidence import CellEvidence
from gmmtorch.occupancy.voxels.ray_casting import cast_evidence
from gmmtorch.occupancy.voxels.rolling_window import RollingWindow
from gmmtorch.sharing.messages.envelope import loaded, stored, within
from gmmtorch.sharing.messages.message_registry import Message, PointsMessage, decode, encode_points
from gmmtorch.sharing.messages.point_messages import MOST_PARTS
from gmmtorch.sharing.replica.intervals import Intervals
from gmmtorch.simulation.sensors.depth_camera import DepthFrame

MOST_INTERVALS = 1 << 14
"""Of the parts of a teammate's frames that have come; of more, the oldest gaps count as closed."""


class GridMapper(Mapper):
    """The map of one robot of a team with voxel grids.

    Its own frames count in full; `shared`: teammates are sent, and count, the beams that were novel to
    the sender. The grid behind the window is `belief.grid`. `size`: robots of the team.
    `decode`: what datagrams say, where others have asked already.

    Frames are numbered from 0 in each life of a robot: one that starts again is not heard until it is past
    what it said before.

    Attributes:
        refused: how many messages of points were not taken in: "stranger" (of no teammate), "repeated" (come
            before, or so late that nobody remembers).
    """

    def __init__(
        self,
        robot: int,
        local: RollingWindow,
        belief: BeliefMap,
        width: int,
        novelty: NoveltyRule,
        memo: Memo,
        shared: bool,
        size: int,
        decode: Callable[[bytes], Message] = decode,
    ) -> None:
        super().__init__(robot, local, belief, width, novelty, memo)
        self._shared, self._size, self._decode = shared, size, decode
        self.refused: Counter[str] = Counter()
        self._n_frames = 0
        self._due: list[bytes] = []
        self._come: dict[int, Intervals] = {}  # parts of teammates' frames, by sender

    def center_on(self, position: Tensor) -> None:
        for box in self.local.center_on(position):
            self.local.add_from(self.belief.grid, box)

    def sense(self, frame: DepthFrame) -> FrameUpdate:
        novel = novel_beams(self.local, frame, self._width, self._novelty, self.belief.grid.box)
        parts, datagrams = [], []
        if self._shared and bool(novel.any()):
            datagrams = encode_points(
                self._robot, self._n_frames, frame.origin, frame.ends[novel], frame.is_hit[novel]
            )
            parts.append(self._said(datagrams))  # from the points as they are sent
            rest = ~novel
        else:
            rest = torch.ones_like(novel)
        self._n_frames += 1
        self._due += datagrams
        grid = self.belief.grid
        parts.append(
            cast_evidence(frame.origin, frame.ends[rest], frame.is_hit[rest], grid.resolution, grid.box)
        )
        for part in parts:
            self._add(part)
        return FrameUpdate(parts, novel)

    def receive(self, heard: Sequence[ReceivedMessage]) -> list[bytes]:
        frames: dict[tuple[int, int], list[bytes]] = {}
        for item in heard:
            if isinstance(item.message, PointsMessage) and self._is_new(item.message):
                frames.setdefault((item.message.sender, item.message.frame), []).append(item.datagram)
        for datagrams in frames.values():
            self._add(self._said(datagrams))
        return [datagram for datagrams in frames.values() for datagram in datagrams]

    def _is_new(self, message: PointsMessage) -> bool:
        """Whether this part of a teammate's frame has not come before; it has, from now on."""
        if message.sender == self._robot or message.sender >= self._size:
            self.refused["stranger"] += 1
            return False
        number = message.frame * MOST_PARTS + message.part
        come = self._come.get(message.sender, Intervals.empty())
        if number in come:
            self.refused["repeated"] += 1
            return False
        self._come[message.sender] = _recent(come | Intervals.span(number, number + 1))
        return True

    def datagrams(self, budget: int | None = None) -> list[bytes]:
        n = within(self._due, budget)
        sent, self._due = self._due[:n], self._due[n:]
        return sent

    def _said(self, datagrams: list[bytes]) -> CellEvidence:
        """The evidence of the points of a frame that have arrived."""

        def make() -> CellEvidence:
            said = [self._decode(datagram) for datagram in datagrams]
            points = [message for message in said if isinstance(message, PointsMessage)]
            ends = torch.cat([message.ends for message in points]).double()
            is_hit = torch.cat([message.is_hit for message in points])
            grid = self.belief.grid
            return cast_evidence(points[0].origin.double(), ends, is_hit, grid.resolution, grid.box)

        return self._memo(tuple(datagrams), make)

    def components(self) -> None:
        """A grid has none."""

    def state(self) -> dict[str, Any]:
        return {
            **super().state(),
            "n_frames": self._n_frames,
            "due": [stored(datagram) for datagram in self._due],
            "come": [[sender, come.stored()] for sender, come in self._come.items()],
        }

    def restore(self, state: dict[str, Any]) -> None:
        super().restore(state)
        self._n_frames = int(state["n_frames"])
        self._due = [loaded(data) for data in state["due"]]
        self._come = {int(sender): Intervals.loaded(edges) for sender, edges in state["come"]}


def _recent(numbers: Intervals) -> Intervals:
    """The same set, with its first gaps closed where it has more than `MOST_INTERVALS` intervals."""
    excess = max(0, len(numbers) - MOST_INTERVALS)
    return Intervals(np.concatenate([numbers.edges[:1], numbers.edges[1 + 2 * excess :]]))
