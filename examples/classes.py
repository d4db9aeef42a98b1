"""A map with classes: which surfaces are floor, and which are obstacles.

python examples/classes.py
"""

from dataclasses import replace

import torch

import gmmtorch as gt

FLOOR, OBSTACLE = 0, 1


def labelled(scan: gt.Scan) -> gt.Scan:
    """A scan with a class for each point, as segmentation gives it; −1: unknown."""
    label = torch.where(scan.points[:, 2] < 0.05, FLOOR, OBSTACLE)
    label[::10] = -1
    return replace(scan, attributes={"class": label})


m = gt.GaussianMap(gt.IncrementalRule(max_bytes=8000))
for scan in gt.datasets.load("synthetic_building", n_scans=20):
    m.insert(labelled(scan))

places = torch.tensor([[7.0, 5.0, 0.0], [0.0, 5.0, 1.5], [7.0, 5.0, 50.0]])
found = m.attributes(places)["class"]
print(f"{m.n_components} components, {m.nbytes:,} bytes")
print("classes of floor, wall and nothing:", found.most_likely.tolist())
print("probability of each:", [[round(p, 2) for p in row] for row in found.mean.tolist()])
