"""Gaussian mixture maps from range data. See the README for a tour.

Names are imported when they are first used, so that `import gmmtorch` stays light.
"""

from __future__ import annotations

import importlib
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gmmtorch import baselines as baselines
    from gmmtorch import datasets as datasets
    from gmmtorch import sharing as sharing
    from gmmtorch.baselines.occupancy_grid import OccupancyGrid as OccupancyGrid
    from gmmtorch.errors import GmmTorchError as GmmTorchError
    from gmmtorch.mapping.gaussian_map import GaussianMap as GaussianMap
    from gmmtorch.mapping.learning.rules import IncrementalRule as IncrementalRule
    from gmmtorch.mapping.learning.rules import NoveltyRule as NoveltyRule
    from gmmtorch.mapping.learning.rules import WindowedRule as WindowedRule
    from gmmtorch.mixture.depth_image import fit_depth_image as fit_depth_image
    from gmmtorch.mixture.estimators.deconvolved import (
        DeconvolvedGaussianMixture as DeconvolvedGaussianMixture,
    )
    from gmmtorch.mixture.estimators.riemannian import RiemannianGaussianMixture as RiemannianGaussianMixture
    from gmmtorch.mixture.estimators.sliced_wasserstein import (
        SlicedWassersteinGaussianMixture as SlicedWassersteinGaussianMixture,
    )
    from gmmtorch.mixture.estimators.trees.hierarchical import (
        HierarchicalGaussianMixture as HierarchicalGaussianMixture,
    )
    from gmmtorch.mixture.estimators.variational import (
        VariationalGaussianMixture as VariationalGaussianMixture,
    )
    from gmmtorch.mixture.gaussian_mixture import GaussianMixture as GaussianMixture
    from gmmtorch.mixture.reduction.merge import merge as merge
    from gmmtorch.mixture.reduction.merge import simplify as simplify
    from gmmtorch.mixture.reduction.pruning import prune as prune
    from gmmtorch.occupancy.evidence import Evidence as Evidence
    from gmmtorch.occupancy.grid import VoxelGrid as VoxelGrid
    from gmmtorch.scan import Scan as Scan

try:
    __version__ = version("gmmtorch")
except PackageNotFoundError:  # a bare checkout on the path
    __version__ = "0+unknown"

_HOMES = {
    "DeconvolvedGaussianMixture": "gmmtorch.mixture.estimators.deconvolved",
    "Evidence": "gmmtorch.occupancy.evidence",
    "GaussianMap": "gmmtorch.mapping.gaussian_map",
    "GaussianMixture": "gmmtorch.mixture.gaussian_mixture",
    "GmmTorchError": "gmmtorch.errors",
    "HierarchicalGaussianMixture": "gmmtorch.mixture.estimators.trees.hierarchical",
    "IncrementalRule": "gmmtorch.mapping.learning.rules",
    "NoveltyRule": "gmmtorch.mapping.learning.rules",
    "OccupancyGrid": "gmmtorch.baselines.occupancy_grid",
    "RiemannianGaussianMixture": "gmmtorch.mixture.estimators.riemannian",
    "Scan": "gmmtorch.scan",
    "SlicedWassersteinGaussianMixture": "gmmtorch.mixture.estimators.sliced_wasserstein",
    "VariationalGaussianMixture": "gmmtorch.mixture.estimators.variational",
    "VoxelGrid": "gmmtorch.occupancy.grid",
    "WindowedRule": "gmmtorch.mapping.learning.rules",
    "fit_depth_image": "gmmtorch.mixture.depth_image",
    "merge": "gmmtorch.mixture.reduction.merge",
    "prune": "gmmtorch.mixture.reduction.pruning",
    "simplify": "gmmtorch.mixture.reduction.merge",
}

__all__ = [
    "DeconvolvedGaussianMixture",
    "Evidence",
    "GaussianMap",
    "GaussianMixture",
    "GmmTorchError",
    "HierarchicalGaussianMixture",
    "IncrementalRule",
    "NoveltyRule",
    "OccupancyGrid",
    "RiemannianGaussianMixture",
    "Scan",
    "SlicedWassersteinGaussianMixture",
    "VariationalGaussianMixture",
    "VoxelGrid",
    "WindowedRule",
    "baselines",
    "datasets",
    "fit_depth_image",
    "merge",
    "prune",
    "sharing",
    "simplify",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    if name in ("baselines", "datasets", "sharing"):
        return importlib.import_module(f"gmmtorch.{name}")
    raise AttributeError(f"module 'gmmtorch' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
