"""The first triangle along each ray, and the distance to the nearest triangle, in a tree of boxes.

The tree is built from the leaves upwards by tensor operations: of neighbours along a Morton curve, those two
join whose common box has the smallest surface (Meister & Bittner 2018, Parallel locally-ordered clustering
for bounding volume hierarchy construction). The fused kernels descend it in depth; the twin descends it in
breadth, with all pairs of a ray and a node at once. All numbers are float64.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.chunks import chunked
from gmmtorch.kernels.compiler import CPU_LANES, FusedKernel
from gmmtorch.linalg import order_along_curve

_WINDOW = 2  # neighbours, in each direction along the curve, among which a box looks for its partner
_SLOWEST = 1 / 6
"""If fewer boxes find a partner in a round, all neighbours join: a tree of 2³¹ triangles is at most 118 deep,
within `DEEPEST` of triangles.h."""
EDGE_SLACK = 64 * torch.finfo(torch.float64).eps
"""Relative distance outside an edge at which a ray still counts as a hit, so that no ray passes between two
adjacent triangles. A ray whose angle to a triangle is below four times this counts as parallel to it."""
_BOX_SLACK = 1 + 16 * torch.finfo(torch.float64).eps
_LEAST_STEP = 1e-200
_CHUNK_RAYS = 1 << 12  # of the twin


class TriangleTree(NamedTuple):
    """A binary tree over T ≥ 1 triangles.

    boxes: (M, 2, 2, 3), lowest and highest corner of the boxes of both children of each node; the last node
    is the root. children: (M, 2) int32, nodes, or ~t for triangle t. corners: (T, 10), a corner of each
    triangle, the edges to the two others, and the length of the longest edge.
    """

    boxes: Tensor
    children: Tensor
    corners: Tensor

    def to(self, device: torch.device | str) -> TriangleTree:
        """The tree on a device."""
        return TriangleTree(*(table.to(device) for table in self))


def triangle_tree(triangles: Tensor) -> TriangleTree:
    """The tree of triangles (T, 3, 3), float64, finite, T of 1 or more, on their device."""
    low, high = triangles.amin(1), triangles.amax(1)
    order = order_along_curve((low + high) / 2, 4)
    a, b, c = triangles[order].unbind(1)
    longest = torch.stack([b - a, c - a, c - b]).norm(dim=2).amax(0)
    corners = torch.cat([a, b - a, c - a, longest[:, None]], 1)
    low, high = low[order].T.contiguous(), high[order].T.contiguous()
    name = ~torch.arange(len(order), device=order.device)
    boxes: list[Tensor] = []
    children: list[Tensor] = []
    n_nodes = 0
    while len(name) > 1 or not boxes:
        partner = _partners(low, high)
        place = torch.arange(len(partner), device=partner.device)
        joins = partner[partner] == place
        first = (joins & (place <= partner)).nonzero()[:, 0]  # place == partner of a single triangle
        if len(first) < _SLOWEST * len(name):
            partner = (place ^ 1).clamp_max(len(name) - 1)
            joins = torch.ones_like(joins)
            first = place[::2][: len(name) // 2]
            joins[2 * len(first) :] = False
        second = partner[first]
        pair = torch.stack([first, second], 1)
        boxes.append(torch.stack([low.T[pair], high.T[pair]], 2))
        children.append(name[pair])
        low[:, first] = torch.minimum(low[:, first], low[:, second])
        high[:, first] = torch.maximum(high[:, first], high[:, second])
        name[first] = torch.arange(n_nodes, n_nodes + len(first), device=name.device)
        n_nodes += len(first)
        joins[first] = False
        left = (~joins).nonzero()[:, 0]
        low, high, name = low[:, left], high[:, left], name[left]
    return TriangleTree(torch.cat(boxes), torch.cat(children).int(), corners)


def _partners(low: Tensor, high: Tensor) -> Tensor:
    """The box (C,) within the window with which each of C boxes (3, C) has the smallest common surface."""
    n = low.shape[1]
    place = torch.arange(n, device=low.device)
    best, partner = torch.full_like(low[0], torch.inf), place.clone()
    for step in range(1, min(_WINDOW, n - 1) + 1):
        x, y, z = torch.maximum(high[:, step:], high[:, :-step]) - torch.minimum(
            low[:, step:], low[:, :-step]
        )
        surface = x * y + (x + y) * z
        if step == 1:
            surface[::2] *= 1 - 1e-6  # of equal pairs, these are disjoint
        for own, others in ((slice(None, n - step), place[step:]), (slice(step, None), place[:-step])):
            nearer = surface < best[own]
            best[own] = torch.where(nearer, surface, best[own])
            partner[own] = torch.where(nearer, others, partner[own])
    return partner


_HITS = FusedKernel("rays/triangles.h", "first_hits")
_NEAREST = FusedKernel("rays/triangles.h", "nearest_triangles")


def first_hits(tree: TriangleTree, origins: Tensor, directions: Tensor) -> Tensor:
    """Distances (N,) to the first triangle, in multiples of the directions' lengths; inf if none is hit.

    Solves o + t d = a + u e + v f for t > 0, u, v ≥ 0 and u + v ≤ 1 (Möller & Trumbore 1997). Both faces
    count. A ray in the plane of a triangle does not hit it, and a ray that is not finite hits nothing.

    Args:
        origins: (N, 3), or (3,) if all rays start at one point. directions: (N, 3).
    """
    if is_fused(tree.boxes, origins, directions):
        n, device = len(directions), directions.device
        found = torch.empty(n, dtype=torch.float64, device=device)
        n_items = -(-n // CPU_LANES) if device.type == "cpu" else n
        stride = 3 if origins.ndim == 2 else 0
        _HITS(n_items, n, origins, stride, directions, *tree, len(tree.boxes), found)
        return found
    origins = origins.expand(directions.shape)

    def compute(part: slice) -> Tensor:
        o, d = origins[part], directions[part]
        best = torch.full_like(d[:, 0], torch.inf)
        inverse = 1 / torch.where(d.abs() < _LEAST_STEP, _LEAST_STEP, d)

        def meets(ray: Tensor, boxes: Tensor) -> Tensor:
            sides = ((boxes - o[ray, None]) * inverse[ray, None]).sort(1).values
            return sides[:, 0].amax(1).clamp_min(0) <= sides[:, 1].amin(1) * _BOX_SLACK

        is_ray = (torch.isfinite(o) & torch.isfinite(d)).all(1)
        for ray, triangle in _descent(tree, is_ray, meets):
            best.scatter_reduce_(0, ray, _crossings(o[ray], d[ray], tree.corners[triangle]), "amin")
        return best

    parts = list(chunked(len(directions), _CHUNK_RAYS, compute))
    return torch.cat(parts) if parts else directions[:, 0]


def nearest_triangles(tree: TriangleTree, points: Tensor) -> Tensor:
    """Distances (N,) from points (N, 3), finite, to the nearest triangle."""
    if is_fused(tree.boxes, points):
        found = torch.empty_like(points[:, 0])
        _NEAREST(len(points), points, *tree, len(tree.boxes), found)
        return found

    def compute(part: slice) -> Tensor:
        x = points[part]
        best = torch.full_like(x[:, 0], torch.inf)  # squares

        def meets(point: Tensor, boxes: Tensor) -> Tensor:
            below, above = (boxes - x[point, None]).unbind(1)
            gap = torch.maximum(below, -above).clamp_min(0).square().sum(1)
            most = torch.maximum(below.abs(), above.abs()).square().sum(1)
            best.scatter_reduce_(0, point, most * _BOX_SLACK, "amin")  # the triangle in it is not farther
            return gap <= best[point]

        everyone = torch.ones_like(best, dtype=torch.bool)
        leaves = list(_descent(tree, everyone, meets))
        best.fill_(torch.inf)
        for point, triangle in leaves:
            squares = _squares_to_triangles(x[point], tree.corners[triangle])
            best.scatter_reduce_(0, point, squares, "amin")
        return best.sqrt()

    parts = list(chunked(len(points), _CHUNK_RAYS, compute))
    return torch.cat(parts) if parts else points[:, 0]


def _descent(
    tree: TriangleTree, starts: Tensor, meets: Callable[[Tensor, Tensor], Tensor]
) -> Iterator[tuple[Tensor, Tensor]]:
    """Pairs of row (P,) and triangle (P,) that are left of all pairs with the rows that start (N,), level by
    level: meets(rows, boxes) flags the pairs (P,) of a row with a box (P, 2, 3) that stay."""
    row = starts.nonzero()[:, 0]
    node = torch.full_like(row, len(tree.boxes) - 1)
    while len(row):
        child, boxes = tree.children[node].long().view(-1), tree.boxes[node].flatten(0, 1)
        row = row.repeat_interleave(2)
        stays = meets(row, boxes).nonzero()[:, 0]
        row, child = row[stays], child[stays]
        is_leaf = child < 0
        yield row[is_leaf], ~child[is_leaf]
        row, node = row[~is_leaf], child[~is_leaf]


def _crossings(origins: Tensor, directions: Tensor, corners: Tensor) -> Tensor:
    """Distances (P,) along rays (P, 3) to triangles (P, 10); inf if the ray misses the triangle."""
    a, e, f, longest = corners.tensor_split((3, 6, 9), 1)
    away = origins - a
    p, q = torch.linalg.cross(directions, f), torch.linalg.cross(away, e)
    steep = (p * e).sum(1)
    sign = torch.where(steep < 0, -1.0, 1.0)
    u, v, w = ((s * t).sum(1) * sign for s, t in ((away, p), (directions, q), (q, f)))
    size = steep * sign
    apart = away.abs().sum(1) + longest[:, 0]
    slack = EDGE_SLACK * longest[:, 0] * directions.abs().sum(1) * apart
    there = w / size
    hits = (u >= -slack) & (v >= -slack) & (u + v <= size + slack) & (size > 4 * slack) & (there > 0)
    return torch.where(hits, there, torch.inf)


def _squares_to_triangles(points: Tensor, corners: Tensor) -> Tensor:
    """Squares (P,) of the distances from points (P, 3) to triangles (P, 10)."""
    a, e, f, _ = corners.tensor_split((3, 6, 9), 1)
    a = a - points
    n = torch.linalg.cross(e, f)
    square = (n * n).sum(1)
    u, v = ((torch.linalg.cross(*pair) * n).sum(1) for pair in ((a, e), (f, a)))
    inside = (square > 0) & (u >= 0) & (v >= 0) & (u + v <= square)
    edges = [_squares_to_segments(*edge) for edge in ((a, e), (a, f), (a + e, f - e))]
    return torch.where(inside, (a * n).sum(1).square() / square, torch.stack(edges).amin(0))


def _squares_to_segments(a: Tensor, e: Tensor) -> Tensor:
    """Squares (P,) of the distances from the origin to segments from a (P, 3) along e (P, 3)."""
    share = -(a * e).sum(1) / (e * e).sum(1).clamp_min(torch.finfo(e.dtype).tiny)
    return (a + share.clamp(0, 1)[:, None] * e).square().sum(1)
