"""What a run shows and writes: status lines, pictures, tables of sweeps."""
