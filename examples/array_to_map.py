"""An array of points becomes a map, and the map becomes a file.

python examples/array_to_map.py [map.safetensors]
"""

import sys

import numpy as np

import gmmtorch as gt

# A scan: points (N, 3) and the position of the sensor (3,), metres in the world frame.
rng = np.random.default_rng(0)
y, z = rng.uniform(-3, 3, 5000), rng.uniform(0, 2.5, 5000)
wall = np.column_stack([np.full(5000, 4.0), y, z])
wall += rng.normal(scale=0.01, size=wall.shape)
sensor = np.array([0.0, 0.0, 1.0])

m = gt.GaussianMap()
m.insert(gt.Scan(wall, sensor))

on_wall, before_wall, behind_wall = [4.0, 0.0, 1.0], [2.0, 0.0, 1.0], [6.0, 0.0, 1.0]
p = m.occupancy(np.array([on_wall, before_wall, behind_wall]), resolution=0.1)
print(f"occupied {p[0]:.2f}, free {p[1]:.2f}, unknown {p[2]:.2f}")

path = sys.argv[1] if len(sys.argv) > 1 else "map.safetensors"
m.save(path)
print(f"{m.n_components} components, {m.nbytes:,} bytes in {path}")
