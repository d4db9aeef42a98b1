"""Simulated worlds whose surfaces are known exactly: an office, a hall, a warehouse, tunnels, any mesh."""
