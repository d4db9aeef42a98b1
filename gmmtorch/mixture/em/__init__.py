"""Expectation maximization: exact, truncated and stepwise, with its initializations (thesis 2.1)."""
