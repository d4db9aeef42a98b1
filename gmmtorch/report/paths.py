"""Paths of robots: smooth curves through recorded poses, drawn on a map from above."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patheffects import Stroke

from gmmtorch.report import style
from gmmtorch.scan import ArrayLike

_N_BETWEEN = 12  # points per leg between two poses
_MAX_NAMED = len(style.PALETTE)  # robots with a colour of their own


def smooth_path(poses: ArrayLike) -> np.ndarray:
    """Returns points (M, 2 or 3) on a smooth path through poses (T, ≥ 2): x, y, z, yaw; metres, radians.

    Robots move along their heading and turn at a constant rate. Between two poses, x and y follow an arc: a
    cubic Hermite curve with tangents of length chord / cos²(Δyaw / 4). z is interpolated without overshoot.
    Legs against the heading, and legs of poses without yaw, are straight.
    """
    from scipy.interpolate import PchipInterpolator

    pose = style.as_array(poses)
    places = pose[:, :3]
    if len(pose) < 2:
        return places
    share = np.arange(_N_BETWEEN) / _N_BETWEEN
    legs = np.diff(pose[:, :2], axis=0)
    begin, end = _tangents(legs, pose[:, 3]) if pose.shape[1] > 3 else (legs, legs)
    s = share[None, :, None]
    flat = (
        pose[:-1, None, :2] * (1 + 2 * s) * (1 - s) ** 2
        + begin[:, None] * s * (1 - s) ** 2
        + pose[1:, None, :2] * (3 - 2 * s) * s**2
        - end[:, None] * s**2 * (1 - s)
    )
    flat = np.concatenate([flat.reshape(-1, 2), pose[-1:, :2]])
    if places.shape[1] < 3:
        return flat
    times = np.append((np.arange(len(pose) - 1)[:, None] + share).ravel(), len(pose) - 1.0)
    height = PchipInterpolator(np.arange(len(pose)), pose[:, 2])(times)
    return np.concatenate([flat, height[:, None]], 1)


def _tangents(legs: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the tangents at the begin and end of each leg (T − 1, 2): those of an arc, or the leg
    itself."""
    heading = np.stack([np.cos(yaw), np.sin(yaw)], 1)
    ahead = np.minimum((legs * heading[:-1]).sum(1), (legs * heading[1:]).sum(1)) > 0
    length = np.linalg.norm(legs, axis=1) / np.cos(np.diff(yaw) / 4) ** 2
    is_arc = ahead & (np.abs(np.diff(yaw)) < math.pi)
    begin, end = (np.where(is_arc[:, None], length[:, None] * u, legs) for u in (heading[:-1], heading[1:]))
    return begin, end


def draw_paths(
    axes: Axes,
    trajectories: Sequence[ArrayLike],
    band: tuple[float, float],
    *,
    ends: bool,
    width: float = 2.2,
) -> None:
    """Draws the path of each robot from above; parts outside the band of heights (m) have a white core.

    A triangle shows the last pose and its heading (a square, if poses have no heading), and with `ends` a
    disc the first pose. trajectories: poses (T, ≥ 2) of each robot, world metres. width: in points.
    """
    for robot, trajectory in enumerate(trajectories):
        poses = style.as_array(trajectory)
        if len(poses) == 0:
            continue
        for outside, part in _parts(smooth_path(poses), band):
            look = _path_look(style.colour(robot), style.line_style(robot), outside, width)
            axes.plot(*part.T, zorder=3, **look)
        mark: dict[str, Any] = {"color": style.colour(robot), "markeredgecolor": "#111111", "zorder": 5}
        if ends:
            axes.plot(*poses[0, :2], "o", markersize=9, **mark)
        last = "s" if poses.shape[1] < 4 else (3, 0, math.degrees(poses[-1, 3]) - 90)
        axes.plot(*poses[-1, :2], marker=last, markersize=12, linestyle="", **mark)


def path_handles(
    trajectories: Sequence[ArrayLike], band: tuple[float, float], ends: bool, traveller: str = "robot"
) -> list[Line2D]:
    """Returns legend entries for `draw_paths`: robots or other travellers, first and last poses, and heights
    outside the band."""
    handles = [
        Line2D(
            [],
            [],
            color=style.colour(i),
            linewidth=2.4,
            label=f"{traveller} {i}" if len(trajectories) > 1 else "path",
        )
        for i in range(min(len(trajectories), _MAX_NAMED))
    ]
    marks = (("o", "start"), ("^", "end")) if ends else (("^", "robot"),)
    if handles:
        look: dict[str, Any] = {"color": style.EDGE, "linestyle": "", "markersize": 8}
        handles += [Line2D([], [], marker=shape, label=name, **look) for shape, name in marks]
    heights = [style.as_array(poses)[:, 2] for poses in trajectories if np.shape(poses)[1] > 2]
    if any(((z < band[0]) | (z > band[1])).any() for z in heights):
        look = _path_look(style.EDGE, "-", outside=True)
        handles.append(Line2D([], [], label="path above or below these heights", **look))
    return handles


def _parts(path: np.ndarray, band: tuple[float, float]) -> list[tuple[bool, np.ndarray]]:
    """Splits a path into parts (N, 2) outside and inside the band, each up to the begin of the next."""
    if path.shape[1] < 3:
        return [(False, path)]
    outside = (path[:, 2] > band[1]) | (path[:, 2] < band[0])
    cuts = [0, *(np.flatnonzero(np.diff(outside)) + 1).tolist(), len(path)]
    return [(bool(outside[a]), path[a : b + 1, :2]) for a, b in pairwise(cuts) if a < b]


def _path_look(hue: str, line_style: str, outside: bool, width: float = 2.2) -> dict[str, Any]:
    effects = style.halo(width + 1.6)
    if outside:
        effects.append(Stroke(linewidth=0.36 * width, foreground="white"))
    return {
        "color": hue,
        "linewidth": width,
        "linestyle": line_style,
        "path_effects": effects,
        "solid_capstyle": "butt",
    }
