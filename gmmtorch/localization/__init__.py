"""Registration: the rigid motion that lays one map over another."""
