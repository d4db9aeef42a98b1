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

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "Checkpoint": "streaming.checkpoints",
        "DeconvolvedGaussianMixture": "estimators.deconvolved",
        "DepthCameraModel": "estimators.sensor_model",
        "GaussianMixture": "gaussian_mixture",
        "HierarchicalGaussianMixture": "estimators.trees.hierarchical",
        "LaserModel": "estimators.sensor_model",
        "LidarModel": "estimators.sensor_model",
        "LostProcessError": "streaming.distributed",
        "MixtureEstimator": "estimator",
        "NotFittedError": "density",
        "Parameters": "em.exact",
        "Processes": "streaming.distributed",
        "Reduction": "reduction.merge",
        "RiemannianGaussianMixture": "estimators.riemannian",
        "SensorModel": "estimators.sensor_model",
        "SlicedWassersteinGaussianMixture": "estimators.sliced_wasserstein",
        "VariationalGaussianMixture": "estimators.variational",
        "fit_depth_image": "depth_image",
        "fit_stream": "streaming.stream_fit",
        "joined": "streaming.distributed",
        "merge": "reduction.merge",
        "prune": "reduction.pruning",
        "score_stream": "streaming.stream_fit",
        "simplify": "reduction.merge",
    },
)
