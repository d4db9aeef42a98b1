"""Reduction of mixtures: merging and pruning of components."""
