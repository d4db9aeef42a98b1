"""What components know besides geometry: colour, intensity, classes."""
