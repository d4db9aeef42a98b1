"""Spatial index over cones: the cones that can give evidence to a point, cell or box."""
