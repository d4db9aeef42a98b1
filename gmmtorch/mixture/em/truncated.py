"""EM over the components that matter: the fast way to many components.

In a mixture of a thousand pieces of surface, a point has a few components near it; all others have
responsibilities that are zero to many digits. Rows (points, or cells of points) are therefore
grouped by the component that owns them, the likeliest one, and the rows of a group are offered a
few candidates only. With the responsibilities of all others set to zero, EM still raises a lower
bound on the log-likelihood (truncated variational EM: Lücke & Forster, 2019), and costs what the
candidates cost, whatever the number of components.

Every group is worked on about its owner's mean, so that the two-product form of `em` keeps enough
digits in float32. Between its E-steps, EM is accelerated by a momentum on the sufficient statistics.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.linalg import inverse_factor, pack_symmetric, safe_cholesky, unpack_symmetric
from gmmtorch.mixture.em.cells import pool_into_cells
from gmmtorch.mixture.em.exact import (
    CHUNK_ELEMENTS,
    EMResult,
    Parameters,
    natural_parameters,
    shift_features,
)
from gmmtorch.mixture.em.grouping import Groups, Rows, choose_candidates, group_rows, owners_of
from gmmtorch.mixture.em.momentum import Momentum
from gmmtorch.mixture.streaming.distributed import ALONE, Processes

_FIRST_SETS = (2, 3, 3, 4, 4)  # iterations with the same candidates; more later on
_LATER_SETS = 8
_AVERAGE_ROUNDING, _WORST_ROUNDING = 0.02, 0.2  # nats, in float32; above them, float64 is used
_SAMPLED_OF_A_COMPONENT = 400  # points, of which EM begins on a sample
_MANY_POINTS = 1 << 19  # from which on EM begins on cells
_POINTS_OF_A_CELL, _CELLS_OF_A_COMPONENT = 16, 32


def local_parameters(parameters: Parameters, centers: Tensor, candidates: Tensor) -> Tensor:
    """Natural parameters (K, m, F) of the candidates (K, m), about each group's center (K, D)."""
    zero = Parameters(parameters.weights, torch.zeros_like(parameters.means), parameters.covariances)
    natural = natural_parameters(zero)  # of the components about their own means
    dim = centers.shape[1]
    doubled = natural[:, 1 + dim :]
    scale = pack_symmetric(0.5 + 0.5 * torch.eye(dim, dtype=natural.dtype, device=natural.device))
    precision = unpack_symmetric(-2 * doubled * scale, dim)
    offset = parameters.means[candidates] - centers[:, None]
    linear = (precision[candidates] @ offset[..., None]).squeeze(-1)
    constant = natural[:, 0][candidates] - 0.5 * (linear * offset).sum(-1)
    return torch.cat([constant[..., None], linear, doubled[candidates]], -1)


class Expectation(NamedTuple):
    """statistics (K, F) about the components' means, float64; value: Σ p log Σ_candidates; owner (N,)."""

    statistics: Tensor
    value: float
    owner: Tensor | None


