"""Figures and recordings of exploring teams."""
