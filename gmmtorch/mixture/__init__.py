"""Gaussian mixtures and how they are learned (thesis chapter 2)."""

from gmmtorch.mixture.depth_image import fit_depth_image
from gmmtorch.mixture.estimators.deconvolved import DeconvolvedGaussianMixture
from gmmtorch.mixture.estimators.riemannian import RiemannianGaussianMixture
from gmmtorch.mixture.estimators.sliced_wasserstein import SlicedWassersteinGaussianMixture
from gmmtorch.mixture.estimators.trees.hierarchical import HierarchicalGaussianMixture
from gmmtorch.mixture.estimators.variational import VariationalGaussianMixture
from gmmtorch.mixture.gaussian_mixture import GaussianMixture
from gmmtorch.mixture.reduction.merge import merge, simplify
from gmmtorch.mixture.reduction.pruning import prune

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
