"""A mixture map and an occupancy grid of the same scans, tested on one that neither saw.

python examples/compare_with_grid.py
"""

import torch
from sklearn.metrics import roc_auc_score

import gmmtorch as gt

scans = list(gt.datasets.load("synthetic_building", stride=4))
test = scans.pop(len(scans) // 2)

maps = {
    "count grid": gt.OccupancyGrid(resolution=0.1),
    "mixture": gt.GaussianMap(gt.IncrementalRule(max_bytes=8000)),
}
for scan in scans:
    for m in maps.values():
        m.insert(scan)

# Each beam of the test scan gives an occupied point, its end, and a free one before it.
generator = torch.Generator().manual_seed(0)
along = torch.rand(len(test.points), 1, generator=generator, dtype=torch.float64)
points = torch.cat([test.points, test.origin + along * (test.points - test.origin)])
labels = torch.cat([torch.ones(len(test.points)), torch.zeros(len(test.points))])
for name, m in maps.items():
    auc = roc_auc_score(labels, m.occupancy(points, resolution=0.1))
    print(f"{name:>10}: AUC {auc:.3f} in {m.nbytes:,} bytes")
