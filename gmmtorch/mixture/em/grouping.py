"""Truncated E-step: rows grouped by their owner, with a few candidate components for each group.

In a mixture of a thousand surface patches, only a few components near a point have responsibilities
above zero to many digits. Each row (a point, or a cell of points) therefore has an owner, its most
likely component. All rows of an owner form a group, and a group is compared with the owner's
candidate components only.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gmmtorch.kernels import (
    GroupedRows,
    chunk_elements,
    chunked,
    fused_candidates,
    fused_expectation,
    fused_natural_parameters,
    is_m_step_fused,
    is_truncated_e_step_fused,
)
from gmmtorch.linalg import argsort, largest_indices, pack_symmetric, unpack_symmetric
from gmmtorch.mixture.em.exact import (
    Parameters,
    exponent_floor,
    feature_dimension,
    natural_parameters,
    quadratic_features,
    shift_features,
)

_SAMPLES = 64  # most rows of a group that are compared with all components
_BUILD_ROWS = 1 << 18


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
        return self.values[:, 1 : 1 + feature_dimension(self.values.shape[1])].contiguous()

    def features(self) -> Tensor:
        """Features (N, F)."""
        return quadratic_features(self.values) if self.are_points else self.values

    def local_features(self, index: Tensor, center: Tensor, dtype: torch.dtype) -> Tensor:
        """Features (n, F) of the rows `index` (n,), each relative to its own center (n, D)."""
        values = self.values.index_select(0, index)
        if self.are_points:
            return quadratic_features((values - center).to(dtype))
        return shift_features(values, -center).to(dtype)


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

    def rows(self) -> GroupedRows:
        """The slots of each group, for the fused kernels."""
        block = self.weight.shape[1]
        n_slots = (self.n_rows + block - 1) // block * block
        begin = torch.cat([n_slots.new_zeros(1), n_slots.cumsum(0)])
        return GroupedRows(
            self.features.flatten(0, 1), self.weight.flatten(), begin, self.centers.contiguous()
        )


def group_rows(rows: Rows, owner: Tensor, centers: Tensor, dtype: torch.dtype) -> Groups:
    """Group rows by owner (N,), relative to the owner's center (K, D), in `dtype`."""
    n, k = owner.shape[0], centers.shape[0]
    # Small blocks need little padding; large blocks multiply faster.
    block = 16 if n < 48 * k else 32 if n < 200 * k else 64
    row = argsort(owner)
    count = torch.bincount(owner, minlength=k)
    blocks = (count + block - 1) // block
    gap = (torch.cumsum(blocks, 0) - blocks) * block - (torch.cumsum(count, 0) - count)
    n_slots = int(blocks.sum()) * block
    n_features = quadratic_features(centers[:1]).shape[1]
    features = torch.zeros(n_slots, n_features, dtype=dtype, device=owner.device)
    weight = torch.zeros(n_slots, dtype=dtype, device=owner.device)
    slot = torch.empty_like(row)
    for begin in range(0, n, _BUILD_ROWS):
        part = slice(begin, min(begin + _BUILD_ROWS, n))
        group = owner.index_select(0, row[part])
        slot[part] = torch.arange(part.start, part.stop, device=owner.device) + gap.index_select(0, group)
        local = rows.local_features(row[part], centers.index_select(0, group), dtype)
        features.index_copy_(0, slot[part], local)
        weight.index_copy_(0, slot[part], rows.weight.index_select(0, row[part]).to(dtype))
    trace = pack_symmetric(torch.eye(centers.shape[1], dtype=dtype, device=owner.device))
    squared = features[:, -trace.shape[0] :] @ trace
    sums = torch.stack([weight, weight * squared]).view(2, -1, block).sum(2).double()
    owner_of_block = torch.repeat_interleave(torch.arange(k, device=owner.device), blocks)
    mass, spread = sums.new_zeros(2, k).index_add_(1, owner_of_block, sums)
    blocks_of_features, blocks_of_weights = features.view(-1, block, n_features), weight.view(-1, block)
    return Groups(
        blocks_of_features, blocks_of_weights, owner_of_block, centers, count, mass, spread, row, slot
    )


