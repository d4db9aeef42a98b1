"""Evidence of hits and misses, and the occupancy that follows from it (thesis chapter 3)."""
