"""Bytes against quality: the curves of codecs, and over which rates one is ahead of all others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report.quantities import byte_text
from gmmtorch.report.style import LABEL_SIZE, TICK_SIZE, Rows, draw_grid, dress, figure_title, new_figure

QUALITIES = {"psnr2_db": "PSNR2", "psnr_lesser_db": "lesser term of PSNR2", "auc": "AUC"}
OURS = "ours"
MIXTURES = (OURS, "ours_without_counts", "float")
"""Ways to write our components: none of them is another codec."""
_STEPS = 400  # of a curve on which leads are looked for

_LINES: dict[str, tuple[str, str, str, str]] = {  # label, colour, marker, style
    "ours": ("mixture, ours", "#0072B2", "o", "-"),
    "thesis": ("mixture, 57 B a component", "#56B4E9", "P", "-"),
    "octree": ("octree, zstd", "#D55E00", "s", "-"),
    "draco": ("Draco", "#009E73", "^", "-"),
    "quantized": ("quantised points, zstd", "#CC79A7", "D", "-"),
    "depth_image": ("depth image, zstd", "#E69F00", "v", "-"),
    "depth_image_thinned": ("depth image of fewer pixels, zstd", "#E69F00", "v", ":"),
    "raw": ("raw points, 12 B", "#333333", "X", "-"),
}
_TITLES = {
    "kinect": "kinect: depth camera, a room",
    "hall": "hall: spinning lidar",
    "warehouse": "warehouse: simulated depth camera",
}


class Lead(NamedTuple):
    """The longest run of rates over which ours takes no more bytes than any other for the same quality.

    low, high: bytes of ours at its ends; octaves: log₂(high/low), 0 where there is none. most: how many
    times more bytes the best other takes, at most. ended_by: who is ahead beyond `high`; "" where our
    curve ends first.
    """

    low: float
    high: float
    octaves: float
    most: float
    ended_by: str


class _Curve(NamedTuple):
    """Settings worth their bytes: log₂ of the bytes (N,) and quality (N,), both rising."""

    log_bytes: np.ndarray
    quality: np.ndarray

    def bytes_for(self, quality: np.ndarray) -> np.ndarray:
        """log₂ of the least bytes for at least this quality; straight between settings, ∞ beyond the best,
        and those of the coarsest setting below it."""
        needed = np.interp(quality, self.quality, self.log_bytes)
        return np.where(quality > self.quality[-1], math.inf, needed)


def leads(rows: Rows, quality: str, left_out: Sequence[str] = (), ours: str = OURS) -> Lead:
    """Over which rates `ours` is at or below every other codec in bytes at equal quality.

    Args:
        rows: of one data set: codec, nbytes, and `quality`, the more the better, ∞ where nothing is lost.
        left_out: codecs that are not compared with, besides other ways to write our components.

    Raises `InvalidArgumentError` where there are no rows of ours, or of no other.
    """
    other_names = dict.fromkeys(
        row["codec"] for row in rows if row["codec"] not in (ours, *MIXTURES, *left_out)
    )
    mine = _curve(rows, ours, quality)
    others = {name: _curve(rows, name, quality) for name in other_names}
    if not len(mine.quality) or not others:
        raise InvalidArgumentError(f"rows hold nothing of {ours!r}, or of nobody else.")
    rate = np.linspace(mine.log_bytes[0], mine.log_bytes[-1], _STEPS)
    reached = np.interp(rate, mine.log_bytes, mine.quality)
    needed = np.stack([curve.bytes_for(reached) for curve in others.values()])
    margin = needed.min(0) - rate
    ahead = np.concatenate([[False], margin >= 0, [False]])
    starts, ends = np.flatnonzero(~ahead[:-1] & ahead[1:]), np.flatnonzero(ahead[:-1] & ~ahead[1:]) - 1
    if not len(starts):
        return Lead(math.nan, math.nan, 0.0, 1.0, list(others)[int(needed.min(1).argmin())])
    longest = int((rate[ends] - rate[starts]).argmax())
    first, last = int(starts[longest]), int(ends[longest])
    ended_by = list(others)[int(needed[:, last + 1].argmin())] if last + 1 < len(rate) else ""
    return Lead(
        low=float(2 ** rate[first]),
        high=float(2 ** rate[last]),
        octaves=float(rate[last] - rate[first]),
        most=float(2 ** margin[first : last + 1].max()),
        ended_by=ended_by,
    )


def bytes_for(rows: Rows, codec: str, quality: str, value: float) -> float:
    """Least bytes with which a codec reaches `value`, as in `leads`; ∞ where it never does, or is absent."""
    curve = _curve(rows, codec, quality)
    return float(2 ** curve.bytes_for(np.array(value))) if len(curve.quality) else math.inf


def _curve(rows: Rows, codec: str, quality: str) -> _Curve:
    """The settings of a codec that no smaller one of it is as good as."""
    own = sorted((row for row in rows if row["codec"] == codec), key=lambda row: row["nbytes"])
    kept: list[tuple[float, float]] = []
    for row in own:
        if not kept or row[quality] > kept[-1][1]:
            kept.append((math.log2(row["nbytes"]), float(row[quality])))
    table = np.array(kept).reshape(-1, 2)
    return _Curve(table[:, 0], np.minimum(table[:, 1], 1e6))  # differences of infinities are none


def figures(rows: Rows) -> dict[str, Figure]:
    """`rate_distortion`: PSNR2 above and AUC below against bytes a frame, a column for each data set.

    A line for each codec, off the scale where it is better than the finest octree; the rates over which
    ours leads are shaded. Depth images of fewer pixels are left out of the lead in PSNR2, whose backward
    term is all but zero for a few of a cloud's own points.

    Args:
        rows: dataset, codec, nbytes, psnr2_db, auc.
    """
    names = list(dict.fromkeys(str(row["dataset"]) for row in rows))
    figure = new_figure(1.0 + 4.4 * len(names), 8.6)
    grid = figure.subplots(2, len(names), squeeze=False)
    for column, name in enumerate(names):
        own = [row for row in rows if row["dataset"] == name]
        for axes, quality in zip(grid[:, column], ("psnr2_db", "auc"), strict=True):
            _draw(axes, own, quality)
            dress(axes, _TITLES.get(name, name) if quality == "psnr2_db" else "", "bytes a frame")
            _scale(axes, [float(row["nbytes"]) for row in own if row["codec"] in _LINES])
    grid[0][0].set_ylabel("PSNR2 of the decoded surface [dB]", fontsize=LABEL_SIZE)
    grid[1][0].set_ylabel("AUC of the map on held-out frames", fontsize=LABEL_SIZE)
    lines = {
        label: line
        for axes in grid.flat
        for line, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        list(lines.values()),
        list(lines),
        loc="outside lower center",
        ncols=4,
        frameon=False,
        fontsize=LABEL_SIZE,
    )
    figure_title(figure, "A frame as a message: what its bytes bring")
    return {"rate_distortion": figure}


def _draw(axes: Axes, rows: Rows, quality: str) -> None:
    for codec, (label, colour, mark, style) in _LINES.items():
        own = sorted(
            (row for row in rows if row["codec"] == codec and math.isfinite(row[quality])),
            key=lambda row: row["nbytes"],
        )
        if own:
            axes.plot(
                [row["nbytes"] for row in own],
                [row[quality] for row in own],
                color=colour,
                marker=mark,
                linestyle=style,
                linewidth=2.6 if codec == OURS else 1.5,
                markersize=7 if codec == OURS else 5.5,
                label=label,
                zorder=4 if codec == OURS else 3,
                clip_on=True,
            )
    left_out = ("depth_image_thinned",) if quality == "psnr2_db" else ()
    lead = leads(rows, quality, left_out)
    scale = [row for row in rows if math.isfinite(row[quality])]
    low = min(row[quality] for row in scale if row["codec"] in (OURS, "octree"))
    high = max(row[quality] for row in scale if row["codec"] in ((OURS, "octree") if left_out else _LINES))
    axes.set_ylim(low - 0.04 * (high - low), high + 0.22 * (high - low))
    if lead.octaves:
        axes.axvspan(lead.low, lead.high, color="#0072B2", alpha=0.09, linewidth=0, zorder=0)
        axes.text(
            math.sqrt(lead.low * lead.high),
            0.975,
            f"ours ahead{' of solid lines' if left_out else ''}:\n{lead.octaves:.1f} octaves",
            transform=axes.get_xaxis_transform(),
            ha="center",
            va="top",
            fontsize=TICK_SIZE,
            color="#00507f",
        )
    draw_grid(axes)


def _scale(axes: Axes, values: Sequence[float]) -> None:
    axes.set_xscale("log")
    axes.set_xlim(min(values) / 1.4, max(values) * 1.6)
    axes.xaxis.set_major_locator(LogLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: byte_text(value, digits=1)))
    axes.xaxis.set_minor_formatter(NullFormatter())
