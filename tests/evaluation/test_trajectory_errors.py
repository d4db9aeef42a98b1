"""Errors of trajectories: evo's numbers, a brute-force alignment, and invariances."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.localization.trajectory_errors import absolute_trajectory_error, aligned, relative_pose_error


def pose(x: float, y: float, z: float, *turn: float) -> Tensor:
    matrix = torch.eye(4).double()
    matrix[:3, :3] = torch.from_numpy(Rotation.from_rotvec(turn).as_matrix())
    matrix[:3, 3] = torch.tensor([x, y, z])
    return matrix


def spiral(n: int = 20) -> tuple[Tensor, Tensor]:
    """An estimated and a true trajectory (N, 4, 4), without random numbers."""
    truth = [pose(3 * math.cos(0.3 * i), 3 * math.sin(0.3 * i), 0.1 * i, 0, 0, 0.3 * i) for i in range(n)]
    noise = [pose(0.1 * math.sin(i), 0.05 * math.cos(2 * i), 0.02 * i, 0.01 * i, 0, 0.03) for i in range(n)]
    moved = pose(5, -2, 1, 0.2, -0.1, 1.1)
    return moved @ torch.stack(truth) @ torch.stack(noise), torch.stack(truth)


# From `evo_ape tum truth.tum estimate.tum [-a | --align_origin]`, also with `-r angle_rad`, and
# `evo_rpe … --delta D --all_pairs`, of evo 1.38.1 on `spiral()`: RMSE and largest
# value (m), RMSE and largest angle (rad).
EVO_APE = {
    "none": (6.511439, 8.701144, 1.156990, 1.201606),
    "first": (0.255728, 0.383618, 0.111126, 0.189993),
    "rigid": (0.103800, 0.180513, 0.119668, 0.230611),
}
EVO_RPE = {1: (0.123638, 0.194012, 0.034205, 0.056091), 5: (0.249855, 0.400160, 0.146849, 0.227759)}


@pytest.mark.parametrize("align", EVO_APE)
def test_absolute_error_is_that_of_evo(align):
    found = absolute_trajectory_error(*spiral(), align=align)
    assert_as_evo(found, EVO_APE[align])


@pytest.mark.parametrize("delta", EVO_RPE)
def test_relative_error_is_that_of_evo(delta):
    assert_as_evo(relative_pose_error(*spiral(), delta=delta), EVO_RPE[delta])


def assert_as_evo(found, numbers) -> None:
    angles = found.angles.square().mean().sqrt(), found.angles.max()
    given = [found.rmse, float(found.distances.max()), *map(float, angles)]
    np.testing.assert_allclose(given, numbers, atol=2e-6)


@pytest.mark.parametrize("dim", [2, 3])
def test_alignment_is_the_least_squares_motion(dim):
    generator = torch.Generator().manual_seed(dim)
    estimate = torch.eye(dim + 1).double().repeat(12, 1, 1)
    truth = estimate.clone()
    estimate[:, :dim, dim] = torch.randn(12, dim, generator=generator).double()
    truth[:, :dim, dim] = torch.randn(12, dim, generator=generator).double()

    def cost(free: np.ndarray) -> float:
        turn = free[dim:] if dim == 3 else np.array([0, 0, free[2]])
        rotation = Rotation.from_rotvec(turn).as_matrix()[:dim, :dim]
        moved = estimate[:, :dim, dim].numpy() @ rotation.T + free[:dim]
        return float(((moved - truth[:, :dim, dim].numpy()) ** 2).sum())

    starts = [np.r_[np.zeros(dim), turn] for turn in Rotation.random(20, rng=0).as_rotvec()]
    starts = starts if dim == 3 else [np.array([0, 0, turn]) for turn in np.arange(0, 6, 0.5)]
    best = min(minimize(cost, start, tol=1e-14).fun for start in starts)
    found = absolute_trajectory_error(estimate, truth)
    assert found.rmse == pytest.approx(math.sqrt(best / 12), rel=1e-6)


def test_a_planar_trajectory_has_the_errors_of_its_copy_in_space(generator):
    flat, deep = [], []
    path = torch.randn(3, 9, generator=generator).double()
    for off in (0.0, 0.1):  # more, and half a turn about an axis of the plane could fit better
        x, y, turn = path + off * torch.randn(3, 9, generator=generator).double()
        deep.append(torch.stack([pose(*row[:2], 0, 0, 0, row[2]) for row in zip(x, y, turn, strict=True)]))
        flat.append(deep[-1][:, [0, 1, 3]][:, :, [0, 1, 3]])
    for errors in (absolute_trajectory_error, relative_pose_error):
        for some, other in zip(errors(*flat), errors(*deep), strict=True):
            torch.testing.assert_close(some, other)


def test_the_errors_of_the_truth_are_zero_in_any_frame():
    _, truth = spiral()
    moved = pose(400e3, 5e6, 30, 1, 2, 3) @ truth
    assert absolute_trajectory_error(moved, truth).rmse < 1e-6
    assert relative_pose_error(moved, truth).scores("rpe")["rpe_max"] < 1e-6
    torch.testing.assert_close(aligned(moved, truth, "first"), truth, atol=1e-6, rtol=0)


def test_errors_name_the_argument():
    estimate, truth = spiral()
    line = torch.eye(4).double().repeat(5, 1, 1)
    line[:, 0, 3] = torch.arange(5)
    with pytest.raises(InvalidArgumentError, match=r"line.*align='first'"):
        absolute_trajectory_error(line, line)
    assert absolute_trajectory_error(line, line, "first").rmse == 0
    with pytest.raises(InvalidArgumentError, match=r"\(19, 4, 4\).*\(20, 4, 4\)"):
        absolute_trajectory_error(estimate[1:], truth)
    with pytest.raises(InvalidArgumentError, match="align='scale' is not one of none, first, rigid"):
        absolute_trajectory_error(estimate, truth, "scale")
    with pytest.raises(InvalidArgumentError, match="at least 21"):
        relative_pose_error(estimate, truth, 20)
    with pytest.raises(InvalidArgumentError, match="delta=0"):
        relative_pose_error(estimate, truth, 0)
    with pytest.raises(InvalidArgumentError, match="0 poses"):
        absolute_trajectory_error(estimate[:0], truth[:0])
    with pytest.raises(InvalidArgumentError, match=r"truth.*not rigid"):
        absolute_trajectory_error(
            estimate, torch.where(torch.arange(20)[:, None, None] == 7, math.nan, truth)
        )
