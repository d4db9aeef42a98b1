"""The poses of a sensor from its scans alone."""
