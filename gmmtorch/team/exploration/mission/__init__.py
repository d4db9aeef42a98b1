"""Missions of a team of robots, simulated or in real time."""
