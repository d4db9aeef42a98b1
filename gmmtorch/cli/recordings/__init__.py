"""Many recordings: their paths, tasks in this process or on Ray, and the merging of their maps."""
