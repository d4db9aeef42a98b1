"""Simulated places whose every surface is known: offices, halls, a warehouse, tunnels, any mesh."""
