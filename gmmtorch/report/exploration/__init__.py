"""Figures of exploration missions."""
