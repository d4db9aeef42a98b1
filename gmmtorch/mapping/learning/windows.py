"""Learning from windows of scans: their components are added to those of a map, and merged under a budget.

Forgetting: components that later beams contradict, or that are old, leave the map.

Contradiction. A surface that is still there stops at least a share q of the beams that meet it; one that is
gone stops at most a share ε. A component that is thicker than flat pieces joins several surfaces, with gaps
between them, so that its q and ε are lower. A scan of which `passed` beams went through a component and
`returned` ones ended on it changes the log-odds that the surface is gone by

    w (passed · log((1 − ε)/(1 − q)) + returned · log(ε/q)),

where w lets the beams of a scan count as at most a few independent ones, because they share the error of its
pose. The log-odds start at 0 and stay between 0 and log(_CERTAIN). A component that ends a window at the
upper limit is dropped (Page's cumulative sum test, Biometrika 41, 1954). Because of the lower limit, many
early returns do not delay the removal of a surface that is gone later.

Half-life. Counts of all components are halved for every half-life between the times of two windows.

Prediction: what a map says about a window's beams before it learns from them. The predictions calibrate the
map, see `occupancy.calibrator`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import PassLimits, beam_passes, few_points_evidence, is_fused
from gmmtorch.mapping.attributes.reflectivity import estimated
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning import merging
from gmmtorch.mapping.learning.fitting import (
    DepthFrame,
    SurfaceFit,
    as_scans,
    fit_frames,
    fit_window,
    mean_range,
)
from gmmtorch.mapping.learning.novelty import count_explained, explained_within, novel_beams
from gmmtorch.mapping.learning.rules import (
    CONTRADICTION,
    FORGET_OFF,
    IncrementalRule,
    LearningRule,
    NoveltyRule,
    WindowedRule,
)
from gmmtorch.mapping.query import Block, boxes_of, cutoff_for
from gmmtorch.mixture import (
    SOFTMAX_DTYPES,
    FlatnessRule,
    Parameters,
    most_likely_component,
    quadratic_features,
    surface_rule,
)
from gmmtorch.occupancy import Calibrator, Cones, Prediction, few_point_evidence, spectrum_of, whitening
from gmmtorch.scan import INTENSITY, Scan

BeforeWindow = Callable[[Components, Sequence[Scan | DepthFrame]], None]
"""Is called with the components of a map before a window, and the window."""


def absorb(
    components: Components,
    scans: Iterable[Scan | DepthFrame],
    rule: IncrementalRule,
    size: merging.Size,
    weight: float = 1.0,
    doubts: Doubts | None = None,
    before: BeforeWindow | None = None,
) -> tuple[Components, Doubts]:
    """The components of a map with scans added, merged until they meet the budget; and the doubts after them.

    Every `rule.window` scans are learned together; scans are taken from the iterable window by window.
    Nothing is random: the same scans in the same order give the same map. Components that are new or
    changed are not numbered (`UNNUMBERED`). Scans without beams add nothing.

    Args:
        scans: or frames, whose pixels are summed into cells at once.
        rule: if it is not complete, it is fitted to all scans, which are then read at once.
        size: for `rule.max_bytes`.
        weight: number of measured points for which each point of the scans stands.
        doubts: before these scans; None: none.
    """
    if None in (rule.noise, rule.length, rule.cell, rule.window):
        scans = as_scans(scans)
        rule = rule.fitted(scans)
    doubts, left = doubts or Doubts.none(), iter(scans)
    while window := list(islice(left, rule.window)):
        if before is not None:
            before(components, window)
        components, doubts = _absorb_window(components, window, rule, size, weight, doubts)
    return components, doubts


def _absorb_window(
    components: Components,
    window: Sequence[Scan | DepthFrame],
    rule: IncrementalRule,
    size: merging.Size,
    weight: float,
    doubts: Doubts,
) -> tuple[Components, Doubts]:
    frames = [frame for frame in window if isinstance(frame, DepthFrame)]
    if rule.novelty is None and len(frames) == len(window):
        learned = fit_frames(frames, surface_fit(rule, components.dim), merging.all_origins(weight))
    else:
        scans = as_scans(window)
        if rule.novelty is not None:
            components, scans = _explain(components, scans, rule.novelty, weight)
        learned = _learned(scans, rule, weight)
    if rule.max_bytes is not None and rule.forget != CONTRADICTION:
        components = components.on_cpu()  # for the codec, which measures them
    components, doubts = joined(components, learned, window, rule, doubts)
    return _within_budget(components, rule, size) if len(learned) else components, doubts


def _learned(
    scans: Sequence[Scan], rule: IncrementalRule, weight: float, iterations: int | None = None
) -> Components:
    """The components of a window of scans; none if no scan has a beam. `iterations`: not the rule's."""
    if not any(scan.n_beams for scan in scans):
        return Components.empty(scans[0].dim, scans[0].points.device)
    if rule.noise is None or rule.length is None or rule.cell is None:
        # Scans without a return still show the scale of the sensor by the ends of their beams.
        rule = rule.fitted([Scan(scan.no_return, scan.origin) for scan in scans])
    fit = surface_fit(rule, scans[0].dim)
    fit = fit if iterations is None else replace(fit, iterations=iterations)
    return fit_window(scans, fit, merging.all_origins(weight))


