"""Roadmap: a sparse, coarse graph of passable space beyond the robot's local map."""

from __future__ import annotations

import itertools
import math

import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from torch import Tensor

from gmmtorch.occupancy import Box
from gmmtorch.team.exploration.robot.mapper import LocalMap

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
