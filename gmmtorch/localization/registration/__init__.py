"""Registration of two maps, and alignment of points with a map."""
