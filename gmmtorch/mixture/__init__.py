"""Gaussian mixtures and how they are learned (thesis chapter 2)."""

from gmmtorch.mixture.deconvolved_mixture import DeconvolvedGaussianMixture
from gmmtorch.mixture.depth_image import fit_depth_image
from gmmtorch.mixture.gaussian_mixture import GaussianMixture
from gmmtorch.mixture.hierarchical import HierarchicalGaussianMixture
from gmmtorch.mixture.pruning import prune
from gmmtorch.mixture.reduction import merge, simplify
from gmmtorch.mixture.riemannian import RiemannianGaussianMixture
from gmmtorch.mixture.sliced_wasserstein import SlicedWassersteinGaussianMixture
from gmmtorch.mixture.variational import VariationalGaussianMixture

__all__ = [
    "DeconvolvedGaussianMixture",
    "GaussianMixture",
    "HierarchicalGaussianMixture",
    "RiemannianGaussianMixture",
    "SlicedWassersteinGaussianMixture",
    "VariationalGaussianMixture",
    "fit_depth_image",
    "merge",
    "prune",
    "simplify",
]
