"""Figures of an exploration from above, and recordings of it for the rerun viewer."""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.files import write_atomically
from gmmtorch.occupancy import CellClass, check_resolution
from gmmtorch.optional_packages import needs_extra
from gmmtorch.pose import Pose
from gmmtorch.report import (
    EDGE,
    N_SIGMA,
    UNKNOWN,
    MapImage,
    as_array,
    checked_components,
    colour,
    count_text,
    draw_paths,
    ellipse_outlines,
    even_sample,
    figure_title,
    height_colours,
    label_axes,
    legend_below,
    metres,
    new_figure,
    path_handles,
    principal_axes,
)
from gmmtorch.scan import ArrayLike
from gmmtorch.team.exploration import BeliefRule

MAX_ELLIPSES = 20_000

_SURFACE, _FREE = "#2b2b2b", "#ffffff"
_SEEN = ("#fffaf0", "#f6e7ba", "#eaca7e", "#d3a345")


@dataclass(frozen=True, eq=False)
class TeamSnapshot:
    """The team's map at one time.

    time: simulated seconds. view: occupancy from above. trajectories: poses (T, ≥ 2) of each robot so far.
    means (K, 3), covariances (K, 3, 3): components to outline, metres. owners (K,): the robot that learned
    each. caption: additional title of the panel.
    """

    time: float
    view: MapImage
    trajectories: Sequence[ArrayLike] = ()
    means: ArrayLike = field(default_factory=lambda: torch.empty(0, 3))
    covariances: ArrayLike = field(default_factory=lambda: torch.empty(0, 3, 3))
    owners: ArrayLike | None = None
    caption: str = ""


def trajectories_figure(
    world: MapImage, trajectories: Sequence[ArrayLike], coverage: ArrayLike | None = None
) -> Figure:
    """Draws the paths of the robots over the world from above, and how many robots saw each place (Fig 1.1).

    world: occupancy; cells above ½ are drawn dark. trajectories: poses (T, ≥ 2) of each robot, world metres;
    parts outside the heights of the world image have a white core. coverage: (nx, ny), number of robots that
    saw each cell of the world image; shaded, with the shares of the seen cells in the legend.

    Raises `InvalidArgumentError`: coverage has another shape than the image.
    """
    occupied = world.image.double() > 0.5
    colours = np.tile(np.array(to_rgb(_FREE)), (*occupied.shape, 1))
    handles = [_patch(_SURFACE, "surface")]
    if coverage is not None:
        counts = as_array(coverage)
        if counts.shape != tuple(occupied.shape):
            raise InvalidArgumentError(
                f"coverage has shape {counts.shape}; expected {tuple(occupied.shape)}, a count for each cell "
                "of the view."
            )
        colours, shades = _shaded(counts, len(trajectories))
        handles += shades
    colours[occupied.numpy()] = to_rgb(_SURFACE)
    figure, (axes, *_) = _sheet(world, 1, 9.0)
    _draw(axes, world, colours)
    draw_paths(axes, trajectories, world.band, ends=True)
    label_axes(axes, "", "x [m]", "y [m]")
    legend_below(figure, [*handles, *path_handles(trajectories, world.band, ends=True)])
    heights = _heights(world)
    shown = "surfaces" if coverage is None else "surfaces and coverage"
    figure_title(figure, f"Robot paths\n{shown}{heights}" if heights else "Robot paths")
    return figure


def team_map_figure(snapshots: Sequence[TeamSnapshot], belief: BeliefRule | None = None) -> Figure:
    """Draws the team's map at several times: free, occupied and unknown space, paths, and components.

    Components within the heights shown have 2σ outlines in the colour of the robot that learned them, at most
    20,000 of them. Parts of paths outside these heights have a white core.

    snapshots: one or more, one per panel. belief: thresholds of free and occupied; the defaults of
    `BeliefRule` if None.

    Raises `InvalidArgumentError`: no snapshot, or components whose shapes disagree.
    """
    if not snapshots:
        raise InvalidArgumentError("snapshots is empty; give the map at one time at least.")
    belief = belief or BeliefRule()
    figure, grid = _sheet(snapshots[0].view, len(snapshots), 5.6)
    has_components = False
    for axes, snapshot in zip(grid, snapshots, strict=False):
        _draw(axes, snapshot.view, _classes(snapshot.view.image, belief))
        has_components |= _draw_ellipses(axes, snapshot) > 0
        draw_paths(axes, snapshot.trajectories, snapshot.view.band, ends=False, width=1.7)
        caption = f", {snapshot.caption}" if snapshot.caption else ""
        label_axes(axes, f"t = {snapshot.time:.0f} s{caption}", "x [m]", "y [m]")
        axes.label_outer()
    for axes in grid[len(snapshots) :]:
        axes.set_visible(False)
    handles = [_patch(_FREE, "free"), _patch(_SURFACE, "occupied"), _patch(UNKNOWN, "unknown")]
    if has_components:
        ring = Line2D([], [], color=EDGE, marker="o", fillstyle="none", markersize=9, linestyle="")
        ring.set_label("component, 2σ")
        handles.append(ring)
    paths = max((s.trajectories for s in snapshots), key=lambda paths: (len(paths), sum(map(len, paths))))
    legend_below(figure, [*handles, *path_handles(paths, snapshots[0].view.band, ends=False)])
    figure_title(figure, f"Team map{_heights(snapshots[0].view)}")
    return figure


