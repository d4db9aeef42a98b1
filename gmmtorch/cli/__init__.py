"""Commands. Nothing heavy is imported before a command really runs."""
