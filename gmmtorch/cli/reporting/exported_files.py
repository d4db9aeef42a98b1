"""Files in the formats of other programs: poses, components, and the space of a map."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from omegaconf import DictConfig
from torch import Tensor

from gmmtorch import export
from gmmtorch import mixture as mixtures  # whose estimators wait a second for scikit-learn
from gmmtorch.cli import inputs
from gmmtorch.datasets import read_trajectory
from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError
from gmmtorch.mapping import GaussianMap
from gmmtorch.occupancy import OccupancyGrid, Thresholds, VoxelGrid, check_resolution, rasterize
from gmmtorch.report import Event
from gmmtorch.scan import COLOUR

_EXTENT = 3.0  # standard deviations around each component that the cells cover


def write_poses(path: Path, output: Path) -> str:
    """Write the poses of a trajectory file as KITTI rows; returns a message."""
    if not path.is_file():
        raise MissingDataError(f"path={path} does not exist; format=kitti needs a trajectory file.")
    matrices = read_trajectory(path).poses.matrix
    export.write_kitti(output, matrices)
    return f"{_size(output)}: {len(matrices):,} poses"


def write_components(config: DictConfig) -> str:
    """Write weights, means and covariances, or splats; returns a message."""
    output = Path(config.output)
    if config.format == "splats":
        splats = export.Splats.of(
            inputs.open_map(Path(config.path), config.runtime, config.bounds).components()
        )
        export.write_splats(output, splats)
        return f"{_size(output)}: {len(splats.means):,} splats"
    mixture = export.checked(_components(config))
    if config.format == "csv":
        export.write_gira_csv(output, mixture)
    elif config.format == "npz":
        export.write_npz(output, mixture)
    else:
        mixtures.GaussianMixture.from_parameters(*mixture[:3]).save(output)
    k, dim = mixture.means.shape
    return f"{_size(output)}: {k:,} components in {dim}D"


def _components(config: DictConfig) -> export.PlainMixture:
    """The mixture in a file of any supported format; the surface components of a map."""
    path = Path(config.path)
    if path.suffix == ".csv":
        return export.read_gira_csv(path)
    if path.suffix == ".npz":
        return export.read_npz(path)
    try:
        found = inputs.open_map(path, config.runtime, config.bounds).components()
        surface = ~found.max_range
        return export.PlainMixture.of_support(
            found.means[surface], found.covariances[surface], found.support[surface]
        )
    except DataError as error:
        no_map = error
    try:
        mixture = mixtures.GaussianMixture.load(path)
    except DataError as error:
        raise DataError(f"{path} contains no components to export. {no_map} {error}") from error
    return export.PlainMixture(mixture.weights, mixture.means, mixture.covariances)


Source = GaussianMap | OccupancyGrid


def open_source(config: DictConfig) -> Source:
    """The map in a file or folder. Raises `DataError` with the errors of all readers if it has no map."""
    path = Path(config.path)
    try:
        return inputs.open_map(path, config.runtime, config.bounds, config.resolution)
    except DataError as error:
        no_map = error
    try:
        return OccupancyGrid.load(path)
    except DataError as error:
        raise DataError(f"{path} is not a map that can be exported. {no_map} {error}") from error


def write_space(config: DictConfig, source: Source, on_event: Event) -> str:
    """Write the space of a map: probabilities of cells, distances or surfaces; returns a message."""
    output, rule = Path(config.output), Thresholds(occupied=config.occupied_thresh)
    space = _Space(config, source)
    if config.format == "map_server":
        about = space.choose_band()
        grid, theta = space.dense(on_event)
        if grid.dim == 3:
            grid, theta = export.highest_in_band(grid, theta)  # `dense` returns only the band
        written = export.write_map_server(output, grid, theta, rule)
        return "\n".join(map(_size, written)) + f": {_cells(grid)}{about}"
    if config.format == "distance_field":
        grid, theta = space.dense(on_event)
        export.write_distance_field(output, grid, export.distance_field(grid, theta, rule))
        return f"{_size(output)}: {_cells(grid)}"
    if config.format == "mesh":
        if not isinstance(source, GaussianMap):
            raise InvalidArgumentError(
                f"format=mesh needs a GaussianMap; {config.path} is an occupancy grid."
            )
        on_event("mesh", 0, None)
        side = space.resolution
        mesh = export.surface_mesh(source.components(), side, memory_limit=config.runtime.memory_limit)
        if space.is_limited:
            mesh = mesh.inside(*space.box())
        export.write_mesh(output, mesh, _colours(source, mesh.vertices))
        return f"{_size(output)}: {len(mesh.faces):,} triangles, cells of {side:g} m"
    cells = space.cloud(on_event)
    if config.format == "octomap":
        colours = _colours(source, cells.centers) if output.suffix == ".ot" else None
        export.write_octomap(output, cells, rule, colours)
    else:
        cells = cells.above(rule.occupied)
        if config.format == "ply":
            export.write_ply(output, cells, _colours(source, cells.centers))
        else:
            export.write_pcd(output, cells)
    return f"{_size(output)}: {len(cells):,} cells of {cells.resolution:g} m"


def _colours(source: Source, points: Tensor) -> Tensor | None:
    """Linear RGB (M, 3) at points (M, D) of a map with colours; None without."""
    found = source.attributes(points) if isinstance(source, GaussianMap) else {}
    return found[COLOUR].mean if COLOUR in found else None


class _Space:
    """The part of a map that the options export.

    Attributes:
        resolution: side (m) of the cells. band: lowest and highest z (m); None: all heights.

    Raises `InvalidArgumentError` if a grid has another resolution than the options.
    """

    def __init__(self, config: DictConfig, source: Source) -> None:
        self._config, self._source, self.resolution = config, source, source.resolution
        if config.resolution is not None:
            self.resolution = check_resolution(config.resolution)
        if isinstance(source, OccupancyGrid) and self.resolution != source.resolution:
            raise InvalidArgumentError(
                f"resolution={self.resolution} m, but the cells of {config.path} are {source.resolution} m; "
                "remove it."
            )
        self.band: tuple[float, float] | None = None
        if config.z_min is not None or config.z_max is not None:
            low, high = config.z_min, config.z_max
            self.band = -math.inf if low is None else low, math.inf if high is None else high

    @property
    def is_limited(self) -> bool:
        """Whether the options give a box or a band of heights."""
        return self._config.bounds is not None or self.band is not None

    def choose_band(self) -> str:
        """Chooses the heights between floor and ceiling if the options give none for 3D; returns a note."""
        source, side, levels = self._source, self.resolution, None
        if self.is_limited:
            return ""
        if isinstance(source, GaussianMap):
            found = source.components()
            if found.dim == 3 and len(found):
                levels = export.of_components(found, side)
        elif (evidence := source.evidence()).dim == 3 and evidence.n_blocks:
            levels = export.of_grid(source, self._config.occupied_thresh)
        if levels is None:
            return ""
        self.band = levels.band(side)
        return f"\nz_min={self.band[0]:.2f} z_max={self.band[1]:.2f} (m) were chosen: {levels.about()}"

    def cloud(self, on_event: Event) -> export.CellCloud:
        """The observed cells with their probabilities; all cells of the box for a `GaussianMap`."""
        if isinstance(self._source, GaussianMap) or self.is_limited:
            return export.CellCloud.of_grid(*self.dense(on_event))
        observed = export.CellCloud.of_blocks(self._source.evidence())
        # By the grid's rule: counts or log-odds.
        theta = torch.as_tensor(self._source.occupancy(observed.centers))
        return export.CellCloud(observed.centers, theta, observed.resolution)

    def dense(self, on_event: Event) -> tuple[VoxelGrid, Tensor]:
        """All cells of the box within the height band, and their probabilities, with the grid's shape."""
        source, resolution = self._source, self.resolution
        low, high = self.box()
        # If the box ends on a plane between cells, the cells behind the plane are left out.
        high = [max(a, b - 1e-6 * resolution) for a, b in zip(low, high, strict=True)]
        grid = VoxelGrid.covering(low, high, resolution, self._config.runtime.memory_limit)
        if not isinstance(source, GaussianMap):
            return grid, rasterize(lambda points: torch.as_tensor(source.occupancy(points)), grid, on_event)
        method = self._config.method or source.method
        if method == "point":
            return grid, rasterize(
                lambda points: torch.as_tensor(source.occupancy(points, resolution, method)), grid, on_event
            )
        on_event(f"evidence by {method}", 0, None)  # of all cells together
        return grid, source.evidence(grid, method).probability()

    def box(self) -> tuple[list[float], list[float]]:
        """Lowest and highest corner (m): `bounds`, or the extent of the map; limited to the height band."""
        low, high = self._extent()
        dim, bounds = len(low), self._config.bounds
        if bounds is not None:
            low, high = inputs.corners(bounds, dim)
            if not all(a < b for a, b in zip(low, high, strict=True)):
                raise InvalidArgumentError(
                    f"bounds={list(bounds)}: the lowest corner {low} must be below the highest {high} along "
                    "every axis."
                )
        elif not all(map(math.isfinite, low)):
            raise DataError(f"{self._config.path} is an empty map; give bounds to export it.")
        if self.band is not None:
            bottom, top = self.band
            if dim == 2:
                raise InvalidArgumentError(f"z_min={bottom}, z_max={top}: a 2D map has no heights.")
            heights = f"{low[2]:.3g} to {high[2]:.3g} m"
            low[2], high[2] = max(low[2], bottom), min(high[2], top)
            if low[2] > high[2]:
                raise InvalidArgumentError(
                    f"z_min={bottom}, z_max={top} is outside the map, which extends from {heights}."
                )
        return low, high

    def _extent(self) -> tuple[list[float], list[float]]:
        """Lowest and highest corner (m) of the map; infinite if it is empty."""
        if isinstance(self._source, OccupancyGrid):
            blocks = self._source.evidence()
            if blocks.n_blocks == 0:
                return [math.inf] * blocks.dim, [-math.inf] * blocks.dim
            low, high = blocks.bounds()
        else:
            found = self._source.components()
            if not len(found):
                return [math.inf] * found.dim, [-math.inf] * found.dim
            extent = _EXTENT * found.covariances.diagonal(dim1=1, dim2=2).sqrt()
            points = torch.cat([found.means - extent, found.means + extent, found.origins])
            low, high = points.amin(0), points.amax(0)
        return low.tolist(), high.tolist()


def _cells(grid: VoxelGrid) -> str:
    return f"{' × '.join(map(str, grid.shape))} cells of {grid.resolution:g} m"


def _size(path: Path) -> str:
    return f"{path}  {path.stat().st_size:,} bytes"
