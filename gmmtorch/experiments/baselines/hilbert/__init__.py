"""Hilbert maps: features, logistic regression, and its Bayesian form."""
