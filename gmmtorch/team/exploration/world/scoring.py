"""The evaluator of all teams: entropy over the observable cells, and comparison with the truth."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import entropy_removed, flags_of_cells
from gmmtorch.occupancy import (
    Box,
    CellEvidence,
    SparseEvidence,
    Thresholds,
    check_prior,
    occupancy_probability,
)


@dataclass(frozen=True)
class BeliefRule:
    """How evidence becomes probability. Every team and the evaluator use the same rule.

    prior: N_p of `occupancy_probability`. clamp: probabilities stay within [clamp, 1 − clamp]. free,
    occupied: a cell is free if its probability is below `free`, occupied if above `occupied`, and unknown
    in between.
    """

    prior: float = 1.0
    clamp: float = 0.05
    free: float = 0.2
    occupied: float = 0.65

    def __post_init__(self) -> None:
        check_prior(self.prior)
        if not 0 <= self.clamp < 0.5:
            raise InvalidArgumentError(f"clamp={self.clamp} must be at least 0 and below 0.5.")
        Thresholds(self.free, self.occupied)  # checks them

    def probability(self, hits: Tensor, misses: Tensor) -> Tensor:
        """Occupancy of cells with these hits and misses, any shape."""
        return occupancy_probability(hits, misses, self.prior).clamp(self.clamp, 1 - self.clamp)

    def classes(self, probability: Tensor) -> Tensor:
        """`CellClass` values, int8."""
        return Thresholds(self.free, self.occupied).classify(probability)


_MARGIN = 8  # cells around a world whose evidence is stored but not scored


class BeliefMap:
    """Evidence of a bounded world in blocks, and its entropy H = Σ h(p) over the observable cells.

    Each addition updates the entropy from the cells that it touches, so the cost does not grow with the
    world.

    Args:
        observable: (nx, ny, nz) bool over `box`: cells that a sensor could ever see.
        device: of the evidence.
    """

    def __init__(
        self,
        resolution: float,
        box: Box,
        observable: Tensor,
        rule: BeliefRule,
        device: torch.device | str = "cpu",
    ) -> None:
        box = Box(*(side.to(device) for side in box))
        # Noise can move hits on a wall just outside the bounds; they must not count as unseen.
        bounds = Box(box.low - _MARGIN, box.high + _MARGIN)
        self.grid = SparseEvidence(resolution, box=bounds, dtype=torch.float32)
        self.rule = rule
        self._low = box.low
        self._observable = observable.to(device)
        self.observable_bits = float(observable.sum())
        self.clear()

    def clear(self) -> None:
        """Remove all evidence."""
        self.grid.clear()
        self.entropy_bits = self.observable_bits
        self.known_bits = 0.0  # entropy removed from all cells, observable or not, as a robot computes it
        self.n_observed = 0

    def add(self, evidence: CellEvidence) -> None:
        """Add evidence."""
        before = self.grid.add(evidence)
        chosen = flags_of_cells(evidence.cells, self._low, self._observable)
        added = evidence.hits, evidence.misses
        bits, observable, n_new = entropy_removed(before, added, chosen, self.rule.prior, self.rule.clamp)
        self.known_bits += bits
        self.entropy_bits -= observable
        self.n_observed += n_new

    def probability(self, cells: Tensor) -> Tensor:
        """Occupancy (C,) of cells (C, 3), on the device of the cells."""
        evidence = self.grid.at_cells(cells.to(self.grid.device))
        return self.rule.probability(*evidence).to(cells.device)


def accuracy(belief: BeliefMap, cells: Tensor, occupied: Tensor) -> dict[str, float | None]:
    """Return AUC and mean cross-entropy (bits a cell) of a map against the truth, over given cells (C, 3)."""
    from sklearn.metrics import roc_auc_score

    p = belief.probability(cells).double()
    right = torch.where(occupied, p, 1 - p).clamp_min(torch.finfo(torch.float64).tiny)
    both = bool(occupied.any()) and not bool(occupied.all())
    return {
        "auc": float(roc_auc_score(occupied.numpy(), p.numpy())) if both else None,
        "cross_entropy_bits": float(-(right.log2()).mean()),
    }


def disagreement(maps: list[BeliefMap], cells: Tensor) -> float | None:
    """Return the share of cells (C, 3) with different classes in any two maps; None for a single map."""
    if len(maps) < 2 or len(cells) == 0:
        return None
    classes = torch.stack([m.rule.classes(m.probability(cells)) for m in maps])
    return float((classes != classes[0]).any(0).double().mean())


def overlap(seen_by: Tensor) -> float | None:
    """Return the share of the seen cells that two or more robots saw; `seen_by` counts robots."""
    seen = int((seen_by > 0).sum())
    return int((seen_by > 1).sum()) / seen if seen else None