def truncated_expectation(
    groups: Groups,
    candidates: Tensor,
    parameters: Parameters,
    want_owner: bool = False,
    compiled: bool = False,
) -> Expectation:
    """The E-step of `em.expectation` over the candidates (G, m) of each of G groups.

    With `want_owner`, each row's likeliest candidate, too. `compiled`: by torch.compile, see `Settings`.
    """
    n_groups, m = candidates.shape
    n_blocks, block, n_features = groups.features.shape
    dtype = groups.features.dtype
    natural = local_parameters(parameters, groups.centers, candidates).to(dtype)
    sums = torch.zeros(n_groups, n_features * m, dtype=dtype, device=candidates.device)
    value = torch.zeros((), dtype=torch.float64, device=candidates.device)
    likeliest = torch.empty_like(groups.weight, dtype=torch.int64) if want_owner else None
    expect = _compiled_block_sums() if compiled else _block_sums
    step = max(1, CHUNK_ELEMENTS // (block * m))
    for begin in range(0, n_blocks, step):
        part = slice(begin, begin + step)
        owner = groups.owner[part]
        mine = natural.index_select(0, owner)
        found, gain = expect(mine, groups.features[part], groups.weight[part])
        sums.index_add_(0, owner, found)
        value += gain
        if likeliest is not None:
            likeliest[part] = candidates[owner].gather(1, _winners(mine, groups.features[part]))
    by_pair = sums.view(n_groups, n_features, m).transpose(1, 2).double()
    about_means = shift_features(by_pair, groups.centers[:, None] - parameters.means[candidates])
    statistics = about_means.new_zeros(parameters.weights.shape[0], n_features)
    statistics.index_add_(0, candidates.flatten(), about_means.flatten(0, 1))
    owners = None
    if likeliest is not None:
        owners = torch.empty_like(groups.row)
        owners[groups.row] = likeliest.flatten()[groups.slot]
    return Expectation(statistics, float(value), owners)


def _block_sums(natural: Tensor, features: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Σγφ (b, F·m) and Σ p log Σ exp of blocks: natural (b, m, F), features (b, B, F), weight (b, B)."""
    floor = -80.0 if features.dtype == torch.float32 else -700.0  # less would be denormal: nothing, but slow
    # Candidates along the rows: reductions over them then run along contiguous memory.
    gamma = torch.bmm(natural, features.transpose(1, 2))  # (b, m, B)
    peak = gamma.amax(1, keepdim=True)
    norm = gamma.sub_(peak).clamp_(min=floor).exp_().sum(1)
    value = (weight * (peak[:, 0] + norm.log())).sum(dtype=torch.float64)
    gamma.mul_((weight / norm)[:, None])
    return torch.bmm(features.transpose(1, 2), gamma.transpose(1, 2)).flatten(1), value


@functools.cache
def _compiled_block_sums() -> Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]:
    compiled: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
    compiled = torch.compile(_block_sums, dynamic=True)
    return compiled


def _winners(natural: Tensor, features: Tensor) -> Tensor:
    """Which of the candidates, (b, B), is likeliest."""
    joint = torch.bmm(natural, features.transpose(1, 2))
    # By a mask: argmax along a dimension that is not the last is slow.
    place = torch.arange(joint.shape[1], dtype=joint.dtype, device=joint.device)[:, None]
    return torch.where(joint == joint.amax(1, keepdim=True), place, 0).amax(1).long()


def rounding(groups: Groups, parameters: Parameters) -> tuple[float, float]:
    """How far float32 may be off, in nats a point: ε/2 E[‖x‖²] tr Σ⁻¹, on the average and in the worst group.

    A component's least variance may be off by so much, too, relative to itself.
    """
    precision = inverse_factor(safe_cholesky(parameters.covariances)).square().sum((1, 2))
    error = groups.spread * precision * (torch.finfo(torch.float32).eps / 2)
    return float(error.sum() / groups.mass.sum()), float((error / groups.mass.clamp_min(1e-300)).max())


@dataclass(frozen=True)
class Settings:
    """How truncated EM runs.

    reg_covar: added to each variance (m²). tol: EM ends when its bound rises by less, in nats a
    point. max_iter: iterations at most. dtype: of the E-step; float32 is raised to float64 where it
    would err too much. n_candidates: components offered to each row. on_iteration: called with the
    iteration, from 1, and the bound. processes: who shares the fit, each with rows of its own.
    compiled: the E-step by torch.compile: the same to rounding, half as fast again, after about five
    seconds for its first use in a process. Needs a C++ compiler.
    """

    reg_covar: float = 1e-6
    tol: float = 1e-3
    max_iter: int = 100
    dtype: torch.dtype = torch.float32
    n_candidates: int = 16
    on_iteration: Callable[[int, float], None] | None = None
    processes: Processes = ALONE
    compiled: bool = False


def run_truncated(
    rows: Rows, owner: Tensor, parameters: Parameters, settings: Settings, candidates: Tensor | None = None
) -> tuple[EMResult, Tensor, Tensor]:
    """Accelerated truncated EM from `parameters`, and from a likely component for each row, `owner` (N,).

    It begins with these owners' `candidates` (K, m), or chooses them. Returns what `em.run_em` does,
    and the owners and candidates that the last bound is of. The bounds never fall: where new
    candidates or the momentum would lower them, the old candidates are kept and the momentum dropped.
    """
    total = float(settings.processes.sum(rows.weight.sum()[None]))
    momentum = Momentum(settings.reg_covar)
    bounds: list[float] = []
    lengths = _set_lengths()
    sets = fresh = _sets(rows, owner, parameters, settings, candidates)
    left, converged, frozen = next(lengths), False, False
    while len(bounds) < settings.max_iter:
        if left == 0 and not frozen:
            fresh, left = _sets(rows, owner, parameters, settings), next(lengths)
        groups = _sharp(rows, fresh[0], parameters)
        last_of_set = left == 1 and not frozen
        found = truncated_expectation(groups, fresh[1], parameters, last_of_set, settings.compiled)
        statistics, value = _summed(found, settings.processes)
        bound = value / total
        if bounds and bound < bounds[-1]:
            if momentum.is_moving:
                parameters = momentum.undo()  # new sets are tried once more, from there
            elif fresh is not sets:
                fresh, frozen = sets, True
            else:
                converged = True  # EM's own step gains less than rounding, or regularisation, takes
                break
            continue
        sets, left = fresh, left - 1
        bounds.append(bound)
        if settings.on_iteration is not None:
            settings.on_iteration(len(bounds), bound)
        was_moving = momentum.is_moving
        parameters = momentum.step(statistics, parameters)
        if len(bounds) > 1 and bounds[-1] - bounds[-2] < settings.tol:
            if not was_moving:
                converged = True
                break
            parameters = momentum.undo()  # it went too far, perhaps: EM's own step decides
        if found.owner is not None:
            owner = found.owner
    # Those that momentum went beyond: sure not to be worse than the last bound.
    parameters = momentum.undo() if momentum.is_moving else parameters
    return EMResult(parameters, bounds, converged), owners_of(sets[0]), sets[1]


def _summed(found: Expectation, processes: Processes) -> tuple[Tensor, float]:
    """Statistics (K, F) and value of all processes."""
    if processes.size == 1:
        return found.statistics, found.value
    statistics = found.statistics
    packed = processes.sum(torch.cat([statistics.flatten(), statistics.new_tensor([found.value])]))
    return packed[:-1].view_as(statistics), float(packed[-1])


def _sets(
    rows: Rows, owner: Tensor, parameters: Parameters, settings: Settings, candidates: Tensor | None = None
) -> tuple[Groups, Tensor]:
    """The groups of these owners, and the candidates of each, chosen if not given."""
    groups = _sharp(rows, group_rows(rows, owner, parameters.means, settings.dtype), parameters)
    if candidates is None:
        candidates = choose_candidates(groups, parameters, settings.n_candidates)
    return groups, candidates


def _sharp(rows: Rows, groups: Groups, parameters: Parameters) -> Groups:
    """The same groups, or in float64, about the present means, where float32 would err too much.

    That may change with every step: components become thin, and leave where their group's center was.
    """
    if groups.features.dtype == torch.float64:
        return groups
    average, worst = rounding(groups, parameters)
    if average <= _AVERAGE_ROUNDING and worst <= _WORST_ROUNDING:
        return groups
    return group_rows(rows, owners_of(groups), parameters.means, torch.float64)


def learn_truncated(rows: Rows, owner: Tensor, parameters: Parameters, settings: Settings) -> EMResult:
    """`run_truncated`, on a sample first where there are many points, on cells where there are very many.

    The bound on cells is below the one on their points with the same owners and candidates, so the
    bounds still never fall. Those on a sample are no bounds on the whole: they are left out.
    """
    n, n_components = rows.weight.shape[0], parameters.weights.shape[0]
    n_all = int(settings.processes.sum(rows.weight.new_tensor([n])))  # all decide alike
    n_cells = max(n_all // _POINTS_OF_A_CELL, _CELLS_OF_A_COMPONENT * n_components)
    many = rows.are_points and n_all >= max(_MANY_POINTS, 4 * n_cells)
    if not many or rows.values.shape[1] > 3 or settings.max_iter < 2:
        n_sampled = _SAMPLED_OF_A_COMPONENT * n_components
        if n_all >= 2 * n_sampled and settings.max_iter > 1:
            drawn = _sample(rows, n * n_sampled // n_all)
            part = Rows(rows.values[drawn], rows.weight[drawn], rows.are_points)
            silent = replace(settings, on_iteration=None)
            parameters = run_truncated(part, owner[drawn], parameters, silent)[0].parameters
        return run_truncated(rows, owner, parameters, settings)[0]
    share = max(1, n_cells // settings.processes.size)
    cells = pool_into_cells(rows.values, share, max(settings.reg_covar, 1e-12) ** 0.5, rows.weight)
    # A cell's owner: that of one of its points, the same one in whatever order they come.
    first = owner.new_zeros(cells.weight.shape[0]).scatter_reduce_(0, cells.member, owner, "amax")
    coarse, owner, candidates = run_truncated(
        Rows(cells.features, cells.weight, are_points=False),
        first,
        parameters,
        replace(settings, max_iter=settings.max_iter // 2),
    )

    def go_on(iteration: int, bound: float) -> None:
        if settings.on_iteration is not None:
            settings.on_iteration(coarse.n_iter + iteration, bound)

    left = replace(settings, max_iter=settings.max_iter - coarse.n_iter, on_iteration=go_on)
    fine, *_ = run_truncated(rows, owner[cells.member], coarse.parameters, left, candidates)
    return EMResult(fine.parameters, coarse.lower_bounds + fine.lower_bounds, fine.converged)


def _sample(rows: Rows, n: int) -> Tensor:
    """n of the rows at random, in their order: the same ones whenever there are as many."""
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randperm(rows.weight.shape[0], generator=generator)[:n]
    return chosen.sort().values.to(rows.weight.device)


def _set_lengths() -> Iterator[int]:
    yield from _FIRST_SETS
    while True:
        yield _LATER_SETS
