"""Gaussian mixture maps from range data. The README gives a tour.

Names are imported on first use, so that `import gmmtorch` is fast.
"""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from gmmtorch.lazy_names import lazy_names

if TYPE_CHECKING:
    from gmmtorch import baselines as baselines
    from gmmtorch import datasets as datasets
    from gmmtorch import mixture as mixture
    from gmmtorch import sharing as sharing
    from gmmtorch.errors import GmmTorchError as GmmTorchError
    from gmmtorch.localization.registration.registration import register as register
    from gmmtorch.mapping.components import Components as Components
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
    from gmmtorch.mixture.streaming.stream_fit import fit_stream as fit_stream
    from gmmtorch.occupancy.evidence import Evidence as Evidence
    from gmmtorch.occupancy.grid import VoxelGrid as VoxelGrid
    from gmmtorch.occupancy.occupancy_grid import OccupancyGrid as OccupancyGrid
    from gmmtorch.scan import Scan as Scan

try:
    __version__ = version("gmmtorch")
except PackageNotFoundError:  # a bare checkout on the path
    __version__ = "0+unknown"

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "Components": "mapping.components",
        "DeconvolvedGaussianMixture": "mixture.estimators.deconvolved",
        "Evidence": "occupancy.evidence",
        "GaussianMap": "mapping.gaussian_map",
        "GaussianMixture": "mixture.gaussian_mixture",
        "GmmTorchError": "errors",
        "HierarchicalGaussianMixture": "mixture.estimators.trees.hierarchical",
        "IncrementalRule": "mapping.learning.rules",
        "NoveltyRule": "mapping.learning.rules",
        "OccupancyGrid": "occupancy.occupancy_grid",
        "RiemannianGaussianMixture": "mixture.estimators.riemannian",
        "Scan": "scan",
        "SlicedWassersteinGaussianMixture": "mixture.estimators.sliced_wasserstein",
        "VariationalGaussianMixture": "mixture.estimators.variational",
        "VoxelGrid": "occupancy.grid",
        "WindowedRule": "mapping.learning.rules",
        "baselines": "",
        "datasets": "",
        "fit_depth_image": "mixture.depth_image",
        "fit_stream": "mixture.streaming.stream_fit",
        "mixture": "",
        "register": "localization.registration.registration",
        "sharing": "",
    },
)
