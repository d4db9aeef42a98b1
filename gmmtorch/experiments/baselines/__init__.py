"""Occupancy maps from the literature, behind the same protocol as `GaussianMap`.

Names are imported when they are first used. See docs/baselines.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gmmtorch.lazy_names import lazy_names

if TYPE_CHECKING:
    from gmmtorch.experiments.baselines.bgk_map import BGKMap as BGKMap
    from gmmtorch.experiments.baselines.bgk_points_map import BGKPointsMap as BGKPointsMap
    from gmmtorch.experiments.baselines.gp_map import GPMap as GPMap
    from gmmtorch.experiments.baselines.hilbert.bayesian_hilbert_map import (
        BayesianHilbertMap as BayesianHilbertMap,
    )
    from gmmtorch.experiments.baselines.hilbert.hilbert_map import HilbertMap as HilbertMap
    from gmmtorch.experiments.baselines.ndt_map import NDTMap as NDTMap
    from gmmtorch.experiments.baselines.octomap_map import OctoMapMap as OctoMapMap
    from gmmtorch.occupancy.occupancy_grid import LogOdds as LogOdds
    from gmmtorch.occupancy.occupancy_grid import OccupancyGrid as OccupancyGrid

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "BGKMap": "bgk_map",
        "BGKPointsMap": "bgk_points_map",
        "BayesianHilbertMap": "hilbert.bayesian_hilbert_map",
        "GPMap": "gp_map",
        "HilbertMap": "hilbert.hilbert_map",
        "LogOdds": "occupancy_grid",
        "NDTMap": "ndt_map",
        "OccupancyGrid": "occupancy_grid",
        "OctoMapMap": "octomap_map",
    },
)
