"""MapPublisher: a map as ROS messages: occupancy grid and its updates, points, and ellipsoids."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, MemoryLimitError, check_choice
from gmmtorch.export import CellCloud, cloud_fields, highest_in_band, of_components
from gmmtorch.live import viewer_scene
from gmmtorch.live.ros import Node
from gmmtorch.live.ros.quality import LATCHED
from gmmtorch.mapping import GaussianMap, Query
from gmmtorch.occupancy import CellClass, KeptEvidence, Thresholds, VoxelGrid, probability

CLOUDS = ("cells", "means", "none")
_EXTENT = 3.0  # standard deviations around each component that the grid covers
_FULL_AFTER = 10.0  # s, after which the latched grid is published again
_MOST_ELLIPSOIDS = 1000
_SPHERE, _DELETE_ALL = 2, 3


class _Grid(NamedTuple):
    """A 2D grid and its cells (n_y, n_x), int8: 0 free, 100 occupied, −1 unknown."""

    grid: VoxelGrid
    cells: np.ndarray


class MapPublisher:
    """Publishes a map on the topics map, map_updates, cloud and ellipsoids of a node.

    Args:
        node: whose names are resolved in its namespace and remapped.
        resolution: side (m) of the cells.
        z_min, z_max: height band (m) of the grid of a 3D map; both None: between floor and ceiling.
        cloud: occupied cells, or the means of the surface components, or none.
        ellipsoids: whether the components are published as markers.
    """

    def __init__(
        self,
        node: Node,
        resolution: float,
        z_min: float | None = None,
        z_max: float | None = None,
        cloud: str = "cells",
        ellipsoids: bool = True,
    ) -> None:
        check_choice("cloud", cloud, CLOUDS)
        self._node, self._resolution, self._cloud = node, resolution, cloud
        self._band = None if z_min is None and z_max is None else (z_min, z_max)
        self._rule = Thresholds()
        self._evidence = KeptEvidence(resolution)
        self._last: _Grid | None = None
        self._published_at = 0.0
        self._send_grid = node.publisher("map", "nav_msgs/msg/OccupancyGrid")
        self._send_update = node.publisher("map_updates", "map_msgs/msg/OccupancyGridUpdate")
        self._send_cloud = node.publisher("cloud", "sensor_msgs/msg/PointCloud2", LATCHED)
        markers = "visualization_msgs/msg/MarkerArray"
        self._send_ellipsoids = node.publisher("ellipsoids", markers) if ellipsoids else None

    def publish(self, shown: GaussianMap, frame: str, stamp: int) -> None:
        """Publishes a map, whose newest scan has a stamp (ns), in a fixed frame."""
        if not len(shown.components()):
            return
        header = {"header": {"frame_id": frame}}
        grid, theta = self._probabilities(shown)
        if grid is not None:
            flat = grid, theta if grid.dim == 2 else highest_in_band(grid, theta)[1]
            self._publish_grid(_cells(*flat, self._rule), header, stamp)
        if self._cloud == "cells" and grid is not None:
            points = CellCloud.of_grid(grid, theta).above(self._rule.occupied).positions()
            self._send_cloud(cloud_fields(frame, _table(points)), stamp)
        elif self._cloud == "means":
            means = viewer_scene.surfaces(shown.components()).means.numpy()
            self._send_cloud(cloud_fields(frame, _table(means)), stamp)
        if self._send_ellipsoids is not None:
            self._send_ellipsoids({"markers": _markers(shown, header["header"])}, stamp)

    # -- the grid -------------------------------------------------------------------------------------

    def _probabilities(self, shown: GaussianMap) -> tuple[VoxelGrid | None, Tensor]:
        """The cells of the map, in 3D of the height band, and their probabilities, with the grid's shape."""
        try:
            low, high = self._box(shown)
            grid = VoxelGrid.covering(low, high, self._resolution, shown.query_options.memory_limit)
            if shown.method != "point":
                return grid, shown.evidence(grid).probability().cpu()
            query = Query(shown.components().cones(), shown.query_options)
            evidence = self._evidence.update(query.cones, grid, query.cutoff)
            theta = probability(*evidence, self._resolution, grid.dim, query.rule)
            return grid, theta.cpu()
        except (InvalidArgumentError, MemoryLimitError) as error:  # no floor yet, or too large
            self._node.warn("grid", f"topic map is not published: {error!s}")
            return None, torch.empty(0)

    def _box(self, shown: GaussianMap) -> tuple[list[float], list[float]]:
        found = shown.components()
        extent = _EXTENT * found.covariances.diagonal(dim1=1, dim2=2).sqrt()
        points = torch.cat([found.means - extent, found.means + extent, found.origins.to(extent)])
        low: list[float] = points.amin(0).tolist()
        high: list[float] = points.amax(0).tolist()
        if found.dim == 3:
            bottom, top = self._band or of_components(found, self._resolution).band(self._resolution)
            low[2] = low[2] if bottom is None else max(low[2], bottom)
            high[2] = high[2] if top is None else max(low[2], min(high[2], top) - 1e-6)
        return low, high

    def _publish_grid(self, new: _Grid, header: dict[str, Any], stamp: int) -> None:
        """Publishes what has changed, or the whole grid: if its place or much of it changed, or it is old."""
        old, now = self._last, time.monotonic()
        changed = None
        if old is not None and old.grid == new.grid and now - self._published_at < _FULL_AFTER:
            changed = np.argwhere(old.cells != new.cells)
            if len(changed) == 0:
                return
        self._last = new
        if changed is not None:
            (y0, x0), (y1, x1) = changed.min(0).tolist(), (changed.max(0) + 1).tolist()
            if 2 * (y1 - y0) * (x1 - x0) <= new.cells.size:
                window = {"x": x0, "y": y0, "width": x1 - x0, "height": y1 - y0}
                part = new.cells[y0:y1, x0:x1].ravel()
                self._send_update({**header, **window, "data": part}, stamp)
                return
        self._published_at = now
        origin = dict(zip("xyz", (*new.grid.origin, 0.0), strict=True))
        info = {
            "resolution": new.grid.resolution,
            "width": new.cells.shape[1],
            "height": new.cells.shape[0],
            "origin": {"position": origin, "orientation": {"w": 1.0}},
        }
        self._send_grid({**header, "info": info, "data": new.cells.ravel()}, stamp)


