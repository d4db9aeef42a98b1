"""Rows grouped by the component that owns them, and the components that each group may come from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gmmtorch.linalg import argsort, largest_indices, pack_symmetric
from gmmtorch.mixture.em.exact import (
    CHUNK_ELEMENTS,
    Parameters,
    feature_dimension,
    natural_parameters,
    quadratic_features,
    shift_features,
)

_SAMPLES = 64  # rows of a group asked which components matter, at most
_BUILD_ROWS = 1 << 18


@dataclass(frozen=True)
class Rows:
    """What EM is run on, in one frame, float64: points (N, D), or the mean features (N, F) of cells.

    weight (N,): how many points each row stands for.
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
        """Features (n, F) of the rows `index` (n,), each about its own center (n, D)."""
        values = self.values.index_select(0, index)
        if self.are_points:
            return quadratic_features((values - center).to(dtype))
        return shift_features(values, -center).to(dtype)


class Groups(NamedTuple):
    """Rows sorted by owner, in blocks of B, filled up with rows of weight 0.

    features (b, B, F) about the block's center, weight (b, B), owner (b,) of each block, centers
    (K, D) of the owners; n_rows, mass and spread (K,) of their rows: number, Σp and Σp‖x − center‖²;
    row (N,) and slot (N,): the row that went into each slot of b·B.
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


def group_rows(rows: Rows, owner: Tensor, centers: Tensor, dtype: torch.dtype) -> Groups:
    """Rows in blocks of the same owner (N,), about the owner's center (K, D), in `dtype`."""
    n, k = owner.shape[0], centers.shape[0]
    # Small blocks waste little on filling up; large ones are faster to multiply.
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
    return Groups(
        features.view(-1, block, n_features),
        weight.view(-1, block),
        owner_of_block,
        centers,
        count,
        mass,
        spread,
        row,
        slot,
    )


def choose_candidates(groups: Groups, parameters: Parameters, n_candidates: int) -> Tensor:
    """For each component (K,) the `n_candidates` (K, m) that its group's rows are likeliest from.

    A sample of each group's rows is compared with all components. The owner is always among them.
    """
    k = parameters.weights.shape[0]
    if k <= n_candidates:
        return torch.arange(k, device=groups.owner.device).expand(k, k)
    n_samples = max(8, min(_SAMPLES, 4096 // k))
    # Evenly out of all of a group's rows: neighbours in a scan are neighbours in space.
    count, steps = groups.n_rows[:, None], torch.arange(n_samples, device=groups.n_rows.device)
    place = torch.cumsum(count, 0) - count + (2 * steps + 1) * count // (2 * n_samples)
    place = place.clamp_max_(groups.slot.shape[0] - 1)  # of empty groups, whose candidates do not matter
    samples = groups.features.flatten(0, 1)[groups.slot[place]]
    natural = natural_parameters(parameters).T.contiguous()
    chosen = []
    step = max(1, 4 * CHUNK_ELEMENTS // (n_samples * k))
    for begin in range(0, k, step):
        part = slice(begin, min(begin + step, k))
        moved = shift_features(samples[part].double(), groups.centers[part, None])
        joint = (moved.flatten(0, 1) @ natural).to(samples.dtype).view(-1, n_samples, k)
        joint -= joint.amax(2, keepdim=True)
        score = joint.amax(1)
        own = torch.arange(part.start, part.stop, device=score.device)
        score[own - part.start, own] = torch.inf
        chosen.append(largest_indices(score, n_candidates))
    return torch.cat(chosen)


def owners_of(groups: Groups) -> Tensor:
    """The owner of each row, (N,)."""
    owner = torch.empty_like(groups.row)
    owner[groups.row] = groups.owner[groups.slot // groups.weight.shape[1]]
    return owner


def nearest(points: Tensor, means: Tensor) -> Tensor:
    """The component (N,) whose mean (K, D) is nearest to each point (N, D)."""
    tree = cKDTree(means.detach().cpu().numpy())
    return torch.from_numpy(tree.query(points.detach().cpu().numpy())[1]).to(points.device)
