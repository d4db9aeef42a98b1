"""gmmtorch-export: writes a map or a mixture in the format of another program."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from gmmtorch.cli import app, common
from gmmtorch.cli.from_options import maps

if TYPE_CHECKING:
    from torch import Tensor

    from gmmtorch.baselines.occupancy_grid import OccupancyGrid
    from gmmtorch.evaluation.events import Event
    from gmmtorch.export.mixture_formats import PlainMixture
    from gmmtorch.export.point_cloud import CellCloud
    from gmmtorch.mapping.gaussian_map import GaussianMap
    from gmmtorch.occupancy.grid import VoxelGrid

_OF_SPACE = ("map_server", "octomap", "ply", "pcd", "mesh", "distance_field")
_OF_COMPONENTS = ("csv", "npz", "mixture")
_OF_POSES = "kitti"
_OF_ENDINGS = {
    **dict.fromkeys((".yaml", ".pgm"), "map_server"),
    **dict.fromkeys((".bt", ".ot"), "octomap"),
    **dict.fromkeys((".obj", ".glb"), "mesh"),
    ".ply": "ply",
    ".pcd": "pcd",
    ".csv": "csv",
    ".npz": "npz",
    ".safetensors": "mixture",
}
"""Formats by the endings of the output, if none is given."""
_EXTENT = 3.0  # standard deviations around each component that the cells cover


def main() -> None:
    """Entry point of the command."""
    app.start("export", run)


def run(config: DictConfig) -> None:
    """Run the command; prints the written files."""
    from gmmtorch.errors import InvalidArgumentError
    from gmmtorch.report.progress import ProgressBars

    for name in ("path", "output"):
        if not config[name]:
            raise InvalidArgumentError(f"{name} is not set; give {name}=FILE.")
    config.format = _format(config)
    common.use_runtime(config.runtime)
    with ProgressBars(enabled=config.report.progress) as bars:
        if config.format == _OF_POSES:
            message = _export_poses(Path(config.path), Path(config.output))
        elif config.format in _OF_COMPONENTS:
            message = _export_components(config)
        else:
            message = write_space(config, _map(config), bars)
    print(message)


def _format(config: DictConfig) -> str:
    """The format that is given, or that of the output's ending."""
    from gmmtorch.errors import InvalidArgumentError

    known = (*_OF_SPACE, *_OF_COMPONENTS, _OF_POSES)
    if config.format is None:
        ending = Path(config.output).suffix.lower()
        if ending not in _OF_ENDINGS:
            raise InvalidArgumentError(
                f"output={config.output} has none of the endings {', '.join(_OF_ENDINGS)}; add one, or give "
                f"format={'|'.join(known)}."
            )
        return _OF_ENDINGS[ending]
    if config.format not in known:
        raise InvalidArgumentError(f"format={config.format!r} is not one of {', '.join(known)}.")
    return str(config.format)


def _export_poses(path: Path, output: Path) -> str:
    """Write the poses of a trajectory file as KITTI rows; returns a message."""
    from gmmtorch.datasets.recordings.trajectory import read_trajectory
    from gmmtorch.errors import MissingDataError
    from gmmtorch.export.trajectory_files import write_kitti

    if not path.is_file():
        raise MissingDataError(f"path={path} does not exist; format=kitti needs a trajectory file.")
    matrices = read_trajectory(path).matrices
    write_kitti(output, matrices)
    return f"{_size(output)}: {len(matrices):,} poses"


# -- components -----------------------------------------------------------------------------------


def _export_components(config: DictConfig) -> str:
    """Write weights, means and covariances; returns a message."""
    from gmmtorch.export import mixture_formats
    from gmmtorch.mixture import GaussianMixture

    mixture = mixture_formats.checked(_components(config))
    output = Path(config.output)
    if config.format == "csv":
        mixture_formats.write_gira_csv(output, mixture)
    elif config.format == "npz":
        mixture_formats.write_npz(output, mixture)
    else:
        GaussianMixture.from_parameters(*mixture[:3]).save(output)
    k, dim = mixture.means.shape
    return f"{_size(output)}: {k:,} components in {dim}D"


def _components(config: DictConfig) -> PlainMixture:
    """The mixture in a file of any supported format; the surface components of a map."""
    from gmmtorch.errors import DataError
    from gmmtorch.export import mixture_formats
    from gmmtorch.mixture import GaussianMixture

    path, n_points = Path(config.path), config.n_points
    if path.suffix == ".csv":
        return mixture_formats.read_gira_csv(path, n_points)
    if path.suffix == ".npz":
        return mixture_formats.read_npz(path)
    try:
        found = maps.open_map(path, config.runtime, config.bounds).components()
        surface = ~found.max_range
        return mixture_formats.PlainMixture.of_support(
            found.means[surface], found.covariances[surface], found.support[surface]
        )
    except DataError as error:
        no_map = error
    try:
        mixture = GaussianMixture.load(path)
    except DataError as error:
        raise DataError(f"{path} contains no components to export. {no_map} {error}") from error
    support = None if n_points is None else mixture.weights * n_points
    return mixture_formats.PlainMixture(mixture.weights, mixture.means, mixture.covariances, support)