def owners_of(groups: Groups) -> Tensor:
    """The owner of each row, (N,)."""
    owner = torch.empty_like(groups.row)
    owner[groups.row] = groups.owner[groups.slot // groups.weight.shape[1]]
    return owner


def nearest(points: Tensor, means: Tensor) -> Tensor:
    """The component (N,) whose mean (K, D) is nearest to each point (N, D)."""
    tree = cKDTree(means.detach().cpu().numpy())
    return torch.from_numpy(tree.query(points.detach().cpu().numpy())[1]).to(points.device)


def choose_candidates(groups: Groups, parameters: Parameters, n_candidates: int) -> Tensor:
    """The `n_candidates` most likely components (K, m) for the group of each of the K owners.

    A sample of each group's rows is compared with all components. The owner is always a candidate.
    """
    k = parameters.weights.shape[0]
    if k <= n_candidates:
        return torch.arange(k, device=groups.owner.device).expand(k, k)
    n_samples = max(8, min(_SAMPLES, 4096 // k))
    # Evenly spaced over the rows of a group, because adjacent rows of a scan are adjacent in space.
    count, steps = groups.n_rows[:, None], torch.arange(n_samples, device=groups.n_rows.device)
    place = torch.cumsum(count, 0) - count + (2 * steps + 1) * count // (2 * n_samples)
    place = place.clamp_max_(groups.slot.shape[0] - 1)  # of empty groups, whose candidates are unused
    natural, rows = natural_parameters(parameters), groups.rows()
    if is_truncated_e_step_fused(rows, natural):
        bounds = _logit_bounds(parameters, natural)
        return fused_candidates(rows, groups.slot[place], natural, bounds, n_candidates)
    natural, samples = natural.T.contiguous(), rows.features[groups.slot[place]]

    def chosen(part: slice) -> Tensor:
        moved = shift_features(samples[part].double(), groups.centers[part, None])
        joint = (moved.flatten(0, 1) @ natural).to(samples.dtype).view(-1, n_samples, k)
        joint -= joint.amax(2, keepdim=True)
        score = joint.amax(1)
        own = torch.arange(part.start, part.stop, device=score.device)
        score[own - part.start, own] = torch.inf
        return largest_indices(score, n_candidates)

    step = max(1, 4 * chunk_elements(groups.owner.device) // (n_samples * k))
    return torch.cat(list(chunked(k, step, chosen)))


def _logit_bounds(parameters: Parameters, natural: Tensor) -> Tensor:
    """Means, log π_k N(μ_k | μ_k, Σ_k), and √(1/2v), (D + 2, K); v = ‖Σ²‖^½ bounds the largest variance."""
    means, covariances = parameters.means, parameters.covariances
    dim = means.shape[1]
    peak = natural[:, 0] + 0.5 * (natural[:, 1 : 1 + dim] * means).sum(1)
    variance = (covariances @ covariances).square().sum((1, 2)).pow(0.25)
    return torch.cat([means.T, torch.stack([peak, (0.5 / variance).sqrt()])])


# -- the E-step over candidates -------------------------------------------------------------------


class Expectation(NamedTuple):
    """Result of a truncated E-step.

    statistics: (K, F) relative to the components' means, float64. value: Σ p log Σ_candidates, nats.
    owner: (N,) the most likely candidate of each row, if requested.
    """

    statistics: Tensor
    value: float
    owner: Tensor | None


def truncated_expectation(
    groups: Groups,
    candidates: Tensor,
    parameters: Parameters,
    want_owner: bool = False,
    compiled: bool = False,
    own: Tensor | None = None,
) -> Expectation:
    """E-step of `exact.expectation`, restricted to the candidates (G, m) of each of the G groups.

    With `want_owner`, also returns each row's most likely candidate. `compiled`: use torch.compile.
    `own`: the `centered_parameters`, if they are known.
    """
    rows, own = groups.rows(), centered_parameters(parameters) if own is None else own
    if not compiled and is_truncated_e_step_fused(rows, own, candidates):
        fused = fused_expectation(rows, candidates, own, parameters.means, want_owner)
        return Expectation(fused[0], float(fused[1]), _owner_of_rows(groups, fused[2]))
    n_groups, m = candidates.shape
    n_blocks, block, n_features = groups.features.shape
    dtype = groups.features.dtype
    natural = _local_parameters(own, parameters.means, groups.centers, candidates).to(dtype)
    sums = torch.zeros(n_groups, n_features * m, dtype=dtype, device=candidates.device)
    value = torch.zeros((), dtype=torch.float64, device=candidates.device)
    likeliest = torch.empty_like(groups.weight, dtype=torch.int64) if want_owner else None
    block_sums = _compiled_block_sums() if compiled else _block_sums

    def sums_of(part: slice) -> tuple[slice, Tensor, Tensor, Tensor | None]:
        features, owner = groups.features[part], groups.owner[part]
        block_natural = natural.index_select(0, owner)
        best = candidates[owner].gather(1, _likeliest(block_natural, features)) if want_owner else None
        return part, *block_sums(block_natural, features, groups.weight[part]), best

    step = max(1, chunk_elements(groups.owner.device) // (block * m))
    for part, block_statistics, block_value, best in chunked(n_blocks, step, sums_of):
        sums.index_add_(0, groups.owner[part], block_statistics)
        value += block_value
        if likeliest is not None and best is not None:
            likeliest[part] = best
    by_pair = sums.view(n_groups, n_features, m).transpose(1, 2).double()
    about_means = shift_features(by_pair, groups.centers[:, None] - parameters.means[candidates])
    statistics = about_means.new_zeros(parameters.weights.shape[0], n_features)
    statistics.index_add_(0, candidates.flatten(), about_means.flatten(0, 1))
    return Expectation(statistics, float(value), _owner_of_rows(groups, likeliest))


def _owner_of_rows(groups: Groups, likeliest: Tensor | None) -> Tensor | None:
    """The most likely candidates of all slots in the order of the rows, (N,)."""
    if likeliest is None:
        return None
    owners = torch.empty_like(groups.row)
    owners[groups.row] = likeliest.flatten()[groups.slot]
    return owners


def centered_parameters(parameters: Parameters) -> Tensor:
    """Natural parameters (K, F) of the components about their own means."""
    weights, means, covariances = parameters
    if is_m_step_fused(means.shape[1], *parameters):
        found, failed = fused_natural_parameters(weights, None, covariances)
        if not bool(failed):
            return found
    return natural_parameters(parameters._replace(means=torch.zeros_like(means)))


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


def _block_sums(natural: Tensor, features: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Σγφ (b, F·m) and Σ p log Σ exp of blocks: natural (b, m, F), features (b, B, F), weight (b, B)."""
    floor = exponent_floor(features.dtype)
    # Candidates are the rows, so that reductions over candidates run along contiguous memory.
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
