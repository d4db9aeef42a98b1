"""Gaussian mixtures and how they are learned (thesis chapter 2)."""

from gmmtorch.mixture.gaussian_mixture import GaussianMixture

__all__ = ["GaussianMixture"]