def _explain(
    components: Components, scans: Sequence[Scan], rule: NoveltyRule, weight: float
) -> tuple[Components, list[Scan]]:
    """The components with the counts of the points that they explain, and the novel beams of each scan
    that no component explains."""
    remaining = []
    for scan in scans:
        novel = scan.select(novel_beams(components, scan, rule))
        frees = None  # all returns are novel by the cells before their ends
        if rule.distance_for != "all":
            before_ends = Scan(novel.points[:0], novel.origin, novel.points)
            frees = novel_beams(components, before_ends, rule)
        keep = []
        for points, max_range, free in ((novel.points, False, frees), (novel.no_return, True, None)):
            components, explained = count_explained(
                components, points, scan.origin, rule.distance, rule.explained, max_range, weight, free
            )
            keep.append(~explained)
        remaining.append(novel.select(torch.cat(keep)))
    return components, remaining


def _within_budget(components: Components, rule: IncrementalRule, size: merging.Size) -> Components:
    if rule.max_cost is not None:
        components = merging.compact(components, None, rule.max_cost)
    if rule.n_components is not None:
        components = merging.compact(components, rule.n_components)
    if rule.max_bytes is None:
        return merging.limit_origins(components, rule.max_origins, rule.mean_origins)
    return merging.compact_to_bytes(components, rule.max_bytes, rule.max_origins, rule.mean_origins, size)


def surface_fit(rule: IncrementalRule, dim: int) -> SurfaceFit:
    """How a window is learned in `dim` dimensions. Raises `InvalidArgumentError` if `rule` is not fitted."""
    if rule.noise is None or rule.length is None or rule.cell is None:
        raise InvalidArgumentError("noise, length or cell is None; take rule.fitted(scans).")
    fit = cell_fit(rule.noise, rule.length, rule.cell, rule.window_components, rule.iterations, dim)
    return replace(fit, rule=rule)


def cell_fit(
    noise: float, length: float, cell: float, max_components: int, iterations: int, dim: int
) -> SurfaceFit:
    """A fit on cells; the arguments are those of `IncrementalRule`, in metres."""
    flatness = FlatnessRule(
        thickness=2 * noise,
        length=length,
        min_weight=3 * (dim - 1),
        max_components=max_components,
        outlier_gap=10 * length,
    )
    return SurfaceFit(noise, cell, flatness, iterations)


