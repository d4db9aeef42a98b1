"""Kernels of entropy coding."""
