"""Experiments: baselines, evaluation, studies, and their commands."""
