"""Hierarchical mixtures: a tree of components, grown level by level (thesis 2.1.2)."""
