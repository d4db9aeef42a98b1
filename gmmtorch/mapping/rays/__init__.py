"""Rays drawn from the components of a map."""
