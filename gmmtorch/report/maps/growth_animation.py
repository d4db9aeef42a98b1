"""A moving picture of a map that grows: occupancy, components, the sensor's path and its newest scan."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from PIL import Image
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.files import write_atomically
from gmmtorch.mapping import GaussianMap
from gmmtorch.report import style
from gmmtorch.report.maps.map_figures import occupancy_colours
from gmmtorch.report.maps.map_images import MapPanel, slice_image
from gmmtorch.report.maps.map_regions import Corners, robust_bounds
from gmmtorch.report.scenes.ellipsoids import ellipse_outlines

_WIDTH, _DPI = 6.4, 100  # inches, and pixels per inch
_COMPONENT, _PATH = style.PALETTE[0], style.PALETTE[1]
_BEAM_STRIDE = 3  # of the beams of the newest scan that are drawn
_QUALITY = 72  # of WebP
_LAST_FRAME = 4000  # milliseconds


class GrowthFrame(NamedTuple):
    """A map in 2D after some scans.

    n_scans: in the map. shown: a copy of the map. path: (S, 2) sensor positions, world metres.
    hits: (N, 2) returns of the newest scan.
    """

    n_scans: int
    shown: GaussianMap
    path: Tensor
    hits: Tensor


def save_growth(
    path: str | Path,
    frames: Sequence[GrowthFrame],
    *,
    resolution: float,
    period: float = 0.15,
) -> Path:
    """Writes frames as an animated WebP or GIF that repeats, and returns its path.

    Args:
        path: file name that ends in .webp or .gif.
        frames: the map as it grows; the last one is the finished map.
        resolution: side (m) of the cells of occupancy.
        period: seconds of a frame; the last one is shown for four seconds.

    Raises:
        InvalidArgumentError: another suffix, no frame, or a map in 3D.
    """
    path = Path(path)
    if path.suffix.lower() not in (".webp", ".gif"):
        raise InvalidArgumentError(f"path={path} must end in .webp or .gif.")
    if not frames or frames[-1].shown.dim != 2:
        raise InvalidArgumentError("frames must contain at least one map, and only maps in 2D.")
    last = frames[-1]
    solid = last.shown.components()
    means = solid.means[~solid.max_range].cpu()
    box = robust_bounds(means, last.path, share=0.995, margin=0.8)
    pictures = [_picture(frame, last.n_scans, box, resolution) for frame in frames]
    durations = [round(1000 * period)] * (len(pictures) - 1) + [_LAST_FRAME]

    def write(temporary: Path) -> None:
        first, *others = pictures
        options: dict[str, Any] = (
            {"quality": _QUALITY, "method": 4} if path.suffix.lower() == ".webp" else {"disposal": 1}
        )
        first.save(temporary, save_all=True, append_images=others, duration=durations, loop=0, **options)

    return write_atomically(path, write)


def _picture(frame: GrowthFrame, n_total: int, box: Corners, resolution: float) -> Image.Image:
    """One frame as a picture; all frames have the same layout."""
    (left, bottom), (right, top) = box
    side = _WIDTH - 0.2
    height = side * (top - bottom) / (right - left)
    page = Figure(figsize=(_WIDTH, height + 0.95), facecolor="white", dpi=_DPI)
    canvas = FigureCanvasAgg(page)
    axes = page.add_axes((0.1 / _WIDTH, 0.4 / (height + 0.95), side / _WIDTH, height / (height + 0.95)))
    _draw_map(axes, frame, box, resolution)
    axes.set(xlim=(left, right), ylim=(bottom, top), xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_color(style.EDGE)
    _write_numbers(page, frame, n_total, height + 0.95)
    _draw_legend(page)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


def _draw_map(axes: Axes, frame: GrowthFrame, box: Corners, resolution: float) -> None:
    """Draws occupancy, 2σ ellipses, the path, and the sensor with the beams of its newest scan."""
    shown = frame.shown

    def answer(points: Tensor) -> Tensor:
        return shown.occupancy(points, resolution)  # type: ignore[return-value]

    image = slice_image(MapPanel("", answer, resolution, *box), shown_pixels=round(_WIDTH * _DPI))
    theta = np.ma.masked_invalid(image.image.numpy())
    image.draw(axes, occupancy_colours()(theta), "antialiased")
    components = shown.components()
    solid = ~components.max_range
    outlines = ellipse_outlines(components.means[solid].cpu(), components.covariances[solid].cpu())
    axes.add_collection(
        PolyCollection(
            list(outlines), facecolors=_COMPONENT, edgecolors=_COMPONENT, alpha=0.65, linewidths=0.7
        )
    )
    axes.plot(*frame.path.T, color=_PATH, linewidth=1.0, alpha=0.85, solid_joinstyle="round", zorder=3)
    sensor = frame.path[-1]
    beams = torch.stack([sensor.expand_as(frame.hits), frame.hits, torch.full_like(frame.hits, torch.nan)], 1)
    fan = beams[::_BEAM_STRIDE].reshape(-1, 2)
    axes.plot(*fan.T, color=_PATH, linewidth=0.5, alpha=0.35, zorder=3)
    axes.plot(*sensor, "o", color=_PATH, markersize=9, markeredgecolor="white", zorder=4)


def _write_numbers(page: Figure, frame: GrowthFrame, n_total: int, height: float) -> None:
    """Writes scans, components and bytes in columns that stay where they are."""
    shown = frame.shown
    numbers = (
        (0.26, f"{frame.n_scans:,}", f" of {n_total:,} scans"),
        (0.60, f"{shown.n_components:,}", " components"),
        (0.88, f"{shown.nbytes / 1e3:,.0f}", " kB"),
    )
    y = 1 - 0.28 / height
    for x, value, unit in numbers:
        page.text(x - 0.02, y, value, ha="right", va="center", fontsize=14, fontweight="bold")
        page.text(x - 0.02, y, unit, ha="left", va="center", fontsize=12, color="#444444")


def _draw_legend(page: Figure) -> None:
    free, occupied = occupancy_colours()([0.0, 1.0])
    page.legend(
        handles=[
            Patch(facecolor=_COMPONENT, alpha=0.65, label="component (2σ)"),
            Patch(facecolor=free, edgecolor=style.EDGE, label="free"),
            Patch(facecolor=occupied, edgecolor=style.EDGE, label="occupied"),
            Patch(facecolor=style.UNKNOWN, edgecolor=style.EDGE, label="unknown"),
            Line2D([], [], color=_PATH, marker="o", markeredgecolor="white", label="robot"),
        ],
        loc="lower center",
        ncols=5,
        frameon=False,
        fontsize=10,
        handlelength=1.3,
        columnspacing=1.4,
        borderaxespad=0.2,
    )
