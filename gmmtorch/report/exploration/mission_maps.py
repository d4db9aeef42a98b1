"""An exploration from above: where the robots flew, what they saw twice, and the team's map as it grew."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.exploration.world.scoring import BeliefRule
from gmmtorch.occupancy.evidence import CellClass
from gmmtorch.report.exploration.path_figures import draw_paths, path_handles
from gmmtorch.report.exploration.top_view import TopView
from gmmtorch.report.maps.mesh_figures import checked_components
from gmmtorch.report.style import (
    LABEL_SIZE,
    TICK_SIZE,
    UNKNOWN,
    as_array,
    colour,
    dress,
    figure_title,
    metres,
    new_figure,
)
from gmmtorch.scan import ArrayLike

MAX_ELLIPSES = 20_000

_SURFACE, _FREE, _EDGE = "#2b2b2b", "#ffffff", "#666666"
_SEEN = ("#fffaf0", "#f6e7ba", "#eaca7e", "#d3a345")
_N_SIGMA = 2.0
_MAX_COLUMNS = 6


Handle = Patch | Line2D


@dataclass(frozen=True, eq=False)
class TeamSnapshot:
    """The team's map at one time.

    time: simulated seconds. view: of its occupancy. trajectories: of each robot, poses (T, ≥ 2) so far.
    means (K, 3), covariances (K, 3, 3): components to outline, metres; owners (K,): the robot that
    learned each. caption: what else stands above the panel.
    """

    time: float
    view: TopView
    trajectories: Sequence[ArrayLike] = ()
    means: ArrayLike = field(default_factory=lambda: torch.empty(0, 3))
    covariances: ArrayLike = field(default_factory=lambda: torch.empty(0, 3, 3))
    owners: ArrayLike | None = None
    caption: str = ""


def trajectories_figure(
    world: TopView,
    trajectories: Sequence[ArrayLike],
    coverage: ArrayLike | None = None,
    title: str | None = "Where the robots flew",
) -> Figure:
    """Paths of the robots over the world from above, and by how many robots each place was seen (Fig 1.1).

    Where a path is above the heights of the view it has a white core, beneath them it is dotted.

    Args:
        world: what is occupied (above ½) is drawn dark.
        trajectories: of each robot, poses (T, ≥ 2), world metres.
        coverage: (nx, ny), on the cells of the world's view: how many robots saw each column; shaded,
            with the share of the seen columns in the legend.
        title: of the figure; the heights shown are added.

    Raises:
        InvalidArgumentError: coverage of another shape than the view.
    """
    occupied = world.image.double() > 0.5
    colours = np.tile(np.array(to_rgb(_FREE)), (*occupied.shape, 1))
    handles: list[Handle] = [Patch(facecolor=_SURFACE, edgecolor=_EDGE, label="surface")]
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
    figure, grid = _sheet(world, 1, 9.0)
    axes = grid[0]
    _show(axes, colours, world)
    draw_paths(axes, trajectories, world.band, ends=True)
    dress(axes, "", "x [m]", "y [m]")
    _legend(figure, [*handles, *path_handles(trajectories, world.band, ends=True)])
    heights = _between(world)
    shown = "surfaces" if coverage is None else "surfaces and coverage"
    figure_title(figure, f"{title}\n{shown}{heights}" if title and heights else title)
    return figure


def team_map_figure(
    snapshots: Sequence[TeamSnapshot], title: str | None = "The team's map", belief: BeliefRule | None = None
) -> Figure:
    """The team's map at several times: free, occupied and unknown, the paths so far, and the mixture.

    Components within the heights shown are outlined as their 2σ ellipses from above, each in the colour
    of the robot that learned it; of very many an even share. Paths above those heights have a white core.

    Args:
        snapshots: one a panel, at least one.
        title: of the figure; the heights shown are added.
        belief: what is called free and what occupied; the usual one if not given.

    Raises:
        InvalidArgumentError: no snapshot, or components whose shapes disagree.
    """
    if not snapshots:
        raise InvalidArgumentError("snapshots is empty; give the map at one time at least.")
    belief = belief or BeliefRule()
    figure, grid = _sheet(snapshots[0].view, len(snapshots), 5.6)
    for axes, snapshot in zip(grid, snapshots, strict=False):
        _show(axes, _classes(snapshot.view.image, belief), snapshot.view)
        _draw_ellipses(axes, snapshot)
        draw_paths(axes, snapshot.trajectories, snapshot.view.band, ends=False, width=1.7)
        caption = f", {snapshot.caption}" if snapshot.caption else ""
        dress(axes, f"t = {snapshot.time:.0f} s{caption}", "x [m]", "y [m]")
        axes.label_outer()
    for axes in grid[len(snapshots) :]:
        axes.set_visible(False)
    handles: list[Handle] = [
        Patch(facecolor=face, edgecolor=_EDGE, label=name)
        for face, name in ((_FREE, "free"), (_SURFACE, "occupied"), (UNKNOWN, "unknown"))
    ]
    if any(len(torch.as_tensor(s.means)) for s in snapshots):
        ring: dict[str, Any] = {"marker": "o", "fillstyle": "none", "markersize": 9, "linestyle": ""}
        handles.append(Line2D([], [], color=_EDGE, label="component, 2σ", **ring))
    paths = max((s.trajectories for s in snapshots), key=lambda paths: (len(paths), sum(map(len, paths))))
    _legend(figure, [*handles, *path_handles(paths, snapshots[0].view.band, ends=False)])
    figure_title(figure, None if title is None else f"{title}{_between(snapshots[0].view)}")
    return figure


def _between(view: TopView) -> str:
    """The heights of a view that has bounds, to be said after what is seen in it."""
    low, high = view.band
    return f" between z = {metres(low)} and {metres(high)}" if math.isfinite(low + high) else ""


def _sheet(view: TopView, n: int, width: float) -> tuple[Figure, list[Axes]]:
    """A figure of n panels of the shape of the view."""
    left, right, bottom, top = view.extent
    shape = float(np.clip((top - bottom) / (right - left), 0.2, 3.0))
    n_columns = n if n <= 2 or (n <= 4 and shape > 1.5) else math.ceil(math.sqrt(n))
    n_columns = 1 if n <= 3 and shape < 0.45 else n_columns
    n_rows = math.ceil(n / n_columns)
    side = width / max(1.0, shape**0.5)
    figure = new_figure(max(side * n_columns + 0.8, 6.8), (side * shape + 0.35) * n_rows + 1.5)
    return figure, list(np.asarray(figure.subplots(n_rows, n_columns, squeeze=False)).flat)


def _show(axes: Axes, colours: np.ndarray, view: TopView) -> None:
    axes.imshow(
        colours.transpose(1, 0, 2),
        origin="lower",
        extent=view.extent,
        aspect="equal",
        interpolation="nearest",
    )
    axes.set(xlim=view.extent[:2], ylim=view.extent[2:])
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(steps=[1, 2, 5, 10]))
    axes.tick_params(labelsize=TICK_SIZE)
    axes.autoscale(False)


def _classes(image: Tensor, belief: BeliefRule) -> np.ndarray:
    """Colours (nx, ny, 3) of free, occupied and unknown."""
    label = belief.classes(image.detach().cpu().double()).numpy()[..., None]
    colours = np.where(label == CellClass.OCCUPIED, to_rgb(_SURFACE), to_rgb(_FREE))
    return np.where(label == CellClass.UNKNOWN, to_rgb(UNKNOWN), colours)


def _shaded(counts: np.ndarray, n_robots: int) -> tuple[np.ndarray, list[Handle]]:
    """Colours (nx, ny, 3) of how many robots saw each column, and what they mean."""
    levels = max(1, min(len(_SEEN), n_robots))
    seen = np.clip(counts, 0, levels).astype(np.int64)
    colours = np.array([to_rgb(c) for c in (UNKNOWN, *_SEEN)])[seen]
    total = max(int((seen > 0).sum()), 1)
    handles: list[Handle] = [Patch(facecolor=UNKNOWN, edgecolor=_EDGE, label="not seen")]
    for level in range(1, levels + 1):
        more = " or more" if level == levels < n_robots else ""
        robots = "robot" if level == 1 and not more else "robots"
        text = f"seen by {level}{more} {robots}: {100 * (seen == level).sum() / total:.0f} %"
        handles.append(Patch(facecolor=_SEEN[level - 1], edgecolor=_EDGE, label=text))
    return colours, handles


def _draw_ellipses(axes: Axes, snapshot: TeamSnapshot) -> None:
    means, covariances = (value.cpu() for value in checked_components(snapshot.means, snapshot.covariances))
    owners = torch.zeros(len(means)) if snapshot.owners is None else torch.as_tensor(snapshot.owners).cpu()
    if owners.shape != (len(means),):
        raise InvalidArgumentError(
            f"owners has shape {tuple(owners.shape)}; expected ({len(means)},), one a component."
        )
    if len(means) == 0:
        return
    low, high = snapshot.view.band
    kept = ((means[:, 2] >= low) & (means[:, 2] <= high)).nonzero()[:, 0]
    kept = kept[:: math.ceil(len(kept) / MAX_ELLIPSES) or 1]
    outlines = _ellipses(means[kept, :2], covariances[kept, :2, :2])
    edges = np.array([to_rgb(colour(int(robot))) for robot in owners[kept]]).reshape(-1, 3)
    faces = np.hstack([edges, np.full((len(edges), 1), 0.15)])
    axes.add_collection(
        PolyCollection(list(outlines), facecolors=faces, edgecolors=edges, linewidths=0.5, zorder=2),
        autolim=False,
    )


def _ellipses(means: Tensor, covariances: Tensor, n_corners: int = 24) -> np.ndarray:
    """2σ outlines (K, C, 2) of components in the plane."""
    angle = torch.arange(n_corners, dtype=torch.float64) * (2 * torch.pi / n_corners)
    circle = torch.stack([angle.cos(), angle.sin()], 1)
    if len(means) == 0:
        return np.empty((0, n_corners, 2))
    variances, directions = torch.linalg.eigh((covariances + covariances.mT) / 2)
    axes = directions * variances.clamp_min(0).sqrt()[:, None]
    return (means[:, None] + _N_SIGMA * circle @ axes.mT).numpy()


def _legend(figure: Figure, handles: Sequence[Handle]) -> None:
    """Beneath the panels, in as few rows as the width allows."""
    width = figure.get_window_extent().width
    for columns in range(min(len(handles), _MAX_COLUMNS), 0, -1):
        legend = figure.legend(
            handles=list(handles),
            loc="outside lower center",
            ncols=columns,
            frameon=False,
            fontsize=LABEL_SIZE - 0.5,
        )
        if columns == 1 or legend.get_window_extent().width <= width:
            return
        legend.remove()
