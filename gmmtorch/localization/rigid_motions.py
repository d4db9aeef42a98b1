"""Rigid motions: how they are perturbed and compared, and lattices of them from which a search starts.

A motion is perturbed on its left, x → exp([ω]) (x − c) + c + v about the moved origin c = t of its frame, by
a shift v (m) and a turn ω (rad). [ω] = Σ_k ω_k G_k has one generator G in 2D and three in 3D.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.linalg import check_rigid

_SMALL_TURN = 1e-8  # rad²
_TURNED = math.radians(10)  # between the headings of neighbouring starts, for each metre between their places


class Motions(NamedTuple):
    """B rigid motions x → R x + t: rotations (B, D, D), translations (B, D)."""

    rotations: Tensor
    translations: Tensor

    def at(self, rows: Tensor) -> Motions:
        return Motions(self.rotations[rows], self.translations[rows])

    def joined(self, others: Motions) -> Motions:
        return Motions(*(torch.cat(both) for both in zip(self, others, strict=True)))

    def moved(self, steps: Tensor) -> Motions:
        """Perturbed by steps (B, D + D(D−1)/2): translations v, then rotations ω about t."""
        dim = self.translations.shape[1]
        return Motions(turns(steps[:, dim:]) @ self.rotations, self.translations + steps[:, :dim])


@functools.cache
def generators(dim: int) -> Tensor:
    """Skew matrices G_k (D(D−1)/2, D, D): Σ_k ω_k G_k x is ω × x in 3D, ω (−y, x) in 2D."""
    if dim == 2:
        return torch.tensor([[[0.0, -1.0], [1.0, 0.0]]], dtype=torch.float64)
    basis = torch.eye(3, dtype=torch.float64)
    return torch.stack([torch.linalg.cross(axis.expand(3, 3), basis, dim=1).T for axis in basis])


def turns(angles: Tensor) -> Tensor:
    """Rotations (B, D, D) exp(Σ_k ω_k G_k) by angles ω (B, D(D−1)/2), rad: Rodrigues' formula."""
    dim = 2 if angles.shape[1] == 1 else 3
    skew = (angles @ generators(dim).to(angles).flatten(1)).view(-1, dim, dim)
    square = angles.square().sum(1)[:, None, None]
    is_small = square < _SMALL_TURN  # a series, so that derivatives exist at zero
    angle = torch.where(is_small, 1.0, square).sqrt()
    first = torch.where(is_small, 1 - square / 6, angle.sin() / angle)
    second = torch.where(is_small, 0.5 - square / 24, 2 * (0.5 * angle).sin().square() / angle.square())
    return torch.eye(dim).to(angles) + first * skew + second * skew @ skew


def logarithm(motions: Tensor) -> Tensor:
    """A shift and a turn (E, F) of motions (E, D+1, D+1): the translation, and the rotation's vector."""
    dim = motions.shape[1] - 1
    rotation = motions[:, :dim, :dim]
    if dim == 2:
        turn = torch.atan2(rotation[:, 1, 0], rotation[:, 0, 0])[:, None]
        return torch.cat([motions[:, :2, 2], turn], 1)
    from scipy.spatial.transform import Rotation

    turn = torch.from_numpy(Rotation.from_matrix(rotation.detach().numpy()).as_rotvec())
    return torch.cat([motions[:, :3, 3], turn.to(motions)], 1)


def measured_motion(motion: ArrayLike, dim: int, device: torch.device) -> Tensor:
    """A motion (D+1, D+1), or its rotation (D, D) alone, float64. Raises `InvalidArgumentError`."""
    matrix = as_tensor(motion, "motion", torch.float64, device).detach().clone()
    is_rotation = tuple(matrix.shape) == (dim, dim)
    check_rigid(_with_rotation(matrix) if is_rotation else matrix, dim, "motion")
    return matrix


def continued(rotation: Tensor, last: Tensor | None, ratio: float = 1.0) -> Tensor:
    """The motion (D+1, D+1) with a measured rotation (D, D) at the velocity of the last one, if it is known.

    The velocity v in the frame of the sensor stays, and takes effect while the sensor turns by ω: the
    translation is t = J(ω) v with J(ω) = ∫₀¹ exp(s [ω]) ds. `ratio`: how many times longer than the last
    motion this one takes.
    """
    found = _with_rotation(rotation)
    if last is not None:
        dim = len(rotation)
        now, before = (_mean_rotation(turn) for turn in (rotation, last[:dim, :dim]))
        found[:dim, dim] = ratio * now @ torch.linalg.solve(before, last[:dim, dim])
    return found


