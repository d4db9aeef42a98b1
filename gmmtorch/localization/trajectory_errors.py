"""Errors of an estimated trajectory against the true one: ATE and RPE, as the program evo defines them.

With true poses Q_i and estimated poses P_i, world ← sensor (Sturm et al. 2012):

- absolute trajectory error: E_i = Q_i⁻¹ S P_i, with S the motion that lays the estimate over the truth;
- relative pose error over d poses: E_i = (Q_i⁻¹ Q_{i+d})⁻¹ (P_i⁻¹ P_{i+d}).

The error of a pose is the length of the translation of E_i, and the angle of its rotation.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError, check_choice, check_whole
from gmmtorch.pose import Pose

Alignment = Literal["none", "first", "rigid"]
ALIGNMENTS: tuple[Alignment, ...] = ("none", "first", "rigid")
UNSCORED = {
    f"{error}{kind}": None for error in ("ate", "rpe") for kind in ("", "_median", "_max", "_degrees")
}
"""The fields of `PoseErrors.scores` of both errors, for poses without a truth."""
_DEGENERATE = 1e-9  # of the largest singular value: below, positions lie on a line


class PoseErrors(NamedTuple):
    """Errors of N poses: distances (N,), metres, and angles (N,), radians; float64."""

    distances: Tensor
    angles: Tensor

    @property
    def rmse(self) -> float:
        """Root of the mean square of the distances, metres: "the" ATE or RPE."""
        return float(self.distances.square().mean().sqrt())

    def scores(self, name: str) -> dict[str, float]:
        """Numbers for results.json: NAME (RMSE), NAME_median and NAME_max in metres, NAME_degrees (RMSE)."""
        return {
            name: self.rmse,
            f"{name}_median": float(self.distances.quantile(0.5)),
            f"{name}_max": float(self.distances.max()),
            f"{name}_degrees": math.degrees(float(self.angles.square().mean().sqrt())),
        }


def absolute_trajectory_error(
    estimate: ArrayLike, truth: ArrayLike, align: Alignment = "rigid"
) -> PoseErrors:
    """Errors of poses (N, D+1, D+1) against the true poses of the same times, after `aligned`."""
    given, true = _checked(estimate, truth, 1)
    return _errors(true.inverse() @ _aligned(given, true, align))


def relative_pose_error(estimate: ArrayLike, truth: ArrayLike, delta: int = 1) -> PoseErrors:
    """Errors of the motions between poses i and i + delta, for every i: evo's `--all_pairs`, in frames.

    Args:
        estimate, truth: poses (N, D+1, D+1) of the same times, N above `delta`. Their frames may differ.
    """
    check_whole("delta", delta, 1)
    given, true = _checked(estimate, truth, delta + 1)
    moved, expected = (poses[:-delta].inverse() @ poses[delta:] for poses in (given, true))
    return _errors(expected.inverse() @ moved)


def aligned(estimate: ArrayLike, truth: ArrayLike, align: Alignment = "rigid") -> Tensor:
    """The estimated poses (N, D+1, D+1), moved as a whole towards the true ones.

    align: none: both have one frame, as in localisation. first: the first poses coincide. rigid: the motion
    that minimises the squares of the distances between positions (Umeyama 1991).

    Raises `InvalidArgumentError` for poses of other shapes, for poses that are not rigid, and for `rigid` if
    the positions lie on a line (in 2D, in a point), so that they determine no rotation.
    """
    return _aligned(*_checked(estimate, truth, 1), align).matrix


def _aligned(given: Pose, true: Pose, align: Alignment) -> Pose:
    check_choice("align", align, ALIGNMENTS)
    if align == "none":
        return given
    if align == "first":
        return true[0] @ given[0].inverse() @ given
    return _umeyama(given.translation, true.translation) @ given


def _umeyama(positions: Tensor, true: Tensor) -> Pose:
    """The motion that lays positions (N, D) over the true ones with the least squares."""
    dim = positions.shape[1]
    center, true_center = positions.mean(0), true.mean(0)
    left, values, right = torch.linalg.svd((true - true_center).T @ (positions - center))
    if not bool(values[dim - 2] > _DEGENERATE * max(float(values[0]), _DEGENERATE)):
        raise InvalidArgumentError(
            f"align='rigid': the {len(positions)} positions lie on a line or in a point and determine no "
            "rotation; use align='first' or align='none'."
        )
    flip = torch.ones_like(values)
    flip[-1] = torch.linalg.det(left @ right).sign()
    turn = left @ (flip[:, None] * right)
    return Pose(turn, true_center - turn @ center)


def _errors(motions: Pose) -> PoseErrors:
    return PoseErrors(motions.translation.norm(dim=1), motions.angle())


def _checked(estimate: ArrayLike, truth: ArrayLike, least: int) -> tuple[Pose, Pose]:
    """Both trajectories on one device."""
    given = as_tensor(estimate, "estimate", torch.float64).detach()
    true = as_tensor(truth, "truth", torch.float64, given.device).detach()
    if given.shape != true.shape or given.ndim != 3 or given.shape[1:] not in ((3, 3), (4, 4)):
        raise InvalidArgumentError(
            f"estimate has shape {tuple(given.shape)} and truth {tuple(true.shape)}; expected poses "
            "(N, D+1, D+1) of the same N times in both."
        )
    if len(given) < least:
        raise InvalidArgumentError(f"estimate has {len(given)} poses; expected at least {least}.")
    n, dim = len(given), given.shape[1] - 1
    return Pose.checked(given, dim, "estimate", n=n), Pose.checked(true, dim, "truth", n=n)
