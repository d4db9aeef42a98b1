"""Replica: a set of records that converges to the same content at every robot."""