def _with_rotation(rotation: Tensor) -> Tensor:
    """The motion (D+1, D+1) with this rotation (D, D) and no translation."""
    motion = torch.eye(len(rotation) + 1).to(rotation)
    motion[:-1, :-1] = rotation
    return motion


def _mean_rotation(rotation: Tensor) -> Tensor:
    """J(ω) (D, D) of a rotation (D, D) by ω: a block of exp [[ω] I; 0 0]."""
    dim = len(rotation)
    turn = logarithm(_with_rotation(rotation).cpu()[None])[0, dim:]
    block = torch.zeros(2 * dim, 2 * dim).double()
    block[:dim, :dim] = torch.tensordot(turn, generators(dim), 1)
    block[:dim, dim:] = torch.eye(dim)
    return torch.linalg.matrix_exp(block)[:dim, dim:].to(rotation)


def differences(some: Motions, others: Motions, distance: float, angle: float) -> Tensor:
    """How different motions are (A, B): the larger of the shift in `distance` and the turn in `angle`."""
    shift = torch.cdist(some.translations, others.translations)
    turn = torch.linalg.matrix_norm(some.rotations[:, None] - others.rotations) / math.sqrt(2)
    return torch.maximum(shift / distance, turn / angle)


def distinct(motions: Motions, distance: float, angle: float) -> Tensor:
    """Rows of motions, best first, without those within both (m, rad) of a better one."""
    is_near = differences(motions, motions, distance, angle) < 1
    return (~is_near.tril(-1).any(1)).nonzero().squeeze(1)


def best_distinct(motions: Motions, score: Tensor, distance: float) -> Tensor:
    """Rows of motions by falling score, without those close to a better one: by less than `distance` (m) and
    the turn that belongs to it.
    """
    order = score.argsort(descending=True, stable=True)
    return order[distinct(motions.at(order), distance, _TURNED * distance)]


def around(start: Motions, distance: float, angle: float, blur: float) -> Motions:
    """Starts on a lattice of places, `blur` metres apart, up to `distance` metres from one along the ground,
    and of headings up to `angle` radians; the start itself among them.
    """
    dim, like = start.translations.shape[1], start.translations
    n, m = math.ceil(distance / blur), math.ceil(angle / (_TURNED * blur))
    side = torch.linspace(-distance, distance, 2 * n + 1).to(like)
    places = torch.cartesian_prod(side, side)
    places = places[places.norm(dim=1) <= distance * (1 + 1e-9)]
    places = torch.nn.functional.pad(places, (0, dim - 2))
    turned = _yaws(torch.linspace(-angle, angle, 2 * m + 1).to(like), dim) @ start.rotations
    return _crossed(turned, start.translations + places)


def everywhere(places: Tensor, blur: float) -> Motions:
    """Starts at places (S, D) with all headings; upright in 3D."""
    n = math.ceil(math.pi / (_TURNED * blur))
    angles = torch.arange(n).to(places) * (2 * math.pi / n)
    return _crossed(_yaws(angles, places.shape[1]), places)


def _yaws(angles: Tensor, dim: int) -> Tensor:
    """Rotations (A, D, D) by angles (A,), rad, about the vertical."""
    axis = torch.eye(dim * (dim - 1) // 2).to(angles)[-1]
    return turns(angles[:, None] * axis)


def _crossed(rotations: Tensor, translations: Tensor) -> Motions:
    """Every pair of a rotation and a translation."""
    n = len(rotations)
    return Motions(rotations.repeat(len(translations), 1, 1), translations.repeat_interleave(n, 0))


def chosen_rows(better: Tensor, new: tuple[Tensor, ...], old: tuple[Tensor, ...]) -> list[Tensor]:
    """Rows of `new` where `better` (B,), else of `old`."""
    return [torch.where(better.view(-1, *[1] * (n.ndim - 1)), n, o) for n, o in zip(new, old, strict=True)]
