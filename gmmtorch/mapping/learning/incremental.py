"""Maps that stay small as they grow: windows of scans learned, added, and merged under a budget."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gmmtorch.datasets.depth_frames import back_project
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.linalg import check_rigid
from gmmtorch.mapping.association import count_explained
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.cell_learning import CellRule, learn_cells
from gmmtorch.mapping.learning.merging import Size, compact, compact_to_bytes, estimated_bytes
from gmmtorch.mapping.learning.rules import IncrementalRule, NoveltyRule
from gmmtorch.mapping.learning.viewpoints import limit_origins
from gmmtorch.mapping.novelty import novel_beams
from gmmtorch.scan import Scan


def cell_rule(rule: IncrementalRule) -> CellRule:
    """What a window is learned by, of a rule that is `fitted`."""
    if rule.noise is None or rule.length is None or rule.cell is None:
        raise InvalidArgumentError("noise, length or cell is None; take rule.fitted(scans).")
    return CellRule(rule.noise, rule.length, rule.cell, rule.window_components, rule.iterations)


def absorb(
    components: Components, scans: Sequence[Scan], rule: IncrementalRule, size: Size = estimated_bytes
) -> Components:
    """The components of a map with scans added, merged until they are within the budget.

    Every `window` scans are learned together and added; `size` says what components take in bytes.
    Components that are not as they were are not numbered (see `compaction.UNNUMBERED`). Nothing is drawn
    at random: the same scans in the same order give the same map. Empty scans add nothing.
    """
    rule = rule.fitted(scans)
    for begin in range(0, len(scans), rule.window or len(scans)):
        components = _absorb_window(components, scans[begin:][: rule.window], rule, size)
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
    if frames:
        rule = rule.fitted([depth_scan(*frames[0], intrinsics, pixel_stride, max_range)])
    for begin in range(0, len(frames), rule.window or len(frames)):
        scans = [
            depth_scan(*frame, intrinsics, pixel_stride, max_range) for frame in frames[begin:][: rule.window]
        ]
        components = _absorb_window(components, scans, rule, size, float(pixel_stride**2))
    return components


def depth_scan(depth: Tensor, pose: Tensor, intrinsics: Tensor, pixel_stride: int, max_range: float) -> Scan:
    """The scan of a depth image, of every so manieth pixel; see `absorb_depth`."""
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
    if not any(scan.n_beams for scan in scans):
        return components
    origins = torch.stack([scan.origin.double() for scan in scans])
    ends, by = [(scan.points, scan.no_return) for scan in scans], _rule_of(scans, rule)
    returns = learn_cells([points for points, _ in ends], origins, by, weight=weight)
    empty = learn_cells([points for _, points in ends], origins, by, max_range=True, weight=weight)
    added = [part for part in (returns, empty) if len(part)]
    return _within_budget(Components.concatenate([components, *added]), rule, size) if added else components


def _rule_of(scans: Sequence[Scan], rule: IncrementalRule) -> CellRule:
    """Scans of nothing but beams without return say as much of the scale by where those were cut off."""
    if rule.noise is None or rule.length is None or rule.cell is None:
        rule = rule.fitted([Scan(scan.no_return, scan.origin) for scan in scans])
    return cell_rule(rule)


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
