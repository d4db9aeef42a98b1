"""Which motions from which states stay in passable cells and keep clear of other robots, in one launch.

The fused kernel handles one motion from one state in one item, and stops at the first point that is not safe.
`exploration.planning.collision_checking.feasible` is its twin: it lists all points of all motions.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import FusedKernel


class Motions(NamedTuple):
    """P motions from each of N states: x, y, z, yaw and three velocities; metres, radians, seconds.

    paths: (F, P, S, 7) float64, states of the motions from the origin with yaw 0, for F initial velocities.
    stops: (P, B, 7) float64, how a robot comes to rest after each motion, from the origin with yaw 0.
    follows: (N,) int64, row of `paths` for each state. starts: (N, 7) float64. ends: (N, P, 7) float64, the
    last states of the paths.
    """

    paths: Tensor
    stops: Tensor
    follows: Tensor
    starts: Tensor
    ends: Tensor


_KERNEL = FusedKernel(
    "rays/path_clearance.h", "motions_are_clear", rounds_each=True
)  # positions are those of the twin


def motions_are_clear(
    motions: Motions,
    passable: Tensor,
    low: Tensor,
    resolution: float,
    n_parts: int,
    peers: Tensor,
    first: int,
    separation: float,
) -> Tensor:
    """Which motions (N, P) are safe: see `feasible`. A motion that does not move is.

    Args:
        passable: (nx, ny, nz) bool, cells in which the centre of a robot may be; low (3,) int64: the lowest.
        resolution: side of a cell (m). n_parts: checked points on each step.
        peers: (M, T, 3) float64, metres, positions of other robots after 1, 2, …, T steps; first: the one
            that belongs to the first step of the motions, below T. separation: metres.

    A motion differs from the twin's only if it meets an edge of a cell, or the separation, within rounding.
    """
    clear = torch.empty(motions.ends.shape[:2], dtype=torch.bool, device=passable.device)
    turns = [
        torch.stack([poses[..., 3].cos(), poses[..., 3].sin()], -1)
        for poses in (motions.starts, motions.ends)
    ]
    _KERNEL(
        clear.numel(),
        clear.shape[1],
        motions.paths.shape[2],
        motions.stops.shape[1],
        motions.paths,
        motions.stops,
        motions.follows,
        motions.starts.contiguous(),
        turns[0],
        motions.ends.contiguous(),
        turns[1],
        passable.contiguous(),
        low.contiguous(),
        *passable.shape,
        resolution,
        n_parts,
        peers.contiguous(),
        *peers.shape[:2],
        first,
        separation,
        clear,
        device=passable.device,
    )
    return clear
