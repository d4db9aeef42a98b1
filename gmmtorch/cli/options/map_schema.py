"""The options of gmmtorch-map, -localize, -export and -view."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from gmmtorch.cli.options.runtime_schema import ExportReport, ExportRuntime, Report, Runtime


@dataclass
class MapFile:
    """codec: quantized, about 9 bytes for each component; or float, exact numbers."""

    name: str = MISSING
    codec: str = "quantized"


@dataclass
class Map:
    """Options of gmmtorch-map.

    seed: seed of all random numbers.
    resolution: side (m) of the cells of queries, pictures and exports.
    export: list of map_server, octomap, cloud, mesh, distance_field.
    view: show the map in the browser while it is built, and until Ctrl-C.
    view_host: address of the view; 0.0.0.0: other machines can open it, too.
    view_port: port of the view; the next free one if it is in use.
    z_min, z_max: height band (m) of map_server in 3D; both null: between floor and ceiling.
    checkpoint_seconds: computing time between two checkpoints.
    inputs: list of paths, globs and URLs of recordings, in place of dataset.path.
    tile: side (m) of the tiles into which the maps of inputs are merged.
    tile_bytes: bytes of a tile's file, at most; null: no limit.
    workers: processes of this machine that map inputs; more than one needs Ray.
    cluster: address of a Ray cluster that maps inputs; null: this machine.
    """

    dataset: Any = MISSING
    map: Any = MISSING
    seed: int = 0
    resolution: float = 0.1
    export: list[str] = field(default_factory=list)
    view: bool = False
    view_host: str = "127.0.0.1"
    view_port: int = 8080
    z_min: float | None = None
    z_max: float | None = None
    checkpoint_seconds: float = 30.0
    inputs: list[str] = field(default_factory=list)
    tile: float = 100.0
    tile_bytes: int | None = None
    workers: int = 1
    cluster: str | None = None
    report: Report = field(default_factory=Report)
    runtime: Runtime = field(default_factory=Runtime)


@dataclass
class SavedMap:
    """A saved map.

    path: map file, run directory of gmmtorch-map, or folder of tiles.
    bounds: of a map in tiles, the box [x0,y0,z0,x1,y1,z1] (m), in 2D without z, that is opened.
    """

    path: str | None = None
    bounds: list[float] | None = None


@dataclass
class Localize:
    """Options of gmmtorch-localize.

    pose: first pose, [x,y,yaw], [x,y,z,yaw] or [x,y,z,qx,qy,qz,qw] (m, rad); dataset; null: unknown.
    distance: metres along the ground by which the first pose may be off.
    angle: radians by which the heading of the first pose may be off.
    motion: constant; dataset: predict with the motion between the poses of the data set; imu: by the IMU of a
        ROS bag.
    n_points: points of a scan that are used at most.
    least_explained: share of the points that must lie on surfaces of the map.
    truth: true poses, for scores: dataset, none, or a TUM or KITTI file.
    align: before scoring: none, first or rigid.
    """

    dataset: Any = MISSING
    map: SavedMap = field(default_factory=SavedMap)
    pose: Any = None
    distance: float = 0.5
    angle: float = 0.175
    motion: str = "constant"
    n_points: int = 1000
    least_explained: float = 0.9
    truth: str | None = "none"
    align: str = "none"
    report: Report = field(default_factory=Report)
    runtime: ExportRuntime = field(default_factory=ExportRuntime)


@dataclass
class Export:
    """Options of gmmtorch-export.

    path: map, grid or mixture of gmmtorch (.safetensors), GIRA .csv, .npz; for kitti a trajectory.
    output: file to write.
    format: map_server, octomap, ply, pcd, mesh, distance_field, csv, npz, mixture, kitti; null: by ending.
    method: form of evidence: point, flux, cone, monte_carlo; null: the map's own.
    resolution: side (m) of the cells; null: the map's own.
    bounds: [x0,y0,x1,y1], in 3D [x0,y0,z0,x1,y1,z1] (m); null: around the components.
    z_min, z_max: height band (m); null: for map_server, between the floor and the ceiling of a 3D map.
    occupied_thresh: cells above this probability are occupied.
    free_thresh: cells below this probability are free; others are unknown.
    n_points: number of points from which a mixture without support (GIRA) was learned.
    """

    path: str | None = None
    output: str | None = None
    format: str | None = None
    method: str | None = None
    resolution: float | None = None
    bounds: list[float] | None = None
    z_min: float | None = None
    z_max: float | None = None
    occupied_thresh: float = 0.65
    free_thresh: float = 0.196
    n_points: float | None = None
    report: ExportReport = field(default_factory=ExportReport)
    runtime: ExportRuntime = field(default_factory=ExportRuntime)


@dataclass
class View:
    """Options of gmmtorch-view.

    path: map file, run directory of gmmtorch-map, or folder of tiles.
    trajectory: TUM or KITTI file; null: trajectory.tum next to the map and of each recording.
    bounds: of a map in tiles, the box [x0,y0,z0,x1,y1,z1] (m), in 2D without z, that is opened.
    html: file to write, .html, instead of serving a page.
    shape: ellipsoids, splats, surfaces or none.
    colour: height, support or age.
    host: address of the page; 0.0.0.0: other machines can open it, too.
    port: port of the page; the next free one if it is in use.
    """

    path: str | None = None
    trajectory: str | None = None
    bounds: list[float] | None = None
    html: str | None = None
    shape: str = "ellipsoids"
    colour: str = "height"
    host: str = "127.0.0.1"
    port: int = 8080
    runtime: ExportRuntime = field(default_factory=ExportRuntime)
