"""Simulated range sensors (laser, lidar, depth camera) and the paths they follow."""
