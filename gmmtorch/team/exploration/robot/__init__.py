"""One exploring robot: its map, its planner, its radio."""
