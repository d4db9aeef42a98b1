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
from gmmtorch.linalg import check_rigid

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
    return _errors(torch.linalg.solve(true, aligned(given, true, align)))


def relative_pose_error(estimate: ArrayLike, truth: ArrayLike, delta: int = 1) -> PoseErrors:
    """Errors of the motions between poses i and i + delta, for every i: evo's `--all_pairs`, in frames.

    Args:
        estimate, truth: poses (N, D+1, D+1) of the same times, N above `delta`. Their frames may differ.
    """
    check_whole("delta", delta, 1)
    given, true = _checked(estimate, truth, delta + 1)
    moved, expected = (torch.linalg.solve(poses[:-delta], poses[delta:]) for poses in (given, true))
    return _errors(torch.linalg.solve(expected, moved))


def aligned(estimate: ArrayLike, truth: ArrayLike, align: Alignment = "rigid") -> Tensor:
    """The estimated poses (N, D+1, D+1), moved as a whole towards the true ones.

    align: none: both have one frame, as in localisation. first: the first poses coincide. rigid: the motion
    that minimises the squares of the distances between positions (Umeyama 1991).

    Raises `InvalidArgumentError` for poses of other shapes, for poses that are not rigid, and for `rigid` if
    the positions lie on a line (in 2D, in a point), so that they determine no rotation.
    """
    check_choice("align", align, ALIGNMENTS)
    given, true = _checked(estimate, truth, 1)
    if align == "none":
        return given
    if align == "first":
        return true[0] @ torch.linalg.solve(given[0], given)
    return _umeyama(given[:, :-1, -1], true[:, :-1, -1]) @ given


def _umeyama(positions: Tensor, true: Tensor) -> Tensor:
    """The motion (D+1, D+1) that lays positions (N, D) over the true ones with the least squares."""
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
    found = torch.eye(dim + 1).to(positions)
    found[:dim, :dim] = left @ (flip[:, None] * right)
    found[:dim, dim] = true_center - found[:dim, :dim] @ center
    return found


def _errors(motions: Tensor) -> PoseErrors:
    """Lengths and angles of motions (N, D+1, D+1); ‖R − I‖_F = 2√2 sin(angle/2) is exact near zero."""
    turned = motions[:, :-1, :-1] - torch.eye(motions.shape[1] - 1).to(motions)
    half = torch.linalg.matrix_norm(turned) / math.sqrt(8)
    return PoseErrors(motions[:, :-1, -1].norm(dim=1), 2 * half.clamp_max(1).asin())


def _checked(estimate: ArrayLike, truth: ArrayLike, least: int) -> tuple[Tensor, Tensor]:
    """Both trajectories in float64 on one device."""
    given = as_tensor(estimate, "estimate", torch.float64).detach()
    true = as_tensor(truth, "truth", torch.float64, given.device).detach()
    if given.shape != true.shape or given.ndim != 3 or given.shape[1:] not in ((3, 3), (4, 4)):
        raise InvalidArgumentError(
            f"estimate has shape {tuple(given.shape)} and truth {tuple(true.shape)}; expected poses "
            "(N, D+1, D+1) of the same N times in both."
        )
    if len(given) < least:
        raise InvalidArgumentError(f"estimate has {len(given)} poses; expected at least {least}.")
    for name, poses in (("estimate", given), ("truth", true)):
        for pose in poses[_worst(poses)[None]]:
            check_rigid(pose, poses.shape[1] - 1, name)
    return given, true


def _worst(poses: Tensor) -> Tensor:
    """The index of the pose that is least rigid; of a NaN, if there is one."""
    turn, eye = poses[:, :-1, :-1], torch.eye(poses.shape[1]).to(poses)
    off = (turn @ turn.mT - eye[:-1, :-1]).abs().amax((1, 2)) + (poses[:, -1] - eye[-1]).abs().amax(1)
    off = off + (torch.linalg.det(turn) < 0)
    finite = torch.isfinite(poses).flatten(1).all(1)
    return torch.where(finite, off, torch.inf).argmax()