# -- space ----------------------------------------------------------------------------------------


def _map(config: DictConfig) -> GaussianMap | OccupancyGrid:
    """The map in a file or folder. Raises `DataError` with the errors of all readers if it has no map."""
    from gmmtorch.baselines.occupancy_grid import OccupancyGrid
    from gmmtorch.errors import DataError

    path = Path(config.path)
    try:
        return maps.open_map(path, config.runtime, config.bounds, config.resolution)
    except DataError as error:
        no_map = error
    try:
        return OccupancyGrid.load(path)
    except DataError as error:
        raise DataError(f"{path} is not a map that can be exported. {no_map} {error}") from error


def write_space(config: DictConfig, source: GaussianMap | OccupancyGrid, on_event: Event) -> str:
    """Write the space of a map: probabilities of cells, distances or surfaces; returns a message."""
    from gmmtorch.export import distance_field, map_server
    from gmmtorch.export.octomap import write_octomap
    from gmmtorch.export.point_cloud import write_pcd, write_ply
    from gmmtorch.occupancy.evidence import Thresholds

    output, rule = Path(config.output), Thresholds(config.free_thresh, config.occupied_thresh)
    if config.format == "map_server":
        about = _choose_band(config, source)
        grid, theta = _dense(config, source, on_event)
        if grid.dim == 3:
            grid, theta = map_server.highest_in_band(grid, theta)  # `_dense` returns only the band
        written = map_server.write_map_server(output, grid, theta, rule)
        size = " × ".join(map(str, grid.shape))
        return "\n".join(map(_size, written)) + f": {size} cells of {grid.resolution:g} m{about}"
    if config.format == "mesh":
        return _export_mesh(config, source, on_event)
    if config.format == "distance_field":
        grid, theta = _dense(config, source, on_event)
        field = distance_field.distance_field(grid, theta, rule)
        distance_field.write_distance_field(output, grid, field)
        size = " × ".join(map(str, grid.shape))
        return f"{_size(output)}: {size} cells of {grid.resolution:g} m"
    cells = _cloud(config, source, on_event)
    if config.format == "octomap":
        write_octomap(output, cells, rule)
    else:
        cells = cells.above(rule.occupied)
        write = write_ply if config.format == "ply" else write_pcd
        write(output, cells)
    return f"{_size(output)}: {len(cells):,} cells of {cells.resolution:g} m"


def _choose_band(config: DictConfig, source: GaussianMap | OccupancyGrid) -> str:
    """Sets the heights between the floor and the ceiling of a 3D map if none are given; returns a note."""
    from gmmtorch.export import floor_and_ceiling
    from gmmtorch.mapping.gaussian_map import GaussianMap

    side = _resolution(config, source)
    if config.bounds is not None or _band(config) is not None:
        return ""
    if isinstance(source, GaussianMap):
        found = source.components()
        levels = None if found.dim == 2 or not len(found) else floor_and_ceiling.of_components(found, side)
    else:
        evidence = source.evidence()
        is_flat = evidence.dim == 2 or not evidence.n_blocks
        levels = None if is_flat else floor_and_ceiling.of_grid(source, config.occupied_thresh)
    if levels is None:
        return ""
    config.z_min, config.z_max = levels.band(side)
    return f"\nz_min={config.z_min:.2f} z_max={config.z_max:.2f} (m) were chosen: {levels.about()}"


def _export_mesh(config: DictConfig, source: GaussianMap | OccupancyGrid, on_event: Event) -> str:
    """Write the surfaces of a map inside the box, if there is one; returns a message."""
    from gmmtorch.errors import InvalidArgumentError
    from gmmtorch.export.mesh import surface_mesh
    from gmmtorch.export.mesh_formats import write_mesh
    from gmmtorch.mapping.gaussian_map import GaussianMap

    if not isinstance(source, GaussianMap):
        raise InvalidArgumentError(f"format=mesh needs a GaussianMap; {config.path} is an occupancy grid.")
    on_event("mesh", 0, None)
    side = _resolution(config, source)
    mesh = surface_mesh(source.components(), side, memory_limit=config.runtime.memory_limit)
    if config.bounds is not None or _band(config) is not None:
        mesh = mesh.inside(*_box(config, source))
    write_mesh(Path(config.output), mesh)
    return f"{_size(Path(config.output))}: {len(mesh.faces):,} triangles, cells of {side:g} m"


