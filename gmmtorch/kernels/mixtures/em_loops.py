"""Whole runs of EM in one launch: E-step, M-step and the test of convergence, again and again, on the device.

A launch costs microseconds and a wait for the device more, as long as an iteration on some thousand rows. The
workers of the launch wait for each other between the phases of an iteration instead (see `Team`). On a CPU
there is one worker. Sums are added in a fixed order, so equal runs give equal bits.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.compiler import CPU_LANES, FusedKernel, Team, templated
from gmmtorch.kernels.mixtures.em_steps import DIMENSIONS, Mixture, is_m_step_fused, lists_near_components

MERGED = 256
"""Numbers that the sums of all workers are merged into, as in `em_loops.h`."""
_MOST_PAIRS = 1 << 25  # of row and component; from here on, an iteration takes much longer than its launches
_PAIRS_OF_A_LAUNCH = {"cpu": 1 << 29, "cuda": 1 << 36}
"""Less than a second: Python can stop a run only between launches."""
_MOST_ITERATIONS = 1 << 10  # of a launch, whose bounds have a place each
_MOST_PARTS, _ROWS_OF_A_PART = 64, 32
_RUNNING, _ENDED, _IMPOSSIBLE, _PAUSED = range(4)  # states, as in `em_loops.h`
_DECIDE = 14  # a phase of truncated EM, as there
_PROGRESS = 16  # numbers of the progress of a run
_HEAD = 2 * _PROGRESS
_FORMS = list(itertools.product(DIMENSIONS, (False, True)))  # the last: for a CPU, whose rows are in lanes
_EXACT = templated("mixtures/em_loops.h", "exact_em", _FORMS)
_TRUNCATED = templated("mixtures/em_loops.h", "truncated_em", _FORMS)
_SAMPLES = 64  # most rows of a group that are compared with all components
_SORTED_PARTS, _MOST_COUNTS = 512, 1 << 22


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
) -> tuple[Mixture, list[float], bool]:
    """Exact EM on features (N, F) of weight (N,) until the bound changes by less than `tol`, at first from
    `last_bound`. A launch has a limit, so a run may end before that and before `max_iter` (1 or more).

    Returns the mixture, the bounds of the iterations, and whether the next one needs the twin, which repairs
    a covariance, or takes a direct step.

    guarded: end also before an iteration whose natural parameters or statistics lose digits. team: other
    workers than those of the device; several on a CPU are launched for each phase.
    """
    (n, width), (k, dim), device = features.shape, start[1].shape, features.device
    wide, team = device.type == "cpu" and team is None, team or Team.of(device)
    lists = wide and lists_near_components(n, k)
    padded = k + (CPU_LANES - k % CPU_LANES if lists else -k % 4 if wide else 0)
    n_parts = team.n if wide else max(1, min(_MOST_PARTS, n // _ROWS_OF_A_PART, team.n // k))
    n_iter = max(1, min(max_iter, _PAIRS_OF_A_LAUNCH[device.type] // (n * k), _MOST_ITERATIONS))
    size, n_sums = k * (1 + dim + dim * dim), n_parts * padded * width
    near = n_parts * padded
    scratch = (2 * n, near * (CPU_LANES + 1), 2 * near) if wide else (n, 0, 0)
    n_partial = n_sums * (CPU_LANES if wide else 1)
    tables = k, padded * width, padded * width, k * width + 2, n_partial, *scratch, 1
    head, mixtures, masses, natural, table, *others = _carved(
        features, _HEAD + n_iter, 2 * size, *tables, 2 * team.n, 2 * MERGED, MERGED
    )
    torch.cat([part.reshape(-1) for part in start], out=mixtures[:size])
    rows = features, weight, n, k, padded, n_parts
    limits = reg_covar, tol, last_bound, n_iter, guarded
    made = mixtures, masses, natural, table if lists else None, *others
    _launch(_EXACT[dim, wide], team, head, (*rows, *limits), made)
    (_, n_done, state, which, *_), bounds = _read(head)
    found = _mixture(mixtures[which * size :][:size].clone(), k, dim)
    return found, bounds[:n_done], state == _IMPOSSIBLE


class TruncatedRun(NamedTuple):
    """The mixture of EM's last step, the bounds, and whether they converged.

    owner (N,) of each row and candidates (K, m) of each owner: those of the last bound.
    """

    mixture: Mixture
    bounds: list[float]
    converged: bool
    owner: Tensor
    candidates: Tensor


def n_sampled_rows(n_components: int) -> int:
    """Rows of a group that are compared with all components."""
    return max(8, min(_SAMPLES, 4096 // n_components))


def fused_truncated_em(
    values: Tensor,
    weight: Tensor,
    owner: Tensor,
    start: Mixture,
    limits: tuple[float, float, float, int],
    candidates: Tensor | int,
    repaired: Callable[[Mixture], Tensor],
    summed: Callable[[Tensor], Tensor] | None = None,
    on_iteration: Callable[[int, float], None] | None = None,
    team: Team | None = None,
) -> TruncatedRun:
    """`mixture.em.truncated.run_truncated` on points (N, D) or mean features (N, F) of cells, float64.

    Args:
        owner: (N,), the first ones. candidates: the first ones (K, m), or their number m.
        limits: reg_covar, tol, previous_bound and max_iter of `mixture.em.truncated.Settings`.
        repaired: natural parameters (K, F), about the means, of a mixture with a covariance that is not
            positive definite. summed: sums a vector over the processes that share the fit.
        team: as in `fused_exact_em`.
    """
    (n, columns), (k, dim), device = values.shape, start[1].shape, values.device
    wide, workers = device.type == "cpu" and team is None, team or Team.of(device)
    first, m = (
        (None, min(candidates, k)) if isinstance(candidates, int) else (candidates, candidates.shape[1])
    )
    width, size, padded = 1 + dim + dim * (dim + 1) // 2, k * (1 + dim + dim * dim), k + -k % CPU_LANES
    n_samples, n_bounds = n_sampled_rows(k), _PAIRS_OF_A_LAUNCH[device.type] // (n * m)
    n_bounds = max(1, min(limits[3], n_bounds, _MOST_ITERATIONS))
    n_parts = 1 if wide else max(1, min(_SORTED_PARTS, workers.n, _MOST_COUNTS // k))
    if wide:
        of_candidates = (m + -m % 4) * (CPU_LANES * (1 + width) + width)
        scratch = k * width, 0, (dim + 2) * padded, max(of_candidates, padded * (CPU_LANES + 4) + m)
    else:
        scratch = k * m * width, n, 0, 2 * k * (n_samples + 1) * m
    places = 2 * n + 2 * (k + 1) + 2 * k * m
    tables = 2 * k, k * width, k * width + 2, k * (width + dim), *scratch, 1 + k // CPU_LANES
    head, mixtures, *others = _carved(
        *(values, _HEAD + n_bounds, 3 * size, *tables, n, (n_parts + 1) * k, 2 * n * (columns + 1)),
        *(2 * places, 2 * workers.n, 2 * MERGED, MERGED),
    )
    natural, statistics, flags, owners, groups = (others[i] for i in (1, 2, 8, 9, 12))
    torch.cat([part.reshape(-1) for part in start], out=mixtures[:size])
    rows = values, weight, owner, first
    given = *rows, n, columns == dim, k, m, n_samples, n_parts, *limits, n_bounds
    bounds: list[float] = []
    while True:
        stop = len(bounds) + n_bounds, summed is not None
        _launch(_TRUNCATED[dim, wide], workers, head, (*given, *stop), (mixtures, *others))
        progress, found = _read(head)
        n_done, state = progress[1:3]
        for number in range(len(bounds), n_done):
            bounds.append(found[number % n_bounds])
            if on_iteration is not None:
                on_iteration(len(bounds), bounds[-1])
        if state == _ENDED:
            break
        if state == _IMPOSSIBLE:
            natural.copy_(repaired(_mixture(mixtures[:size], k, dim)).flatten())
            flags.zero_()
        elif summed is not None and progress[0] == _DECIDE:
            statistics.copy_(summed(statistics))
        head[:_PROGRESS].copy_(head[_PROGRESS:_HEAD])
    begin = progress[4] * places + 2 * n + k + 1
    chosen = groups.view(torch.int64)[begin : begin + k * m].view(k, m)
    found_mixture = _mixture(mixtures[size : 2 * size].clone(), k, dim)
    return TruncatedRun(found_mixture, bounds, bool(progress[14]), owners.view(torch.int64), chosen)


def _mixture(table: Tensor, k: int, dim: int) -> Mixture:
    weights, means, covariances = table.split([k, k * dim, k * dim * dim])
    return weights, means.view(k, dim), covariances.view(k, dim, dim)


def _carved(like: Tensor, *sizes: int) -> list[Tensor]:
    """Tables of zeros of these sizes, float64, in one tensor; each begins where a vector may."""
    begins = [0, *itertools.accumulate(size + -size % CPU_LANES for size in sizes)]
    memory = like.new_zeros(begins[-1], dtype=torch.float64)
    return [memory[begin : begin + size] for begin, size in zip(begins, sizes, strict=False)]


def _launch(
    kernel: FusedKernel,
    team: Team,
    head: Tensor,
    given: tuple[Tensor | float | None, ...],
    tables: tuple[Tensor | None, ...],
) -> None:
    """Runs a loop to its end. head: the progress before a launch, after it, and the bounds."""
    before, after, bounds = head[:_PROGRESS], head[_PROGRESS:_HEAD], head[_HEAD:]
    is_stepped = team.n > 1 and team.arrived is None  # workers that cannot wait
    while True:
        n_phases = 1 if is_stepped else 1 << 62
        if team.arrived is not None:
            team.arrived.zero_()
        kernel(team.n, *team, *given, n_phases, before, after, bounds, *tables)
        if not is_stepped or after[2]:
            return
        before.copy_(after)


def _read(head: Tensor) -> tuple[list[int], list[float]]:
    """The progress in whole numbers, except for the last bound, and the bounds; waits for the device."""
    values = head.tolist()
    return [int(value) if math.isfinite(value) else 0 for value in values[_PROGRESS:_HEAD]], values[_HEAD:]
