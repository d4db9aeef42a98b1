"""Ellipsoids, points and paths in space: one renderer for all commands."""
