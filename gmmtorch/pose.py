"""Pose: rigid motions of the plane or of space, one or a batch, and all that is computed with them.

The pose of a sensor in the world is the motion world ← sensor, which moves points from the frame of the
sensor to that of the world. A small motion is a shift v (m) and a turn ω (rad), F = D + D(D−1)/2 numbers:
x, y and the heading in 2D; x, y, z and the rotation vector in 3D.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError

MIN_NORM = 1e-6
"""A quaternion with a smaller norm states no rotation."""
_ORTHONORMAL = 1e-5  # largest error of an entry of R Rᵀ
_LAST_ROW = 1e-12  # largest error of an entry of the last row: that of an inverse
_ROUNDING = 1e-12  # largest error of an entry of R Rᵀ after some computations in float64
_SMALL_TURN = 1e-8  # rad²


@dataclass(frozen=True, eq=False)
class Pose:
    """Rigid motions x → R x + t: one, or a batch of any shape (…). float64, on any device; metres.

    `first @ second` moves by the second motion and then by the first one: (a ← b) @ (b ← c) is a ← c.
    Batches broadcast. `pose[rows]` chooses from the first dimension of a batch, and `len` is its size.

    rotation: (…, D, D), D = 2 or 3. translation: (…, D).
    """

    rotation: Tensor
    translation: Tensor

    @staticmethod
    def identity(dim: int, *shape: int, device: torch.device | str | None = None) -> Pose:
        """The motion, or a batch of this shape, that moves nothing."""
        eye = torch.eye(dim, dtype=torch.float64, device=device)
        return Pose(eye.repeat(*shape, 1, 1), eye.new_zeros(*shape, dim))

    @staticmethod
    def from_matrix(matrix: ArrayLike) -> Pose:
        """The motions of matrices (…, D+1, D+1), which are not checked; see `checked`."""
        given = as_tensor(matrix, "matrix", torch.float64)
        return Pose(given[..., :-1, :-1], given[..., :-1, -1])

    @staticmethod
    def checked(
        matrix: ArrayLike,
        dim: int,
        name: str = "transform",
        *,
        n: int | None = None,
        device: torch.device | str | None = None,
    ) -> Pose:
        """The motion of a matrix (D+1, D+1), or the `n` motions of (n, D+1, D+1), given by a user.

        Raises `InvalidArgumentError`, which names the first bad one, unless every matrix is finite, its
        rotation is orthonormal with determinant +1, and its last row is 0 … 0 1, up to the rounding of an
        inverse.
        """
        given = as_tensor(matrix, name, torch.float64, device)
        shape = (dim + 1, dim + 1) if n is None else (n, dim + 1, dim + 1)
        if tuple(given.shape) != shape:
            raise InvalidArgumentError(
                f"{name} has shape {tuple(given.shape)}; a rigid motion in {dim}D is {(dim + 1, dim + 1)}."
            )
        row = _first_not_rigid(given)
        if row is not None:
            bad, where = (given, name) if n is None else (given[row], f"{name}[{row}]")
            raise InvalidArgumentError(
                f"{where}={bad.tolist()} is not rigid; its rotation must be orthonormal with determinant "
                "1, its translation in metres, and its last row 0 … 0 1."
            )
        return Pose.from_matrix(given)

    @staticmethod
    def from_quaternion(translation: ArrayLike, quaternion: ArrayLike) -> Pose:
        """Motions of space from translations (…, 3) and quaternions (…, 4) in the order x, y, z, w, as in ROS
        and in TUM's files. They are normalised.

        Raises `InvalidArgumentError` if a number is not finite or a quaternion is zero.
        """
        shift = as_tensor(translation, "translation", torch.float64)
        given = as_tensor(quaternion, "quaternion", torch.float64, shift.device)
        norm = given.norm(dim=-1, keepdim=True)
        good = shift.isfinite().all(-1) & (norm.isfinite() & (norm > MIN_NORM)).squeeze(-1)
        if not bool(good.all()):
            raise InvalidArgumentError(
                f"position {shift[~good][:1].tolist()} with quaternion {given[~good][:1].tolist()} is not a "
                "pose: give finite numbers, and a quaternion x, y, z, w of length 1."
            )
        x, y, z, w = (given / norm).unbind(-1)
        rows = [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], -1),
            torch.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], -1),
            torch.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], -1),
        ]
        return Pose(torch.stack(rows, -2), shift)

    @staticmethod
    def from_yaw(yaw: ArrayLike | float, translation: ArrayLike) -> Pose:
        """Upright motions with headings (…), rad, counter-clockwise, and translations (…, D)."""
        shift = as_tensor(translation, "translation", torch.float64)
        angle = as_tensor(yaw, "yaw", torch.float64, shift.device)
        shift = shift.expand(*angle.shape, shift.shape[-1])
        rotation = torch.eye(shift.shape[-1]).to(shift).repeat(*angle.shape, 1, 1)
        rotation[..., 0, 0] = rotation[..., 1, 1] = angle.cos()
        rotation[..., 1, 0], rotation[..., 0, 1] = angle.sin(), -angle.sin()
        return Pose(rotation, shift)

    @staticmethod
    def from_turn(turn: Tensor, translation: Tensor | None = None) -> Pose:
        """Motions with turns (…, 1) or (…, 3) and translations (…, D), zero if None: Rodrigues' formula."""
        dim = 2 if turn.shape[-1] == 1 else 3
        cross, square = skew(turn), turn.square().sum(-1)[..., None, None]
        is_small = square < _SMALL_TURN  # a series, so that derivatives exist at zero
        angle = torch.where(is_small, 1.0, square).sqrt()
        first = torch.where(is_small, 1 - square / 6, angle.sin() / angle)
        second = torch.where(is_small, 0.5 - square / 24, 2 * (0.5 * angle).sin().square() / angle.square())
        rotation = torch.eye(dim).to(turn) + first * cross + second * cross @ cross
        return Pose(rotation, turn.new_zeros(*turn.shape[:-1], dim) if translation is None else translation)

    @staticmethod
    def stack(poses: Sequence[Pose]) -> Pose:
        """A batch of single motions, or of batches of one shape."""
        return Pose(torch.stack([p.rotation for p in poses]), torch.stack([p.translation for p in poses]))

    @staticmethod
    def cat(poses: Sequence[Pose]) -> Pose:
        """The motions of some batches, one after the other."""
        return Pose(torch.cat([p.rotation for p in poses]), torch.cat([p.translation for p in poses]))

    def __len__(self) -> int:
        return len(self.translation) if self.translation.ndim > 1 else 1

    def __getitem__(self, rows: Any) -> Pose:
        return Pose(self.rotation[rows], self.translation[rows])

    def to(self, device: torch.device | str | None) -> Pose:
        """The motions on another device."""
        return Pose(self.rotation.to(device), self.translation.to(device))

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self.translation.shape[-1]

    @property
    def parts(self) -> tuple[Tensor, Tensor]:
        """Rotation and translation, for kernels."""
        return self.rotation, self.translation

    @property
    def matrix(self) -> Tensor:
        """Matrices (…, D+1, D+1)."""
        last = torch.zeros_like(self.translation)[..., None, :]
        one = torch.ones_like(last[..., :1])
        upper = torch.cat([self.rotation, self.translation[..., None]], -1)
        return torch.cat([upper, torch.cat([last, one], -1)], -2)

    def quaternion(self) -> Tensor:
        """Unit quaternions (…, 4) in the order x, y, z, w, of the nearest rotations. Their largest component
        (w first, then x, y, z, if some are as large) is above zero."""
        rotation = self.in_space().rotation
        if bool(((rotation @ rotation.mT - torch.eye(3).to(rotation)).abs() > _ROUNDING).any()):
            rotation = self.in_space().orthonormal().rotation
        diagonal = rotation.diagonal(dim1=-2, dim2=-1)
        trace = diagonal.sum(-1, keepdim=True)
        (_, xy, xz), (yx, _, yz), (zx, zy, _) = (row.unbind(-1) for row in rotation.unbind(-2))
        own = torch.cat([1 - trace + 2 * diagonal, 1 + trace], -1)  # 4 x², 4 y², 4 z², 4 w²
        products = rotation.new_zeros(*own.shape, 4)  # 4 q qᵀ, whose longest row is the most exact
        places = (0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3)
        values = xy + yx, xz + zx, yz + zy, zy - yz, xz - zx, yx - xy
        for (i, j), value in zip(places, values, strict=True):
            products[..., i, j] = products[..., j, i] = value
        products.diagonal(dim1=-2, dim2=-1).copy_(own)
        best = torch.cat([trace, diagonal], -1).argmax(-1)
        chosen = (best - 1) % 4  # w, x, y, z as rows 3, 0, 1, 2
        index = chosen[..., None, None].expand(*chosen.shape, 1, 4)
        return torch.nn.functional.normalize(products.gather(-2, index).squeeze(-2), dim=-1)

    def turn(self) -> Tensor:
        """Angles (…, 1) in 2D, rotation vectors (…, 3) in 3D; rad, at most π long."""
        if self.dim == 2:
            return torch.atan2(self.rotation[..., 1, 0], self.rotation[..., 0, 0])[..., None]
        quaternion = self.quaternion()
        quaternion = torch.where(quaternion[..., 3:] < 0, -quaternion, quaternion)
        axis, scalar = quaternion[..., :3], quaternion[..., 3:]
        sine = axis.norm(dim=-1, keepdim=True)
        ratio = torch.where(sine > 0, 2 * torch.atan2(sine, scalar) / sine.clamp_min(1e-300), 2.0)
        return axis * ratio

    def log(self) -> Tensor:
        """A shift and a turn (…, F): the translation, and `turn`."""
        return torch.cat([self.translation, self.turn()], -1)

    def chord(self) -> Tensor:
        """2 sin(α/2) of the angles α (…), rad, by which the motions turn: about α if it is small."""
        turned = self.rotation - torch.eye(self.dim).to(self.rotation)
        return torch.linalg.matrix_norm(turned) / 2**0.5

    def angle(self) -> Tensor:
        """The angles (…), rad, by which the motions turn, from 0 to π; exact near zero."""
        return 2 * (self.chord() / 2).clamp_max(1).asin()

    def in_plane(self) -> Pose:
        """Motions of space as motions of the plane: x, y and the heading of the x axis."""
        yaw = torch.atan2(self.rotation[..., 1, 0], self.rotation[..., 0, 0])
        return Pose.from_yaw(yaw, self.translation[..., :2])

    def in_space(self) -> Pose:
        """Motions of the plane as motions of space at height 0; motions of space as they are."""
        if self.dim == 3:
            return self
        found = Pose.identity(3, *self.translation.shape[:-1], device=self.translation.device)
        found.rotation[..., :2, :2], found.translation[..., :2] = self.rotation, self.translation
        return found

    def inverse(self) -> Pose:
        """The motions back.

        A rotation that was rounded is inverted, not transposed: in a chain of predictions, each from the last
        motion, the error of a transpose grows exponentially.
        """
        back = torch.linalg.inv_ex(self.rotation).inverse
        return Pose(back, -(back @ self.translation[..., None])[..., 0])

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(
            self.rotation @ other.rotation,
            (self.rotation @ other.translation[..., None])[..., 0] + self.translation,
        )

    def apply(self, points: Tensor) -> Tensor:
        """Points (…, N, D) moved by each motion of the batch (…), in their own type."""
        moved = points.double() @ self.rotation.mT + self.translation[..., None, :]
        return moved.to(points.dtype)

    def towards(self, other: Pose, share: ArrayLike | float) -> Pose:
        """The poses at a share (…) of the way to others: linear in position, spherical linear in rotation
        (Shoemake 1985). A share beyond 0 to 1 continues the motion.
        """
        part = as_tensor(share, "share", torch.float64, self.translation.device)[..., None]
        step = Pose.from_turn((self.inverse() @ other).turn() * part)
        shift = self.translation + (other.translation - self.translation) * part
        return Pose(self.rotation @ step.rotation, shift)

    def shifted(self, shift: Tensor) -> Pose:
        """The poses with translations t + `shift` (…, D), such as those about another origin."""
        return Pose(self.rotation, self.translation + shift)

    def moved(self, steps: Tensor) -> Pose:
        """The poses after steps (…, F) in the frame of the world: a shift v, and a turn ω about the origin t
        of the moved frame, x → exp([ω]) (x − t) + t + v.
        """
        turned = Pose.from_turn(steps[..., self.dim :])
        return Pose(turned.rotation @ self.rotation, self.translation + steps[..., : self.dim])

    def orthonormal(self) -> Pose:
        """The poses with the nearest rotations, U Vᵀ of U Σ Vᵀ, for rotations that were rounded."""
        left, _, right = torch.linalg.svd(self.rotation)
        return Pose(left @ right, self.translation)

    def adjoint(self) -> Tensor:
        """Matrices (…, F, F): a small motion in the frame that is moved, as it appears in the other frame."""
        dim = self.dim
        free = dim * (dim + 1) // 2
        found = self.rotation.new_zeros(*self.translation.shape[:-1], free, free)
        found[..., :dim, :dim] = self.rotation
        if dim == 2:
            found[..., 0, 2], found[..., 1, 2] = self.translation[..., 1], -self.translation[..., 0]
            found[..., 2, 2] = 1
        else:
            found[..., 3:, 3:] = self.rotation
            found[..., :3, 3:] = skew(self.translation) @ self.rotation
        return found


