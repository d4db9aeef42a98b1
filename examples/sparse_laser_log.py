"""Every tenth beam of a laser log becomes a 2D map, and an image for ROS's map_server.

python examples/sparse_laser_log.py                    # a simulated building
python examples/sparse_laser_log.py intel.log.gz       # a CARMEN log
"""

import sys
from pathlib import Path

import torch

import gmmtorch as gt
from gmmtorch.export import write_map_server

if len(sys.argv) > 1:
    scans = gt.datasets.load("carmen", path=sys.argv[1])
else:
    scans = gt.datasets.load("synthetic_building_2d")

m = gt.GaussianMap()
ends = []
for scan in scans:
    sparse = gt.Scan(scan.points[::10], scan.origin, scan.no_return[::10])
    m.insert(sparse)
    ends.append(sparse.points)
ends = torch.cat(ends)
print(f"{len(ends):,} beams, {m.n_components:,} components, {m.nbytes:,} bytes")

low, high = ends.amin(0).tolist(), ends.amax(0).tolist()
grid = gt.VoxelGrid.covering(low=low, high=high, resolution=0.1)
occupancy = m.evidence(grid).probability()
output = Path("outputs/examples/laser.yaml")
output.parent.mkdir(parents=True, exist_ok=True)
print(*write_map_server(output, grid, occupancy))
