"""Rays drawn from the components of a map, and a spatial index of its batches."""
