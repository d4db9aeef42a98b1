"""What live mapping and localisation publish: the map, the sensor's pose, and how they keep up."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch import export
from gmmtorch.errors import DataError, InvalidArgumentError, MemoryLimitError, arg, check_choice
from gmmtorch.live import viewer_scene
from gmmtorch.live.live_scans import SETTLING, LiveScan, LiveScans
from gmmtorch.live.ros import Node
from gmmtorch.live.ros.topics import LATCHED
from gmmtorch.localization import Location
from gmmtorch.mapping import GaussianMap, Numbers, Query, resident_bytes
from gmmtorch.occupancy import CellClass, KeptEvidence, Thresholds, VoxelGrid, probability
from gmmtorch.pose import Pose
from gmmtorch.scan import COLOUR

CLOUDS = ("cells", "means", "none")
_EXTENT = 3.0  # standard deviations around each component that the grid covers
_FULL_AFTER = 10.0  # s, after which the latched grid is published again
_MOST_ELLIPSOIDS = 1000
_SPHERE, _DELETE_ALL = 2, 3


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
        self._last: tuple[VoxelGrid, np.ndarray] | None = None
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
            flat = grid, theta if grid.dim == 2 else export.highest_in_band(grid, theta)[1]
            self._publish_grid(*_cells(*flat, self._rule), header, stamp)
        if self._cloud == "cells" and grid is not None:
            cells = export.CellCloud.of_grid(grid, theta).above(self._rule.occupied)
            known = shown.attributes(cells.centers).get(COLOUR)
            colours = None if known is None else known.mean
            self._send_cloud(export.cloud_fields(frame, _table(cells.positions(), colours)), stamp)
        elif self._cloud == "means":
            solid = viewer_scene.surfaces(shown.components())
            channel = shown.components().attributes.channels.get(COLOUR)
            colours = channel.mean.cpu()[solid.rows] if isinstance(channel, Numbers) else None
            self._send_cloud(export.cloud_fields(frame, _table(solid.means.numpy(), colours)), stamp)
        if self._send_ellipsoids is not None:
            self._send_ellipsoids({"markers": _markers(shown, header["header"])}, stamp)

    def _probabilities(self, shown: GaussianMap) -> tuple[VoxelGrid | None, Tensor]:
        """The cells of the map, in 3D of the height band, and their probabilities, with the grid's shape."""
        try:
            low, high = self._box(shown)
            grid = VoxelGrid.covering(low, high, self._resolution, shown.query_options.memory_limit)
            if shown.method != "point":
                return grid, shown.evidence(grid).probability().cpu()
            query = Query([shown.components()], shown.query_options)
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
            bottom, top = self._band or export.of_components(found, self._resolution).band(self._resolution)
            low[2] = low[2] if bottom is None else max(low[2], bottom)
            high[2] = high[2] if top is None else max(low[2], min(high[2], top) - 1e-6)
        return low, high

    def _publish_grid(self, grid: VoxelGrid, cells: np.ndarray, header: dict[str, Any], stamp: int) -> None:
        """Publishes what has changed, or the whole grid: if its place or much of it changed, or it is old."""
        old, now = self._last, time.monotonic()
        changed = None
        if old is not None and old[0] == grid and now - self._published_at < _FULL_AFTER:
            changed = np.argwhere(old[1] != cells)
            if len(changed) == 0:
                return
        self._last = grid, cells
        if changed is not None:
            (y0, x0), (y1, x1) = changed.min(0).tolist(), (changed.max(0) + 1).tolist()
            if 2 * (y1 - y0) * (x1 - x0) <= cells.size:
                window = {"x": x0, "y": y0, "width": x1 - x0, "height": y1 - y0}
                part = cells[y0:y1, x0:x1].ravel()
                self._send_update({**header, **window, "data": part}, stamp)
                return
        self._published_at = now
        origin = dict(zip("xyz", (*grid.origin, 0.0), strict=True))
        info = {
            "resolution": grid.resolution,
            "width": cells.shape[1],
            "height": cells.shape[0],
            "origin": {"position": origin, "orientation": {"w": 1.0}},
        }
        self._send_grid({**header, "info": info, "data": cells.ravel()}, stamp)


