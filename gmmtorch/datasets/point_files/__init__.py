"""Readers of point clouds in files (PLY, PCD, LAS, NPY, text), whole or in chunks."""
