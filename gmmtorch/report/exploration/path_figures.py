"""Paths of robots from above: smooth between the poses that are kept, and lighter where they pass over."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke

from gmmtorch.report.style import as_array, colour, line_style, metres
from gmmtorch.scan import ArrayLike

_N_BETWEEN = 12  # places that a leg between two poses is drawn with
_MAX_NAMED = 7
_EDGE, _RIM = "#666666", "#111111"
_OVER, _IN, _UNDER = 1, 0, -1


def smooth_path(poses: ArrayLike) -> np.ndarray:
    """Places (M, 2 or 3) along the way through poses (T, ≥ 2): x, y, z, yaw; metres, radians.

    Robots fly along their heading, and turn evenly: from one pose to the next x and y follow an arc, as a
    cubic (Hermite's) whose tangents have the length chord / cos²(Δyaw / 4), and z does not overshoot. Legs
    that lead against the heading are straight, and those of poses without yaw.
    """
    from scipy.interpolate import PchipInterpolator

    pose = as_array(poses)
    places = pose[:, :3]
    if len(pose) < 2:
        return places
    share = np.arange(_N_BETWEEN) / _N_BETWEEN
    when = np.append((np.arange(len(pose) - 1)[:, None] + share).ravel(), len(pose) - 1.0)
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
    height = PchipInterpolator(np.arange(len(pose)), pose[:, 2])(when)
    return np.concatenate([flat, height[:, None]], 1)


def _tangents(legs: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each leg (T − 1, 2), where it begins and ends: of an arc, or the leg itself."""
    heading = np.stack([np.cos(yaw), np.sin(yaw)], 1)
    ahead = np.minimum((legs * heading[:-1]).sum(1), (legs * heading[1:]).sum(1)) > 0
    length = np.linalg.norm(legs, axis=1) / np.cos(np.diff(yaw) / 4) ** 2
    turned = ahead & (np.abs(np.diff(yaw)) < math.pi)
    begin, end = (np.where(turned[:, None], length[:, None] * u, legs) for u in (heading[:-1], heading[1:]))
    return begin, end


def draw_paths(
    axes: Axes,
    trajectories: Sequence[ArrayLike],
    band: tuple[float, float],
    *,
    ends: bool,
    width: float = 2.2,
) -> None:
    """Each robot's path, with a white core where it is above the band of heights (m), dotted beneath it.

    A triangle towards its heading, if poses have one, is where the robot is; `ends`: a disc where it began.
    `width` of the lines, points.
    """
    for robot, trajectory in enumerate(trajectories):
        poses = as_array(trajectory)
        if len(poses) == 0:
            continue
        for level, part in _parts(smooth_path(poses), band):
            axes.plot(*part.T, zorder=3, **_look(colour(robot), line_style(robot), level, width))
        mark: dict[str, Any] = {
            "color": colour(robot),
            "markeredgecolor": _RIM,
            "markeredgewidth": 0.9,
            "zorder": 5,
        }
        if ends:
            axes.plot(*poses[0, :2], "o", markersize=9, **mark)
        last = "s" if poses.shape[1] < 4 else (3, 0, math.degrees(poses[-1, 3]) - 90)
        axes.plot(*poses[-1, :2], marker=last, markersize=12, linestyle="", **mark)


def path_handles(trajectories: Sequence[ArrayLike], band: tuple[float, float], ends: bool) -> list[Line2D]:
    """Legend entries: robots, as many as have colours of their own; where they are; how high they flew."""
    handles = [
        Line2D([], [], color=colour(i), linewidth=2.4, label=f"robot {i}")
        for i in range(min(len(trajectories), _MAX_NAMED))
    ]
    marks = (("o", "start"), ("^", "end")) if ends else (("^", "robot, now"),)
    if handles:
        look: dict[str, Any] = {"color": _EDGE, "linestyle": "", "markersize": 8}
        handles += [Line2D([], [], marker=shape, label=name, **look) for shape, name in marks]
    paths = [as_array(poses)[:, :3] for poses in trajectories if len(poses)]
    found = {level for path in paths for level, _ in _parts(path, band)}
    heights = ((_OVER, f"path above {metres(band[1])}"), (_UNDER, f"path below {metres(band[0])}"))
    handles += [
        Line2D([], [], label=text, **_look(_EDGE, "-", level)) for level, text in heights if level in found
    ]
    return handles


def _parts(path: np.ndarray, band: tuple[float, float]) -> list[tuple[int, np.ndarray]]:
    """Parts (N, 2) of a path that are above, in or beneath the band, each to where the next begins."""
    if path.shape[1] < 3:
        return [(_IN, path)]
    level = (path[:, 2] > band[1]).astype(np.int64) - (path[:, 2] < band[0])
    cuts = [0, *(np.flatnonzero(np.diff(level)) + 1).tolist(), len(path)]
    return [(int(level[a]), path[a : b + 1, :2]) for a, b in pairwise(cuts) if a < b]


def _look(hue: str, style: str, level: int, width: float = 2.2) -> dict[str, Any]:
    effects = [Stroke(linewidth=width + 1.6, foreground="white"), Normal()]
    if level == _OVER:
        effects.append(Stroke(linewidth=0.36 * width, foreground="white"))
    return {
        "color": hue,
        "linewidth": width,
        "linestyle": ":" if level == _UNDER else style,
        "path_effects": effects,
        "solid_capstyle": "butt",
    }
