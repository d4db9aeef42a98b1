"""Truncated EM: fast EM for many components, with a momentum on the sufficient statistics.

In a mixture of a thousand surface patches, only a few components near a point have responsibilities above
zero to many digits. Each row (a point, or a cell of points) therefore has an owner, its most likely
component. All rows of an owner form a group, and a group is compared with the owner's candidate
components only. With all other responsibilities set to zero, EM still increases a lower bound of the
log-likelihood (truncated variational EM: Lücke & Forster, 2019). The cost depends on the number of
candidates, not on the number of components. Each group is computed relative to its owner's mean, so that
float32 has enough digits.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels import chunk_elements, chunked, fused_truncated_em, is_m_step_fused, n_sampled_rows
from gmmtorch.linalg import argsort, largest_indices, pack_symmetric, unpack_symmetric
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.distributed import SINGLE_PROCESS, Processes
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.em.loop import EMResult, has_converged
from gmmtorch.mixture.em.partition import pool_into_cells

_FIRST_SETS, _LATER_SETS = (2, 3, 3, 4, 4), 8  # iterations for which each set of candidates is used
_AVERAGE_ROUNDING, _WORST_ROUNDING = 0.02, 0.2  # nats of float32 error above which float64 is used
_SAMPLED_OF_A_COMPONENT = 400  # points a component in the random sample that EM starts on
_MANY_POINTS = 1 << 19  # from this number of points on, EM starts on cells
_POINTS_OF_A_CELL, _CELLS_OF_A_COMPONENT = 16, 32
_BUILD_ROWS = 1 << 18


@dataclass(frozen=True)
class Settings:
    """Settings of truncated EM.

    reg_covar: added to each variance (m²). tol: EM stops when the bound increases by less (nats a
    point). max_iter: largest number of iterations. dtype: of the E-step; float32 is replaced by float64
    where its error is too large, and in the fused kernel. n_candidates: components that each row is
    compared with. on_iteration: called with the iteration, from 1, and the bound. processes: that share
    the fit, each with its own rows. previous_bound: bound of the fit that this one continues.
    """

    reg_covar: float = 1e-6
    tol: float = 1e-3
    max_iter: int = 100
    dtype: torch.dtype = torch.float32
    n_candidates: int = 16
    on_iteration: Callable[[int, float], None] | None = None
    processes: Processes = SINGLE_PROCESS
    previous_bound: float = -math.inf


class Momentum:
    """M-steps on the statistics of the E-step plus a share of their last change (Nesterov's schedule).

    A component takes EM's own step instead if that reduces its mass or its smallest thickness too much.
    """

    def __init__(self, reg_covar: float) -> None:
        self._reg_covar = reg_covar
        self._age = 0
        self._last: tuple[Tensor, Tensor] | None = None  # statistics, and the means they are relative to
        self._em_step: Parameters | None = None
        self.is_extrapolated = False

    def step(self, statistics: Tensor, parameters: Parameters) -> Parameters:
        """The next parameters, from statistics (K, F) relative to the means of `parameters`."""
        means, last, self._last = parameters.means, self._last, (statistics, parameters.means)
        centered = parameters._replace(means=torch.zeros_like(means))

        def maximized(sums: Tensor) -> Parameters:
            found = em.maximization(sums, self._reg_covar, centered)
            return found._replace(means=found.means + means)

        em_step = self._em_step = maximized(statistics)
        share = 0.0 if last is None else self._age / (self._age + 3)
        self._age += last is not None
        self.is_extrapolated = share > 0
        if last is None or not self.is_extrapolated:
            return em_step
        ahead = statistics + share * (statistics - em.shift_features(last[0], last[1] - means))
        trusted = ahead[:, 0] > 0.2 * statistics[:, 0]
        moved = maximized(torch.where(trusted[:, None], ahead, statistics))
        thickness, em_thickness = (torch.linalg.eigvalsh(p.covariances)[:, 0] for p in (moved, em_step))
        trusted &= thickness > 0.3 * em_thickness
        weights = torch.where(trusted, moved.weights, em_step.weights)
        return Parameters(
            weights / weights.sum(),
            torch.where(trusted[:, None], moved.means, em_step.means),
            torch.where(trusted[:, None, None], moved.covariances, em_step.covariances),
        )

    def undo(self) -> Parameters:
        """EM's own parameters of the last step. Resets the momentum."""
        assert self._em_step is not None
        self._last, self._age, self.is_extrapolated = None, 0, False
        return self._em_step


def run_truncated(
    rows: Rows, owner: Tensor, parameters: Parameters, settings: Settings, candidates: Tensor | None = None
) -> tuple[EMResult[Parameters], Tensor, Tensor]:
    """Accelerated truncated EM from `parameters` and an initial owner (N,) of each row.

    It starts with the owners' `candidates` (K, m), or chooses them. Returns the result of EM, and the
    owners and candidates of the last bound. The bounds never decrease: if new candidates or the
    momentum decrease the bound, the old candidates are kept and the momentum is undone.

    In up to three dimensions a fused kernel computes all of it in float64. `settings.on_iteration` is called
    when it ends, after many iterations.
    """
    if is_m_step_fused(parameters.means.shape[1], rows.values, rows.weight, *parameters):
        found = fused_truncated_em(
            rows.values,
            rows.weight,
            owner,
            parameters,
            (settings.reg_covar, settings.tol, settings.previous_bound, settings.max_iter),
            settings.n_candidates if candidates is None else candidates,
            lambda mixture: centered_parameters(Parameters(*mixture)),
            settings.processes.sum if settings.processes.size > 1 else None,
            settings.on_iteration,
        )
        result = EMResult(Parameters(*found.mixture), found.bounds, found.converged)
        return result, found.owner, found.candidates
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
        statistics, value, likeliest = truncated_expectation(
            groups, new_sets[1], parameters, last_of_set, own
        )
        packed = torch.cat([statistics.flatten(), statistics.new_tensor([value])])
        packed = settings.processes.sum(packed)
        bound = float(packed[-1]) / total
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
        parameters = momentum.step(packed[:-1].view_as(statistics), parameters)
        if has_converged(bounds, settings.tol, settings.previous_bound):
            if not was_extrapolated:
                converged = True
                break
            parameters = momentum.undo()  # the extrapolation may be too long: decide by EM's own step
        owner = owner if likeliest is None else likeliest
    # EM's own parameters are certainly not worse than the last bound; extrapolated ones may be.
    parameters = momentum.undo() if momentum.is_extrapolated else parameters
    return EMResult(parameters, bounds, converged), owners_of(sets[0]), sets[1]


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
    shared = settings.processes.size > 1  # then all processes decide equally
    n_all = int(settings.processes.sum(rows.weight.new_tensor([n]))) if shared else n
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

    report, n_left = settings.on_iteration, settings.max_iter - coarse.n_iter
    later = None if report is None else lambda iteration, bound: report(coarse.n_iter + iteration, bound)
    left = replace(settings, max_iter=n_left, on_iteration=later, previous_bound=-math.inf)
    fine, *_ = run_truncated(rows, owner[cells.member], coarse.parameters, left, candidates)
    return EMResult(fine.parameters, coarse.lower_bounds + fine.lower_bounds, fine.converged)


def _sample(rows: Rows, n: int) -> Tensor:
    """Indices of n random rows, in order. The seed is fixed: the same number of rows gives the same draw."""
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randperm(rows.weight.shape[0], generator=generator)[:n]
    return chosen.sort().values.to(rows.weight.device)


@dataclass(frozen=True)
class Rows:
    """Input of EM, in one frame, float64: points (N, D), or the mean features (N, F) of cells.

    weight (N,): number of points that each row stands for.
    """

    values: Tensor
    weight: Tensor
    are_points: bool = True

    @property
    def points(self) -> Tensor:
        """The points (N, D), or the means of the cells."""
        if self.are_points:
            return self.values
        return self.values[:, 1 : 1 + em.feature_dimension(self.values.shape[1])].contiguous()


class Groups(NamedTuple):
    """Rows sorted by owner, in blocks of B rows of one owner. Rows of weight 0 fill incomplete blocks.

    features: (b, B, F) relative to the center of the owner. weight: (b, B). owner: (b,) of each block.
    centers: (K, D) of the owners. n_rows, mass, spread: (K,) number of rows, Σp and Σp‖x − center‖² of
    each owner. row, slot: (N,) row `row[i]` is stored in slot `slot[i]` of the b·B slots.
    """

    features: Tensor
    weight: Tensor
    owner: Tensor
    centers: Tensor
    n_rows: Tensor
    mass: Tensor
    spread: Tensor
    row: Tensor
    slot: Tensor


def group_rows(
    rows: Rows, owner: Tensor, centers: Tensor, dtype: torch.dtype, as_points: bool = False
) -> Groups:
    """Group rows by owner (N,), relative to the owner's center (K, D), in `dtype`.

    With `as_points`, for points: the groups have points (b, B, D) in place of their features.
    """
    n, (k, dim) = owner.shape[0], centers.shape
    # Small blocks need little padding; large blocks multiply faster.
    block = 16 if n < 48 * k else 32 if n < 200 * k else 64
    row = argsort(owner)
    count = torch.bincount(owner, minlength=k)
    n_blocks = (count + block - 1) // block
    gap = (torch.cumsum(n_blocks, 0) - n_blocks) * block - (torch.cumsum(count, 0) - count)
    n_slots = int(n_blocks.sum()) * block
    n_features = dim if as_points else em.quadratic_features(centers[:1]).shape[1]
    features = torch.zeros(n_slots, n_features, dtype=dtype, device=owner.device)
    weight = torch.zeros(n_slots, dtype=dtype, device=owner.device)
    slot = torch.empty_like(row)
    for begin in range(0, n, _BUILD_ROWS):
        part = slice(begin, min(begin + _BUILD_ROWS, n))
        group = owner.index_select(0, row[part])
        slot[part] = torch.arange(part.start, part.stop, device=owner.device) + gap.index_select(0, group)
        values, own = rows.values.index_select(0, row[part]), centers.index_select(0, group)
        local = (values - own if rows.are_points else em.shift_features(values, -own)).to(dtype)
        local = em.quadratic_features(local) if rows.are_points and not as_points else local
        features.index_copy_(0, slot[part], local)
        weight.index_copy_(0, slot[part], rows.weight.index_select(0, row[part]).to(dtype))
    trace = pack_symmetric(torch.eye(dim, dtype=dtype, device=owner.device))
    squared = features.square().sum(1) if as_points else features[:, -trace.shape[0] :] @ trace
    sums = torch.stack([weight, weight * squared]).view(2, -1, block).sum(2).double()
    owner_of_block = torch.repeat_interleave(torch.arange(k, device=owner.device), n_blocks)
    mass, spread = sums.new_zeros(2, k).index_add_(1, owner_of_block, sums)
    blocks = features.view(-1, block, n_features), weight.view(-1, block), owner_of_block
    return Groups(*blocks, centers, count, mass, spread, row, slot)


def owners_of(groups: Groups) -> Tensor:
    """The owner of each row, (N,)."""
    return _of_rows(groups, groups.owner[groups.slot // groups.weight.shape[1]])


def _of_rows(groups: Groups, values: Tensor) -> Tensor:
    """Values (N,) in the order of `groups.row`, in the order of the rows."""
    return torch.empty_like(values).scatter_(0, groups.row, values)


def nearest(points: Tensor, means: Tensor) -> Tensor:
    """The component (N,) whose mean (K, D) is nearest to each point (N, D)."""
    from scipy.spatial import cKDTree

    tree = cKDTree(means.detach().cpu().numpy())
    return torch.from_numpy(tree.query(points.detach().cpu().numpy())[1]).to(points.device)


def choose_candidates(groups: Groups, parameters: Parameters, n_candidates: int) -> Tensor:
    """The `n_candidates` most likely components (K, m) for the group of each of the K owners.

    A sample of each group's rows is compared with all components. The owner is always a candidate.
    """
    k = parameters.weights.shape[0]
    if k <= n_candidates:
        return torch.arange(k, device=groups.owner.device).expand(k, k)
    n_samples = n_sampled_rows(k)
    # Evenly spaced over the rows of a group, because adjacent rows of a scan are adjacent in space.
    count, steps = groups.n_rows[:, None], torch.arange(n_samples, device=groups.n_rows.device)
    place = torch.cumsum(count, 0) - count + (2 * steps + 1) * count // (2 * n_samples)
    place = place.clamp_max_(groups.slot.shape[0] - 1)  # of empty groups, whose candidates are unused
    natural = em.natural_parameters(parameters).T.contiguous()
    samples = groups.features.flatten(0, 1)[groups.slot[place]]

    def chosen(part: slice) -> Tensor:
        moved = em.shift_features(samples[part].double(), groups.centers[part, None])
        joint = (moved.flatten(0, 1) @ natural).to(samples.dtype).view(-1, n_samples, k)
        joint -= joint.amax(2, keepdim=True)
        score = joint.amax(1)
        own = torch.arange(part.start, part.stop, device=score.device)
        score[own - part.start, own] = torch.inf
        return largest_indices(score, n_candidates)

    step = max(1, 4 * chunk_elements(groups.owner.device) // (n_samples * k))
    return torch.cat(list(chunked(k, step, chosen)))


def truncated_expectation(
    groups: Groups,
    candidates: Tensor,
    parameters: Parameters,
    want_owner: bool = False,
    own: Tensor | None = None,
) -> tuple[Tensor, float, Tensor | None]:
    """E-step of `exact.expectation`, restricted to the candidates (G, m) of each of the G groups.

    Returns the statistics (K, F) relative to the components' means, float64; Σ p log Σ_candidates, nats; and
    with `want_owner` the most likely candidate (N,) of each row. `own`: the `centered_parameters`, if they
    are known.
    """
    own = centered_parameters(parameters) if own is None else own
    n_groups, m = candidates.shape
    n_blocks, block, n_features = groups.features.shape
    dtype = groups.features.dtype
    natural = _local_parameters(own, parameters.means, groups.centers, candidates).to(dtype)
    sums = torch.zeros(n_groups, m * n_features, dtype=dtype, device=candidates.device)
    value = torch.zeros((), dtype=torch.float64, device=candidates.device)
    likeliest = torch.empty_like(groups.weight, dtype=torch.int64) if want_owner else None

    def sums_of(part: slice) -> tuple[slice, Tensor, Tensor, Tensor | None]:
        features, owner = groups.features[part], groups.owner[part]
        block_natural = natural.index_select(0, owner)
        best = candidates[owner].gather(1, _likeliest(block_natural, features)) if want_owner else None
        return part, *sums_of_blocks(block_natural, features.transpose(1, 2), groups.weight[part]), best

    step = max(1, chunk_elements(groups.owner.device) // (block * m))
    for part, block_statistics, block_value, best in chunked(n_blocks, step, sums_of):
        sums.index_add_(0, groups.owner[part], block_statistics)
        value += block_value.sum()
        if likeliest is not None and best is not None:
            likeliest[part] = best
    by_pair = sums.view(n_groups, m, n_features).double()
    about_means = em.shift_features(by_pair, groups.centers[:, None] - parameters.means[candidates])
    statistics = about_means.new_zeros(parameters.weights.shape[0], n_features)
    statistics.index_add_(0, candidates.flatten(), about_means.flatten(0, 1))
    likeliest_of_rows = None if likeliest is None else _of_rows(groups, likeliest.flatten()[groups.slot])
    return statistics, float(value), likeliest_of_rows


def centered_parameters(parameters: Parameters) -> Tensor:
    """Natural parameters (K, F) of the components about their own means."""
    return em.natural_parameters(parameters._replace(means=torch.zeros_like(parameters.means)))


def _local_parameters(own: Tensor, means: Tensor, centers: Tensor, candidates: Tensor) -> Tensor:
    """Natural parameters (K, m, F) of the candidates (K, m), relative to each group's center (K, D).

    own (K, F): natural parameters of the components about their own means (K, D).
    """
    dim = centers.shape[1]
    doubled = own[:, 1 + dim :]
    scale = pack_symmetric(0.5 + 0.5 * torch.eye(dim, dtype=own.dtype, device=own.device))
    precision = unpack_symmetric(-2 * doubled * scale, dim)
    offset = means[candidates] - centers[:, None]
    linear = (precision[candidates] @ offset[..., None]).squeeze(-1)
    constant = own[:, 0][candidates] - 0.5 * (linear * offset).sum(-1)
    return torch.cat([constant[..., None], linear, doubled[candidates]], -1)


def sums_of_blocks(natural: Tensor, features: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Σγφ (b, m·F) and Σ p log Σ exp (b,), float64, of blocks: natural (b, m, F), features (b, F, B), weight
    (b, B)."""
    floor = em.exponent_floor(features.dtype)
    # Candidates are the rows, so that reductions over candidates run along contiguous memory.
    gamma = torch.bmm(natural, features)  # (b, m, B)
    peak = gamma.amax(1, keepdim=True)
    norm = gamma.sub_(peak).clamp_(min=floor).exp_().sum(1)
    value = (weight * (peak[:, 0] + norm.log())).sum(1, dtype=torch.float64)
    gamma.mul_((weight / norm)[:, None])
    return torch.bmm(gamma, features.transpose(1, 2)).flatten(1), value


def _likeliest(natural: Tensor, features: Tensor) -> Tensor:
    """Position (b, B) of the most likely candidate of each row."""
    joint = torch.bmm(natural, features.transpose(1, 2))
    # A mask, because argmax along a dimension other than the last is slow.
    place = torch.arange(joint.shape[1], dtype=joint.dtype, device=joint.device)[:, None]
    return torch.where(joint == joint.amax(1, keepdim=True), place, 0).amax(1).long()


def rounding(groups: Groups, own: Tensor) -> tuple[float, float]:
    """Expected error of a float32 E-step, nats a point: the mean, and that of the worst group.

    The error is ε/2 E[‖x‖²] tr Σ⁻¹. It is also the relative error of a component's smallest variance. `own`
    (K, F): the `centered_parameters`.
    """
    diagonal = pack_symmetric(torch.eye(groups.centers.shape[1], dtype=own.dtype, device=own.device))
    precision = -2 * (own[:, -diagonal.shape[0] :] @ diagonal)
    error = groups.spread * precision * (torch.finfo(torch.float32).eps / 2)
    return float(error.sum() / groups.mass.sum()), float((error / groups.mass.clamp_min(1e-300)).max())
