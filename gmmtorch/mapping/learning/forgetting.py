"""Forgetting: components that later beams contradict, or that are old, leave the map.

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
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import PassLimits, beam_passes
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.association import explained_within
from gmmtorch.mapping.learning.depth_frame import DepthFrame, as_scans
from gmmtorch.mapping.learning.rules import CONTRADICTION, FORGET_OFF, LearningRule
from gmmtorch.occupancy import whitening
from gmmtorch.scan import Scan

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

    Args:
        rule: its noise must be set if a scan has a return.
        doubts: before the window.

    Raises `InvalidArgumentError` for a half-life if a scan has no time.
    """
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
