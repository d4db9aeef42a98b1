"""Truncated EM: fast EM for many components, with a momentum on the sufficient statistics.

Each E-step compares a row with a few candidate components only (see `grouping`). With all other
responsibilities set to zero, EM still increases a lower bound of the log-likelihood (truncated
variational EM: Lücke & Forster, 2019). The cost depends on the number of candidates, not on the number
of components. Each group is computed relative to its owner's mean, so that float32 has enough digits.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gmmtorch.kernels import fused_steps, is_m_step_fused
from gmmtorch.mixture.em.cells import pool_into_cells
from gmmtorch.mixture.em.exact import Parameters, maximization, shift_features
from gmmtorch.mixture.em.grouping import (
    Expectation,
    Groups,
    Rows,
    centered_parameters,
    choose_candidates,
    group_rows,
    owners_of,
    rounding,
    truncated_expectation,
)
from gmmtorch.mixture.em.loop import EMResult, has_converged
from gmmtorch.mixture.streaming.distributed import SINGLE_PROCESS, Processes

_FIRST_SETS, _LATER_SETS = (2, 3, 3, 4, 4), 8  # iterations for which each set of candidates is used
_AVERAGE_ROUNDING, _WORST_ROUNDING = 0.02, 0.2  # nats of float32 error above which float64 is used
_SAMPLED_OF_A_COMPONENT = 400  # points a component in the random sample that EM starts on
_MANY_POINTS = 1 << 19  # from this number of points on, EM starts on cells
_POINTS_OF_A_CELL, _CELLS_OF_A_COMPONENT = 16, 32


@dataclass(frozen=True)
class Settings:
    """Settings of truncated EM.

    reg_covar: added to each variance (m²). tol: EM stops when the bound increases by less (nats a
    point). max_iter: largest number of iterations. dtype: of the E-step; float32 is replaced by float64
    where its error is too large. n_candidates: components that each row is compared with.
    on_iteration: called with the iteration, from 1, and the bound. processes: processes that share the
    fit, each with its own rows. compiled: run the E-step through torch.compile. The result is the same
    to rounding and about 1.5 times as fast, after about five seconds for the first use in a process.
    Needs a C++ compiler. previous_bound: bound of the fit that this one continues.
    """

    reg_covar: float = 1e-6
    tol: float = 1e-3
    max_iter: int = 100
    dtype: torch.dtype = torch.float32
    n_candidates: int = 16
    on_iteration: Callable[[int, float], None] | None = None
    processes: Processes = SINGLE_PROCESS
    compiled: bool = False
    previous_bound: float = -math.inf


# -- momentum -------------------------------------------------------------------------------------


class Momentum:
    """M-steps that extrapolate the change of the statistics (Nesterov's schedule).

    The extrapolated statistics are those of the E-step plus a share of their last change. A component
    takes EM's own step instead if extrapolation reduces its mass or its smallest thickness too much.
    """

    def __init__(self, reg_covar: float) -> None:
        self._reg_covar = reg_covar
        self._age = 0
        self._last: tuple[Tensor, Tensor] | None = None  # statistics, and the means they are relative to
        self._em_step: Parameters | None = None
        self.is_extrapolated = False

    def step(self, statistics: Tensor, parameters: Parameters) -> Parameters:
        """The next parameters, from statistics (K, F) relative to the means of `parameters`."""
        last, self._last = self._last, (statistics, parameters.means)
        share = 0.0 if last is None else self._age / (self._age + 3)
        self._age += last is not None
        self.is_extrapolated = share > 0
        given = statistics, parameters, self._reg_covar, last if self.is_extrapolated else None, share
        if is_m_step_fused(parameters.means.shape[1], statistics, *parameters):
            em_step, ahead = fused_steps(*given)
        else:
            em_step, ahead = _steps(*given)
        self._em_step = Parameters(*em_step)
        return self._em_step if ahead is None else Parameters(*ahead)

    def undo(self) -> Parameters:
        """EM's own parameters of the last step. Resets the momentum."""
        assert self._em_step is not None
        self._last, self._age, self.is_extrapolated = None, 0, False
        return self._em_step


def _steps(
    statistics: Tensor,
    parameters: Parameters,
    reg_covar: float,
    last: tuple[Tensor, Tensor] | None,
    share: float,
) -> tuple[Parameters, Parameters | None]:
    """EM's own step and the extrapolated one; the twin of `kernels.mixtures.m_step.fused_steps`."""
    centered = parameters._replace(means=torch.zeros_like(parameters.means))

    def maximized(sums: Tensor) -> Parameters:
        found = maximization(sums, reg_covar, centered)
        return found._replace(means=found.means + parameters.means)

    em_step = maximized(statistics)
    if last is None:
        return em_step, None
    before = shift_features(last[0], last[1] - parameters.means)
    ahead = statistics + share * (statistics - before)
    trusted = ahead[:, 0] > 0.2 * statistics[:, 0]
    ahead = torch.where(trusted[:, None], ahead, statistics)
    moved = maximized(ahead)
    thickness, em_thickness = (torch.linalg.eigvalsh(p.covariances)[:, 0] for p in (moved, em_step))
    trusted &= thickness > 0.3 * em_thickness
    weights = torch.where(trusted, moved.weights, em_step.weights)
    return em_step, Parameters(
        weights / weights.sum(),
        torch.where(trusted[:, None], moved.means, em_step.means),
        torch.where(trusted[:, None, None], moved.covariances, em_step.covariances),
    )


# -- the loop -------------------------------------------------------------------------------------


def run_truncated(
    rows: Rows, owner: Tensor, parameters: Parameters, settings: Settings, candidates: Tensor | None = None
) -> tuple[EMResult[Parameters], Tensor, Tensor]:
    """Accelerated truncated EM from `parameters` and an initial owner (N,) of each row.

    It starts with the owners' `candidates` (K, m), or chooses them. Returns the result of EM, and the
    owners and candidates of the last bound. The bounds never decrease: if new candidates or the
    momentum decrease the bound, the old candidates are kept and the momentum is undone.
    """
    total = float(settings.processes.sum(rows.weight.sum()[None]))
    momentum = Momentum(settings.reg_covar)
    bounds: list[float] = []
    lengths = itertools.chain(_FIRST_SETS, itertools.repeat(_LATER_SETS))
    sets = new_sets = _candidate_sets(rows, owner, parameters, settings, candidates)
    left, converged, frozen = next(lengths), False, False
    while len(bounds) < settings.max_iter:
        if left == 0 and not frozen:
            new_sets, left = _candidate_sets(rows, owner, parameters, settings), next(lengths)
        own = centered_parameters(parameters)
        groups = _with_enough_digits(rows, new_sets[0], parameters.means, own)
        last_of_set = left == 1 and not frozen
        found = truncated_expectation(groups, new_sets[1], parameters, last_of_set, settings.compiled, own)
        statistics, value = _summed(found, settings.processes)
        bound = value / total
        if bounds and bound < bounds[-1]:
            if momentum.is_extrapolated:
                parameters = momentum.undo()  # the next pass tries the new sets once more from there
            elif new_sets is not sets:
                new_sets, frozen = sets, True
            else:
                converged = True  # EM's own step gains less than rounding or regularisation loses
                break
            continue
        sets, left = new_sets, left - 1
        bounds.append(bound)
        if settings.on_iteration is not None:
            settings.on_iteration(len(bounds), bound)
        was_extrapolated = momentum.is_extrapolated
        parameters = momentum.step(statistics, parameters)
        if has_converged(bounds, settings.tol, settings.previous_bound):
            if not was_extrapolated:
                converged = True
                break
            parameters = momentum.undo()  # the extrapolation may be too long: decide by EM's own step
        if found.owner is not None:
            owner = found.owner
    # EM's own parameters are certainly not worse than the last bound; extrapolated ones may be.
    parameters = momentum.undo() if momentum.is_extrapolated else parameters
    return EMResult(parameters, bounds, converged), owners_of(sets[0]), sets[1]


def _summed(found: Expectation, processes: Processes) -> tuple[Tensor, float]:
    """Statistics (K, F) and value, summed over all processes."""
    statistics = found.statistics
    packed = processes.sum(torch.cat([statistics.flatten(), statistics.new_tensor([found.value])]))
    return packed[:-1].view_as(statistics), float(packed[-1])


def _candidate_sets(
    rows: Rows, owner: Tensor, parameters: Parameters, settings: Settings, candidates: Tensor | None = None
) -> tuple[Groups, Tensor]:
    """The groups of these owners, and the candidates of each group, chosen if not given."""
    means = parameters.means
    groups = group_rows(rows, owner, means, settings.dtype)
    groups = _with_enough_digits(rows, groups, means, centered_parameters(parameters))
    if candidates is None:
        candidates = choose_candidates(groups, parameters, settings.n_candidates)
    return groups, candidates


def _with_enough_digits(rows: Rows, groups: Groups, means: Tensor, own: Tensor) -> Groups:
    """The same groups, in float64 and relative to the current means if float32 has too few digits.

    This is checked at each step, because components become thinner and move away from their group's center.
    """
    if groups.features.dtype == torch.float64:
        return groups
    average, worst = rounding(groups, own)
    if average <= _AVERAGE_ROUNDING and worst <= _WORST_ROUNDING:
        return groups
    return group_rows(rows, owners_of(groups), means, torch.float64)


def fit_truncated(
    rows: Rows, owner: Tensor, parameters: Parameters, settings: Settings
) -> EMResult[Parameters]:
    """`run_truncated`, first on a random sample if there are many points, or on cells if very many.

    With the same owners and candidates, the bound on cells is below the bound on their points, so the
    bounds still never decrease. Bounds on a sample do not bound the whole cloud and are left out.
    """
    n, n_components = rows.weight.shape[0], parameters.weights.shape[0]
    n_all = int(settings.processes.sum(rows.weight.new_tensor([n])))  # so that all processes decide equally
    n_cells = max(n_all // _POINTS_OF_A_CELL, _CELLS_OF_A_COMPONENT * n_components)
    many = rows.are_points and n_all >= max(_MANY_POINTS, 4 * n_cells)
    if not many or rows.values.shape[1] > 3 or settings.max_iter < 2:
        n_sampled = _SAMPLED_OF_A_COMPONENT * n_components
        if n_all >= 2 * n_sampled and settings.max_iter > 1:
            drawn = _sample(rows, n * n_sampled // n_all)
            part = Rows(rows.values[drawn], rows.weight[drawn], rows.are_points)
            silent = replace(settings, on_iteration=None, previous_bound=-math.inf)
            parameters = run_truncated(part, owner[drawn], parameters, silent)[0].parameters
        return run_truncated(rows, owner, parameters, settings)[0]
    share = max(1, n_cells // settings.processes.size)
    cells = pool_into_cells(rows.values, share, max(settings.reg_covar, 1e-12) ** 0.5, rows.weight)
    # The owner of a cell is the largest owner of its points, which does not depend on their order.
    first = owner.new_zeros(cells.weight.shape[0]).scatter_reduce_(0, cells.member, owner, "amax")
    coarse, owner, candidates = run_truncated(
        Rows(cells.features, cells.weight, are_points=False),
        first,
        parameters,
        replace(settings, max_iter=settings.max_iter // 2, previous_bound=-math.inf),
    )

    def on_fine_iteration(iteration: int, bound: float) -> None:
        if settings.on_iteration is not None:
            settings.on_iteration(coarse.n_iter + iteration, bound)

    left = replace(
        settings,
        max_iter=settings.max_iter - coarse.n_iter,
        on_iteration=on_fine_iteration,
        previous_bound=-math.inf,
    )
    fine, *_ = run_truncated(rows, owner[cells.member], coarse.parameters, left, candidates)
    return EMResult(fine.parameters, coarse.lower_bounds + fine.lower_bounds, fine.converged)


def _sample(rows: Rows, n: int) -> Tensor:
    """Indices of n random rows, in order. The seed is fixed: the same number of rows gives the same draw."""
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randperm(rows.weight.shape[0], generator=generator)[:n]
    return chosen.sort().values.to(rows.weight.device)
