"""Comparisons of ways to fit a mixture: estimators, pruning, and clouds larger than memory."""
