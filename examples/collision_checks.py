"""A planner checks a path against a map: distances, collision probability, gradient.

python examples/collision_checks.py
"""

import torch

import gmmtorch as gt
from gmmtorch.mapping.surfaces import clearance, collision_probability

RADIUS = 0.3  # metres, of the robot's body

scans = gt.datasets.load("synthetic_building", stride=4)
m = gt.GaussianMap()
for scan in scans:
    m.insert(scan)

start, goal = scans[0].origin, scans[5].origin
share = torch.linspace(0, 1, 50, dtype=torch.float64)[:, None]
path = torch.lerp(start, goal, share).requires_grad_()

gap = clearance(m, path)  # (50,), metres to the nearest surface
risk = collision_probability(m, path.detach(), RADIUS)  # (50,)
gap.min().backward()
nearest = int(gap.argmin())
print(f"clearance {gap.min():.2f} m at least, ", end="")
print(f"collision probability {risk.max():.3f} at most")
print(f"at point {nearest}, move along {path.grad[nearest].tolist()} to gain clearance")
