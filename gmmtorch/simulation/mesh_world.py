"""Worlds of triangles: checks of a mesh, ray casting, and the places where a sensor can be carried."""

from __future__ import annotations

import logging
import math
from copy import copy
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import DataError, InvalidArgumentError, check_whole
from gmmtorch.kernels import first_hits, nearest_triangles, triangle_tree

_log = logging.getLogger(__name__)

_MIN_AREA = 1e-12
"""Smallest ratio of a triangle's area to the square of its longest edge; below it the triangle is dropped."""

_FLOORS = 8  # largest number of floors, one above another, that are searched for

_ENCLOSED = 0.75  # share of the horizontal directions in which a surface must be in sight of an indoor place


def checked_triangles(triangles: Tensor, name: str = "mesh") -> Tensor:
    """Triangles (T', 3, 3), float64, on the CPU, without those that have no area; logs their number.

    Holes and inverted triangles are accepted: rays hit both faces, and the bounds of the world limit what is
    visible through a hole. Raises `InvalidArgumentError` for another shape, and `DataError` for a corner
    that is not finite or a mesh without any triangle that has an area.
    """
    triangles = triangles.detach().cpu().double()
    _check_corners(triangles, name)
    solid = have_area(triangles)
    n_flat = int((~solid).sum())
    if n_flat == len(triangles):
        raise DataError(
            f"{name}: all {n_flat} triangles have no area; check that the coordinates are neither rounded "
            "nor flat."
        )
    if n_flat:
        _log.warning("%s: dropped %d of %d triangles that have no area", name, n_flat, len(triangles))
    return triangles[solid]


def _check_corners(triangles: Tensor, name: str) -> None:
    """Raises the errors of `checked_triangles` for the shape, and for corners that are not finite."""
    if triangles.ndim != 3 or triangles.shape[1:] != (3, 3):
        raise InvalidArgumentError(
            f"{name}: triangles have shape {tuple(triangles.shape)}; expected (T, 3, 3)."
        )
    if len(triangles) == 0:
        raise DataError(f"{name} has no triangles; give a mesh with faces.")
    broken = ~torch.isfinite(triangles).flatten(1).all(1)
    if bool(broken.any()):
        raise DataError(
            f"{name}: {int(broken.sum())} of {len(triangles)} triangles have a corner that is NaN or "
            f"infinite, the first is number {int(broken.nonzero()[0])}; repair the mesh, or drop them."
        )


def have_area(triangles: Tensor) -> Tensor:
    """Whether each triangle (T, 3, 3) has an area, so that it is not a line or a point: (T,) bool."""
    edges = triangles.roll(-1, 1) - triangles
    area = torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1) / 2
    return area > _MIN_AREA * edges.square().sum(2).amax(1)


def checked_rays(
    origin: ArrayLike, directions: ArrayLike, dim: int, device: torch.device | None = None
) -> tuple[Tensor, Tensor]:
    """Origin (D,) or (N, D) and directions (N, D), float64. Raises `InvalidArgumentError` for others."""
    directions = as_tensor(directions, "directions", torch.float64, device)
    origin = as_tensor(origin, "origin", torch.float64, device)
    if directions.ndim != 2 or directions.shape[1] != dim:
        raise InvalidArgumentError(f"directions has shape {tuple(directions.shape)}; expected (N, {dim}).")
    if origin.shape not in ((dim,), directions.shape):
        raise InvalidArgumentError(
            f"origin has shape {tuple(origin.shape)}; expected ({dim},) or {tuple(directions.shape)}, metres."
        )
    return origin, directions


