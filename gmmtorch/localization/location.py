"""Location: the pose of a scan, how sure it is, and reasons against it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gmmtorch.localization.rigid_motions import generators

UNSEEN = 10.0
"""Metres of standard deviation of a direction that no surface fixes."""

CORRELATED = 10.0
"""Points that share one error, that of their component (measured on a hall and an office)."""


@dataclass(frozen=True, eq=False)
class Location:
    """The pose of a scan in a map.

    pose: (D+1, D+1), map ← sensor, float64, metres.
    covariance: (F, F) of the pose's error, a shift v (m, in the frame of the map) and a turn ω (rad) about
        the sensor, F = D + D(D−1)/2. No direction has a standard deviation above 10 m.
    explained: share of the points that lie on surfaces of the map.
    doubts: reasons against the pose; the sensor is `found` if there are none.
    """

    pose: Tensor
    covariance: Tensor
    explained: float
    doubts: tuple[str, ...]

    @property
    def found(self) -> bool:
        """Whether there are no doubts."""
        return not self.doubts


def pose_covariance(information: Tensor, rows: Tensor) -> tuple[Tensor, float]:
    """The covariance (F, F) of a pose, and the largest standard deviation (m) at the median range."""
    dim = rows.shape[1]
    scale = information.new_ones(len(information))
    scale[dim:] = 1 / rows.norm(dim=1).median().clamp_min(1e-3)
    values, axes = torch.linalg.eigh(information * scale[:, None] * scale)
    variances = CORRELATED / values.clamp_min(CORRELATED / UNSEEN**2)
    inner = axes @ (variances[:, None] * axes.mT)
    return inner * scale[:, None] * scale, float(variances.max().sqrt())


def composed(first: Location, then: Location) -> Location:
    """A location `then`, whose map's frame is the sensor's frame of `first`, in the map of `first`.

    The errors of both are independent.
    """
    dim = len(first.pose) - 1
    rotation = first.pose[:dim, :dim]
    turned = torch.eye(len(then.covariance), dtype=torch.float64)
    turned[:dim, :dim] = rotation
    if dim == 3:
        turned[3:, 3:] = rotation
    lever = torch.eye(len(turned), dtype=torch.float64)  # an error of the first turn shifts later poses
    lever[:dim, dim:] = (generators(dim) @ (rotation @ then.pose[:dim, dim])).mT
    covariance = turned @ then.covariance @ turned.mT + lever @ first.covariance @ lever.mT
    return replace(then, pose=first.pose @ then.pose, covariance=covariance)