def _cloud(config: DictConfig, source: GaussianMap | OccupancyGrid, on_event: Event) -> CellCloud:
    """The observed cells with their probabilities; all cells of the box for a `GaussianMap`."""
    import torch

    from gmmtorch.export.point_cloud import CellCloud
    from gmmtorch.mapping.gaussian_map import GaussianMap

    if isinstance(source, GaussianMap) or config.bounds is not None or _band(config) is not None:
        return CellCloud.of_grid(*_dense(config, source, on_event))
    _resolution(config, source)
    observed = CellCloud.of_blocks(source.evidence())
    theta = torch.as_tensor(source.occupancy(observed.centers))  # by the grid's rule: counts or log-odds
    return CellCloud(observed.centers, theta, observed.resolution)


def _dense(
    config: DictConfig, source: GaussianMap | OccupancyGrid, on_event: Event
) -> tuple[VoxelGrid, Tensor]:
    """All cells of the box, limited to the height band, and their probabilities, with the grid's shape."""
    import torch

    from gmmtorch.mapping.gaussian_map import GaussianMap
    from gmmtorch.occupancy.grid import VoxelGrid, rasterize

    resolution = _resolution(config, source)
    low, high = _box(config, source)
    # If the box ends on a plane between cells, the cells behind the plane are left out.
    high = [max(a, b - 1e-6 * resolution) for a, b in zip(low, high, strict=True)]
    grid = VoxelGrid.covering(low, high, resolution, config.runtime.memory_limit)
    method = config.method
    if isinstance(source, GaussianMap):
        method = source.method if method is None else method
        if method != "point":  # the other forms compute the evidence of all cells together
            on_event(f"evidence by {method}", 0, None)
            return grid, source.evidence(grid, method).probability(source.query_options.prior)

    def answer(points: Tensor) -> Tensor:
        if isinstance(source, GaussianMap):
            theta = source.occupancy(points, resolution, method)
        else:
            theta = source.occupancy(points)
        return torch.as_tensor(theta)

    return grid, rasterize(answer, grid, on_event)


def _resolution(config: DictConfig, source: GaussianMap | OccupancyGrid) -> float:
    """Side of the cells (m). Raises `InvalidArgumentError` if a grid has another resolution."""
    from gmmtorch.baselines.occupancy_grid import OccupancyGrid
    from gmmtorch.errors import InvalidArgumentError
    from gmmtorch.occupancy.grid import check_resolution

    if config.resolution is None:
        return source.resolution
    wanted = check_resolution(config.resolution)
    if isinstance(source, OccupancyGrid) and wanted != source.resolution:
        raise InvalidArgumentError(
            f"resolution={wanted} m, but the cells of {config.path} are {source.resolution} m; remove it."
        )
    return wanted


def _box(config: DictConfig, source: GaussianMap | OccupancyGrid) -> tuple[list[float], list[float]]:
    """Lowest and highest corner (m): `bounds`, or the extent of the map; limited to the height band."""
    import torch

    from gmmtorch.baselines.occupancy_grid import OccupancyGrid
    from gmmtorch.errors import DataError, InvalidArgumentError

    if isinstance(source, OccupancyGrid):
        blocks = source.evidence()
        empty, dim = blocks.n_blocks == 0, blocks.dim
        corners = [] if empty else list(blocks.bounds())
    else:
        found = source.components()
        empty, dim = len(found) == 0, found.dim
        extent = _EXTENT * found.covariances.diagonal(dim1=1, dim2=2).sqrt()
        points = torch.cat([found.means - extent, found.means + extent, found.origins])
        corners = [] if empty else [points.amin(0), points.amax(0)]
    if config.bounds is not None:
        if len(config.bounds) != 2 * dim:
            raise InvalidArgumentError(
                f"bounds={list(config.bounds)} must be {2 * dim} numbers in {dim}D: the lowest corner, then "
                "the highest."
            )
        low, high = list(config.bounds[:dim]), list(config.bounds[dim:])
        if not all(a < b for a, b in zip(low, high, strict=True)):
            raise InvalidArgumentError(
                f"bounds={list(config.bounds)}: the lowest corner {low} must be below the highest {high} "
                "along every axis."
            )
    elif empty:
        raise DataError(f"{config.path} is an empty map; give bounds to export it.")
    else:
        low, high = (corner.tolist() for corner in corners)
    band = _band(config)
    if band is not None:
        if dim == 2:
            raise InvalidArgumentError(f"z_min={band[0]}, z_max={band[1]}: a 2D map has no heights.")
        heights = (low[2], high[2])
        low[2], high[2] = max(low[2], band[0]), min(high[2], band[1])
        if low[2] > high[2]:
            raise InvalidArgumentError(
                f"z_min={band[0]}, z_max={band[1]} is outside the map, which extends from "
                f"{heights[0]:.3g} to {heights[1]:.3g} m."
            )
    return low, high


def _band(config: DictConfig) -> tuple[float, float] | None:
    """The height band (m) that is exported; None: all heights."""
    if config.z_min is None and config.z_max is None:
        return None
    return (
        float("-inf") if config.z_min is None else config.z_min,
        float("inf") if config.z_max is None else config.z_max,
    )


def _size(path: Path) -> str:
    return f"{path}  {path.stat().st_size:,} bytes"


if __name__ == "__main__":
    main()
