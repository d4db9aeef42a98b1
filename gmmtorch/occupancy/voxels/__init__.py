"""Sparse voxels that store evidence, and the traversal of rays through them."""