@functools.cache
def generators(dim: int) -> Tensor:
    """Skew matrices G_k (D(D−1)/2, D, D): Σ_k ω_k G_k x is ω × x in 3D, ω (−y, x) in 2D."""
    if dim == 2:
        return torch.tensor([[[0.0, -1.0], [1.0, 0.0]]], dtype=torch.float64)
    basis = torch.eye(3, dtype=torch.float64)
    return torch.stack([torch.linalg.cross(axis.expand(3, 3), basis, dim=1).T for axis in basis])


def skew(turns: Tensor) -> Tensor:
    """[ω] = Σ_k ω_k G_k (…, D, D) of turns (…, 1) or (…, 3), rad: the rotation is exp [ω]."""
    return torch.tensordot(turns, generators(2 if turns.shape[-1] == 1 else 3).to(turns), 1)


def _first_not_rigid(matrices: Tensor) -> int | None:
    """The first of matrices (…, D+1, D+1) that is not rigid; None if all are. Waits once for a device."""
    values = matrices.detach().cpu().numpy().reshape(-1, *matrices.shape[-2:])
    turn, eye = values[:, :-1, :-1], np.eye(values.shape[1])
    with np.errstate(invalid="ignore", over="ignore"):  # numbers that are not finite
        rigid = (
            np.isfinite(values).all((1, 2))
            & (np.abs(turn @ turn.transpose(0, 2, 1) - eye[:-1, :-1]).max((1, 2)) <= _ORTHONORMAL)
            & (np.linalg.det(turn) > 0)
            & (np.abs(values[:, -1] - eye[-1]).max(1) <= _LAST_ROW)
        )
    return None if rigid.all() else int(rigid.argmin())
