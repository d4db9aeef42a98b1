"""Rays and voxels: traversal, counting, entropies, information of beams, casting, lookup of cells."""
