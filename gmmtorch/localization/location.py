"""Location: the pose of a scan, how sure it is, and reasons against it; and predictions of the next one."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.localization.pose_search import CORRELATED
from gmmtorch.pose import Pose, skew

UNSEEN = 10.0
"""Metres of standard deviation of a direction that no surface fixes."""


@dataclass(frozen=True, eq=False)
class Location:
    """The pose of a scan in a map.

    pose: (D+1, D+1), map ← sensor, float64, metres.
    covariance: (F, F) of the pose's error, a shift v (m, in the frame of the map) and a turn ω (rad) about
        the sensor, F = D + D(D−1)/2. No direction has a standard deviation above 10 m.
    explained: share of the points that lie on surfaces of the map.
    doubts: reasons against the pose; the sensor is `found` if there are none.
    probability: that the pose is right; NaN if it is not estimated.
    """

    pose: Tensor
    covariance: Tensor
    explained: float
    doubts: tuple[str, ...]
    probability: float = math.nan

    @property
    def found(self) -> bool:
        """Whether there are no doubts."""
        return not self.doubts


def pose_covariance(information: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Covariances (…, F, F) of poses, and the largest standard deviations (…), m, at the median range."""
    dim = rows.shape[1]
    scale = information.new_ones(information.shape[-1])
    scale[dim:] = 1 / rows.norm(dim=1).median().clamp_min(1e-3)
    values, axes = torch.linalg.eigh(information * scale[:, None] * scale)
    variances = CORRELATED / values.clamp_min(CORRELATED / UNSEEN**2)
    inner = axes @ (variances[..., None] * axes.mT)
    return inner * scale[:, None] * scale, variances.amax(-1).sqrt()


def composed(first: Location, then: Location) -> Location:
    """A location `then`, whose map's frame is the sensor's frame of `first`, in the map of `first`.

    The errors of both are independent.
    """
    before, after = Pose.from_matrix(first.pose), Pose.from_matrix(then.pose)
    turned = Pose(before.rotation, torch.zeros_like(before.translation)).adjoint()
    still = torch.eye(before.dim, dtype=torch.float64)
    lever = Pose(still, -(before.rotation @ after.translation)).adjoint()  # an error of the first turn shifts
    covariance = turned @ then.covariance @ turned.mT + lever @ first.covariance @ lever.mT
    return replace(then, pose=(before @ after).matrix, covariance=covariance)


def measured_motion(motion: ArrayLike, dim: int, device: torch.device) -> Pose | Tensor:
    """A motion (D+1, D+1), or its rotation (D, D) alone, as a tensor. Raises `InvalidArgumentError`."""
    matrix = as_tensor(motion, "motion", torch.float64, device).detach().clone()
    if tuple(matrix.shape) == (dim, dim):
        return Pose.checked(_turned(matrix).matrix, dim, "motion").rotation
    return Pose.checked(matrix, dim, "motion")


def continued(rotation: Tensor, last: Pose | None, ratio: float = 1.0) -> Pose:
    """The motion with a measured rotation (D, D) at the velocity of the last one, if it is known.

    The velocity v in the frame of the sensor stays, and takes effect while the sensor turns by ω: the
    translation is t = J(ω) v with J(ω) = ∫₀¹ exp(s [ω]) ds. `ratio`: how many times longer than the last
    motion this one takes.
    """
    if last is None:
        return _turned(rotation)
    velocity = torch.linalg.solve(_mean_rotation(last.rotation), last.translation)
    return Pose(rotation, ratio * _mean_rotation(rotation) @ velocity)


def _turned(rotation: Tensor) -> Pose:
    """The motion with this rotation (D, D) and no translation."""
    return Pose(rotation, rotation.new_zeros(len(rotation)))


def _mean_rotation(rotation: Tensor) -> Tensor:
    """J(ω) (D, D) of a rotation (D, D) by ω: a block of exp [[ω] I; 0 0]."""
    dim = len(rotation)
    block = torch.zeros(2 * dim, 2 * dim).double()
    block[:dim, :dim] = skew(_turned(rotation).turn().cpu())
    block[:dim, dim:] = torch.eye(dim)
    return torch.linalg.matrix_exp(block)[:dim, dim:].to(rotation)