def _patch(face: str, label: str) -> Artist:
    return Patch(facecolor=face, edgecolor=EDGE, label=label)


def _heights(view: MapImage) -> str:
    """Returns the heights that an image shows as the end of a title; "" if they have no bounds."""
    low, high = view.band
    return f" between z = {metres(low)} and {metres(high)}" if math.isfinite(low + high) else ""


def _sheet(view: MapImage, n: int, width: float) -> tuple[Figure, list[Axes]]:
    """Returns a figure with n panels, and possibly spare ones, of the shape of the image."""
    left, right, bottom, top = view.extent
    shape = float(np.clip((top - bottom) / (right - left), 0.2, 3.0))
    n_columns = n if n <= 2 or (n <= 4 and shape > 1.5) else math.ceil(math.sqrt(n))
    n_columns = 1 if n <= 3 and shape < 0.45 else n_columns
    n_rows = math.ceil(n / n_columns)
    side = width / max(1.0, shape**0.5)
    figure = new_figure(max(side * n_columns + 0.8, 6.8), (side * shape + 0.35) * n_rows + 1.5)
    return figure, list(np.asarray(figure.subplots(n_rows, n_columns, squeeze=False)).flat)


def _draw(axes: Axes, view: MapImage, colours: np.ndarray) -> None:
    view.draw(axes, colours)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(steps=[1, 2, 5, 10]))


def _classes(image: Tensor, belief: BeliefRule) -> np.ndarray:
    """Returns the colours (nx, ny, 3) of free, occupied and unknown cells."""
    label = belief.classes(image.detach().cpu().double()).numpy()[..., None]
    colours = np.where(label == CellClass.OCCUPIED, to_rgb(_SURFACE), to_rgb(_FREE))
    return np.where(label == CellClass.UNKNOWN, to_rgb(UNKNOWN), colours)


def _shaded(counts: np.ndarray, n_robots: int) -> tuple[np.ndarray, list[Artist]]:
    """Returns the colours (nx, ny, 3) of the number of robots that saw each cell, and their legend
    entries."""
    levels = max(1, min(len(_SEEN), n_robots))
    seen = np.clip(counts, 0, levels).astype(np.int64)
    colours = np.array([to_rgb(c) for c in (UNKNOWN, *_SEEN)])[seen]
    total = max(int((seen > 0).sum()), 1)
    handles = [_patch(UNKNOWN, "not seen")]
    for level in range(1, levels + 1):
        robots = f"{level} or more robots" if level == levels < n_robots else count_text(level, "robot")
        share = 100 * (seen == level).sum() / total
        handles.append(_patch(_SEEN[level - 1], f"seen by {robots}: {share:.0f} %"))
    return colours, handles


def _draw_ellipses(axes: Axes, snapshot: TeamSnapshot) -> int:
    """Draws the outlines of the components within the heights shown, and returns the number of components."""
    means, covariances = (value.cpu() for value in checked_components(snapshot.means, snapshot.covariances))
    owners = torch.zeros(len(means)) if snapshot.owners is None else torch.as_tensor(snapshot.owners).cpu()
    if owners.shape != (len(means),):
        raise InvalidArgumentError(
            f"owners has shape {tuple(owners.shape)}; expected ({len(means)},), one per component."
        )
    low, high = snapshot.view.band
    kept = ((means[:, 2] >= low) & (means[:, 2] <= high)).nonzero()[:, 0]
    kept = kept[even_sample(len(kept), MAX_ELLIPSES)]
    outlines = ellipse_outlines(means[kept, :2], covariances[kept, :2, :2], n_corners=24)
    edges = np.array([to_rgb(colour(int(robot))) for robot in owners[kept]]).reshape(-1, 3)
    faces = np.hstack([edges, np.full((len(edges), 1), 0.15)])
    patches = PolyCollection(list(outlines), facecolors=faces, edgecolors=edges, linewidths=0.5, zorder=2)
    axes.add_collection(patches, autolim=False)
    return len(means)


TIMELINE = "simulated_time"


