"""A planner finds a path through a map: a grid of clearances, then gradient steps.

python examples/plan_path.py                   # a simulated building
python examples/plan_path.py map.safetensors   # your map: its two farthest sensors
"""

import sys

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

import gmmtorch as gt
from gmmtorch.mapping import Body
from gmmtorch.mapping.surfaces import clearance

STEP = 0.25  # metres between the places that the search visits
# Two balls: 0.7 m long, 0.4 m wide.
BODY = Body([[0.15, 0.0, 0.0], [-0.15, 0.0, 0.0]], [0.2, 0.2])
DEVIATIONS = 2.0  # an ellipsoid of 2 deviations is an obstacle
DENSITY = 5.0  # returns per m³; ellipsoids with fewer are stray returns

if len(sys.argv) > 1:
    m = gt.GaussianMap.load(sys.argv[1])
else:
    m = gt.GaussianMap()
    for scan in gt.datasets.load("synthetic_building"):
        m.insert(scan)

# Start and goal: two places where the sensor was.
sensors = m.components().origins
pair = int(torch.cdist(sensors, sensors).argmax())
start, goal = sensors[pair // len(sensors)], sensors[pair % len(sensors)]
height = float(start[2])

# Places at the sensor's height, their clearances, and whether they are known to be free.
low, high = sensors[:, :2].amin(0) - 2, sensors[:, :2].amax(0) + 2
shape = ((high - low) / STEP).ceil().int().tolist()
axes = [low[d] + STEP * torch.arange(shape[d]) for d in range(2)]
x, y = torch.meshgrid(*axes, indexing="ij")
places = torch.stack([x, y, torch.full_like(x, height)], -1).view(-1, 3)
room = clearance(m, places, DEVIATIONS, DENSITY) - BODY.radii.max()
is_free = (room > 0) & (m.occupancy(places, resolution=STEP) < 0.3)

# Edges to the eight neighbours. Steps near surfaces cost more.
index = torch.arange(len(places)).view(shape)
rows, columns, costs = [], [], []
for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
    a = index[: shape[0] - dx, max(0, -dy) : shape[1] - max(0, dy)].flatten()
    b = index[dx:, max(0, dy) : shape[1] + min(0, dy)].flatten()
    usable = is_free[a] & is_free[b]
    a, b = a[usable], b[usable]
    length = (places[a] - places[b]).norm(dim=1)
    rows.append(a)
    columns.append(b)
    costs.append(length * (1 + 0.5 / (torch.minimum(room[a], room[b]) + 0.1)))
ends = torch.cat(rows), torch.cat(columns)
edges = coo_array((torch.cat(costs), ends), shape=(len(places), len(places)))


def nearest_free(place: torch.Tensor) -> int:
    return int(torch.where(is_free, (places - place).norm(dim=1), torch.inf).argmin())


first, last = nearest_free(start), nearest_free(goal)
cost, before = dijkstra(edges, directed=False, indices=first, return_predecessors=True)
if not cost[last] < float("inf"):
    sys.exit("There is no path through known free space.")
found = [last]
while found[-1] != first:
    found.append(int(before[found[-1]]))
path = places[found[::-1]]


def headed(points: torch.Tensor) -> torch.Tensor:
    """Poses (S, 4, 4) that look along the path."""
    ahead = torch.cat([points[1:] - points[:-1], points[-1:] - points[-2:-1]])
    yaw = torch.atan2(ahead[:, 1], ahead[:, 0])
    poses = torch.eye(4, dtype=torch.float64).repeat(len(points), 1, 1)
    poses[:, 0, 0], poses[:, 0, 1] = yaw.cos(), -yaw.sin()
    poses[:, 1, 0], poses[:, 1, 1] = yaw.sin(), yaw.cos()
    poses[:, :3, 3] = points
    return poses


# Gradient steps smooth the path and keep half a metre of room where there is some.
inner = path[1:-1, :2].clone().requires_grad_()
optimizer = torch.optim.Adam([inner], lr=0.02)
for _ in range(100):
    points = torch.cat([path[:1], torch.cat([inner, path[1:-1, 2:]], 1), path[-1:]])
    bend = (points[2:] - 2 * points[1:-1] + points[:-2]).square().sum()
    gaps = BODY.clearance(m, headed(points), DEVIATIONS, DENSITY)
    too_close = (0.5 - gaps).clamp_min(0).square().sum()
    optimizer.zero_grad()
    (20 * bend + too_close).backward()
    optimizer.step()
smooth = torch.cat([path[:1], torch.cat([inner.detach(), path[1:-1, 2:]], 1), path[-1:]])

for name, points in (("search", path), ("smoothed", smooth)):
    length = float((points[1:] - points[:-1]).norm(dim=1).sum())
    gap = float(BODY.clearance(m, headed(points), DEVIATIONS, DENSITY).min())
    risk = float(BODY.collision_probability(m, headed(points)).max())
    print(f"{name}: {length:.1f} m, smallest clearance {gap:.2f} m, ", end="")
    print(f"largest collision probability {risk:.3f}")

occupancy = m.occupancy(places, resolution=STEP).view(shape)
left, bottom = low.tolist()
extent = (left, left + STEP * shape[0], bottom, bottom + STEP * shape[1])
plt.imshow(occupancy.T, origin="lower", extent=extent, cmap="gray_r", vmin=0, vmax=1)
plt.plot(path[:, 0], path[:, 1], ":", color="tab:blue", label="search")
plt.plot(smooth[:, 0], smooth[:, 1], color="tab:orange", label="smoothed")
plt.legend(loc="upper right")
plt.xlabel("x [m]")
plt.ylabel("y [m]")
plt.savefig("path.png", dpi=150, bbox_inches="tight")
print("path.png shows the paths over the occupancy at the sensor's height")
