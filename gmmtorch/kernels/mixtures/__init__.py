"""E-steps, moments of cells, and pairs of components of two mixtures."""
