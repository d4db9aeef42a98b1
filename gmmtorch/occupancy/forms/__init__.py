"""The four forms of evidence: point, flux, cone and Monte Carlo (thesis 3.2)."""
