"""Occupancy maps from the literature, behind the same protocol as `GaussianMap`.

Names are imported when they are first used. See docs/baselines.md.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gmmtorch.baselines.bayesian_hilbert_map import BayesianHilbertMap as BayesianHilbertMap
    from gmmtorch.baselines.bgk_map import BGKMap as BGKMap
    from gmmtorch.baselines.bgk_points_map import BGKPointsMap as BGKPointsMap
    from gmmtorch.baselines.gp_map import GPMap as GPMap
    from gmmtorch.baselines.hilbert_map import HilbertMap as HilbertMap
    from gmmtorch.baselines.ndt_map import NDTMap as NDTMap
    from gmmtorch.baselines.occupancy_grid import LogOdds as LogOdds
    from gmmtorch.baselines.occupancy_grid import OccupancyGrid as OccupancyGrid
    from gmmtorch.baselines.octomap_map import OctoMapMap as OctoMapMap

_HOMES = {
    "BGKMap": "bgk_map",
    "BGKPointsMap": "bgk_points_map",
    "BayesianHilbertMap": "bayesian_hilbert_map",
    "GPMap": "gp_map",
    "HilbertMap": "hilbert_map",
    "LogOdds": "occupancy_grid",
    "NDTMap": "ndt_map",
    "OccupancyGrid": "occupancy_grid",
    "OctoMapMap": "octomap_map",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"gmmtorch.baselines.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'gmmtorch.baselines' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
