"""Which motions from which states stay in passable cells and keep clear of other robots, in one launch.

The fused kernel handles one motion from one state in one item, and stops at the first point that is not safe.
`exploration.planning.collision_checking.feasible` is its twin: it lists all points of all motions.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel


class Library(NamedTuple):
    """P motions: x, y, z, yaw and three velocities; metres, radians, seconds.

    paths: (P, P, S, 7) float64, states of the motions from the origin with yaw 0, after each of the motions.
    stops: (P, B, 7) float64, how a robot comes to rest after each motion, from the origin with yaw 0.
    """

    n_motions: int
    n_steps: int
    n_stops: int
    paths: Tensor
    stops: Tensor


class FreeSpace(NamedTuple):
    """Where motions are safe.

    passable: (nx, ny, nz) bool, cells in which the centre of a robot may be; low: (3,) int64, the lowest.
    resolution: side of a cell (m).
    peers: (M, T, 3) float64, metres, positions of other robots after 1, 2, …, T steps. separation: metres.
    """

    passable: Tensor
    low: Tensor
    nx: int
    ny: int
    nz: int
    resolution: float
    peers: Tensor
    n_peers: int
    n_times: int
    separation: float


_KERNEL = FusedKernel(
    "rays/path_clearance.h", "motions_are_clear", rounds_each=True
)  # positions are those of the twin


def motions_are_clear(
    library: Library,
    space: FreeSpace,
    follows: Tensor,
    starts: Tensor,
    ends: Tensor,
    n_parts: int,
    first: int,
) -> Tensor:
    """Which motions (N, P) are safe: see `feasible`. A motion that does not move is.

    Args:
        follows: (N,) int64, the motion before each start. starts: (N, 7) float64.
        ends: (N, P, 7) float64, the last states of the motions.
        n_parts: checked points on each step. first: of the peers' positions, that of the first step; below T.

    A motion differs from the twin's only if it meets an edge of a cell, or the separation, within rounding.
    """
    clear = torch.empty(ends.shape[:2], dtype=torch.bool, device=starts.device)
    turns = [torch.stack([poses[..., 3].cos(), poses[..., 3].sin()], -1) for poses in (starts, ends)]
    given = follows, starts, turns[0], ends, turns[1], n_parts, first
    _KERNEL(clear.numel(), *library, *space, *given, clear)
    return clear
