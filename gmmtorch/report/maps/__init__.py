"""Pictures of maps and mixtures."""