def _cells(grid: VoxelGrid, theta: Tensor, rule: Thresholds) -> tuple[VoxelGrid, np.ndarray]:
    """The 2D grid of a map, and its cells (n_y, n_x), int8, as in ROS: 0 free, 100 occupied, −1 unknown."""
    classes = rule.classify(theta)
    values = torch.full(classes.shape, -1, dtype=torch.int8)
    values[classes == CellClass.FREE] = 0
    values[classes == CellClass.OCCUPIED] = 100
    flat = grid if grid.dim == 2 else VoxelGrid(grid.origin[:2], grid.resolution, grid.shape[:2])
    return flat, np.ascontiguousarray(values.T.numpy())


def _table(points: np.ndarray, colours: Tensor | None = None) -> np.ndarray:
    """Points (N, 3) as a structured array with fields x, y, z, float32; and rgb, whose bits are 0x00RRGGBB of
    linear RGB (N, 3), as RViz and Foxglove expect."""
    columns = [np.ascontiguousarray(points, "<f4")]
    if colours is not None:
        red, green, blue = export.colour_bytes(colours).astype("<u4").T
        columns.append((red << 16 | green << 8 | blue).astype("<u4").view("<f4")[:, None])
    names = ("x", "y", "z", "rgb")[: 2 + len(columns)]
    return np.concatenate(columns, 1).view([(name, "<f4") for name in names]).reshape(-1)


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
    colours = viewer_scene.colours(components, solid, "height").rgb
    balls = (part.tolist() for part in viewer_scene.instances(solid))
    for number, (turn, position, radii, rgb) in enumerate(zip(*balls, colours / 255, strict=True)):
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


_PLANAR = (0, 1, 5)
"""Rows of x, y and the heading among those of a pose's covariance in ROS."""


class PosePublisher:
    """Publishes poses on the topic pose, and transforms on /tf, each with the stamp of a scan.

    Args:
        node: whose names are resolved in its namespace and remapped.
        frame: in which the poses are.
    """

    def __init__(self, node: Node, frame: str) -> None:
        self._node, self._frame = node, frame
        self._robot: str | None = None  # the frame that moves with the sensor, and has no parent
        self._candidate: tuple[list[str], float] = ([], 0.0)
        self._send_pose = node.publisher("pose", "nav_msgs/msg/Odometry")
        self._send_transform = node.publisher("/tf", "tf2_msgs/msg/TFMessage")

    def publish(self, location: Location, newest: LiveScan, child: str, below: Pose) -> None:
        """Publishes the pose of a scan's sensor, and the transform from the frame to `child`.

        below: child ← sensor, in 3D.
        """
        pose = Pose.from_matrix(location.pose.cpu()).in_space()
        fields = export.odometry_fields(self._frame, newest.frame, pose.matrix)
        fields["pose"]["covariance"] = _covariance(location.covariance.cpu())
        self._send_pose(fields, newest.stamp)
        if child != self._frame:  # TF of somebody else has a frame of this name
            above = (pose @ below.inverse()).matrix
            self._send_transform(export.transform_fields({(self._frame, child): above}), newest.stamp)

    def publish_odometry(self, location: Location, newest: LiveScan) -> None:
        """Publishes a pose, and the transform to the robot's frame: the root of those fixed to the sensor.

        The transform is published once the root has not changed for half a second, and only if no other node
        moves it.
        """
        tree, child, below = self._node.transforms, self._frame, Pose.identity(3)
        try:
            chain = tree.chain(newest.frame)
            fixed = tree.static_part(chain)
            if self._robot is None and len(fixed) < len(chain):
                raise DataError(f"TF of another node moves {fixed[-1]} in {chain[len(fixed)]}")
            if fixed != self._candidate[0]:
                self._candidate = fixed, time.monotonic()
            if self._robot is not None or time.monotonic() - self._candidate[1] >= SETTLING:
                self._robot = child = fixed[-1]
                below = tree.lookup(fixed, np.array([newest.stamp]), 0.0).poses[0]
        except DataError as error:
            self._node.warn("odometry", f"{error!s}; only the topic pose is published.")
        self.publish(location, newest, child, below)


