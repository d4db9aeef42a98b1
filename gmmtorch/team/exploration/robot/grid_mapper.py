"""Voxel maps of robots (frameworks E1 and E2): teammates share novel points as they are, or nothing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from gmmtorch.mapping import NoveltyRule
from gmmtorch.occupancy import CellEvidence, RollingWindow, cast_evidence
from gmmtorch.simulation import DepthFrame
from gmmtorch.team.exploration.robot.mapper import FrameUpdate, Mapper, Memo, novel_beams
from gmmtorch.team.exploration.world.scoring import BeliefMap
from gmmtorch.team.sharing import (
    MOST_PARTS,
    Intervals,
    Message,
    PointsMessage,
    ReceivedMessage,
    SendOnce,
    decode,
    encode_points,
)

MOST_INTERVALS = 1 << 14
"""Intervals of received parts kept for a teammate; beyond, the oldest gaps count as received."""


class SharedPoints(SendOnce):
    """The points that a robot sends, and which parts of its teammates' frames have arrived. No losses are
    repaired, so nothing is announced.

    A robot numbers its frames from 0 in each session. So teammates ignore a restarted robot until its frames
    have higher numbers than before.

    Args:
        robot: its id. size: robots of the team.

    Attributes:
        refused: messages of points that were not merged: "stranger" (not from a teammate), "repeated"
            (received before, or so late that this is no longer known).
    """

    def __init__(self, robot: int, size: int) -> None:
        super().__init__()
        self.refused: Counter[str] = Counter()
        self._robot, self._size = robot, size
        self._n_frames = 0
        self._received: dict[int, Intervals] = {}  # parts of frames, by sender

    def add(self, frame: DepthFrame, novel: Tensor) -> list[bytes]:
        """Queues the novel beams (N,) bool of the next frame; returns the datagrams."""
        datagrams = []
        if bool(novel.any()):
            datagrams = encode_points(
                self._robot,
                self._n_frames,
                frame.origin.cpu(),
                frame.ends[novel].cpu(),
                frame.is_hit[novel].cpu(),
            )
        self._n_frames += 1
        self._due += datagrams
        return datagrams

    def accept(self, message: PointsMessage) -> bool:
        """Whether this part of a teammate's frame is new; from now on it counts as received."""
        if message.sender == self._robot or message.sender >= self._size:
            self.refused["stranger"] += 1
            return False
        number = message.frame * MOST_PARTS + message.part
        received = self._received.get(message.sender, Intervals.empty())
        if number in received:
            self.refused["repeated"] += 1
            return False
        self._received[message.sender] = _bounded(received | Intervals.span(number, number + 1))
        return True


class GridMapper(Mapper):
    """The voxel map of one robot.

    All beams of its own frames count. Teammates are sent, and count, the beams that were novel to the sender.
    The grid behind the window is `belief.grid`.

    Args:
        robot: its id. shares: whether the robot sends its novel points. size: robots of the team.
        decode: turns a datagram into a message; a memo's, where robots share one.
    """

    shared: SharedPoints

    def __init__(
        self,
        robot: int,
        local: RollingWindow,
        belief: BeliefMap,
        width: int,
        novelty: NoveltyRule,
        memo: Memo,
        shares: bool,
        size: int,
        decode: Callable[[bytes], Message] = decode,
    ) -> None:
        super().__init__(local, belief, width, novelty, memo)
        self.shared = SharedPoints(robot, size)
        self._shares, self._decode = shares, decode

    def center_on(self, position: Tensor) -> None:
        for box in self.local.center_on(position):
            self.local.add_from(self.belief.grid, box)

    def sense(self, frame: DepthFrame) -> FrameUpdate:
        novel = novel_beams(self.local, frame, self._width, self._novelty, self.belief.grid.box)
        parts, rest = [], torch.ones_like(novel)
        if self._shares and (datagrams := self.shared.add(frame, novel)):
            parts.append(self._evidence_of(datagrams))  # of the points as teammates receive them
            rest = ~novel
        grid = self.belief.grid
        parts.append(
            cast_evidence(frame.origin, frame.ends[rest], frame.is_hit[rest], grid.resolution, grid.box)
        )
        for part in parts:
            self._add(part)
        return FrameUpdate(parts, novel)

    def receive(self, received: Sequence[ReceivedMessage]) -> list[bytes]:
        frames: dict[tuple[int, int], list[bytes]] = {}
        for item in received:
            if isinstance(item.message, PointsMessage) and self.shared.accept(item.message):
                frames.setdefault((item.message.sender, item.message.frame), []).append(item.datagram)
        for datagrams in frames.values():
            self._add(self._evidence_of(datagrams))
        return [datagram for datagrams in frames.values() for datagram in datagrams]

    def components(self) -> None:
        """None: a grid has no components."""

    def _evidence_of(self, datagrams: list[bytes]) -> CellEvidence:
        """The evidence of the points of one frame."""

        def make() -> CellEvidence:
            messages = [self._decode(datagram) for datagram in datagrams]
            points = [message for message in messages if isinstance(message, PointsMessage)]
            grid = self.belief.grid
            ends = torch.cat([message.ends for message in points]).double().to(grid.device)
            is_hit = torch.cat([message.is_hit for message in points]).to(grid.device)
            origin = points[0].origin.double().to(grid.device)
            return cast_evidence(origin, ends, is_hit, grid.resolution, grid.box)

        return self._memo(tuple(datagrams), make)


def _bounded(numbers: Intervals) -> Intervals:
    """The same set, with its first gaps closed if it has more than `MOST_INTERVALS` intervals."""
    excess = max(0, len(numbers) - MOST_INTERVALS)
    return Intervals(np.concatenate([numbers.edges[:1], numbers.edges[1 + 2 * excess :]]))
