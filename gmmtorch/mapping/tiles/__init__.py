"""Maps in tiles on disk."""
