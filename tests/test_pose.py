"""Pose against SciPy's Rotation and Slerp, and against 4 × 4 matrices."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pretended_gpu import pretended_gpu
from scipy.linalg import polar
from scipy.spatial.transform import Rotation, Slerp

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.pose import Pose, generators, skew

ANGLES = st.one_of(
    st.floats(-math.pi, math.pi), st.sampled_from([0.0, 1e-12, 1e-5, -1e-4, 3.1415926, math.pi])
)


@st.composite
def batches(draw: st.DrawFn, dim: int | None = None) -> Pose:
    """A few poses, many with turns near 0 or π."""
    dim = draw(st.sampled_from([2, 3])) if dim is None else dim
    generator = torch.Generator().manual_seed(draw(st.integers(0, 10**6)))
    angles = torch.tensor(draw(st.lists(ANGLES, min_size=1, max_size=4)), dtype=torch.float64)
    shifts = torch.randn(len(angles), dim, dtype=torch.float64, generator=generator) * 10
    if dim == 2:
        return Pose.from_yaw(angles, shifts)
    axes = torch.nn.functional.normalize(torch.randn(len(angles), 3, generator=generator).double(), dim=1)
    axes = torch.where(torch.rand(len(angles), 1, generator=generator) < 0.3, axes.round(), axes)
    axes = torch.nn.functional.normalize(axes + (axes.norm(dim=1, keepdim=True) == 0).double(), dim=1)
    turns = Rotation.from_rotvec((axes * angles[:, None]).numpy()).as_matrix()
    return Pose(torch.from_numpy(turns), shifts)


def close(found: torch.Tensor, expected: object, tolerance: float = 1e-12) -> None:
    np.testing.assert_allclose(found.numpy(), np.asarray(expected), rtol=0, atol=tolerance)


@given(batches(), st.integers(0, 10**6))
def test_composition_inverse_and_application_are_those_of_matrices(pose, seed):
    matrix = pose.matrix.numpy()
    other = Pose.from_matrix(torch.from_numpy(np.linalg.inv(matrix[:1])))
    close((pose @ other).matrix, matrix @ other.matrix.numpy(), 1e-11)
    close(pose.inverse().matrix, np.linalg.inv(matrix), 1e-11)
    points = torch.randn(5, pose.dim, generator=torch.Generator().manual_seed(seed)).double()
    expected = np.einsum("bij,nj->bni", matrix[:, :-1, :-1], points.numpy()) + matrix[:, None, :-1, -1]
    close(pose.apply(points), expected, 1e-11)
    assert pose.apply(points.float()).dtype == torch.float32
    again = Pose.checked(pose.matrix, pose.dim, n=len(pose))
    assert torch.equal(again.matrix, pose.matrix)
    assert torch.equal(Pose.cat([pose[:1], pose[1:]]).matrix, pose.matrix)
    assert torch.equal(Pose.stack([pose[i] for i in range(len(pose))]).matrix, pose.matrix)


@given(batches(3))
def test_quaternions_and_turns_equal_scipys(pose):
    rotation = Rotation.from_matrix(pose.rotation.numpy())
    close(pose.quaternion(), rotation.as_quat())
    close(Pose.from_turn(pose.turn()).rotation, pose.rotation.numpy(), 1e-11)
    close(pose.angle(), rotation.magnitude(), 1e-7)  # near π, the angle is as exact as the root of a rounding
    small = pose.angle() < 3
    close(pose.turn()[small], rotation.as_rotvec()[small.numpy()], 1e-11)
    back = Pose.from_quaternion(pose.translation, 3 * pose.quaternion())
    close(back.matrix, pose.matrix.numpy())
    random = Rotation.random(4, random_state=int(pose.translation[0, 0].abs() * 1e6))
    close(Pose.from_quaternion(np.zeros((4, 3)), random.as_quat()).rotation, random.as_matrix())


@given(batches(3), st.floats(0, 1))
def test_poses_between_two_are_linear_in_position_and_slerp_in_rotation(pose, share):
    first, last = pose[:1], pose[-1:]
    found = first.towards(last, share)
    both = Rotation.from_matrix(torch.cat([first.rotation, last.rotation]).numpy())
    expected = Slerp([0, 1], both)(share).as_matrix()[None]
    if float((first.inverse() @ last).angle()) < 3.14:  # half a turn has two ways
        close(found.rotation, expected, 1e-9)
    shift = last.translation - first.translation
    close(found.translation, first.translation + share * shift)
    close(first.towards(last, 0.0).matrix, first.matrix)
    close(first.towards(last, 1.0).matrix, last.matrix, 1e-7)


@given(batches(2), st.floats(-2, 2))
def test_the_plane_is_a_part_of_space(pose, share):
    there = pose.in_space()
    close(there.in_plane().matrix, pose.matrix)
    close((there @ there.inverse()[:1]).in_plane().matrix, (pose @ pose.inverse()[:1]).matrix, 1e-11)
    close(there.turn()[:, 2:].cos(), pose.turn().cos(), 1e-7)
    upright = Pose.from_yaw(pose.turn()[:, 0], there.translation)
    close(upright.matrix, there.matrix)
    near = pose[pose.angle() < 3]
    if len(near.translation):
        still = Pose.identity(2, len(near))
        close(
            still.towards(near, share).in_space().matrix,
            still.in_space().towards(near.in_space(), share).matrix,
            1e-11,
        )
    assert there.in_space() is there


@given(batches(), st.integers(0, 10**6))
def test_small_motions_are_exponentials_and_change_frames_by_the_adjoint(pose, seed):
    dim = pose.dim
    steps = torch.randn(
        len(pose), dim * (dim + 1) // 2, generator=torch.Generator().manual_seed(seed)
    ).double()
    turn = torch.linalg.matrix_exp(skew(steps[:, dim:]))
    close(Pose.from_turn(steps[:, dim:]).rotation, turn)
    close(skew(steps[:, dim:]), torch.einsum("nk,kij->nij", steps[:, dim:], generators(dim)))
    moved = pose.moved(steps)
    close(moved.rotation, turn @ pose.rotation)
    close(moved.translation, pose.translation + steps[:, :dim])

    def twist(numbers: torch.Tensor) -> torch.Tensor:
        return torch.cat(
            [torch.cat([skew(numbers[:, dim:]), numbers[:, :dim, None]], 2), 0 * pose.matrix[:, -1:]], 1
        )

    expected = pose.matrix @ twist(steps) @ pose.inverse().matrix
    close(twist((pose.adjoint() @ steps[:, :, None])[:, :, 0]), expected, 1e-10)
    rounded = Pose(pose.rotation + 1e-3 * steps[0, 0].cos(), pose.translation)
    nearest = np.stack([polar(matrix)[0] for matrix in rounded.rotation.numpy()])
    close(rounded.orthonormal().rotation, nearest)
    if dim == 3:
        again = Pose.from_quaternion(rounded.translation, rounded.quaternion())
        close(again.rotation, nearest)
    assert bool((pose.angle() - pose.chord() >= -1e-12).all())


def test_turns_have_derivatives_at_zero():
    zero = torch.zeros(3, dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(lambda turn: Pose.from_turn(turn).rotation, zero)
    close(jacobian.permute(2, 0, 1), generators(3))


def test_a_pose_stays_on_its_device():
    with pretended_gpu():
        pose = Pose.checked(torch.eye(4), 3, device="cuda")
        moved = (pose @ pose.inverse()).towards(pose, 0.5)
        for value in (
            moved.matrix,
            moved.quaternion(),
            moved.log(),
            moved.in_plane().matrix,
            moved.adjoint(),
        ):
            assert value.device.type == "cuda"
        assert torch.equal(pose.to("cpu").matrix, torch.eye(4).double())


@pytest.mark.parametrize(
    ("row", "column", "value"),
    [(0, 0, 1.01), (0, 0, -1.0), (0, 3, math.nan), (1, 1, math.inf), (3, 0, 1e-6), (3, 3, 2.0)],
)
def test_matrices_that_are_not_rigid_are_refused(row, column, value):
    matrix = torch.eye(4).double()
    matrix[row, column] = value
    with pytest.raises(
        InvalidArgumentError, match=r"mount=\[\[.* is not rigid; its rotation must be orthonormal"
    ):
        Pose.checked(matrix, 3, "mount")
    both = torch.stack([torch.eye(4).double(), matrix])
    with pytest.raises(InvalidArgumentError, match=r"poses\[1\]=\[\[.* is not rigid"):
        Pose.checked(both, 3, "poses", n=2)
    with pytest.raises(InvalidArgumentError, match=r"transform has shape \(4, 4\); a rigid motion in 2D is"):
        Pose.checked(matrix, 2)


@pytest.mark.parametrize("quaternion", [[0.0, 0, 0, 0], [math.nan, 0, 0, 1], [math.inf, 0, 0, 1]])
def test_a_quaternion_without_a_direction_is_refused(quaternion):
    with pytest.raises(InvalidArgumentError, match="quaternion x, y, z, w of length 1"):
        Pose.from_quaternion([[0.0, 0, 0], [1, 2, 3]], [[0.0, 0, 0, 1], quaternion])
    with pytest.raises(InvalidArgumentError, match="is not a pose"):
        Pose.from_quaternion([math.inf, 0, 0], [0.0, 0, 0, 1])


def test_a_chain_of_predictions_from_a_rounded_pose_stays_rigid():
    turn = Pose.from_turn(torch.tensor([0.02, -0.01, 0.05]).double(), torch.tensor([0.1, 0.0, 0.02]).double())
    rounded = Pose(turn.rotation.float().double() * (1 + 8e-7), turn.translation)  # as a file has it
    last, now = Pose.identity(3), rounded
    for _ in range(200):
        last, now = now, now @ (last.inverse() @ now)
    error = now.rotation @ now.rotation.mT - torch.eye(3)
    assert float(error.abs().max()) < 1e-3  # 200 steps of the first error, which does not grow faster
