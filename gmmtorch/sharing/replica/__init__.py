"""Replica: a set of records that converges to the same content on every robot."""
