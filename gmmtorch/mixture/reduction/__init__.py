"""Mixtures with fewer components: merging and pruning (thesis 2.1.4)."""
