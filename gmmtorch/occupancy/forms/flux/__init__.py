"""Flux form: exact hits and misses of a cell, box, polygon or mesh, from the rays through its faces."""
