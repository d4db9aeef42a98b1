"""Expectation–maximisation: exact, truncated and stepwise, and its starting points."""
