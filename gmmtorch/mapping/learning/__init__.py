"""From scans to components: the learning rules of a map (thesis 4.1)."""