def _covariance(of_pose: Tensor) -> np.ndarray:
    """The covariance (36,) of x, y, z and turns about them, from one of a pose, (3, 3) or (6, 6); zeros if
    it is unknown (NaN), as ROS has it.
    """
    found = np.zeros((6, 6))
    rows = list(_PLANAR) if len(of_pose) == len(_PLANAR) else list(range(6))
    found[np.ix_(rows, rows)] = torch.nan_to_num(of_pose).numpy()
    return found.ravel()


_PERIOD = 1.0  # s
_MOST = 10_000  # latencies that are kept
_OTHER_CLOCK = 60.0  # s of latency, which shows that stamps come from another clock
_OK, _WARN = 0, 1


class Diagnostics:
    """Counts scans and latencies of a mapper, and publishes them once a second."""

    def __init__(self, node: Node, scans: LiveScans, name: str = "gmmtorch mapping") -> None:
        self._node, self._scans, self._name = node, scans, name
        self._latencies: deque[float] = deque(maxlen=_MOST)
        self._send = node.publisher("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        self._begin = time.monotonic()
        self._last, self._n_last, self._n_dropped = self._begin, 0, 0
        self._nbytes = 0
        self._rate = 0.0

    def note_latency(self, seconds: float) -> None:
        """Notes the time from the stamp of a scan to the publication of a map with it."""
        if abs(seconds) > _OTHER_CLOCK:
            self._node.warn(
                "clock",
                f"stamps are {seconds:.0f} s away from the clock of this node. For a recording that is "
                f"played set {arg('use_sim_time')}=true; for a sensor with a clock of its own "
                f"{arg('clock')}=received.",
            )
            return
        self._latencies.append(seconds)

    def is_due(self) -> bool:
        """Whether a second has passed since the last publication."""
        return time.monotonic() - self._last >= _PERIOD

    def publish(self, n_scans: int, n_components: int, nbytes: int) -> None:
        """Publishes the numbers; nbytes: of the map."""
        now = time.monotonic()
        self._rate = (n_scans - self._n_last) / max(now - self._last, 1e-3)
        self._last, self._n_last = now, n_scans
        self._nbytes = nbytes
        dropped = self._scans.n_dropped
        is_late, self._n_dropped = dropped > self._n_dropped, dropped
        message = "scans are dropped" if is_late else "keeps up"
        if is_late:
            self._node.warn("dropped", f"{dropped} scans were dropped: the sensor is faster than mapping.")
        elif (n_waiting := self._scans.n_waiting) > max(self._rate, 1.0):  # more than it maps in a second
            is_late, message = True, f"falls behind: {n_waiting} scans wait"
            self._node.warn("behind", f"{n_waiting} scans wait: {self._name} is slower than the sensor.")
        numbers = self.numbers(n_scans, n_components)
        status = {
            "level": _WARN if is_late else _OK,
            "name": self._name,
            "message": message,
            "hardware_id": self._scans.name,
            "values": [{"key": key, "value": f"{value:.6g}"} for key, value in numbers.items()],
        }
        self._send({"status": [status]})

    def numbers(self, n_scans: int, n_components: int) -> dict[str, float]:
        """All numbers by name; latencies in s are those of the last 10,000 scans."""
        latencies = np.array(self._latencies) if self._latencies else np.array([np.nan])
        counts: Any = self._node.counts
        return {
            "n_scans": n_scans,
            "scans_per_second": self._rate,
            "latency_median": float(np.median(latencies)),
            "latency_p99": float(np.percentile(latencies, 99)),
            "n_dropped": self._scans.n_dropped + counts.get(self._scans.name, {}).get("dropped", 0),
            "n_malformed": sum(c["malformed"] for c in counts.values()),
            "n_components": n_components,
            "nbytes": self._nbytes,
            "memory_bytes": resident_bytes(),
            "seconds": time.monotonic() - self._begin,
        }
