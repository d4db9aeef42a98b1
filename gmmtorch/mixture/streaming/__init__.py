"""Fits of clouds that are larger than memory, or shared by several processes."""
