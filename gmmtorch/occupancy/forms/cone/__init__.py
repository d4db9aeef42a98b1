"""Cone form: the closed-form approximations of hits and misses in a cell (thesis 3.2.2)."""