def record_rerun(
    path: str | Path,
    trajectories: Sequence[ArrayLike],
    *,
    period: float = 1.0,
    maps: Mapping[float, Mapping[str, ArrayLike]] = MappingProxyType({}),
    resolution: float = 0.2,
    row: Mapping[str, Any] | None = None,
) -> Path:
    """Writes a recording and returns its path; `rerun FILE` opens it.

    One timeline of simulated seconds shows moving robots, occupied cells, 2σ ellipsoids coloured by height,
    and curves of entropy and bytes.

    path: file name that ends in .rrd. trajectories: poses (T, ≥ 3) of each robot, world metres. period:
    seconds between poses. maps: by time (s), in any order, "cells", the occupied ones as indices (C, 3) of
    the lattice, and perhaps "means" (K, 3) and "covariances" (K, 3, 3) of the mixture, metres.
    resolution: side (m) of the maps' cells.
    row: explore row of `results.json` with the curves.

    Raises `GmmTorchError`: rerun is not installed, or older than 0.23; `InvalidArgumentError`: another
    suffix, a period that is not positive, or shapes that disagree; `OutputError`: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".rrd":
        raise InvalidArgumentError(f"path={path} must end in .rrd.")
    if not (math.isfinite(period) and period > 0):
        raise InvalidArgumentError(f"period={period} must be above zero seconds.")
    check_resolution(resolution)
    rerun = load_rerun()

    def write(temporary: Path) -> None:
        with rerun.RecordingStream("gmmtorch_exploration") as stream:
            stream.save(str(temporary))
            stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            for robot, trajectory in enumerate(trajectories):
                _log_robot(rerun, stream, robot, as_array(trajectory), period)
            for time in sorted(maps):
                stream.set_time(TIMELINE, duration=float(time))
                _log_map(rerun, stream, maps[time], resolution)
            if row is not None:
                _log_curves(rerun, stream, row)
            stream.flush()
            stream.disconnect()

    return write_atomically(path, write)


def load_rerun() -> Any:
    """Imports rerun. Raises `GmmTorchError` if it is not installed or too old."""
    with needs_extra("The recording for the rerun viewer needs", "rerun-sdk", "viewer"):
        rerun = importlib.import_module("rerun")
    if not hasattr(rerun, "Scalars"):  # was introduced together with set_time(duration=…)
        version = getattr(rerun, "__version__", "unknown")
        raise GmmTorchError(
            f"rerun-sdk {version} is too old for the recording; pip install 'rerun-sdk>=0.23'."
        )
    return rerun


def _log_robot(rerun: Any, stream: Any, robot: int, poses: np.ndarray, period: float) -> None:
    """Logs the whole path, visible at all times, and the robot and its heading at each pose."""
    if poses.ndim != 2 or poses.shape[1] < 3:
        raise InvalidArgumentError(
            f"trajectories[{robot}] has shape {poses.shape}; expected (T, 3) or more, metres."
        )
    name = f"world/robots/{robot}"
    hue = [round(255 * share) for share in to_rgb(colour(robot))]
    if len(poses):
        stream.log(f"{name}/path", rerun.LineStrips3D([poses[:, :3]], colors=[[*hue, 110]]), static=True)
    for i, pose in enumerate(poses):
        stream.set_time(TIMELINE, duration=i * period)
        stream.log(name, rerun.Points3D([pose[:3]], colors=[hue], radii=[0.3]))
        if len(pose) > 3:
            ahead = [math.cos(pose[3]), math.sin(pose[3]), 0.0]
            stream.log(f"{name}/heading", rerun.Arrows3D(origins=[pose[:3]], vectors=[ahead], colors=[hue]))


def _log_map(rerun: Any, stream: Any, recorded: Mapping[str, ArrayLike], resolution: float) -> None:
    cells = as_array(recorded["cells"]).reshape(-1, 3)
    centres = (cells + 0.5) * resolution
    half = np.full((len(cells), 3), resolution / 2)
    boxes = rerun.Boxes3D(centers=centres, half_sizes=half, colors=_shades(centres))
    stream.log("world/cells", boxes)
    means, covariances = checked_components(
        torch.as_tensor(recorded.get("means", ())).reshape(-1, 3),
        torch.as_tensor(recorded.get("covariances", ())).reshape(-1, 3, 3),
    )
    deviations, directions = principal_axes(covariances.cpu())
    ellipsoids = rerun.Ellipsoids3D(
        centers=means.cpu().numpy(),
        half_sizes=(N_SIGMA * deviations).numpy(),
        quaternions=Pose(directions, means.cpu()).quaternion().numpy(),
        colors=_shades(means.cpu().numpy()),
        fill_mode="solid",
    )
    stream.log("world/mixture", ellipsoids)


def _shades(centres: np.ndarray) -> np.ndarray:
    """Returns the colours of heights (K, 3), 0 to 255, of centres (K, 3)."""
    return (255 * height_colours(torch.from_numpy(centres[:, 2])).numpy()).astype(np.uint8)


def _log_curves(rerun: Any, stream: Any, row: Mapping[str, Any]) -> None:
    observable = max(float(row["observable_bits"]), 1.0)
    for i, time in enumerate(row["times"]):
        stream.set_time(TIMELINE, duration=float(time))
        stream.log("entropy_left", rerun.Scalars(row["entropy_bits"][i] / observable))
        if row.get("bytes_over_time"):
            stream.log("bytes_sent", rerun.Scalars(float(row["bytes_over_time"][i])))
