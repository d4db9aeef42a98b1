"""Where to fly next: motion primitives, tree search, frontiers, coordination (thesis 4.3)."""
