"""How the mixture of a window is learned. Importing this file does not load torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from gmmtorch.errors import check_choice, check_number, check_whole
from gmmtorch.mixture.reduction.prune_options import PruneOptions

FORGET_OFF, CONTRADICTION = "off", "contradiction"
LearnerName = Literal["flat_pieces", "hierarchical"]


@dataclass(frozen=True, kw_only=True)
class MixtureRule(PruneOptions):
    """How the mixture of a window is learned. Components of no-return beams are not pruned.

    learner: "flat_pieces", EM that starts from flat pieces; "hierarchical", the leaves of a tree of mixtures
        (thesis 2.1.2).
    planarity: the tree does not split a node whose smallest variance is a smaller share of the sum of its
        variances (2.9). None: it does not split a node that is at most as thick as a flat piece.
    free_points: points at equal distances on each beam with a return, from which components of free space
        are learned, as from the ends of no-return beams (thesis 3.5).
    forget: what leaves the map. "off": nothing. "contradiction": surfaces that later beams pass through, see
        `mapping.learning.forgetting`. A number: all evidence, with this half-life (s) of the scans' times.
    """

    learner: LearnerName = "flat_pieces"
    planarity: float | None = None
    free_points: int = 0
    forget: int | float | str = FORGET_OFF

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("learner", self.learner, get_args(LearnerName))
        if self.planarity is not None:
            check_number("planarity", self.planarity, largest=1.0, above=True)
        check_whole("free_points", self.free_points, 0)
        if self.forget is False:  # YAML reads `off` as False
            object.__setattr__(self, "forget", FORGET_OFF)
        if isinstance(self.forget, str | bool):
            check_choice("forget", self.forget, (FORGET_OFF, CONTRADICTION, "a half-life in seconds"))
        else:
            check_number("forget", self.forget, above=True)

    @property
    def needs_points(self) -> bool:
        """Whether learning needs the points of depth images, and not only their sums over cells."""
        return self.learner != "flat_pieces" or self.prune != "none" or self.free_points > 0
