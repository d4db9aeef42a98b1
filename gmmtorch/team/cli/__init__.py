"""Commands of teams and robots."""
