"""What of a mixture is left out so that one looks into rooms: ceilings, near walls, what is at them."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from gmmtorch.report.exploration.scene_renderer import Camera

_FLAT = 0.1  # largest ratio of the smallest variance to the next of what has a side
_TURNED_AWAY = -0.05  # cosine of the side that was seen and the viewer, below which a surface is left out
_OVERHEAD = -0.9  # vertical part of the side that was seen, below which a surface is overhead
_LEVEL = 0.9  # share of the height above which most of what is overhead is, if the ceiling is level
_CUT = 0.78  # share of the height at which a level ceiling is cut off, with what hangs from it
_N_NEAR = 7  # flat ones that say what a component belongs to
_MOST = 0.85  # share of these


def cut_away(
    mean: Tensor, covariance: Tensor, seen_from: Tensor | None, ceiling: float | None, camera: Camera
) -> tuple[Tensor, float]:
    """Which components (K,) stay, and the height (m) at which these are to be cut off.

    What goes is what has its mean above that height; flat ones that were seen from the side turned away from
    the viewer; and what is at such flat ones, at its mean or at either end: of what has no side where
    most of the nearest flat ones go, of what has one where all do.

    Args:
        mean, covariance: (K, 3), (K, 3, 3). seen_from: (K, 3), a place from which each was seen.
        ceiling: the height (m). If not given, a share of the height of all, but none where the ceiling that
            was seen is not level.
        camera: the viewer.
    """
    if len(mean) == 0:
        return torch.ones(0, dtype=torch.bool), math.inf
    if seen_from is None:
        top = _share_of_height(mean, _CUT) if ceiling is None else ceiling
        return mean[:, 2] <= top, top
    variances, directions = torch.linalg.eigh((covariance + covariance.mT) / 2)
    flat = variances[:, 0] < _FLAT * variances[:, 1]
    normal, longest = directions[:, :, 0], directions[:, :, 2]
    side = normal * ((seen_from - mean) * normal).sum(1, keepdim=True).sign()
    hides = flat & (side @ camera.axes[2] < _TURNED_AWAY)
    if ceiling is None:
        ceiling = _level_ceiling(mean, mean[flat & (side[:, 2] < _OVERHEAD), 2])
    end = 2 * longest * variances[:, 2:].clamp_min(0).sqrt()
    kept = (mean[:, 2] <= ceiling) & ~hides
    if bool(flat.any()):
        near = _share_near(torch.stack([mean, mean + end, mean - end]), mean[flat], hides[flat]).amax(0)
        kept &= near < torch.where(flat, 1.0, _MOST)
    return kept, ceiling


def _level_ceiling(mean: Tensor, overhead: Tensor) -> float:
    """Where to cut, if most heights (N,) of what is overhead are near the top; else nowhere."""
    level = len(overhead) and float(overhead.median()) >= _share_of_height(mean, _LEVEL)
    return _share_of_height(mean, _CUT) if level else math.inf


def _share_of_height(mean: Tensor, share: float) -> float:
    low, high = np.quantile(mean[:, 2].numpy(), [0.001, 0.999])
    return float(low + share * (high - low))


def _share_near(places: Tensor, flat: Tensor, hides: Tensor) -> Tensor:
    """Of the flat ones (F, 3) nearest to places (..., 3), the share (...) that hides (F,) the inside."""
    from scipy.spatial import cKDTree

    n = min(_N_NEAR, len(flat))
    _, near = cKDTree(flat.numpy()).query(places.numpy(), k=range(1, n + 1))
    return hides[torch.from_numpy(near)].double().mean(-1)
