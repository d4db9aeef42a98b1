"""A laser log becomes a moving picture of the map that grows.

python examples/growing_map.py               # a simulated building
python examples/growing_map.py intel.log.gz  # your CARMEN log; 910 scans take two minutes
"""

import sys
from pathlib import Path

import torch

import gmmtorch as gt
from gmmtorch.mapping.map_builder import MapBuilder
from gmmtorch.report.map_figures import GrowthFrame, save_growth

N_FRAMES = 20

torch.set_num_threads(1)
scans = (
    gt.datasets.load("carmen", sys.argv[1])
    if len(sys.argv) > 1
    else gt.datasets.load("synthetic_building_2d")
)
builder = MapBuilder(scans, gt.GaussianMap(gt.IncrementalRule(max_bytes=40_000)))
due = {round(k * len(scans) / N_FRAMES) for k in range(1, N_FRAMES + 1)}
frames = []
for now in builder.insert_all():
    if now.n_read in due:
        hits = scans[builder.record.indices[-1]].points
        copy = gt.GaussianMap.of(builder.map.components(), codec="quantized")
        frames.append(GrowthFrame(now.n_read, copy, builder.poses[:, :2, 2], hits))
        size = f"{copy.n_components:,} components"
        print(f"\r{now.n_read} of {now.n_total} scans, {size}", end="")

picture = Path("outputs/examples/growing_map.webp")
picture.parent.mkdir(parents=True, exist_ok=True)
save_growth(picture, frames, resolution=0.05, period=0.3)
print(f"\n{picture}: {len(frames)} frames, {picture.stat().st_size:,} bytes")
