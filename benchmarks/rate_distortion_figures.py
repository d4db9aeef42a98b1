"""Bytes against quality: the curves of codecs, and the range of sizes in which one leads all others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.report import (
    PALETTE,
    TICK_SIZE,
    Rows,
    byte_text,
    draw_grid,
    figure_title,
    label_axes,
    legend_below,
    new_figure,
    tick_text,
)

QUALITIES = {"psnr2_db": "PSNR2", "psnr_lesser_db": "lesser term of PSNR2", "auc": "AUC"}
OURS = "ours"
MIXTURES = (OURS, "ours_without_counts", "float")
"""Encodings of the components of this package; they are not compared with each other."""

_N_SIZES = 400  # sizes on a curve at which `leads` compares
_LINES: dict[str, tuple[str, str, str, str]] = {  # label, colour, marker, line style
    "ours": ("mixture (gmmtorch)", PALETTE[0], "o", "-"),
    "thesis": ("mixture, 57 B per component", PALETTE[5], "P", "-"),
    "octree": ("octree, zstd", PALETTE[1], "s", "-"),
    "draco": ("Draco", PALETTE[2], "^", "-"),
    "quantized": ("quantized points, zstd", PALETTE[3], "D", "-"),
    "depth_image": ("depth image, zstd", PALETTE[4], "v", "-"),
    "depth_image_thinned": ("depth image with fewer pixels, zstd", PALETTE[4], "v", ":"),
    "raw": ("raw points, 12 B each", PALETTE[6], "X", "-"),
}
_TITLES = {
    "kinect": "kinect: depth camera in a room",
    "hall": "hall: spinning lidar",
    "warehouse": "warehouse: simulated depth camera",
}
_Y_LABELS = {"psnr2_db": "PSNR2 of the decoded surface [dB]", "auc": "AUC of the map on held-out frames"}


class Lead(NamedTuple):
    """The longest range of sizes in which one codec needs no more bytes than any other for the same quality.

    low, high: its bytes at the ends. octaves: log₂(high/low), 0 if there is no such range. most: largest
    ratio of the bytes of the best other codec to its own, where one reaches the quality. ended_by: codec that
    is better above `high`; "" if the curve ends there.
    """

    low: float
    high: float
    octaves: float
    most: float
    ended_by: str


class _Curve(NamedTuple):
    """The settings of a codec that are better than all smaller ones: log₂ of the bytes (N,) and quality (N,),
    both increasing."""

    log_bytes: np.ndarray
    quality: np.ndarray

    def bytes_for(self, quality: np.ndarray) -> np.ndarray:
        """Returns log₂ of the fewest bytes for at least this quality: linear between settings, ∞ above the
        best one, and the bytes of the smallest one below its quality."""
        needed = np.interp(quality, self.quality, self.log_bytes)
        return np.where(quality > self.quality[-1], math.inf, needed)


def leads(rows: Rows, quality: str, left_out: Sequence[str] = ()) -> Lead:
    """Returns the range of sizes in which ours needs no more bytes than every other codec.

    Args:
        rows: of one data set: codec, nbytes, and `quality`; higher is better, ∞ is lossless.
        quality: field of the rows.
        left_out: codecs to ignore, in addition to `MIXTURES`.

    Raises `InvalidArgumentError` if ours or all other codecs have no rows.
    """
    ignored = (*MIXTURES, *left_out)
    other_names = dict.fromkeys(row["codec"] for row in rows if row["codec"] not in ignored)
    own = _curve(rows, OURS, quality)
    others = {name: _curve(rows, name, quality) for name in other_names}
    if not len(own.quality) or not others:
        raise InvalidArgumentError(f"rows contain nothing of {OURS!r}, or of no other codec.")
    rate = np.linspace(own.log_bytes[0], own.log_bytes[-1], _N_SIZES)
    reached = np.interp(rate, own.log_bytes, own.quality)
    needed = np.stack([curve.bytes_for(reached) for curve in others.values()])
    margin = needed.min(0) - rate
    ahead = np.concatenate([[False], margin >= 0, [False]])
    starts, ends = np.flatnonzero(~ahead[:-1] & ahead[1:]), np.flatnonzero(ahead[:-1] & ~ahead[1:]) - 1
    if not len(starts):
        return Lead(math.nan, math.nan, 0.0, 1.0, list(others)[int(needed.min(1).argmin())])
    longest = int((rate[ends] - rate[starts]).argmax())
    first, last = int(starts[longest]), int(ends[longest])
    led = margin[first : last + 1]
    ended_by = list(others)[int(needed[:, last + 1].argmin())] if last + 1 < len(rate) else ""
    return Lead(
        low=float(2 ** rate[first]),
        high=float(2 ** rate[last]),
        octaves=float(rate[last] - rate[first]),
        most=float(2 ** led[np.isfinite(led)].max(initial=0.0)),
        ended_by=ended_by,
    )


def bytes_for(rows: Rows, codec: str, quality: str, value: float) -> float:
    """Returns the fewest bytes with which a codec reaches `value`; ∞ if it never does or has no rows."""
    curve = _curve(rows, codec, quality)
    return float(2 ** curve.bytes_for(np.array(value))) if len(curve.quality) else math.inf


def _curve(rows: Rows, codec: str, quality: str) -> _Curve:
    own = sorted((row for row in rows if row["codec"] == codec), key=lambda row: row["nbytes"])
    kept: list[tuple[float, float]] = []
    for row in own:
        if not kept or row[quality] > kept[-1][1]:
            kept.append((math.log2(row["nbytes"]), float(row[quality])))
    table = np.array(kept).reshape(-1, 2)
    return _Curve(table[:, 0], np.minimum(table[:, 1], 1e6))  # ∞ − ∞ is undefined


def figures(rows: Rows) -> dict[str, Figure]:
    """Draws `rate_distortion`: PSNR2 (top) and AUC (bottom) against bytes per frame, a column per data set.

    There is a line for each codec; qualities above the best octree are not shown. The range in which the
    mixture of this package leads is shaded. Depth images with fewer pixels do not count for PSNR2: its
    backward term is almost zero for a subset of the points.

    Args:
        rows: dataset, codec, nbytes, psnr2_db, auc.
    """
    names = list(dict.fromkeys(str(row["dataset"]) for row in rows))
    figure = new_figure(1.0 + 4.4 * len(names), 8.6)
    grid = figure.subplots(2, len(names), squeeze=False)
    for column, name in enumerate(names):
        own = [row for row in rows if row["dataset"] == name]
        for axes, (quality, y_label) in zip(grid[:, column], _Y_LABELS.items(), strict=True):
            _scale(axes, [float(row["nbytes"]) for row in own if row["codec"] in _LINES])
            _draw(axes, own, quality)
            heading = _TITLES.get(name, name) if quality == "psnr2_db" else ""
            label_axes(axes, heading, "bytes per frame", y_label if column == 0 else "")
    legend_below(figure, max_columns=4)
    figure_title(figure, "Quality of one frame against its bytes")
    return {"rate_distortion": figure}


def _draw(axes: Axes, rows: Rows, quality: str) -> None:
    finite = [row for row in rows if math.isfinite(row[quality])]
    for codec, (label, hue, mark, line_style) in _LINES.items():
        own = sorted((row for row in finite if row["codec"] == codec), key=lambda row: row["nbytes"])
        if own:
            axes.plot(
                [row["nbytes"] for row in own],
                [row[quality] for row in own],
                color=hue,
                marker=mark,
                linestyle=line_style,
                linewidth=2.6 if codec == OURS else 1.5,
                markersize=7 if codec == OURS else 5.5,
                label=label,
                zorder=4 if codec == OURS else 3,
            )
    left_out = ("depth_image_thinned",) if quality == "psnr2_db" else ()
    lead = leads(rows, quality, left_out)
    low = min(row[quality] for row in finite if row["codec"] in (OURS, "octree"))
    high = max(row[quality] for row in finite if row["codec"] in ((OURS, "octree") if left_out else _LINES))
    axes.set_ylim(low - 0.04 * (high - low), high + 0.22 * (high - low))
    draw_grid(axes)
    if lead.octaves:
        axes.axvspan(lead.low, lead.high, color=PALETTE[0], alpha=0.09, linewidth=0, zorder=0)
        axes.text(
            0.02,
            0.98,
            f"shaded: gmmtorch best{' of solid lines' if left_out else ''}, {lead.octaves:.1f} octaves",
            transform=axes.transAxes,
            va="top",
            fontsize=TICK_SIZE,
            color="#00507f",
        )


def _scale(axes: Axes, values: Sequence[float]) -> None:
    axes.set_xscale("log")
    axes.set_xlim(min(values) / 1.4, max(values) * 1.6)
    axes.xaxis.set_major_locator(LogLocator())
    tick_text(axes.xaxis, lambda value: byte_text(value, digits=1))
    axes.xaxis.set_minor_formatter(NullFormatter())


_TEAMS = {  # label, colour, marker
    "E0": ("mixture (gmmtorch)", PALETTE[0], "o"),
    "octree, contexts": ("octree, contexts", PALETTE[1], "s"),
    "octree, zstd": ("octree, zstd", PALETTE[5], "P"),
    "octree and counts, contexts": ("octree and counts, contexts", PALETTE[6], "X"),
    "Draco": ("Draco", PALETTE[2], "^"),
    "range image": ("range image, zstd", PALETTE[4], "v"),
}
_KNOWN = {"AUC": "AUC of the team's map", "entropy taken away (kbit)": "entropy taken away [kbit]"}


def knowledge_figure(rows: Rows) -> Figure:
    """Draws what a team knows against the bytes of its map, a line for each way to share it.

    Args:
        rows: of the table "shared-knowledge".
    """
    figure = new_figure(11.0, 5.0)
    for axes, (quality, y_label) in zip(figure.subplots(1, 2), _KNOWN.items(), strict=True):
        for name, (label, hue, mark) in _TEAMS.items():
            first, _, code = name.partition(", ")
            own = [
                (row["kB"], row[quality])
                for row in rows
                if str(row["shared"]).startswith(f"{first},") and str(row["shared"]).endswith(code)
            ]
            axes.plot(*zip(*sorted(own), strict=True), color=hue, marker=mark, label=label)
        axes.set_xlim(left=0)
        label_axes(axes, "", "kilobytes that the team sends of its map", y_label)
        draw_grid(axes)
    legend_below(figure, max_columns=3)
    figure_title(figure, "What a team knows against its bytes")
    return figure
