"""Robots that choose where to look next: information, planning, teams, missions."""
