"""A ROS bag becomes a map: read, map, look.

python examples/bag_to_map.py                 # writes a bag of a simulated building first
python examples/bag_to_map.py drive.mcap      # a bag of your own

The command gmmtorch-map dataset=rosbag dataset.path=drive.mcap does the same, and more.
"""

import sys
from pathlib import Path

import gmmtorch as gt
from gmmtorch.export import surface_mesh, write_bag, write_mesh
from gmmtorch.mapping.map_builder import MapBuilder

output = Path("outputs/examples")
if len(sys.argv) > 1:
    bag = Path(sys.argv[1])
else:
    building = gt.datasets.load("synthetic_building", n_scans=20)
    output.mkdir(parents=True, exist_ok=True)
    poses = [building.pose(i) for i in range(len(building))]
    bag = write_bag(output / "building.mcap", list(building), poses)
    print(f"wrote {bag}: {bag.stat().st_size:,} bytes")

builder = MapBuilder(gt.datasets.load("rosbag", bag), gt.GaussianMap())
for now in builder.insert_all():
    print(f"\r{now.n_read} of {now.n_total} scans, {now.metres:.1f} m", end="")
print(f"\n{builder.map.n_components:,} components, {builder.map.nbytes:,} bytes")
print(f"skipped: {builder.skipped}")

builder.map.save(output / "building.safetensors")
if builder.map.dim == 3:
    mesh = surface_mesh(builder.map.components(), 0.1)
    print(write_mesh(output / "building.ply", mesh))