def _cells(grid: VoxelGrid, theta: Tensor, rule: Thresholds) -> _Grid:
    """Occupied, free and unknown cells of a 2D map; rows run along x, as in ROS."""
    classes = rule.classify(theta)
    values = torch.full(classes.shape, -1, dtype=torch.int8)
    values[classes == CellClass.FREE] = 0
    values[classes == CellClass.OCCUPIED] = 100
    flat = grid if grid.dim == 2 else VoxelGrid(grid.origin[:2], grid.resolution, grid.shape[:2])
    return _Grid(flat, np.ascontiguousarray(values.T.numpy()))


def _table(points: np.ndarray) -> np.ndarray:
    """Points (N, 3) as a structured array with fields x, y, z, float32."""
    return np.ascontiguousarray(points, "<f4").view([(axis, "<f4") for axis in "xyz"]).reshape(-1)


def _markers(shown: GaussianMap, header: dict[str, Any]) -> list[dict[str, Any]]:
    """2σ ellipsoids, coloured by height, with most points first; a marker before them deletes old ones."""
    components = shown.components()
    solid = viewer_scene.surfaces(components)
    support = components.support.cpu()[solid.rows]
    kept = support.argsort(descending=True, stable=True)[:_MOST_ELLIPSOIDS]
    solid = viewer_scene.Solid(*(part[kept] for part in solid))
    made: list[dict[str, Any]] = [{"header": header, "action": _DELETE_ALL}]
    if not len(kept):
        return made
    balls, colours = viewer_scene.instances(solid), viewer_scene.colours(components, solid, "height").rgb
    rows = zip(
        balls.wxyz.tolist(), balls.positions.tolist(), balls.scales.tolist(), colours / 255, strict=True
    )
    for number, (turn, position, radii, rgb) in enumerate(rows):
        pose = {
            "position": dict(zip("xyz", position, strict=True)),
            "orientation": dict(zip("wxyz", turn, strict=True)),
        }
        made.append(
            {
                "header": header,
                "ns": "components",
                "id": number,
                "type": _SPHERE,
                "pose": pose,
                "scale": {axis: 2 * radius for axis, radius in zip("xyz", radii, strict=True)},
                "color": {**dict(zip("rgb", rgb.tolist(), strict=True)), "a": 1.0},
            }
        )
    return made
