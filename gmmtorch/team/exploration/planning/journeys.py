"""The way to a distant view: distances through free space, the roadmap beyond it, and the journey."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from torch import Tensor

from gmmtorch.occupancy import Box
from gmmtorch.team.exploration.planning.collision_checking import LocalMap

if TYPE_CHECKING:
    from gmmtorch.team.exploration.planning.planner_interface import PlanningTask

_FACTOR = 4  # cells along each side of a node
_BLOCK = 8  # nodes along each side of a block of storage
_PASSABLE = 1
_EDGES = (2, 4, 8)  # flags of an edge to the next node along x, y, z
_REACH = 2.5  # node spacings from a point within which it joins the roadmap


class Roadmap:
    """A graph on a lattice `_FACTOR` times as coarse as the map's. A node has a passable cell.

    Two nodes that share a face are joined if passable cells meet on it. Nodes that share an edge or a
    corner are joined if two or three such steps connect them. Nodes are stored in blocks: the cost of an
    update depends on the local map, not on the world; the cost of a query grows with the explored space.
    """

    def __init__(self) -> None:
        self._resolution = 1.0
        self._blocks: dict[tuple[int, int, int], np.ndarray] = {}
        self._cached: _Graph | None = None

    def __len__(self) -> int:
        """Number of nodes."""
        return sum(int(np.count_nonzero(block & _PASSABLE)) for block in self._blocks.values())

    @property
    def spacing(self) -> float:
        """Metres between neighbouring nodes."""
        return _FACTOR * self._resolution

    def update(self, local_map: LocalMap) -> None:
        """Replace the nodes inside the local map, including those that are no longer passable."""
        if self._resolution != local_map.resolution:
            self._resolution, self._cached = local_map.resolution, None
        passable, low = local_map.passable.cpu().numpy(), local_map.low.cpu().numpy()
        first = -(-low // _FACTOR)
        last = (low + passable.shape) // _FACTOR
        if (first >= last).any():
            return
        begin = first * _FACTOR - low
        whole = tuple(slice(b, b + n) for b, n in zip(begin, (last - first) * _FACTOR, strict=True))
        flags, known = _flags(passable[whole])
        for block, inside, outside in _blocks_between(first, last):
            kept = self._blocks.setdefault(block, np.zeros((_BLOCK,) * 3, np.uint8))
            new = (kept[inside] & ~known[outside]) | flags[outside]
            if not np.array_equal(kept[inside], new):
                kept[inside] = new
                self._cached = None

    def distances(self, start: Tensor, goals: Tensor) -> Tensor:
        """Return metres (M,) of the shortest routes from `start` (3,) to goals (M, 3); inf: none."""
        graph = self._graph
        source, gap = graph.nearest(start.cpu().numpy()[None])
        ends, rest = graph.nearest(goals.cpu().numpy().reshape(-1, 3))
        metres = graph.from_node(int(source[0]))
        total = np.full(len(ends), math.inf)
        joined = ends >= 0
        total[joined] = metres[ends[joined]] + gap[0] + rest[joined]
        return torch.from_numpy(total)

    def reaching(self, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Return the nodes (N, 3) from which a goal (3,) can be reached, and their distances (N,), metres."""
        graph = self._graph
        source, gap = graph.nearest(goal.cpu().numpy()[None])
        metres = graph.from_node(int(source[0]))
        good = np.isfinite(metres)
        return torch.from_numpy(graph.points[good]), torch.from_numpy(metres[good] + gap[0])

    @property
    def _graph(self) -> _Graph:
        if self._cached is None:
            self._cached = _Graph(self._blocks, self.spacing)
        return self._cached


def at_the_rim(points: Tensor, box: Box, resolution: float, width: float) -> Tensor:
    """Flag (N,) the points (N, 3), metres, inside a box of cells and within `width` metres of its border."""
    low, high = box.low.double() * resolution, box.high.double() * resolution
    depth = torch.minimum(points - low, high - points).amin(-1)
    return (depth >= 0) & (depth <= width)


