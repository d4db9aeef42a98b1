"""Whole runs of EM in one launch: E-step, M-step and the test of convergence, again and again, on the device.

A launch costs microseconds and a wait for the device more, as long as an iteration on some thousand rows. The
workers of the launch wait for each other between the phases of an iteration instead (see `Team`). On a CPU
there is one worker. Sums are added in a fixed order, so equal runs give equal bits.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import CPU_LANES, FusedKernel, Team
from gmmtorch.kernels.mixtures.em_steps import DIMENSIONS, Mixture, is_m_step_fused

MERGED = 256
"""Numbers that the sums of all workers are merged into, as in `em_loops.h`."""
_MOST_PAIRS = 1 << 25  # of row and component; from here on, an iteration takes much longer than its launches
_PAIRS_OF_A_LAUNCH = {"cpu": 1 << 29, "cuda": 1 << 36}
"""Less than a second: Python can stop a run only between launches."""
_MOST_ITERATIONS = 1 << 10  # of a launch, whose bounds have a place each
_MOST_PARTS, _ROWS_OF_A_PART = 64, 32
_RUNNING, _ENDED, _IMPOSSIBLE = range(3)  # states, as in `em_loops.h`
_PROGRESS, _N_WHOLE = 16, 5  # numbers of the progress of a run, and how many of them are whole
_HEAD = 2 * _PROGRESS
_EXACT = {
    (dim, wide): FusedKernel("mixtures/em_loops.h", f"exact_em<{dim}, {str(wide).lower()}>")
    for dim, wide in itertools.product(DIMENSIONS, (False, True))
}


class Run(NamedTuple):
    """A mixture, the bounds of the iterations that led to it, and whether the next iteration needs the twin,
    which repairs a covariance, or takes a direct step."""

    mixture: Mixture
    bounds: list[float]
    failed: bool


def is_em_fused(features: Tensor, *others: Tensor) -> bool:
    """Whether `fused_exact_em` computes with these rows (N, F) in few dimensions."""
    n_features = {1 + dim + dim * (dim + 1) // 2: dim for dim in DIMENSIONS}
    return is_m_step_fused(n_features.get(features.shape[1], 0), features, *others)


def takes_one_launch(n_rows: int, n_components: int) -> bool:
    """Whether a whole run of exact EM is faster in one launch than an iteration at a time."""
    return n_rows * n_components <= _MOST_PAIRS


def fused_exact_em(
    features: Tensor,
    weight: Tensor,
    start: Mixture,
    reg_covar: float,
    tol: float,
    max_iter: int,
    last_bound: float = -math.inf,
    guarded: bool = False,
    team: Team | None = None,
) -> Run:
    """Exact EM on features (N, F) of weight (N,) until the bound changes by less than `tol`, at first from
    `last_bound`. A launch has a limit, so a run may end before that and before `max_iter` (1 or more).

    guarded: end also before an iteration whose natural parameters or statistics lose digits. team: other
    workers than those of the device; several on a CPU are launched for each phase.
    """
    (n, width), (k, dim), device = features.shape, start[1].shape, features.device
    wide, team = device.type == "cpu" and team is None, team or Team.of(device)
    padded = k + -k % 4 if wide else k
    n_parts = team.n if wide else max(1, min(_MOST_PARTS, n // _ROWS_OF_A_PART, team.n // k))
    n_iter = max(1, min(max_iter, _PAIRS_OF_A_LAUNCH[device.type] // (n * k), _MOST_ITERATIONS))
    size, n_sums = k * (1 + dim + dim * dim), n_parts * padded * width
    scratch = (2 * n, n_parts * padded * CPU_LANES, n_parts * padded) if wide else (n, 0, 0)
    tables = k, padded * width, k * width + 2, n_sums * (CPU_LANES if wide else 1), *scratch, 1
    head, mixtures, *others = _carved(features, _HEAD + n_iter, 2 * size, *tables, 2 * team.n, 2 * MERGED)
    torch.cat([part.reshape(-1) for part in start], out=mixtures[:size])
    rows = features.contiguous(), weight.contiguous(), n, k, padded, n_parts
    limits = reg_covar, tol, last_bound, n_iter, guarded
    _launch(_EXACT[dim, wide], team, head, (*rows, *limits), (mixtures, *others))
    (_, n_done, state, which, *_), bounds = _read(head)
    masses, means, covariances = mixtures[which * size :][:size].clone().split([k, k * dim, k * dim * dim])
    found = masses, means.view(k, dim), covariances.view(k, dim, dim)
    return Run(found, bounds[:n_done], state == _IMPOSSIBLE)


def _carved(like: Tensor, *sizes: int) -> list[Tensor]:
    """Tables of zeros of these sizes, float64, in one tensor; each begins where a vector may."""
    begins = [0, *itertools.accumulate(size + -size % CPU_LANES for size in sizes)]
    memory = like.new_zeros(begins[-1], dtype=torch.float64)
    return [memory[begin : begin + size] for begin, size in zip(begins, sizes, strict=False)]


def _launch(
    kernel: FusedKernel,
    team: Team,
    head: Tensor,
    given: tuple[Tensor | float, ...],
    tables: tuple[Tensor, ...],
) -> None:
    """Runs a loop to its end. head: the progress before a launch, after it, and the bounds."""
    before, after, bounds = head[:_PROGRESS], head[_PROGRESS:_HEAD], head[_HEAD:]
    is_stepped = team.n > 1 and team.arrived is None  # workers that cannot wait
    while True:
        n_phases = 1 if is_stepped else 1 << 62
        kernel(team.n, *team, *given, n_phases, before, after, bounds, *tables, device=head.device)
        if not is_stepped or after[2]:
            return
        before.copy_(after)


def _read(head: Tensor) -> tuple[list[int], list[float]]:
    """The progress in whole numbers, and the bounds; waits for the device."""
    values = head.tolist()
    return [int(value) for value in values[_PROGRESS : _PROGRESS + _N_WHOLE]], values[_HEAD:]
