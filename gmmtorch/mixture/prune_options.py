"""Options of pruning. Importing this file does not load torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from gmmtorch.errors import check_choice, check_number

Prune = Literal["none", "support", "density"]


@dataclass(frozen=True, kw_only=True)
class PruneOptions:
    """Which components are removed because they fit no surface (thesis 2.1.4).

    prune: "none"; "support", those with fewer points than `min_support`; "density", those with a lower
        density of points than `min_density_share`.
    min_support: fewest points of a component.
    min_density_share: smallest density of points of a component, as a share of the density that the beams
        of the scans give a surface at its range and incidence.
    """

    prune: Prune = "none"
    min_support: float = 20.0
    min_density_share: float = 0.1

    def __post_init__(self) -> None:
        check_choice("prune", self.prune, get_args(Prune))
        check_number("min_support", self.min_support)
        check_number("min_density_share", self.min_density_share)
