"""Mapper: the interface between a robot and its map; maps of voxels, and of mixtures."""

from __future__ import annotations

import hashlib
import itertools
import operator
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from gmmtorch.errors import check_whole
from gmmtorch.mapping import (
    Components,
    NoveltyRule,
    all_origins,
    beam_novelty,
    box_around,
    count_explained,
    explained_within,
    fit_window,
    quantized,
    summed,
)
from gmmtorch.occupancy import Box, CellEvidence, RollingWindow, cast_evidence, cone_bounds, intersection
from gmmtorch.scan import Scan
from gmmtorch.simulation import DepthFrame
from gmmtorch.team.exploration.mission.options import TeamOptions
from gmmtorch.team.exploration.robot.component_rays import RayRule, component_evidence
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


_LEEWAY = 0.5  # cells
_EMPTY_RAYS = 0.75  # of the rays of components of surfaces: components of free space overlap far more
_EMPTY_CUTOFF = 2.0
"""Mahalanobis distance. Tails of components of free space reach through surfaces that beams just missed."""


_REACH = 3.0  # deviations around the means in which the rays of components end


class _Boxes:
    """Batches of components, each with the box (2, 3) around its rays, or around what it explains, metres."""

    def __init__(self) -> None:
        self._batches: list[Components] = []
        self._corners = torch.zeros(0, 2, 3, dtype=torch.float64)

    def add(self, batch: Components, low: Tensor, high: Tensor) -> None:
        """Adds a batch of K parts with boxes from `low` to `high`, (K, 3)."""
        self._batches.append(batch)
        corners = torch.stack([low.amin(0), high.amax(0)])[None]
        self._corners = torch.cat([self._corners.to(corners), corners])

    def near(self, low: Tensor, high: Tensor) -> list[Components]:
        """The batches whose box meets that from `low` to `high`, (3,), in the order of `add`."""
        first, last = self._corners.unbind(1)
        meets = ((first <= high.to(first)) & (last >= low.to(last))).all(1)
        return [self._batches[row] for row in meets.nonzero().squeeze(1).tolist()]


