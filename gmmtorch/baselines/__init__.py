"""The maps that robots use today, behind the same protocol as ours."""