class _Graph:
    """The nodes as points (N, 3), metres, in the order of their cells, and the edges between them."""

    def __init__(self, blocks: dict[tuple[int, int, int], np.ndarray], spacing: float) -> None:
        cells, flags = _nodes(blocks)
        self.points = (cells + 0.5) * spacing
        self._ways = _ways(cells, flags) * spacing
        self._reach = _REACH * spacing
        self._tree = cKDTree(self.points) if len(cells) else None

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the nearest node (M,) of each point and its distance; −1 and inf if none is near."""
        if self._tree is None:
            return np.full(len(points), -1), np.full(len(points), math.inf)
        gap, node = self._tree.query(points, distance_upper_bound=self._reach)
        return np.where(np.isfinite(gap), node, -1), gap

    def from_node(self, source: int) -> np.ndarray:
        """Return metres (N,) from a node to all nodes, inf if not connected."""
        return np.full(len(self.points), math.inf) if source < 0 else dijkstra(self._ways, indices=source)


def _flags(passable: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the flags of each node (a, b, c), uint8, and a mask of those that the local map determines."""
    node = passable
    for axis in range(3):
        node = _any(node, axis)
    flags = node.astype(np.uint8)
    known = np.full_like(flags, _PASSABLE + sum(_EDGES))
    for axis, flag in enumerate(_EDGES):
        behind = np.take(passable, range(_FACTOR - 1, passable.shape[axis] - 1, _FACTOR), axis)
        before = np.take(passable, range(_FACTOR, passable.shape[axis], _FACTOR), axis)
        joined = behind & before
        for other in {0, 1, 2} - {axis}:
            joined = _any(joined, other)
        inner = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
        rim = tuple(slice(-1, None) if a == axis else slice(None) for a in range(3))
        flags[inner] |= joined.astype(np.uint8) * np.uint8(flag)
        known[rim] &= np.uint8(255 - flag)  # the next node lies beyond the local map
    return flags, known


def _any(values: np.ndarray, axis: int) -> np.ndarray:
    """Reduce groups of `_FACTOR` values along an axis by logical or."""
    before = (slice(None),) * axis
    return np.logical_or.reduce([values[(*before, slice(i, None, _FACTOR))] for i in range(_FACTOR)])


