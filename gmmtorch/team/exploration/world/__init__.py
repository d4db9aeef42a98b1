"""The simulated world of a mission: truth, visibility, free space, collisions, scores."""
