from . import baselines as baselines
from . import datasets as datasets
from . import mixture as mixture
from . import sharing as sharing
from .errors import GmmTorchError as GmmTorchError
from .localization.registration import register as register
from .mapping.components import Components as Components
from .mapping.gaussian_map import GaussianMap as GaussianMap
from .mapping.learning.rules import IncrementalRule as IncrementalRule
from .mapping.learning.rules import NoveltyRule as NoveltyRule
from .mapping.learning.rules import WindowedRule as WindowedRule
from .mixture.estimators.deconvolved import DeconvolvedGaussianMixture as DeconvolvedGaussianMixture
from .mixture.estimators.depth_image import fit_depth_image as fit_depth_image
from .mixture.estimators.hierarchical import HierarchicalGaussianMixture as HierarchicalGaussianMixture
from .mixture.estimators.riemannian import RiemannianGaussianMixture as RiemannianGaussianMixture
from .mixture.estimators.sliced_wasserstein import (
    SlicedWassersteinGaussianMixture as SlicedWassersteinGaussianMixture,
)
from .mixture.estimators.variational import VariationalGaussianMixture as VariationalGaussianMixture
from .mixture.gaussian_mixture import GaussianMixture as GaussianMixture
from .mixture.streaming import fit_stream as fit_stream
from .occupancy.evidence import Evidence as Evidence
from .occupancy.grid import VoxelGrid as VoxelGrid
from .occupancy.occupancy_grid import OccupancyGrid as OccupancyGrid
from .scan import Scan as Scan

__version__: str
