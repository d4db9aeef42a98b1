"""The thesis's cone approximation of hits and misses in a cell (thesis 3.2.2)."""
