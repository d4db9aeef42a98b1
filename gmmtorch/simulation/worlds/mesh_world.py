"""A world of triangles from a file, and the places in it where a sensor can be carried."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import GmmTorchError, InvalidArgumentError, check_whole

_FLOORS = 8
"""Floors above one another that are looked for, at most."""

_ENCLOSED = 0.75
"""Share of the level directions in which something must be in sight: outside a tunnel nothing is."""


class MeshWorld:
    """Triangles (T, 3, 3), metres, z up. Rays are cast by Open3D (Embree), in float32 about the middle.

    Raises `GmmTorchError` where Open3D does not load.
    """

    def __init__(self, triangles: Tensor) -> None:
        try:
            import open3d
        except (ImportError, OSError) as error:
            raise GmmTorchError(
                f"Rays cannot be cast in a mesh, because Open3D does not load: {error}. On Debian or Ubuntu "
                "scripts/setup.sh installs the libraries it needs."
            ) from error
        corners = triangles.detach().double().cpu().reshape(-1, 3)
        self.low, self.high = corners.amin(0), corners.amax(0)
        self._middle = (self.low + self.high) / 2
        core: Any = open3d.core
        self._tensor = core.Tensor
        self._scene: Any = open3d.t.geometry.RaycastingScene()
        faces = np.arange(corners.shape[0], dtype=np.uint32).reshape(-1, 3)
        self._scene.add_triangles(self._tensor((corners - self._middle).float().numpy()), self._tensor(faces))

    def distances(self, origin: Tensor, directions: Tensor, threads: int = 0) -> Tensor:
        """Metres (N,) from the origin (D,) or origins (N, D) along unit directions (N, D), or inf.

        `threads`: how many cast rays; 0 for as many as there are cores.
        """
        starts = (origin - self._middle).expand_as(directions)
        rays = torch.cat([starts, directions], 1).float().contiguous()
        cast = self._scene.cast_rays(self._tensor(rays.numpy()), nthreads=threads)
        return torch.from_numpy(cast["t_hit"].numpy()).double()

    def clearance(self, points: Tensor, threads: int = 0) -> Tensor:
        """Metres (N,) from each point (N, 3) to the nearest surface; `threads` as for `distances`."""
        moved = (points - self._middle).float().contiguous().numpy()
        found = self._scene.compute_distance(self._tensor(moved), nthreads=threads)
        return torch.from_numpy(found.numpy()).double()

    def standing_places(
        self, height: float = 1.2, clearance: float = 0.4, spacing: float = 1.0, sight: float = 30.0
    ) -> Tensor:
        """Places (P, 3) `height` metres above a floor, on a lattice of columns `spacing` metres apart.

        They keep `clearance` metres from every surface, and see something within `sight` metres in most
        level directions: so they are inside.
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
            fall = self.distances(starts, down.expand_as(starts))
            met = torch.isfinite(fall)
            columns, floor = columns[met], (top[met, 0] - fall[met])[:, None]
            if len(columns) == 0:
                break
            places.append(torch.cat([columns, floor + height], 1))
            top = floor - 1e-3
        if not places:
            return torch.empty(0, 3, dtype=torch.float64)
        found = torch.cat(places)
        found = found[self.clearance(found) >= min(clearance, height)]
        return found[self._enclosed(found, sight)]

    def _enclosed(self, points: Tensor, sight: float) -> Tensor:
        angle = torch.arange(16, dtype=torch.float64) * (2 * math.pi / 16)
        level = torch.stack([angle.cos(), angle.sin(), 0 * angle], 1)
        starts = points.repeat_interleave(16, 0)
        seen = self.distances(starts, level.repeat(len(points), 1)) < sight
        return seen.view(-1, 16).double().mean(1) >= _ENCLOSED

    def tour(self, n: int, stride: int = 2, spacing: float = 1.0, **options: float) -> Tensor:
        """`n` places (n, 3) in the order of a walk through the largest connected part of the world.

        Neighbouring standing places are connected where one sees the other. The walk goes from one end
        to the place that is farthest from all it has been to, and on from there; it stops at every
        `stride`-th place, sooner where everything has been seen before `n` stops. Raises
        `InvalidArgumentError` where there is no place to stand. `options` are those of
        `standing_places`.
        """
        check_whole("n", n, 1)
        check_whole("stride", stride, 1)
        places = self.standing_places(spacing=spacing, **options)
        if len(places) == 0:
            size = " × ".join(f"{x:.3g}" for x in (self.high - self.low).tolist())
            raise InvalidArgumentError(
                f"The mesh of {size} m has no place where a sensor could be carried: a floor with walls "
                "around it, and room to pass. Check that z is up and that lengths are metres."
            )
        walk = _walk(self._connections(places, 1.5 * spacing), 1 + stride * (n - 1), 3 * spacing)
        stops = np.linspace(0, min(len(walk) - 1, stride * (n - 1)), n).round().astype(np.int64)
        return places[torch.from_numpy(walk[stops])]

    def _connections(self, places: Tensor, reach: float) -> Any:
        """Sparse matrix of the distances between places (P, 3) within `reach` that see each other."""
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
    """Nodes (W,) of a walk in the largest connected part, W ≤ n, that ends when all are within `reach`."""
    from scipy.sparse.csgraph import connected_components, dijkstra

    _, label = connected_components(graph, directed=False)
    part = np.flatnonzero(label == np.bincount(label).argmax())
    here = int(part[0])
    here = int(part[dijkstra(graph, directed=False, indices=here)[part].argmax()])  # an end of it
    walk = [here]
    while len(walk) < n:
        unseen = dijkstra(graph, directed=False, indices=np.unique(walk), min_only=True)[part]
        if unseen.max() <= reach:
            break
        target = int(part[unseen.argmax()])
        _, before = dijkstra(graph, directed=False, indices=here, return_predecessors=True)
        way = [target]
        while way[-1] != here:
            way.append(int(before[way[-1]]))
        walk += way[-2::-1]
        here = target
    return np.asarray(walk[:n], dtype=np.int64)
