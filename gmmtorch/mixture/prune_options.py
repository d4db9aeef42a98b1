"""Options of pruning. Importing this file does not load torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from gmmtorch.declarations import option
from gmmtorch.errors import check_choice, check_number

Prune = Literal["none", "support", "density"]


@dataclass(frozen=True, kw_only=True)
class PruneOptions:
    """Which components are removed because they fit no surface (thesis 2.1.4).

    min_support: fewest points of a component.
    min_density_share: smallest density of points of a component, as a share of the density that the beams
        of the scans give a surface at its range and incidence.
    """

    prune: Prune = option(
        "none",
        "which components that fit no surface are removed: none; support: those with fewer than 20 points; "
        "density: those with less than a tenth of the density of a surface (thesis 2.1.4)",
    )
    min_support: float = 20.0
    min_density_share: float = 0.1

    def __post_init__(self) -> None:
        check_choice("prune", self.prune, get_args(Prune))
        check_number("min_support", self.min_support)
        check_number("min_density_share", self.min_density_share)
