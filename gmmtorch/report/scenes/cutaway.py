"""Selects the components to leave out of a scene so that the inside of rooms is visible.

These are ceilings, near walls, and what is attached to them.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from gmmtorch.mapping.components import Components
from gmmtorch.report.scenes.ellipsoids import N_SIGMA, principal_axes
from gmmtorch.report.scenes.scene_renderer import Camera

_FLAT = 0.1  # largest ratio of the two smallest variances of a flat component
_BACK_FACE = -0.05  # largest cosine between the observed side and the viewer of a surface that is left out
_OVERHEAD = -0.9  # largest vertical part of the observed side of a surface that is overhead
_LEVEL = 0.9  # share of the height above which the median of overhead surfaces lies if the ceiling is level
_CUT = 0.78  # share of the height at which a level ceiling is cut off, with what hangs from it
_N_NEIGHBOURS = 7  # nearest flat components, which say what a component is attached to
_MAX_SHARE = 0.85  # share of these that is left out, above which a component without a side is left out too


def first_viewpoints(components: Components) -> Tensor:
    """Returns the first sensor origin (K, D) that observed each component, metres."""
    first = components.seen_from.new_zeros(len(components))
    first[components.seen_by.flip(0)] = components.seen_from.flip(0)
    return components.origins[first]


def cut_away(
    mean: Tensor, covariance: Tensor, seen_from: Tensor | None, ceiling: float | None, camera: Camera
) -> tuple[Tensor, float]:
    """Returns which components to draw (K,), and the height (m) above which to cut these off.

    Leaves out components with means above that height, flat components that were observed from the side that
    faces away from the viewer, and components attached to such surfaces. A component is attached if most of
    its nearest flat neighbours, at its mean or at either end, are left out; a flat one, if all are.

    Args:
        mean: (K, 3), metres.
        covariance: (K, 3, 3), m².
        seen_from: (K, 3), a sensor origin that observed each; if None, only the height counts.
        ceiling: the height (m); if None, a share of the total height, or ∞ if the observed ceiling is not
            level.
        camera: the viewer.
    """
    if len(mean) == 0:
        return torch.ones(0, dtype=torch.bool), math.inf
    if seen_from is None:
        top = _share_of_height(mean, _CUT) if ceiling is None else ceiling
        return mean[:, 2] <= top, top
    deviations, directions = principal_axes(covariance)
    flat = deviations[:, 0] ** 2 < _FLAT * deviations[:, 1] ** 2
    normal, longest = directions[:, :, 0], directions[:, :, 2]
    side = normal * ((seen_from - mean) * normal).sum(1, keepdim=True).sign()
    hides = flat & (side @ camera.axes[2] < _BACK_FACE)
    if ceiling is None:
        ceiling = _level_ceiling(mean, mean[flat & (side[:, 2] < _OVERHEAD), 2])
    end = N_SIGMA * longest * deviations[:, 2:]
    kept = (mean[:, 2] <= ceiling) & ~hides
    if bool(flat.any()):
        places = torch.stack([mean, mean + end, mean - end])
        share = _hidden_share(places, mean[flat], hides[flat]).amax(0)
        kept &= share < torch.where(flat, 1.0, _MAX_SHARE)
    return kept, ceiling


def _level_ceiling(mean: Tensor, overhead: Tensor) -> float:
    """Returns the height of the cut if the heights (N,) of overhead surfaces form a level ceiling, else ∞."""
    level = len(overhead) and float(overhead.median()) >= _share_of_height(mean, _LEVEL)
    return _share_of_height(mean, _CUT) if level else math.inf


def _share_of_height(mean: Tensor, share: float) -> float:
    low, high = np.quantile(mean[:, 2].numpy(), [0.001, 0.999])
    return float(low + share * (high - low))


def _hidden_share(places: Tensor, flat: Tensor, hides: Tensor) -> Tensor:
    """Returns the share (...) of hiding ones, `hides` (F,), among the flat components (F, 3) nearest to each
    place (..., 3)."""
    from scipy.spatial import cKDTree

    n = min(_N_NEIGHBOURS, len(flat))
    _, near = cKDTree(flat.numpy()).query(places.numpy(), k=range(1, n + 1))
    return hides[torch.from_numpy(near)].double().mean(-1)
