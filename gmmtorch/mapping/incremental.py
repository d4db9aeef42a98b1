"""Maps that stay small as they grow: windows of scans learned, added, and merged under a budget."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.datasets.depth_frames import back_project
from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.linalg import check_rigid
from gmmtorch.mapping.cell_learning import learn_cells
from gmmtorch.mapping.compaction import Size, compact, compact_to_bytes, estimated_bytes
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.novelty import NoveltyRule, novel_beams
from gmmtorch.mapping.sightings import limit_origins
from gmmtorch.mapping.updating import count_explained
from gmmtorch.scan import Scan


@dataclass(frozen=True)
class IncrementalRule:
    """How scans are added to a map.

    noise: standard deviation of the range sensor (m); its square is the least variance of a component,
        and pieces of twice that thickness count as flat.
    length: largest standard deviation (m) along a component where it is learned; merging may exceed it.
    cell: side (m) of the cells that points are summed into before EM.
    window: neighbouring scans that are learned together.
    window_components: components of a window at most.
    iterations: of EM on a window's cells.
    n_components, max_bytes: the budget, of the whole map; either, both, or none.
    max_origins, mean_origins: sensor positions kept for a component, at most and on average; see
        `sightings.limit_origins`.
    max_cost: squared Hellinger distance up to which components are merged even if there is room.
    novelty: learn only from beams that tell something new, and count the points that components
        explain already to those (the thesis's way); None learns from all.
    """

    noise: float = 0.005
    length: float = 0.2
    cell: float = 0.03
    window: int = 8
    window_components: int = 250
    iterations: int = 6
    n_components: int | None = None
    max_bytes: int | None = None
    max_origins: int = 8
    mean_origins: float | None = 2.0
    max_cost: float | None = None
    novelty: NoveltyRule | None = None

    def __post_init__(self) -> None:
        for name in ("noise", "length", "cell"):
            if not 0 < getattr(self, name) < math.inf:
                raise InvalidArgumentError(f"{name}={getattr(self, name)} must be above zero metres.")
        for name in ("window", "window_components", "iterations", "max_origins"):
            check_whole(name, getattr(self, name), 1)
        for name in ("n_components", "max_bytes"):
            if getattr(self, name) is not None:
                check_whole(name, getattr(self, name), 1)
        if self.mean_origins is not None and not 1 <= self.mean_origins < math.inf:
            raise InvalidArgumentError(f"mean_origins={self.mean_origins} must be at least 1, or null.")
        if self.max_cost is not None and not 0 <= self.max_cost < 1:
            raise InvalidArgumentError(
                f"max_cost={self.max_cost} must be at least 0 (equal) and below 1 (no overlap)."
            )


def absorb(
    components: Components, scans: Sequence[Scan], rule: IncrementalRule, size: Size = estimated_bytes
) -> Components:
    """The components of a map with scans added, merged until they are within the budget.

    Every `window` scans are learned together and added; `size` says what components take in bytes.
    Components that are not as they were are not numbered (see `compaction.UNNUMBERED`). Nothing is drawn
    at random: the same scans in the same order give the same map. Empty scans add nothing.
    """
    for begin in range(0, len(scans), rule.window):
        components = _absorb_window(components, scans[begin : begin + rule.window], rule, size)
    return components


def absorb_depth(
    components: Components,
    frames: Sequence[tuple[Tensor, Tensor]],
    intrinsics: Tensor,
    rule: IncrementalRule,
    pixel_stride: int = 4,
    max_range: float = math.inf,
    size: Size = estimated_bytes,
) -> Components:
    """Depth images added to a map: `frames` of depth (H, W), metres, and pose (4, 4), world ← camera.

    Every `pixel_stride`-th pixel of every `pixel_stride`-th row is taken, and stands for as many as that
    leaves out. What is beyond `max_range` metres along the axis, zero or not finite, is left out.
    """
    for begin in range(0, len(frames), rule.window):
        scans = [
            _seen(*frame, intrinsics, pixel_stride, max_range)
            for frame in frames[begin : begin + rule.window]
        ]
        components = _absorb_window(components, scans, rule, size, float(pixel_stride**2))
    return components


def _seen(depth: Tensor, pose: Tensor, intrinsics: Tensor, pixel_stride: int, max_range: float) -> Scan:
    rotation, translation = check_rigid(pose, 3)
    taken = depth[::pixel_stride, ::pixel_stride]
    valid = torch.isfinite(taken) & (taken < max_range)
    scaled = intrinsics.double().clone()
    scaled[:2] /= pixel_stride
    points = back_project(torch.where(valid, taken, 0.0).double(), scaled)
    return Scan(points @ rotation.T + translation, translation)


def _absorb_window(
    components: Components, scans: Sequence[Scan], rule: IncrementalRule, size: Size, weight: float = 1.0
) -> Components:
    for scan in scans:
        if scan.dim != components.dim:
            raise InvalidArgumentError(
                f"The scan is {scan.dim}-dimensional and the map {components.dim}-dimensional; give the "
                "scans of one sensor to one map."
            )
    if rule.novelty is not None:
        components, scans = _explain(components, scans, rule.novelty, weight)
    origins = torch.stack([scan.origin.double() for scan in scans])
    returns = learn_cells([scan.points for scan in scans], origins, rule, weight=weight)
    empty = learn_cells([scan.no_return for scan in scans], origins, rule, max_range=True, weight=weight)
    added = [part for part in (returns, empty) if len(part)]
    return _within_budget(Components.concatenate([components, *added]), rule, size) if added else components


def _explain(
    components: Components, scans: Sequence[Scan], rule: NoveltyRule, weight: float
) -> tuple[Components, list[Scan]]:
    """The novel beams that no component explains, and the components with the counts of those explained."""
    left = []
    for scan in scans:
        fresh = scan.select(novel_beams(components, scan, rule))
        keep = []
        for points, max_range in ((fresh.points, False), (fresh.no_return, True)):
            components, explained = count_explained(
                components, points, scan.origin, rule.distance, rule.explained, max_range, weight
            )
            keep.append(~explained)
        left.append(fresh.select(torch.cat(keep)))
    return components, left


def _within_budget(components: Components, rule: IncrementalRule, size: Size) -> Components:
    if rule.max_cost is not None:
        components = compact(components, None, rule.max_cost)
    if rule.n_components is not None:
        components = compact(components, rule.n_components)
    components = limit_origins(components, rule.max_origins, rule.mean_origins)
    if rule.max_bytes is not None:
        components = compact_to_bytes(components, rule.max_bytes, rule.max_origins, rule.mean_origins, size)
    return components