def _blocks_between(
    first: np.ndarray, last: np.ndarray
) -> list[tuple[tuple[int, int, int], tuple[slice, ...], tuple[slice, ...]]]:
    """Return the blocks of nodes `first` to `last` (exclusive), with the slices in block and nodes."""
    ranges = [range(int(a) // _BLOCK, (int(b) - 1) // _BLOCK + 1) for a, b in zip(first, last, strict=True)]
    found = []
    for block in itertools.product(*ranges):
        low = [max(int(a), n * _BLOCK) for a, n in zip(first, block, strict=True)]
        high = [min(int(b), (n + 1) * _BLOCK) for b, n in zip(last, block, strict=True)]
        inside = tuple(
            slice(a - n * _BLOCK, b - n * _BLOCK) for a, b, n in zip(low, high, block, strict=True)
        )
        outside = tuple(slice(a - int(f), b - int(f)) for a, b, f in zip(low, high, first, strict=True))
        found.append((block, inside, outside))
    return found  # type: ignore[return-value]


def _nodes(blocks: dict[tuple[int, int, int], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells (N, 3) of the nodes, in lexicographic order, and their flags (N,)."""
    if not blocks:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.uint8)
    corner = np.array(list(blocks)) * _BLOCK
    stored = np.stack(list(blocks.values()))
    at = np.stack(np.nonzero(stored & _PASSABLE), 1)
    cells = corner[at[:, 0]] + at[:, 1:]
    flags = stored[tuple(at.T)]
    order = np.lexsort(cells.T[::-1])
    return cells[order], flags[order]


def _ways(cells: np.ndarray, flags: np.ndarray) -> csr_matrix:
    """Return the lengths (N, N), in node spacings, of the edges between nodes, in both directions."""
    n = len(cells)
    if n == 0:
        return csr_matrix((0, 0))
    low = cells.min(0)
    size = cells.max(0) - low + 2  # one more, so that a step beyond the end matches no other node
    key = ((cells - low) * [size[1] * size[2], size[2], 1]).sum(1)
    straight = []
    for stride, flag in zip((size[1] * size[2], size[2], 1), _EDGES, strict=True):
        one = np.nonzero(flags & flag)[0]
        other = np.searchsorted(key, key[one] + stride).clip(max=n - 1)
        there = key[other] == key[one] + stride
        one, other = one[there], other[there]
        step = csr_matrix((np.ones(len(one)), (one, other)), shape=(n, n))
        straight.append(step + step.T)
    x, y, z = straight
    edge = [_either(a @ b, b @ a) for a, b in ((x, y), (x, z), (y, z))]
    corner = _either(*(a @ b for a, b in zip(edge, (z, y, x), strict=True)))
    lengths = x + y + z + math.sqrt(2) * (edge[0] + edge[1] + edge[2]) + math.sqrt(3) * corner
    return csr_matrix(lengths)


def _either(*steps: csr_matrix) -> csr_matrix:
    """Return a matrix with 1 at every entry of any of the matrices."""
    total = csr_matrix(sum(steps))
    total.data[:] = 1
    return total


COARSE = 2
"""Cells of the map along the side of a cell of the field."""
_AROUND = list(itertools.product((-1, 0, 1), repeat=3))
_CHECK_EVERY = 4  # rounds of the wave between two convergence checks


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Distances to the nearest goal on a coarse lattice.

    metres: (nx, ny, nz) float32; inf if a cell has no way to a goal. origin: (3,) metres, world frame, the
    lattice's lowest corner. spacing: side of its cells (m).
    """

    origin: Tensor
    spacing: float
    metres: Tensor

    @classmethod
    def to(cls, local_map: LocalMap, goals: Tensor, offsets: Tensor | None = None) -> DistanceField:
        """Compute the distance to the nearest of goals (M, 3), metres; `offsets` (M,) are added to each goal.
        Goals outside the local map are ignored. Without a goal inside, all distances are inf."""
        _, inside = local_map.flat_index(goals)
        cells = local_map.cells_of(goals[inside])
        begin = torch.zeros(len(cells)) if offsets is None else offsets[inside]
        metres = geodesic(local_map.passable, cells, local_map.resolution, begin)
        origin = local_map.low.double() * local_map.resolution
        return cls(origin, COARSE * local_map.resolution, metres)

    def way(self, points: Tensor, n_cells: int) -> tuple[Tensor, Tensor]:
        """Return metres (...,) float64 from points (..., 3), and the points (..., 3) reached after `n_cells`
        cells of the shortest way.

        The metres are the smallest over the cell of a point and its 26 neighbours, so that a point between
        passable cells also has a way. Without a way, the reached point is the point itself.
        """
        metres, cell = self._entry(points)
        for _ in range(n_cells - 1):
            cell = self._onward[cell]
        _, ny, nz = self.metres.shape
        there = torch.stack([cell // (ny * nz), cell // nz % ny, cell % nz], -1)
        there = self.origin + (there + 0.5) * self.spacing
        return metres, torch.where(torch.isfinite(metres)[..., None], there, points)

    def _entry(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return metres (...,) from points, and the flat index (...,) of the first cell on each way."""
        size = torch.tensor(self.metres.shape, device=points.device)
        steps = torch.tensor(_AROUND, device=points.device)
        cell = ((points - self.origin) / self.spacing).floor().long().unsqueeze(-2) + steps
        inside = ((cell >= 0) & (cell < size)).all(-1)
        _, ny, nz = self.metres.shape
        flat = torch.where(inside, (cell[..., 0] * ny + cell[..., 1]) * nz + cell[..., 2], 0)
        step = self.origin + (cell + 0.5) * self.spacing - points.unsqueeze(-2)
        length = self.metres.view(-1)[flat].double().masked_fill_(~inside, math.inf) + step.norm(dim=-1)
        metres, first = length.min(-1)
        return metres, flat.gather(-1, first.unsqueeze(-1)).squeeze(-1)

    @cached_property
    def _onward(self) -> Tensor:
        """Flat index (n,) of the cell that follows each on its shortest way; a goal follows itself."""
        shape = tuple(n + 2 for n in self.metres.shape)
        inside = (slice(1, -1),) * 3
        padded = torch.full(shape, math.inf, device=self.metres.device)
        padded[inside] = self.metres / self.spacing
        best, onward = self.metres / self.spacing - 1e-4, torch.zeros_like(self.metres, dtype=torch.int64)
        _, ny, nz = self.metres.shape
        for dx, dy, dz in _AROUND:
            there = padded[1 + dx : shape[0] - 1 + dx, 1 + dy : shape[1] - 1 + dy, 1 + dz : shape[2] - 1 + dz]
            # A step a little too short: rounding cannot hide that it leads on.
            there = there + 0.999 * math.sqrt(dx * dx + dy * dy + dz * dz)
            nearer = there < best
            best = torch.where(nearer, there, best)
            onward.masked_fill_(nearer, (dx * ny + dy) * nz + dz)
        return onward.view(-1) + torch.arange(onward.numel(), device=onward.device)


def geodesic(
    passable: Tensor, sources: Tensor, resolution: float, offsets: Tensor, coarse: int = COARSE
) -> Tensor:
    """Metres (nx', ny', nz') float32 to the nearest source over passable cells `coarse` times as wide.

    Steps lead to the 26 neighbours and are as long as they look. A coarse cell is passable where at
    least half of its cells are: one cell is wide enough for a way, while what separates two of them is
    never thinner than the body of the robot, by which the passable cells were shrunk.
    Sources always count as passable. inf: cannot be reached.

    passable: (nx, ny, nz) bool. sources: (M, 3) int64, cells of it. resolution: side (m) of its cells.
    offsets: (M,) metres, at least zero, that each source starts with. coarse: nx' = ⌈nx/coarse⌉.
    """
    open_cells = coarsened(passable, coarse)
    start = torch.full(open_cells.shape, math.inf, device=passable.device)
    index = (sources // coarse).unbind(1)
    flat = (index[0] * start.shape[1] + index[1]) * start.shape[2] + index[2]
    start.view(-1).scatter_reduce_(0, flat, offsets.to(start), "amin")
    open_cells[index] = True
    return _wave(open_cells, start / (coarse * resolution)) * (coarse * resolution)


def coarsened(passable: Tensor, coarse: int) -> Tensor:
    """Return coarse cells (⌈n/coarse⌉, …), bool, at least half of which is passable."""
    share = torch.nn.functional.avg_pool3d(
        passable[None].float(), coarse, ceil_mode=True, divisor_override=coarse**3
    )
    return share[0] >= 0.5


def _wave(open_cells: Tensor, start: Tensor) -> Tensor:
    """Return the smallest number of cell widths to each cell: a wave spreads from `start` until it converges.
    The minimum over the 26 neighbours is computed axis by axis: edges from faces, corners from edges. Cells
    lie in one padded row, so that a shift is a slice."""
    inside = (slice(1, -1),) * 3
    shape = tuple(n + 2 for n in open_cells.shape)
    wall = torch.full(shape, math.inf, device=start.device)
    wall[inside] = torch.where(open_cells, 0.0, math.inf)
    width = torch.full_like(wall, math.inf)
    width[inside] = start
    wall, width = wall.view(-1), width.view(-1)
    strides = (shape[1] * shape[2], shape[2], 1)
    x, y, z, xy, xz, yz, xyz = (torch.full_like(width, math.inf) for _ in range(7))
    count = 0
    while True:
        count += 1
        for stride, out in zip(strides, (x, y, z), strict=True):
            _least_of_two(width, stride, out)
        _least_of_two(x, strides[1], xy)
        _least_of_two(x, strides[2], xz)
        _least_of_two(y, strides[2], yz)
        _least_of_two(xy, strides[2], xyz)
        face = torch.minimum(torch.minimum(x, y), z).add_(1)
        edge = torch.minimum(torch.minimum(xy, xz), yz).add_(math.sqrt(2))
        near = torch.minimum(torch.minimum(face, edge, out=face), xyz + math.sqrt(3), out=face)
        after = torch.minimum(near.add_(wall), width, out=near)
        if count % _CHECK_EVERY == 0 and torch.equal(after, width):
            return after.view(shape)[inside].contiguous()
        width = after


def _least_of_two(values: Tensor, stride: int, out: Tensor) -> None:
    torch.minimum(values[: -2 * stride], values[2 * stride :], out=out[stride:-stride])


_TURNING = 1.25  # metres that a radian off the direction of the way costs
_NEAR = 1.0  # horizontal metres from the goal within which a robot turns to the goal's heading
_AHEAD = 3  # cells of the distance field along which the direction of the way is measured


@dataclass(frozen=True, eq=False)
class Goal:
    """A goal and the value of a metre of progress towards it.

    distances: to the goal. weight: value of a metre of progress. yaw: heading at the goal.
    """

    distances: DistanceField
    weight: float
    yaw: float

    def cost(self, states: Tensor) -> Tensor:
        """Remaining cost (...,) in metres from states (..., 7): the way, the turn into it, and the last turn.
        Close to the goal, and directly above or below it, only the last turn counts."""
        points, yaw = states[..., :3], states[..., 3]
        metres, there = self.distances.way(points, _AHEAD)
        way = there - points
        bearing = torch.atan2(way[..., 1], way[..., 0])
        into, last = angle(bearing - yaw) + angle(self.yaw - bearing), angle(self.yaw - yaw)
        level = (way[..., :2].norm(dim=-1) / _NEAR).clamp_max(1)
        return metres + _TURNING * torch.lerp(last, into, level)


def angle(radians: Tensor) -> Tensor:
    """Absolute angles, wrapped to at most π."""
    return (torch.remainder(radians + math.pi, 2 * math.pi) - math.pi).abs()


_REFRESHED = 10.0  # seconds after which the way over the roadmap is computed again
_PATIENCE = 12.0  # seconds without progress after which a robot gives up
_CLOSER = 0.5  # metres that count as progress
_THERE = 1.2  # metres from the goal at which the robot has arrived
_FACING = 0.7  # radians off the goal's heading at which the robot has arrived


def looks(state: Tensor, poses: Tensor) -> Tensor:
    """Flag (...,) the poses (..., 4) that a robot in a state (7,) has reached, position and heading."""
    is_there = (state[:3] - poses[..., :3]).norm(dim=-1) < _THERE
    return is_there & (angle(state[3] - poses[..., 3]) < _FACING)


class Journey:
    """A journey to a view `pose` (4,) with a `value`, `metres` away at the start.

    `since` is the time (s) of the last progress. The roadmap gives the distance from its nodes to the
    goal. Inside the local map the distance is computed cell by cell, from the goal if it is inside, and
    from the nodes near the border, each with its remaining distance.
    """

    def __init__(self, pose: Tensor, value: float, metres: float, now: float) -> None:
        self.pose, self.value, self.metres = pose, value, metres
        self._nearest, self.since = math.inf, now
        self._nodes, self._rest = torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
        self._refreshed = -math.inf

    @classmethod
    def chosen(cls, task: PlanningTask, least: float, given_up: Tensor | None = None) -> Journey | None:
        """Start a journey to the view with the largest value/(1 + metres), and take it from the library.
        Returns None if no view worth `least` can be reached. Views close to `given_up` (N, 4) are ignored."""
        known = task.library.candidates()
        if not known.keys:
            return None
        metres = task.roadmap.distances(task.state[:3], known.poses[:, :3])
        if given_up is not None and len(given_up):
            apart = torch.cdist(known.poses[:, :3], given_up[:, :3]).amin(1)
            metres = metres.masked_fill(apart < _THERE, math.inf)
        row = task.library.best(metres, least=least)
        if row is None:
            return None
        task.library.remove([known.keys[row]], task.now)
        return cls(known.poses[row], float(known.values[row]), float(metres[row]), task.now)

    def put_back(self, task: PlanningTask) -> None:
        """Return the view to the library."""
        task.library.add(self.pose[None], torch.tensor([self.value]), task.now, 0.0)

    def goal(self, task: PlanningTask, weight: float) -> Goal | None:
        """Return the goal of the next motion; None if the robot has arrived or makes no progress."""
        if bool(looks(task.state, self.pose)):
            return None
        goal = Goal(self._field(task), weight, float(self.pose[3]))
        cost = float(goal.cost(task.state))
        if cost < self._nearest - _CLOSER:
            self._nearest, self.since = cost, task.now
        return None if task.now - self.since > _PATIENCE else goal

    def _field(self, task: PlanningTask) -> DistanceField:
        if task.now - self._refreshed >= _REFRESHED:
            self._nodes, self._rest = task.roadmap.reaching(self.pose[:3])
            self._refreshed = task.now
        here = task.local_map
        rim = at_the_rim(self._nodes, here.box, here.resolution, 1.5 * task.roadmap.spacing)
        goals = torch.cat([self.pose[None, :3], self._nodes[rim]])
        offsets = torch.cat([self._rest.new_zeros(1), self._rest[rim]])
        return DistanceField.to(here, goals, offsets)
