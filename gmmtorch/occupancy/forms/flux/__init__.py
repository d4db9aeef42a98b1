"""Exact hits and misses of a cell, polygon or mesh: the flux of rays through its faces."""
