"""Split of scans into training and test scans, removal of training data, and perturbed poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args

import torch

from gmmtorch.errors import InvalidArgumentError, check_choice
from gmmtorch.evaluation.protocol_options import (
    Removal,
    check_noise,
    check_share,
    check_test_every,
)
from gmmtorch.scan import Scan


def split_indices(n_scans: int, test_every: int) -> tuple[list[int], list[int]]:
    """Indices of training and test scans: 0, n, 2n, … are held out."""
    check_test_every(test_every)
    if n_scans < 2:
        raise InvalidArgumentError(
            f"The data set has {n_scans} scans; at least 2 are needed: one for training and one for the test."
        )
    test = list(range(0, n_scans, test_every))
    held_out = set(test)
    return [i for i in range(n_scans) if i not in held_out], test


def keep_share(scans: Sequence[Scan], share: float, removal: Removal, seed: int) -> list[Scan]:
    """Keeps a random share of the beams of each scan, or a random share of the scans.

    With the same seed, a smaller share is a subset of a larger one.
    """
    check_share(share)
    check_choice("removal", removal, get_args(Removal))
    if share == 1:
        return list(scans)
    generator = torch.Generator().manual_seed(seed)
    if removal == "scans":
        rank = torch.rand(len(scans), generator=generator).argsort().argsort()
        return [scan for scan, r in zip(scans, rank.tolist(), strict=True) if r < max(1, share * len(scans))]
    return [scan.select(torch.rand(scan.n_beams, generator=generator) < share) for scan in scans]


def pose_perturbations(scans: Sequence[Scan], noise: Sequence[float], seed: int) -> list[torch.Tensor]:
    """A random rigid motion (D+1, D+1) of each scan about its sensor origin, float64.

    `noise`: standard deviations of the translation along each axis (m) and of the rotation about each
    axis (rad).
    """
    shift, angle = check_noise(noise)
    generator = torch.Generator().manual_seed(seed)
    motions = []
    for scan in scans:
        dim = scan.dim
        translation = torch.randn(dim, generator=generator, dtype=torch.float64) * shift
        turn = torch.randn(1 if dim == 2 else 3, generator=generator, dtype=torch.float64) * angle
        transform = torch.eye(dim + 1, dtype=torch.float64)
        transform[:dim, :dim] = _rotation(turn)
        origin = scan.origin.double().cpu()
        transform[:dim, dim] = origin + translation - transform[:dim, :dim] @ origin
        motions.append(transform)
    return motions


def perturb_poses(scans: Sequence[Scan], noise: Sequence[float], seed: int) -> list[Scan]:
    """Each scan moved by its motion of `pose_perturbations`; unchanged if both deviations are zero."""
    if check_noise(noise) == (0, 0):
        return list(scans)
    motions = pose_perturbations(scans, noise, seed)
    return [scan.transformed(motion) for scan, motion in zip(scans, motions, strict=True)]


def _rotation(turn: torch.Tensor) -> torch.Tensor:
    """Rotation matrix of an angle (1,) or of a rotation vector (3,): exponential of the skew matrix."""
    skew = torch.zeros(2 if turn.shape[0] == 1 else 3, 2 if turn.shape[0] == 1 else 3, dtype=torch.float64)
    if turn.shape[0] == 1:
        skew[0, 1], skew[1, 0] = -turn[0], turn[0]
    else:
        skew[0, 1], skew[0, 2], skew[1, 2] = -turn[2], turn[1], -turn[0]
        skew = skew - skew.T
    return torch.matrix_exp(skew)
