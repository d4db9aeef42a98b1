"""How good a map is, on scans that it was never shown."""
