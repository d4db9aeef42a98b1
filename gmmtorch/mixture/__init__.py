"""Gaussian mixtures: estimators, streamed fits, and reduction of mixtures (thesis chapter 2).

Names are imported on first use, so that one estimator does not load the others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gmmtorch.lazy_names import lazy_names

if TYPE_CHECKING:
    from gmmtorch.mixture.density import NotFittedError as NotFittedError
    from gmmtorch.mixture.depth_image import fit_depth_image as fit_depth_image
    from gmmtorch.mixture.em.exact import Parameters as Parameters
    from gmmtorch.mixture.estimator import MixtureEstimator as MixtureEstimator
    from gmmtorch.mixture.estimators.deconvolved import (
        DeconvolvedGaussianMixture as DeconvolvedGaussianMixture,
    )
    from gmmtorch.mixture.estimators.riemannian import RiemannianGaussianMixture as RiemannianGaussianMixture
    from gmmtorch.mixture.estimators.sensor_model import DepthCameraModel as DepthCameraModel
    from gmmtorch.mixture.estimators.sensor_model import LaserModel as LaserModel
    from gmmtorch.mixture.estimators.sensor_model import LidarModel as LidarModel
    from gmmtorch.mixture.estimators.sensor_model import SensorModel as SensorModel
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
    from gmmtorch.mixture.reduction.merge import Reduction as Reduction
    from gmmtorch.mixture.reduction.merge import merge as merge
    from gmmtorch.mixture.reduction.merge import simplify as simplify
    from gmmtorch.mixture.reduction.pruning import prune as prune
    from gmmtorch.mixture.streaming.checkpoints import Checkpoint as Checkpoint
    from gmmtorch.mixture.streaming.distributed import LostProcessError as LostProcessError
    from gmmtorch.mixture.streaming.distributed import Processes as Processes
    from gmmtorch.mixture.streaming.distributed import joined as joined
    from gmmtorch.mixture.streaming.stream_fit import fit_stream as fit_stream
    from gmmtorch.mixture.streaming.stream_fit import score_stream as score_stream

_MODULES = {
    "density": ["NotFittedError"],
    "depth_image": ["fit_depth_image"],
    "em.exact": ["Parameters"],
    "estimator": ["MixtureEstimator"],
    "estimators.deconvolved": ["DeconvolvedGaussianMixture"],
    "estimators.riemannian": ["RiemannianGaussianMixture"],
    "estimators.sensor_model": ["DepthCameraModel", "LaserModel", "LidarModel", "SensorModel"],
    "estimators.sliced_wasserstein": ["SlicedWassersteinGaussianMixture"],
    "estimators.trees.hierarchical": ["HierarchicalGaussianMixture"],
    "estimators.variational": ["VariationalGaussianMixture"],
    "gaussian_mixture": ["GaussianMixture"],
    "reduction.merge": ["Reduction", "merge", "simplify"],
    "reduction.pruning": ["prune"],
    "streaming.checkpoints": ["Checkpoint"],
    "streaming.distributed": ["LostProcessError", "Processes", "joined"],
    "streaming.stream_fit": ["fit_stream", "score_stream"],
}
__getattr__, __dir__, __all__ = lazy_names(
    __name__, {name: module for module, names in _MODULES.items() for name in names}
)