class GmmMapper(Mapper):
    """The map of one robot of a team that learns mixtures from novel beams and shares them (thesis Fig 4.1).

    Components are immutable; points that they explain later become counts, which any robot may add. All
    robots, the owner included, hold components as they are decoded from datagrams, so all maps are equal to
    the bit. The voxels follow the mixture: each change of the mixture is cast into them once.

    Args:
        shared: the empty mixture; a `Replica`, or a `Broadcast` for codecs other than "quantized".
    """

    shared: Replica | Broadcast

    def __init__(
        self,
        local: RollingWindow,
        belief: BeliefMap,
        options: TeamOptions,
        memo: Memo,
        shared: Replica | Broadcast,
    ) -> None:
        super().__init__(local, belief, options, memo)
        self.shared = shared
        self._rule = rule = options.frame
        self._rays = RayRule(
            local.resolution,
            rays_per_cell=rule.rays,
            empty_rays_per_cell=_EMPTY_RAYS * rule.rays,
            empty_cutoff=_EMPTY_CUTOFF,
            shell=rule.shell,
            hits_per_ray=rule.hits_per_ray,
        )
        self._gained: dict[tuple[int, int], float] = {}  # counts that have not grown enough, by id
        self._due: dict[tuple[int, int], float] = {}  # counts that are sent with the next message
        self._n_frames = 0
        self._forget()

    def _forget(self) -> None:
        """Forgets where batches are."""
        self._by_rays, self._by_explained = _Boxes(), _Boxes()
        self._by_origin: dict[tuple[int, ...], list[Components]] = {}  # batches by the cell of their origins
        self._near: tuple[list[Components], Components] | None = None  # the last `_seen_from_near`

    def center_on(self, position: Tensor) -> None:
        for uncovered in self.local.center_on(position):
            box, side = intersection(uncovered, self.belief.grid.box), self.local.resolution
            # Rays are clipped to the uncovered cells, so nothing is counted twice (thesis Fig 4.2).
            if box is not None and (near := self._by_rays.near(*(side * corner.double() for corner in box))):
                self.local.add(component_evidence(Components.concatenate(near), box, self._rays))

    def sense(self, frame: DepthFrame) -> FrameUpdate:
        rule = self._rule
        novel = learned = self._novel(frame)
        if rule.update_novel:
            learned = novel & ~self._count(frame, novel.nonzero().squeeze(1), 1)
        if rule.update_stride is not None:
            self._count(frame, (~novel).nonzero().squeeze(1)[:: rule.update_stride], rule.update_stride)
        components = self._learned(frame, learned)
        if isinstance(self.shared, Replica):
            components = quantized(components, coarse=True)
        self.shared.add(components)
        self._n_frames += 1
        if self._n_frames % rule.update_every == 0:
            self.shared.count(self._due)
            self._due = {}
        return FrameUpdate(self._follow(), novel)

    def _novel(self, frame: DepthFrame) -> Tensor:
        """Which beams (N,) of a frame are novel."""
        rule = self._rule
        # Components do not count cells close to surfaces as free: this must not make beams novel.
        short = (rule.shell + _LEEWAY) * self.local.resolution if rule.shell else 0.0
        within, side = self.belief.grid.box, rule.novelty_block
        return novel_beams(self.local, frame, self._width, self._novelty, within, short, side)

    def _learned(self, frame: DepthFrame, novel: Tensor) -> Components:
        """The components of the novel beams, on the CPU, where messages are encoded."""
        scan = Scan(frame.ends[novel & frame.is_hit], frame.origin, frame.ends[novel & ~frame.is_hit])
        return fit_window([scan], self._rule.surface_fit(), all_origins())

    def _count(self, frame: DepthFrame, chosen: Tensor, weight: int) -> Tensor:
        """Adds the beams `chosen` (M,) to the counts of the components that explain them, with a weight each;
        returns which of all beams (N,) are explained."""
        rule, found = self._novelty, torch.zeros_like(frame.is_hit)
        is_near = rule.distance_for == "all"
        nearby = self._seen_from_near(frame.origin) if is_near else self._around(frame.ends[chosen])
        if nearby is None or len(chosen) == 0:
            return found
        # A beam whose way alone makes it novel contributes free space, and so does one without return.
        way = replace(frame, is_hit=torch.zeros_like(frame.is_hit))
        frees = None if is_near else self._novel(way) | ~frame.is_hit
        counted = nearby
        for max_range in (False, True):
            beams = chosen[frame.is_hit[chosen] != max_range]
            counted, found[beams] = count_explained(
                counted,
                frame.ends[beams],
                frame.origin,
                rule.distance,
                rule.explained,
                max_range,
                weight,
                None if frees is None else frees[beams],
            )
        self._gain(nearby, counted.support - nearby.support)
        return found

    def _gain(self, nearby: Components, gain: Tensor) -> None:
        """Adds points (K,) to the counts of components; counts that have grown enough become due."""
        rows = (gain > 0).nonzero().squeeze(1)
        columns = (nearby.ids[rows], gain[rows], nearby.support[rows])
        for (robot, sequence), gained, support in zip(*(c.tolist() for c in columns), strict=True):
            key = (robot, sequence)
            total = self._gained.pop(key, 0.0) + gained
            if total >= (self._rule.update_at - 1) * support:
                self._due[key] = self._due.get(key, 0.0) + total
            else:
                self._gained[key] = total

    def _around(self, points: Tensor) -> Components | None:
        """Components, with all counts, of the batches that may explain points (M, 3); None if none may."""
        near = self._by_explained.near(*points.aminmax(dim=0)) if len(points) else []
        return summed(Components.concatenate(near)) if near else None

    def _seen_from_near(self, origin: Tensor) -> Components | None:
        """Components with all their counts, of batches seen from near a place (3,); None: there are none."""
        middle = self._origin_cell(origin)
        near = [
            batch
            for offset in itertools.product((-1, 0, 1), repeat=3)
            for batch in self._by_origin.get(tuple(a + b for a, b in zip(middle, offset, strict=True)), [])
        ]
        if not near:
            return None
        known = [] if self._near is None else self._near[0]
        if self._near is None or len(known) != len(near) or any(map(operator.is_not, known, near)):
            self._near = near, summed(Components.concatenate(near))
        return self._near[1]

    def _origin_cell(self, origin: Tensor) -> tuple[int, ...]:
        """The cell of `_by_origin` that contains a place (3,)."""
        return tuple((origin / self._novelty.distance).floor().long().tolist())

    def receive(self, received: Sequence[ReceivedMessage]) -> list[bytes]:
        merged = [item.datagram for item in received if self.shared.receive(item.datagram, item.message)]
        self._follow()
        return merged

    def components(self) -> Components:
        """All components with all their counts, sorted by id."""
        return self.shared.components()

    def _follow(self) -> list[CellEvidence]:
        """Enters the changes of the mixture since the last call; returns their evidence, in parts."""
        changes = self.shared.changes()
        if changes.rebuilt:
            self._rebuild()
            return []
        batches = [*itertools.chain(*map(_frames, changes.added)), changes.gained]
        return [self._enter(batch) for batch in batches if len(batch)]

    def _rebuild(self) -> None:
        """Casts the whole mixture again, after components were moved or replaced."""
        self.local.clear()
        self.belief.clear()
        self._forget()
        everything = self.shared.components()
        if len(everything):
            self._enter(everything)

    def _enter(self, batch: Components) -> CellEvidence:
        """Enters a batch of components, or of counts added to some; returns its evidence."""
        grid = self.belief.grid
        there = batch.to(grid.device)
        self._by_rays.add(there, *cone_bounds(there.cones(), _REACH))
        self._by_explained.add(there, *box_around(there, explained_within(3, self._novelty.explained)))
        for cell in {self._origin_cell(origin) for origin in batch.origins}:
            self._by_origin.setdefault(cell, []).append(there)
        evidence = self._memo(_key(batch), lambda: component_evidence(there, grid.box, self._rays))
        self._add(evidence)
        return evidence


def _frames(batch: Components) -> list[Components]:
    """The components of each frame of a batch, as their robot learned them, so that their evidence is cached.
    A component of several frames is in the last one."""
    if len(batch.origins) < 2:
        return [batch]
    seen_from = batch.seen_from.new_zeros(len(batch)).scatter_(0, batch.seen_by, batch.seen_from)
    return [
        batch.selected((seen_from == origin).nonzero().squeeze(1)).with_used_origins()
        for origin in torch.unique(seen_from)
    ]


def _key(batch: Components) -> bytes:
    """A hash of all values of a batch: corrected components keep their ids and support."""
    digest = hashlib.blake2b(digest_size=16)
    for value in batch.tensors().values():
        digest.update(value.contiguous().numpy().tobytes())
    return digest.digest()
