"""Mixture maps of robots (framework E0): components learned from novel beams, and shared (thesis Fig 4.1).

Components are immutable; points that they explain later become counts, which any robot may add. All robots,
the owner included, hold components as they are decoded from datagrams, so all maps are equal to the bit.
The voxels follow the mixture: each change of the mixture is cast into them once.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.exploration.robot.mapper import FrameUpdate, Mapper, Memo, novel_beams
from gmmtorch.exploration.robot.radio import ReceivedMessage
from gmmtorch.exploration.world.scoring import BeliefMap
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.association import count_explained, summed
from gmmtorch.mapping.learning.fitting import SurfaceFit, fit_window
from gmmtorch.mapping.learning.incremental import cell_fit
from gmmtorch.mapping.learning.rules import NoveltyRule
from gmmtorch.mapping.learning.viewpoints import all_origins
from gmmtorch.mapping.rays.component_rays import component_evidence
from gmmtorch.mapping.rays.mixture_tiles import MixtureTiles, regenerate
from gmmtorch.occupancy.voxels.boxes import Box, intersection
from gmmtorch.occupancy.voxels.cell_evidence import CellEvidence, sum_evidence
from gmmtorch.occupancy.voxels.rolling_window import RollingWindow
from gmmtorch.scan import Scan
from gmmtorch.sharing.broadcast import Broadcast
from gmmtorch.sharing.replica.replica import Replica
from gmmtorch.simulation.sensors.depth_camera import DepthFrame

_HITS_PER_RAY = 8
_LEEWAY = 0.5  # cells
_FRAMES_PER_COUNT = 10
"""Frames between two messages of counts: they are then few and large, and seldom change the mixture."""
_EMPTY_LENGTH = 0.75  # of the length of components of surfaces
_EMPTY_RAYS = 0.75  # of the rays of components of surfaces: components of free space overlap far more
_EMPTY_CUTOFF = 2.0
"""Mahalanobis distance. Tails of components of free space reach through surfaces that beams just missed."""


@dataclass(frozen=True)
class FrameRule:
    """How a frame becomes components; lengths in metres. See `IncrementalRule` for the first five.

    rays: for each cell that a component covers; see `component_evidence`.
    shell: cells in front of a component's surface that its rays do not count as free.
    update_at: counts of a component are sent once they have grown by this factor.
    update_stride: of the explained beams, every `update_stride`-th is counted, with that weight.
    """

    noise: float = 0.03
    length: float = 0.6
    cell: float = 0.15
    components: int = 200
    iterations: int = 4
    rays: float = 4.0
    shell: float = 0.5
    update_at: float = 3.0
    update_stride: int = 11

    def __post_init__(self) -> None:
        for name in ("noise", "length", "cell"):
            if not getattr(self, name) > 0:
                raise InvalidArgumentError(f"{name}={getattr(self, name)} must be above zero metres.")
        if not self.rays > 0 or not self.shell >= 0:
            raise InvalidArgumentError(
                f"rays={self.rays} must be above zero, shell={self.shell} at least zero."
            )
        for name in ("components", "iterations", "update_stride"):
            check_whole(name, getattr(self, name), 1)
        if not self.update_at > 1:
            raise InvalidArgumentError(f"update_at={self.update_at} must be above 1.")

    def surface_fit(self) -> SurfaceFit:
        """How the returns of a frame become components."""
        return cell_fit(self.noise, self.length, self.cell, self.components, self.iterations, 3)

    def empty_fit(self) -> SurfaceFit:
        """The same for no-return beams: finer, because they end at the edges of the field of view."""
        return replace(self, length=_EMPTY_LENGTH * self.length).surface_fit()


class GmmMapper(Mapper):
    """The map of one robot of a team that shares mixtures.

    Args:
        shared: the empty mixture; a `Replica`, or a `Broadcast` for codecs other than "quantized".
    """

    shared: Replica | Broadcast

    def __init__(
        self,
        robot: int,
        local: RollingWindow,
        belief: BeliefMap,
        width: int,
        novelty: NoveltyRule,
        rule: FrameRule,
        memo: Memo,
        shared: Replica | Broadcast,
    ) -> None:
        super().__init__(robot, local, belief, width, novelty, memo)
        self.shared = shared
        self.tiles = MixtureTiles()
        self._rule = rule
        self._gained: dict[tuple[int, int], float] = {}  # counts that have not grown enough, by id
        self._due: dict[tuple[int, int], float] = {}  # counts that are sent with the next message
        self._n_frames = 0
        self._by_origin: dict[tuple[int, ...], list[Components]] = {}  # batches by the cell of their origins

    # -- sensing ----------------------------------------------------------------------------------

    def center_on(self, position: Tensor) -> None:
        uncovered = [intersection(box, self.belief.grid.box) for box in self.local.center_on(position)]
        boxes = [box for box in uncovered if box is not None]
        regenerate(self.local, boxes, self.tiles, self._evidence)

    def sense(self, frame: DepthFrame) -> FrameUpdate:
        # Components do not count cells close to surfaces as free: this must not make beams novel.
        short = (self._rule.shell + _LEEWAY) * self.local.resolution if self._rule.shell else 0.0
        novel = novel_beams(self.local, frame, self._width, self._novelty, self.belief.grid.box, short)
        self._count(frame, ~novel)
        self.shared.add(self._learned(frame, novel).to("cpu"))  # where messages are encoded
        self._n_frames += 1
        if self._n_frames % _FRAMES_PER_COUNT == 0:
            self.shared.count(self._due)
            self._due = {}
        return FrameUpdate(self._follow(), novel)

    def _learned(self, frame: DepthFrame, novel: Tensor) -> Components:
        """The components of the novel beams."""
        scan = Scan(frame.ends[novel & frame.is_hit], frame.origin, frame.ends[novel & ~frame.is_hit])
        return fit_window([scan], self._rule.surface_fit(), all_origins(), self._rule.empty_fit())

    def _count(self, frame: DepthFrame, known: Tensor) -> None:
        """Adds the beams (N,) that were not novel to the counts of the components that explain them."""
        nearby = self._seen_from_near(frame.origin)
        chosen = known.nonzero().squeeze(1)[:: self._rule.update_stride]
        if nearby is None or len(chosen) == 0:
            return
        weight = float(self._rule.update_stride)
        counted = nearby
        for max_range in (False, True):
            ends = frame.ends[chosen[frame.is_hit[chosen] != max_range]]
            counted = count_explained(
                counted, ends, frame.origin, self._novelty.distance, None, max_range, weight
            ).components
        gain = counted.support - nearby.support
        rows = (gain > 0).nonzero().squeeze(1)
        columns = (nearby.ids[rows], gain[rows], nearby.support[rows])
        for (robot, sequence), gained, support in zip(*(c.tolist() for c in columns), strict=True):
            key = (robot, sequence)
            total = self._gained.pop(key, 0.0) + gained
            if total >= (self._rule.update_at - 1) * support:
                self._due[key] = self._due.get(key, 0.0) + total
            else:
                self._gained[key] = total

    def _seen_from_near(self, origin: Tensor) -> Components | None:
        """Components with all their counts, of batches seen from near a place (3,); None: there are none."""
        middle = self._origin_cell(origin)
        near = [
            batch
            for offset in itertools.product((-1, 0, 1), repeat=3)
            for batch in self._by_origin.get(tuple(a + b for a, b in zip(middle, offset, strict=True)), [])
        ]
        return summed(Components.concatenate(near)) if near else None

    def _origin_cell(self, origin: Tensor) -> tuple[int, ...]:
        """The cell of `_by_origin` that contains a place (3,)."""
        return tuple((origin / self._novelty.distance).floor().long().tolist())

    # -- the mixture ------------------------------------------------------------------------------

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
        batches = [*changes.added, changes.gained]
        return [self._enter(batch) for batch in batches if len(batch)]

    def _rebuild(self) -> None:
        """Casts the whole mixture again, after components were moved or replaced. None of this is new
        evidence."""
        self.local.clear()
        self.belief.clear()
        self.tiles, self._by_origin = MixtureTiles(), {}
        everything = self.shared.components()
        if len(everything):
            self._enter(everything)

    def _enter(self, batch: Components) -> CellEvidence:
        """Enters a batch of components, or of counts added to some; returns its evidence."""
        grid = self.belief.grid
        there = batch.to(grid.device)
        self.tiles.add(len(self.tiles), there)
        for cell in {self._origin_cell(origin) for origin in batch.origins}:
            self._by_origin.setdefault(cell, []).append(there)
        evidence = self._memo(_key(batch), lambda: self._evidence(there, grid.resolution, grid.box))
        self._add(evidence)
        return evidence

    def _evidence(self, batch: Components, resolution: float, box: Box) -> CellEvidence:
        """The evidence of components for the cells of a box."""
        rule = self._rule
        surfaces, empty = (
            batch.selected((batch.max_range == kind).nonzero().squeeze(1)) for kind in (False, True)
        )
        parts = []
        if len(surfaces):
            parts.append(
                component_evidence(
                    surfaces,
                    resolution,
                    box,
                    rays_per_cell=rule.rays,
                    shell=rule.shell,
                    hits_per_ray=_HITS_PER_RAY,
                    thinned=True,
                )
            )
        if len(empty):
            rays = _EMPTY_RAYS * rule.rays
            parts.append(
                component_evidence(
                    empty, resolution, box, rays_per_cell=rays, cutoff=_EMPTY_CUTOFF, thinned=True
                )
            )
        return sum_evidence(parts) if parts else CellEvidence.empty(box.low.device)


def _key(batch: Components) -> bytes:
    """A hash of all values of a batch: corrected components keep their ids and support."""
    digest = hashlib.blake2b(digest_size=16)
    for value in vars(batch).values():
        digest.update(value.contiguous().numpy().tobytes())
    return digest.digest()