def learn_part(scans: Sequence[Scan], rule: LearningRule, generator: torch.Generator) -> Components:
    """Components of a part of an unfinished window, with which it answers until all of it is learned.

    Those of an `IncrementalRule` are its flat pieces, at most half as many as of a window, without EM.
    """
    if isinstance(rule, WindowedRule):
        return learn_window(scans, replace(rule, iterations=1), generator)
    quick = replace(rule, window_components=max(1, rule.window_components // 2))
    learned = _learned(scans, quick, 1.0, 0).to(scans[0].points.device)
    return merging.limit_origins(learned, rule.max_origins, rule.mean_origins)


_LAW_POINTS = 50_000  # of a window, from which the law of intensities is estimated


def with_law(rule: LearningRule, scans: Sequence[Scan]) -> LearningRule:
    """The rule with the law of intensities after some scans, estimated within their flat pieces."""
    scans = [scan for scan in scans if INTENSITY in scan.attributes and len(scan.points)]
    if not rule.reflectivity or not scans:
        return rule
    step = 1 + sum(len(scan.points) for scan in scans) // _LAW_POINTS
    some = [Scan(scan.points[::step].double(), scan.origin) for scan in scans]
    pieces = learn_part(some, replace(rule, reflectivity=False), torch.Generator().manual_seed(0))
    pieces = pieces.to(some[0].points.device)
    points = torch.cat([one.points for one in some])
    rays = points - torch.cat([one.origin.double().expand_as(one.points) for one in some])
    values = torch.cat([scan.attributes[INTENSITY][::step, 0] for scan in scans])
    center, shares = points.mean(0), pieces.support / pieces.support.sum()
    mixture = Parameters(shares, pieces.means - center, pieces.covariances)
    owner = most_likely_component(quadratic_features(points - center), mixture)
    law = None if isinstance(rule.reflectivity, bool) else rule.reflectivity
    law = estimated(law, rays, whitening(pieces.covariances)[0][owner], owner, values)
    return rule if law is None else replace(rule, reflectivity=law)


def learns_in_parts(rule: LearningRule) -> bool:
    """Whether the components of a window do not depend on those of the map."""
    return rule.forget == FORGET_OFF and (isinstance(rule, WindowedRule) or rule.novelty is None)


def keeps_components(rule: LearningRule) -> bool:
    """Whether a window leaves the components of the map as they are, except the latest: those whose number of
    origins is limited together with that of the new ones."""
    budgets = () if isinstance(rule, WindowedRule) else (rule.n_components, rule.max_bytes, rule.max_cost)
    return learns_in_parts(rule) and all(budget is None for budget in budgets)


def learn_window(scans: Sequence[Scan], rule: WindowedRule, generator: torch.Generator) -> Components:
    """Components of the returns, and `max_range` components of the no-return beams, of neighbouring scans.

    `generator` draws the origins that are kept. Components are not numbered; the owner of the map does that.
    """
    fit = SurfaceFit(
        noise=rule.noise,
        cell=rule.noise,
        flatness=flatness_rule(rule, scans[0].dim),
        iterations=rule.iterations,
        max_cells=rule.max_cells,
        dtype=SOFTMAX_DTYPES[rule.dtype],
        partition_by_moments=False,
        rule=rule,
    )
    return fit_window(scans, fit, merging.sampled_origins(rule.max_origins, generator))


def flatness_rule(rule: WindowedRule, dim: int) -> FlatnessRule:
    """When a piece of a window's points is cut further, in `dim` dimensions."""
    flatness = surface_rule(rule.noise, dim, rule.min_points)
    # In 2D, few points that span several surfaces are better separated, down to single points
    # (5 % of intel, 0.1 m: AUC 0.948 against 0.940). In 3D this only adds components.
    return replace(
        flatness,
        length=rule.length,
        min_weight_thick=1 if dim == 2 else flatness.min_weight,
        max_components=rule.n_components,
        outlier_gap=10 * rule.length,
    )


_FLAT = 3.0  # times the noise: the smallest deviation of a flat component, at most
_FLAT_STOPS, _THICK_STOPS = (0.5, 0.05), (0.3, 0.02)  # q and ε
_CERTAIN = 1000.0  # odds that the surface is gone
_INDEPENDENT = 4.0  # beams of a scan
_MOST_BEAMS = 4096  # of a scan that are counted
_LEAST_SUPPORT = 0.5  # points: a component with fewer is dropped
_MARGIN = 20.0  # times the noise
_LIMITS = {"through": 1.0, "reach": 3.0, "grazing": 4.0}  # see `PassLimits`; 4: about 14°


@dataclass(frozen=True)
class Doubts:
    """The state of forgetting, besides the components.

    ids: (J, 2) of the components in doubt. log_odds: (J,) that their surfaces are gone, above 0.
    time: of the last scan (s); None: not known.
    """

    ids: Tensor
    log_odds: Tensor
    time: float | None = None

    @classmethod
    def none(cls, time: float | None = None) -> Doubts:
        """No component is in doubt."""
        return cls(torch.zeros(0, 2, dtype=torch.int64), torch.zeros(0, dtype=torch.float64), time)

    @classmethod
    def read(cls, state: dict[str, Any]) -> Doubts:
        """The doubts of a state, `vars` of others. Raises `ValueError` if it is damaged."""
        made = cls(**state)
        if made.ids.shape != (len(made.log_odds), 2) or made.ids.dtype != torch.int64:
            raise ValueError("the components in doubt are damaged")
        return made

    def of(self, ids: Tensor) -> Tensor:
        """The log-odds (K,) of components with these ids (K, 2); 0 for those that are not in doubt."""
        found = torch.zeros(len(ids), dtype=torch.float64, device=ids.device)
        if len(self.ids) == 0:
            return found
        both = torch.cat([self.ids.to(ids.device), ids])
        _, number = torch.unique(both, dim=0, return_inverse=True)
        table = found.new_zeros(int(number.max()) + 1)
        table[number[: len(self.ids)]] = self.log_odds.to(ids.device)
        return table[number[len(self.ids) :]]


def joined(
    known: Components,
    learned: Components,
    window: Sequence[Scan | DepthFrame],
    rule: LearningRule,
    doubts: Doubts,
) -> tuple[Components, Doubts]:
    """The components of a map and those learned from a window of S scans, without those that are gone; and
    the doubts after the window.

    Components without a number are not in doubt: their test begins with the next window.

    The noise of the rule must be set if a scan has a return. Raises `InvalidArgumentError` for a half-life if
    a scan has no time.
    """
    learned = learned.to(known.means.device)
    if rule.forget == FORGET_OFF:
        return Components.concatenate([known, learned]), doubts
    if rule.forget == CONTRADICTION:
        both = Components.concatenate([known, learned])
        return _confirmed(both, as_scans(window), rule.noise or 0.0, doubts)
    aged, doubts = _aged(known, getattr(window[-1], "time", None), float(rule.forget), doubts)
    return Components.concatenate([aged, learned]), doubts


def _confirmed(
    components: Components, scans: Sequence[Scan], noise: float, doubts: Doubts
) -> tuple[Components, Doubts]:
    """The components that these scans do not contradict."""
    log_odds = doubts.of(components.ids)
    surfaces = (~components.max_range).nonzero().squeeze(1)
    found = gone_log_odds(components.selected(surfaces), scans, noise, log_odds[surfaces])
    log_odds = log_odds.index_copy(0, surfaces, found)
    kept = (log_odds < math.log(_CERTAIN)).nonzero().squeeze(1)
    doubted = kept[(log_odds[kept] > 0) & (components.ids[kept, 1] >= 0)]
    doubts = Doubts(components.ids[doubted].cpu(), log_odds[doubted].cpu())
    return components if len(kept) == len(components) else components.selected(kept), doubts


def _aged(
    components: Components, time: float | None, half_life: float, doubts: Doubts
) -> tuple[Components, Doubts]:
    """The components with their counts at the time (s) of the last scan of the window."""
    if time is None:
        raise InvalidArgumentError(
            f"forget={half_life:g} is a half-life in seconds, but a scan has no time: give "
            "Scan(points, origin, time=seconds), or forget='contradiction'."
        )
    before = doubts.time
    doubts = replace(doubts, time=time if before is None else max(time, before))
    if before is None or time <= before:  # a clock that goes back does not add evidence
        return components, doubts
    left = 2.0 ** ((before - time) / half_life)
    kept = (components.support * left >= _LEAST_SUPPORT).nonzero().squeeze(1)
    aged = components.selected(kept)
    return replace(aged, support=aged.support * left, seen_count=aged.seen_count * left), doubts


def gone_log_odds(components: Components, scans: Sequence[Scan], noise: float, log_odds: Tensor) -> Tensor:
    """Log-odds (K,) after the scans that the surfaces of K components are gone; `log_odds` (K,): before them.

    Components of no-return beams must not be among the components. noise: of the sensor, metres.
    """
    if len(components) == 0:
        return log_odds
    white, _ = whitening(components.covariances)
    deviations = torch.linalg.eigvalsh(components.covariances.double())[:, [0, -1]].clamp_min(0).sqrt()
    limits = PassLimits(**_LIMITS, margin=_MARGIN * noise, explained=explained_within(components.dim, None))
    is_flat = deviations[:, :1] <= _FLAT * noise
    flat, thick = deviations.new_tensor([_FLAT_STOPS, _THICK_STOPS])
    there, gone = torch.where(is_flat, flat, thick).unbind(1)
    passes, returns = ((1 - gone) / (1 - there)).log(), (gone / there).log()
    for scan in scans:
        ends, is_hit = scan.ends()
        stride = -(-len(ends) // _MOST_BEAMS) or 1
        origin = scan.origin.double()
        beams = ends[::stride].double() - origin
        passed, returned = beam_passes(
            white, components.means - origin, deviations, beams, is_hit[::stride], limits
        )
        share = _INDEPENDENT / (passed + returned).clamp_min(_INDEPENDENT)
        change = share * (passes * passed + returns * returned)
        log_odds = (log_odds + change).clamp(0, math.log(_CERTAIN))
    return log_odds


SIDES = (0.02, 0.1, 0.4)
"""Sides (m) of the cubes for which a map predicts."""

_BEAMS = 12  # of a window, from one scan, whose neighbourhood few components reach
_PREDICTING = 3.5, 8e-4  # ms of a prediction, and of each pair of a point and a cone, on one core
_LEARNING, _MOST = (20.0, 5e-4), 200_000  # ms of a window, and of each of its points, at most so many
_SHARE = 0.04  # of the time of learning that predictions take


def predicted(
    known: Sequence[Block], window: Sequence[Scan | DepthFrame], calibrator: Calibrator | None, number: int
) -> Calibrator | None:
    """What is known about the calibration after a map has predicted the beams of a window.

    Of each chosen beam, its end is occupied and a point drawn uniformly from the rest is free. Points without
    evidence are left out, and those with less than half of the others: they lie where the map has only begun,
    and later it is asked mostly about places that it knows well.

    known, calibrator: before the window; without a calibrator the ranges of the window give one.
    number: of the window; chooses the beams.
    """
    if calibrator is not None and number < calibrator.next_window:
        return calibrator
    generator = torch.Generator().manual_seed(number)
    origins, ends = _beams(window, generator)
    if not len(ends):
        return calibrator
    if calibrator is None:
        calibrator = Calibrator.of(mean_range(window), len(SIDES))
    if not any(len(block.components.seen_by) for block in known):
        return calibrator
    share = torch.rand(len(ends), 1, generator=generator, dtype=torch.float64)
    share = share.to(ends.device, non_blocking=True)
    points = torch.cat([ends, origins + share * (ends - origins)])
    occupied = np.arange(len(points)) < len(ends)
    predictions = []
    evidence, n_pairs = few_points(known, points, SIDES)
    for side, (hits, misses) in zip(SIDES, evidence, strict=True):
        seen = hits * (calibrator.length / side) + misses
        kept = (seen >= np.sort(seen)[(len(seen) - 1) // 2]) & (seen > 0)
        predictions.append(Prediction(hits[kept], misses[kept], occupied[kept], side))
    n_points = sum(s.depth.numel() if isinstance(s, DepthFrame) else len(s.points) for s in window)
    predicting = _PREDICTING[0] + _PREDICTING[1] * n_pairs
    learning = _LEARNING[0] + _LEARNING[1] * min(n_points, _MOST)
    due = number + max(1, round(predicting / (_SHARE * learning)))
    return replace(calibrator.updated(predictions, ends.shape[1]), next_window=due)


def _beams(window: Sequence[Scan | DepthFrame], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Origins and ends (B, D) of some returns of a scan of a window, float64."""
    scan = window[int(torch.randint(len(window), (1,), generator=generator))]
    found = scan.pixels() if isinstance(scan, DepthFrame) else scan.points
    if len(found):
        chosen = torch.randint(len(found), (_BEAMS,), generator=generator)
        found = found[chosen.to(found.device, non_blocking=True)]
    points = scan.points_at(found) if isinstance(scan, DepthFrame) else found
    return scan.origin.double().expand_as(points), points.double()


def few_points(blocks: Sequence[Block], points: Tensor, sides: Sequence[float]) -> tuple[np.ndarray, int]:
    """Hits and misses (S, 2, M) of cubes of several sides (m) at a few points (M, D), without an index; and
    the number of pairs of a point and a cone near it. `blocks`: at least one has a viewpoint."""
    cutoff = cutoff_for(blocks)
    blocks = [block for block in blocks if len(block.components.seen_by)]
    if len(blocks) > 1:
        low, high = boxes_of(blocks, max(sides), cutoff)
        met = ((low <= points.amax(0)) & (high >= points.amin(0))).all(1).tolist()
        blocks = [block for block, is_met in zip(blocks, met, strict=True) if is_met] or blocks[:1]
    known = Components.concatenate([block.components.to(points.device) for block in blocks])
    widest = max(sides) * max(0.5 * known.dim**0.5, cutoff / 12**0.5)
    if is_fused(points, known.means):
        views = known.means, known.covariances, known.max_range, known.origins
        seen = known.seen_by, known.seen_from, known.seen_count
        found, n_pairs = few_points_evidence((*views, *seen), points, sides, cutoff, widest)
        values = torch.cat([found.flatten(), n_pairs.double()[None]]).cpu().numpy()
        return values[:-1].reshape(found.shape), int(values[-1])
    view = _near(known, points, widest, cutoff)
    cones = Cones(*(part[view.unique()] for part in known.cones()))
    axes = spectrum_of(cones.covariances)[1]
    return few_point_evidence(cones, axes, points, sides, cutoff).cpu().numpy(), len(view)


def _near(known: Components, points: Tensor, widest: float, cutoff: float) -> Tensor:
    """The viewpoint (P,) of each pair of a point and a viewpoint whose cone may give evidence to the cube.

    First by boxes around the cones, then by balls around the components. Pairs that they leave out give
    next to no evidence.
    """
    extent = cutoff * known.covariances.diagonal(dim1=1, dim2=2).sqrt()
    by, origins = known.seen_by, known.origins[known.seen_from]
    low = torch.minimum((known.means - extent)[by], origins) - widest
    high = torch.maximum((known.means + extent)[by], origins) + widest
    view = ((low <= points.amax(0)) & (high >= points.amin(0))).all(1).nonzero().squeeze(1)
    low, high = low[view], high[view]
    columns = zip(points.T[..., None], low.T, high.T, strict=True)
    met = functools.reduce(torch.logical_and, ((x >= first) & (x <= last) for x, first, last in columns))
    point, row = met.nonzero(as_tuple=True)
    view = view[row]
    ray, offset = points[point] - origins[view], points[point] - known.means[by[view]]
    square = (ray * ray).sum(1).clamp_min(1e-12)
    along = (ray * offset).sum(1)
    distance = (offset - ray).square().sum(1)
    # The cube seen from a sensor at range r is as wide as widest · distance / r at the component.
    ball = extent.norm(dim=1)[by[view]] + widest * (distance / square).clamp_min(1).sqrt()
    reach = 1.001 * ball * ball * square
    is_beside = (offset * offset).sum(1) * square - along * along <= reach
    is_before = (along <= 0) | (along * along <= reach)
    return view[is_beside & is_before | (square <= widest * widest)]