class MeshWorld:
    """A world of triangles (T, 3, 3), metres, z up, on the device of the triangles.

    Attributes:
        low, high: (3,) float64, on the CPU, the corners of its box.

    Raises `InvalidArgumentError` for another shape, and `DataError` for no triangle or one not finite.
    """

    def __init__(self, triangles: ArrayLike) -> None:
        corners = as_tensor(triangles, "triangles", torch.float64).detach()
        _check_corners(corners, "triangles")
        self.low, self.high = corners.flatten(0, 1).aminmax(dim=0)
        self.low, self.high = self.low.cpu(), self.high.cpu()
        self._tree = triangle_tree(corners)

    @property
    def device(self) -> torch.device:
        """Where rays are cast."""
        return self._tree.boxes.device

    def to(self, device: torch.device | str) -> MeshWorld:
        """The world on a device."""
        moved = copy(self)
        moved._tree = self._tree.to(device)
        return moved

    def distances(self, origin: ArrayLike, directions: ArrayLike) -> Tensor:
        """Distances (N,) to the first surface, in multiples of the directions' lengths; inf if none is hit.

        A ray passes through a triangle that it meets within 10⁻¹⁴ of the distance, so no ray passes between
        two triangles that share an edge. Both faces count. A ray in the plane of a triangle does not hit it.

        Args:
            origin: (3,), or (N, 3) for one origin per ray. directions: (N, 3).
        """
        return first_hits(self._tree, *checked_rays(origin, directions, 3, self.device))

    def clearance(self, points: ArrayLike) -> Tensor:
        """Distance (N,) in metres from each point (N, 3) to the nearest surface. Raises
        `InvalidArgumentError` for points that are not finite."""
        points = as_tensor(points, "points", torch.float64, self.device)
        if points.ndim != 2 or points.shape[1] != 3 or not bool(torch.isfinite(points).all()):
            raise InvalidArgumentError(
                f"points has shape {tuple(points.shape)}; expected (N, 3), finite metres."
            )
        return nearest_triangles(self._tree, points)

    def standing_places(
        self, height: float = 1.2, clearance: float = 0.4, spacing: float = 1.0, sight: float = 30.0
    ) -> Tensor:
        """Indoor places (P, 3) at `height` metres above a floor, on a horizontal grid of `spacing` metres.

        Each place is at least `clearance` metres from every surface. In at least three quarters of the
        horizontal directions a surface is within `sight` metres, so places outside the building are excluded.
        """
        for name, value in (("height", height), ("clearance", clearance), ("spacing", spacing)):
            if not (math.isfinite(value) and value > 0):
                raise InvalidArgumentError(f"{name}={value} must be above zero metres.")
        axes = [
            low + spacing * (0.5 + torch.arange(round(float((high - low) / spacing)), dtype=torch.float64))
            for low, high in zip(self.low[:2], self.high[:2], strict=True)
        ]
        columns = torch.cartesian_prod(*axes)
        down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
        top = torch.full_like(columns[:, :1], float(self.high[2]) + 1)
        places = []
        for _ in range(_FLOORS):
            starts = torch.cat([columns, top], 1)
            drop = self.distances(starts, down.expand_as(starts))
            hit = torch.isfinite(drop)
            columns, floor = columns[hit], (top[hit, 0] - drop[hit])[:, None]
            if len(columns) == 0:
                break
            places.append(torch.cat([columns, floor + height], 1))
            top = floor - 1e-3
        if not places:
            return torch.empty(0, 3, dtype=torch.float64)
        found = torch.cat(places)
        found = found[self.clearance(found) >= min(clearance, height)]
        angle = torch.arange(16, dtype=torch.float64) * (2 * math.pi / 16)
        level = torch.stack([angle.cos(), angle.sin(), 0 * angle], 1)
        seen = self.distances(found.repeat(16, 1), level.repeat_interleave(len(found), 0)) < sight
        return found[seen.view(16, -1).double().mean(0) >= _ENCLOSED]

    def tour(self, n: int, stride: int = 2, spacing: float = 1.0, **options: float) -> Tensor:
        """`n` places (n, 3) along a path through the largest connected part of the world.

        Standing places within 1.5 `spacing` are connected if they see each other. The path starts at one end
        of the part and always continues to the place that is farthest from all visited places. It stops at
        every `stride`-th place, or more often if it covers the part before the n-th stop. `options` are
        those of `standing_places`. Raises `InvalidArgumentError` if there is no standing place.
        """
        check_whole("n", n, 1)
        check_whole("stride", stride, 1)
        places = self.standing_places(spacing=spacing, **options)
        if len(places) == 0:
            size = " × ".join(f"{x:.3g}" for x in (self.high - self.low).tolist())
            raise InvalidArgumentError(
                f"The mesh of {size} m has no place where a sensor can be carried: a floor with walls "
                "around it and enough room to pass. Check that z is up and that lengths are in metres."
            )
        walk = _walk(self._connections(places, 1.5 * spacing), 1 + stride * (n - 1), 3 * spacing)
        stops = np.linspace(0, min(len(walk) - 1, stride * (n - 1)), n).round().astype(np.int64)
        return places[torch.from_numpy(walk[stops])]

    def _connections(self, places: Tensor, reach: float) -> Any:
        """Sparse matrix of distances between places (P, 3) that are within `reach` and see each other."""
        from scipy.sparse import coo_matrix
        from scipy.spatial import cKDTree

        pairs = cKDTree(places.numpy()).query_pairs(reach, output_type="ndarray")
        first, second = torch.from_numpy(pairs.astype(np.int64)).reshape(-1, 2).unbind(1)
        step = places[second] - places[first]
        length = step.norm(dim=1)
        clear = self.distances(places[first], step / length[:, None]) > length
        edges = (first[clear].numpy(), second[clear].numpy())
        return coo_matrix((length[clear].numpy(), edges), shape=(len(places), len(places))).tocsr()


def _walk(graph: Any, n: int, reach: float) -> np.ndarray:
    """Nodes (W,), W ≤ n, of a walk through the largest connected part of a graph, to within `reach` metres of
    all of its nodes."""
    from scipy.sparse.csgraph import connected_components, dijkstra

    _, label = connected_components(graph, directed=False)
    largest = np.flatnonzero(label == np.bincount(label).argmax())
    here = int(largest[0])
    here = int(largest[dijkstra(graph, directed=False, indices=here)[largest].argmax()])  # one end
    walk = [here]
    while len(walk) < n:
        distance = dijkstra(graph, directed=False, indices=np.unique(walk), min_only=True)[largest]
        if distance.max() <= reach:
            break
        target = int(largest[distance.argmax()])
        _, before = dijkstra(graph, directed=False, indices=here, return_predecessors=True)
        path = [target]
        while path[-1] != here:
            path.append(int(before[path[-1]]))
        walk += path[-2::-1]
        here = target
    return np.asarray(walk[:n], dtype=np.int64)
