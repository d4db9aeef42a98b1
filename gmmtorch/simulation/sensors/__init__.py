"""Simulated range sensors: laser, lidar and depth camera, and the paths they move along."""
