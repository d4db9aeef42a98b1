"""Mapper: the interface between a robot and its map; LocalMap, which its planner reads; and voxel maps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from gmmtorch.errors import check_whole
from gmmtorch.mapping import Components, NoveltyRule, beam_novelty
from gmmtorch.occupancy import Box, CellEvidence, RollingWindow, cast_evidence
from gmmtorch.simulation import DepthFrame
from gmmtorch.team.exploration.mission.options import TeamOptions
from gmmtorch.team.exploration.world.scoring import BeliefMap
from gmmtorch.team.sharing import (
    Broadcast,
    Message,
    PointsMessage,
    ReceivedMessage,
    Replica,
    SharedPoints,
    decode,
)


@dataclass(frozen=True, eq=False)
class LocalMap:
    """A dense snapshot (nx, ny, nz) of the cells of the sliding map.

    low: (3,) int64, index of the lowest cell; cell c is [c, c + 1) · resolution, world frame.
    resolution: side (m) of the cells.
    occupancy: (nx, ny, nz) float32, with the planner's prior where nothing was observed.
    observed: bool, cells with any evidence.
    free: bool, known to be free.
    passable: bool, where the centre of the robot may be: all cells that its body touches are free.
    """

    low: Tensor
    resolution: float
    occupancy: Tensor
    observed: Tensor
    free: Tensor
    passable: Tensor

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.free.shape)

    @property
    def box(self) -> Box:
        return Box(self.low, self.low + torch.tensor(self.shape))

    @cached_property
    def _size(self) -> Tensor:
        return torch.tensor(self.shape)

    def cells_of(self, points: Tensor) -> Tensor:
        """Indices (..., 3) int64, relative to `low`, of the cells that contain points (..., 3), metres."""
        return (points / self.resolution).floor().long() - self.low

    def flat_index(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Flat row-major indices (...,) of points (..., 3), 0 where outside; and whether each is inside."""
        cell = self.cells_of(points)
        inside = ((cell >= 0) & (cell < self._size)).all(-1)
        _, ny, nz = self.shape
        flat = (cell[..., 0] * ny + cell[..., 1]) * nz + cell[..., 2]
        return torch.where(inside, flat, 0), inside

    def is_passable(self, points: Tensor) -> Tensor:
        """Whether the centre of the robot may be at points (..., 3), metres; False outside the map."""
        flat, inside = self.flat_index(points)
        return self.passable.view(-1)[flat] & inside

    def centers(self, cells: Tensor) -> Tensor:
        """Centres (..., 3), metres, of cells (..., 3) relative to `low`."""
        return (cells + self.low + 0.5).double() * self.resolution


T = TypeVar("T")


class FrameUpdate(NamedTuple):
    """What a map learned from a frame of N beams.

    evidence: what the frame adds to the robot's own map, in parts.
    novel: (N,) bool, the beams that the map learned from.
    """

    evidence: list[CellEvidence]
    novel: Tensor


class Memo:
    """A cache of a pure function's values, which the robots of a simulation share. Robots that receive the
    same datagram get the same evidence from it, so one computation serves all. The cache keeps the `size`
    values used last."""

    def __init__(self, size: int) -> None:
        self._size = check_whole("size", size, 1)
        self._values: OrderedDict[Hashable, Any] = OrderedDict()

    def __call__(self, key: Hashable, make: Callable[[], T]) -> T:
        """The value for `key`, computed by `make` if it is not cached."""
        if key in self._values:
            self._values.move_to_end(key)
        else:
            self._values[key] = make()
            if len(self._values) > self._size:
                self._values.popitem(last=False)
        value: T = self._values[key]
        return value

    def decoded(self, datagram: bytes) -> Message:
        """The message of a datagram. Raises `DataError` for a damaged one."""
        return self(("message", datagram), lambda: decode(datagram))


class Mapper(ABC):
    """One robot's map: a window of voxels to plan in, and a map of the whole world behind it.

    `sense` and `receive` have updated both when they return.

    Args:
        local: the window. belief: the map of the world, which the evaluator reads.
        memo: cache of evidence; shared by the robots of a simulation.

    Attributes:
        shared: what teammates receive.
    """

    shared: Replica | Broadcast | SharedPoints

    def __init__(self, local: RollingWindow, belief: BeliefMap, options: TeamOptions, memo: Memo) -> None:
        self.local, self.belief = local, belief
        self._width, self._novelty, self._memo = options.camera.width, options.novelty, memo

    @abstractmethod
    def center_on(self, position: Tensor) -> None:
        """Moves the window to a robot at (3,), metres, and fills the cells that it uncovers."""

    @abstractmethod
    def sense(self, frame: DepthFrame) -> FrameUpdate:
        """Learns from a frame of the robot's own camera."""

    @abstractmethod
    def receive(self, received: Sequence[ReceivedMessage]) -> list[bytes]:
        """Merges messages of teammates; returns the datagrams that were merged."""

    @abstractmethod
    def components(self) -> Components | None:
        """The mixture; None for maps of voxels."""

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
    side: int = 3,
) -> Tensor:
    """Which beams (N,) of a frame are novel to a map.

    The first beam of each block of `side` × `side` pixels decides for the block: neighbouring pixels are much
    closer to one another than the cells are wide.

    width: of the image, pixels. within, short: see `beam_novelty`.
    """
    n, across = len(frame.pixel), -(-width // side)
    block = frame.pixel // (side * width) * across + frame.pixel % width // side
    first = block.new_full((int(block.max()) + 1 if n else 0,), n)
    first.scatter_reduce_(0, block, torch.arange(n, device=block.device), "amin")
    present = first < n
    number = torch.cumsum(present, 0) - 1
    first = first[present]
    bits, unobserved = beam_novelty(
        local, frame.origin, frame.ends[first], frame.is_hit[first], rule, short=short, within=within
    )
    return (unobserved | (bits >= rule.threshold))[number[block]]


class GridMapper(Mapper):
    """The voxel map of one robot.

    All beams of its own frames count. Teammates are sent, and count, the beams that were novel to the sender.
    The grid behind the window is `belief.grid`.

    Args:
        robot: its id. decode: turns a datagram into a message; a cached one, where robots share the work.
    """

    shared: SharedPoints

    def __init__(
        self,
        robot: int,
        local: RollingWindow,
        belief: BeliefMap,
        options: TeamOptions,
        memo: Memo,
        decode: Callable[[bytes], Message] = decode,
    ) -> None:
        super().__init__(local, belief, options, memo)
        self.shared = SharedPoints(robot, options.size)
        self._shares, self._decode = options.shares, decode

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
