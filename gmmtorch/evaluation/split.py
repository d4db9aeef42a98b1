"""Which scans train and which test, and what is kept of those that train."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, get_args

import torch

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.scan import Scan

Removal = Literal["beams", "scans"]


def split_indices(n_scans: int, test_every: int) -> tuple[list[int], list[int]]:
    """Indices of training and test scans: 0, n, 2n, … are held out."""
    check_test_every(test_every)
    if n_scans < 2:
        raise InvalidArgumentError(
            f"The data set has {n_scans} scans; at least 2 are needed, one to learn from and one to test on."
        )
    test = list(range(0, n_scans, test_every))
    held_out = set(test)
    return [i for i in range(n_scans) if i not in held_out], test


def check_share(share: float) -> None:
    """Raises unless the share kept lies in (0, 1]."""
    if not 0 < share <= 1:
        raise InvalidArgumentError(f"kept={share} must be a share in (0, 1].")


def check_removal(removal: str) -> None:
    """Raises for a removal that is not known."""
    if removal not in get_args(Removal):
        raise InvalidArgumentError(f"removal={removal!r} is not one of {', '.join(get_args(Removal))}.")


def check_noise(noise: Sequence[float]) -> tuple[float, float]:
    """Standard deviations (m, rad); raises unless they are two finite numbers ≥ 0."""
    if len(noise) != 2 or not all(math.isfinite(x) and x >= 0 for x in noise):
        raise InvalidArgumentError(f"pose_noise={list(noise)} must be two numbers ≥ 0: metres and radians.")
    return float(noise[0]), float(noise[1])


def check_test_every(test_every: int) -> None:
    """Raises unless some scans are left to train on."""
    if test_every < 2:
        raise InvalidArgumentError(
            f"test_every={test_every} must be at least 2: with 1 every scan is held out and none is left."
        )


def keep_share(scans: Sequence[Scan], share: float, removal: Removal, seed: int) -> list[Scan]:
    """The scans with a random share of their beams, or a random share of the scans.

    Smaller shares are subsets of larger ones with the same seed.
    """
    check_share(share)
    check_removal(removal)
    if share == 1:
        return list(scans)
    generator = torch.Generator().manual_seed(seed)
    if removal == "scans":
        rank = torch.rand(len(scans), generator=generator).argsort().argsort()
        return [scan for scan, r in zip(scans, rank.tolist(), strict=True) if r < max(1, share * len(scans))]
    return [scan.select(torch.rand(scan.n_beams, generator=generator) < share) for scan in scans]


def pose_perturbations(scans: Sequence[Scan], noise: Sequence[float], seed: int) -> list[torch.Tensor]:
    """A random rigid motion (D+1, D+1) of each scan about its sensor, float64.

    `noise`: standard deviations of the shift along each axis (m) and of the rotation about each
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
    """Each scan moved by its motion of `pose_perturbations`; as it is without noise."""
    if check_noise(noise) == (0, 0):
        return list(scans)
    motions = pose_perturbations(scans, noise, seed)
    return [scan.transformed(motion) for scan, motion in zip(scans, motions, strict=True)]


def _rotation(turn: torch.Tensor) -> torch.Tensor:
    """Rotation matrix of an angle (1,) or of a rotation vector (3,): exp of the skew matrix."""
    skew = torch.zeros(2 if turn.shape[0] == 1 else 3, 2 if turn.shape[0] == 1 else 3, dtype=torch.float64)
    if turn.shape[0] == 1:
        skew[0, 1], skew[1, 0] = -turn[0], turn[0]
    else:
        skew[0, 1], skew[0, 2], skew[1, 2] = -turn[2], turn[1], -turn[0]
        skew = skew - skew.T
    return torch.matrix_exp(skew)
