"""Lattices of voxels: sparse stores of evidence, the rolling window, and the traversal of rays."""
