"""Maps of components that remember whence they were seen (thesis 4.1)."""
