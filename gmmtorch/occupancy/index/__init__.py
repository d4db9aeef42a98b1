"""Cones of a map, and the spatial index that finds those near a point or cell."""
