"""Fewer components for nearly the same density: greedy merging of a mixture's cheapest pairs.

What a merge costs is Runnalls' bound on the Kullback–Leibler divergence (IEEE Trans. AES 43(3),
2007) or the squared Hellinger distance. A few hundred components are merged one pair after the
other, always the cheapest of all. More of them are merged in rounds: candidates are pairs of near
neighbours, and a round merges disjoint pairs, each of whose two has no cheaper partner. A round is
a handful of batched operations; its pairs are, but for the last, those that greedy merging takes.
"""

from __future__ import annotations

import math
import numbers
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.linalg import check_symmetric, pack_symmetric
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.em.stepwise import check_points
from gmmtorch.mixture.estimator import MixtureEstimator
from gmmtorch.mixture.gaussian_mixture import GaussianMixture
from gmmtorch.mixture.reduction.merge_costs import COSTS, Cost, Gaussians
from gmmtorch.mixture.validation import checked_parameter

_MOST_EXACT = 512  # components whose pairs are all looked at
_PAIRS_AT_ONCE = 1 << 16


class Reduction(NamedTuple):
    """The mixture that is left; labels (K,): which of its components each given one went into;
    bound: Runnalls' on what that cost, as of `kullback_leibler_bound`, whichever cost chose."""

    parameters: Parameters
    labels: Tensor
    bound: float


def simplify(
    parameters: Parameters,
    n_components: int | None = None,
    max_cost: float | None = None,
    cost: str = "kullback_leibler",
    neighbors: int = 8,
    most_exact: int | None = None,
) -> Reduction:
    """Merge the pairs that cost least until few enough components, or only costly pairs, are left.

    Total weight, mean and covariance of the mixture stay as they are, and what is not merged keeps
    every bit. The components are left in the order in which the first of their members were given;
    that order changes nothing else.

    Args:
        parameters: weights (K,), not negative, that need not add up to one (supports in points, say);
            means (K, D); covariances (K, D, D). K may be 0.
        n_components: no merging below so many.
        max_cost: no merge that costs more; see `cost` for the unit.
        cost: "kullback_leibler" (see `kullback_leibler_bound`: in nats times the unit of the weights),
            or "hellinger" (`squared_hellinger`: 0 to 1), which merges what looks alike, however
            much it weighs.
        neighbors: of a component, by distance of the means, that it may merge with in a round;
            above `most_exact` components only.
        most_exact: components whose pairs are all looked at, and merged one after the other; 512 if
            not given. Rounds alone (0) are many times faster and nearly as good.

    Raises:
        InvalidArgumentError: neither n_components nor max_cost, or one that cannot be; parameters
            that are no mixture. NumericalError: an indefinite covariance.
    """
    weights, means, covariances = _checked(parameters)
    if n_components is None and max_cost is None:
        raise InvalidArgumentError("n_components=None and max_cost=None: give one, or both, to merge until.")
    least = 1 if n_components is None else check_whole("n_components", n_components, 1)
    limit = math.inf if max_cost is None else _checked_cost(max_cost)
    if cost not in COSTS:
        raise InvalidArgumentError(f"cost={cost!r} is not one of {', '.join(COSTS)}.")
    check_whole("neighbors", neighbors, 1)
    exact = check_whole("most_exact", _MOST_EXACT if most_exact is None else most_exact, 0)

    order = _canonical_order(weights, means, covariances)
    given = Gaussians.of(Parameters(weights[order], means[order], covariances[order]))
    left, labels = _merge_in_rounds(given, max(least, exact), limit, COSTS[cost], neighbors)
    if left.weights.shape[0] <= exact:
        left, merged = _merge_greedily(left, least, limit, COSTS[cost])
        labels = merged[labels]
    bound = given.weights @ (left.half_log_dets[labels] - given.half_log_dets)
    labels, kept = _in_order_given(torch.empty_like(labels).scatter_(0, order, labels), left.weights.shape[0])
    return Reduction(Parameters(*left.at(kept)[:3]), labels, max(0.0, float(bound)))


def _merge_greedily(given: Gaussians, least: int, limit: float, cost: Cost) -> tuple[Gaussians, Tensor]:
    """Merge the cheapest of all pairs, again and again; also labels (K,), of those left."""
    state = Gaussians(*(value.clone() for value in given))
    k = state.weights.shape[0]
    owner = torch.arange(k, device=state.weights.device)
    alive = torch.ones(k, dtype=torch.bool, device=state.weights.device)
    i, j = torch.triu_indices(k, k, 1, device=state.weights.device)
    costs = state.weights.new_full((k, k), torch.inf)
    costs[i, j] = costs[j, i] = _pair_costs(state, i, j, cost)
    for _ in range(k - least):
        kept, gone = divmod(int(costs.argmin()), k)
        if not float(costs[kept, gone]) <= limit:
            break
        merged = state.at(slice(kept, kept + 1)).merged(state.at(slice(gone, gone + 1)))
        for value, new in zip(state, merged, strict=True):
            value[kept] = new[0]
        owner[owner == gone] = kept
        alive[gone] = False
        costs[gone] = costs[:, gone] = torch.inf
        row = cost(merged, state).masked_fill_(~alive, torch.inf)
        row[kept] = torch.inf
        costs[kept] = costs[:, kept] = row
    left, labels = torch.unique(owner, return_inverse=True)
    return state.at(left), labels


def _merge_in_rounds(
    state: Gaussians, least: int, limit: float, cost: Cost, neighbors: int
) -> tuple[Gaussians, Tensor]:
    """Merge many disjoint cheap pairs of near neighbours at once; also labels (K,), of those left."""
    labels = torch.arange(state.weights.shape[0], device=state.weights.device)
    while (k := state.weights.shape[0]) > least:
        i, j = _near_pairs(state.means, neighbors)
        costs = _pair_costs(state, i, j, cost)
        cheap = costs <= limit
        i, j = _mutual_choices(i[cheap], j[cheap], costs[cheap], k)
        if len(i) == 0:
            break
        # The dearer half waits: cheaper partners may yet come of the merges.
        n_merges = min((len(i) + 1) // 2, k - least)
        i, j = i[:n_merges], j[:n_merges]
        merged = state.at(i).merged(state.at(j))
        state = Gaussians(*(v.index_copy(0, i, new) for v, new in zip(state, merged, strict=True)))
        owner = torch.arange(k, device=i.device).index_copy(0, j, i)
        left, relabel = torch.unique(owner, return_inverse=True)
        state, labels = state.at(left), relabel[labels]
    return state, labels


def _pair_costs(state: Gaussians, i: Tensor, j: Tensor, cost: Cost) -> Tensor:
    """Costs (P,) of the pairs of rows i, j (P,)."""
    parts = zip(i.split(_PAIRS_AT_ONCE), j.split(_PAIRS_AT_ONCE), strict=True)
    return torch.cat([cost(state.at(a), state.at(b)) for a, b in parts])


def _near_pairs(means: Tensor, neighbors: int) -> tuple[Tensor, Tensor]:
    """Rows i < j (P,) of means (K, D) that are near neighbours, each pair once, shuffled.

    Of more means in one place than a search for neighbours returns, it finds but a few; so the
    next row, which is in the same place then, is a neighbour too.
    """
    k, device = means.shape[0], means.device
    positions = means.cpu().numpy()
    found = cKDTree(positions).query(positions, k=min(neighbors + 1, k))[1]
    nearest = torch.as_tensor(found, device=device).reshape(k, -1)
    rows = torch.arange(k, device=device)
    a = torch.cat([rows[:, None].expand_as(nearest).reshape(-1), rows[:-1]])
    b = torch.cat([nearest.reshape(-1), rows[1:]])
    keys = torch.unique(torch.minimum(a, b)[a != b] * k + torch.maximum(a, b)[a != b])
    # Shuffled, always alike: among equal costs the earlier pair is chosen, and in sorted order
    # each pair would wait for the one before it.
    shuffle = torch.randperm(keys.numel(), generator=torch.Generator().manual_seed(0))
    keys = keys[shuffle.to(device)]
    return keys // k, keys % k


def _mutual_choices(i: Tensor, j: Tensor, costs: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Those of the pairs i, j (P,) of which each is the other's cheapest, the cheapest pair first.

    No component is in two of them, and the cheapest pair of all is one.
    """
    order = costs.argsort(stable=True)
    i, j = i[order], j[order]
    rank = torch.arange(len(i), device=i.device)
    best = rank.new_full((k,), len(i))
    best.scatter_reduce_(0, i, rank, "amin").scatter_reduce_(0, j, rank, "amin")
    mutual = (best[i] == rank) & (best[j] == rank)
    return i[mutual], j[mutual]


# -- arguments and order --------------------------------------------------------------------------


def _checked(parameters: Parameters) -> Parameters:
    """The parameters, float64, if they are a mixture's; weights need not add up to one."""
    means = torch.as_tensor(parameters.means).detach()
    if means.ndim != 2 or means.shape[1] == 0:
        raise InvalidArgumentError(f"means has shape {tuple(means.shape)}; expected (K, D).")
    k, dim = means.shape
    shapes = {"weights": (k,), "means": (k, dim), "covariances": (k, dim, dim)}
    checked = Parameters(
        *(
            checked_parameter(torch.as_tensor(value).detach(), shape, name, means.device)
            for value, (name, shape) in zip(parameters, shapes.items(), strict=True)
        )
    )
    if bool((checked.weights < 0).any()):
        first = int((checked.weights < 0).nonzero()[0])
        raise InvalidArgumentError(f"weights[{first}]={float(checked.weights[first])} must be at least 0.")
    check_symmetric(checked.covariances, "covariances")
    return checked


def _checked_cost(max_cost: object) -> float:
    if not isinstance(max_cost, numbers.Real) or not float(max_cost) >= 0:
        raise InvalidArgumentError(f"max_cost={max_cost!r} must be a number of at least 0.")
    return float(max_cost)


def _canonical_order(weights: Tensor, means: Tensor, covariances: Tensor) -> Tensor:
    """The order (K,) that sorts components by their numbers, so that none given to them matters."""
    columns = torch.cat([means, pack_symmetric(covariances), weights[:, None]], 1).cpu().numpy()
    return torch.from_numpy(np.lexsort(columns.T[::-1])).to(means.device)


def _in_order_given(labels: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Labels (K,) renumbered by first occurrence, and which old label (n,) each new one was."""
    rows = torch.arange(labels.shape[0], device=labels.device)
    first = rows.new_full((n,), labels.shape[0]).scatter_reduce_(0, labels, rows, "amin")
    kept = first.argsort()
    return torch.empty_like(kept).scatter_(0, kept, torch.arange(n, device=labels.device))[labels], kept


# -- estimators -----------------------------------------------------------------------------------


def merge(
    a: MixtureEstimator,
    b: MixtureEstimator,
    weight_a: float,
    weight_b: float,
    *,
    n_components: int | None = None,
    max_cost: float | None = None,
    cost: str = "kullback_leibler",
    neighbors: int = 8,
    **options: Any,
) -> GaussianMixture:
    """The mixture of what two fitted ones were learned from, on the device and in the kind of `a`.

    Args:
        a, b: mixtures of one dimension.
        weight_a, weight_b: how many points each stands for.
        n_components, max_cost, cost, neighbors: how far the union is simplified, see `simplify`
            (weights add up to one: a max_cost is in nats a point); not at all without the first two.
        options: of the `GaussianMixture`.

    Raises:
        NotFittedError: a mixture without parameters. InvalidArgumentError: other dimensions; weights
            that are negative or all zero; what `simplify` refuses.
    """
    dims = a._fitted().shape[1], b._fitted().shape[1]
    if dims[0] != dims[1]:
        raise InvalidArgumentError(
            f"a is a mixture in {dims[0]}D, b in {dims[1]}D; give two of one dimension."
        )
    n_a, n_b = check_points("weight_a", weight_a), check_points("weight_b", weight_b)
    total = n_a + n_b
    if total == 0:
        raise InvalidArgumentError("weight_a and weight_b are both zero; at least one mixture must count.")
    device = a.means.device
    union = Parameters(
        torch.cat([a.weights * (n_a / total), b.weights.to(device) * (n_b / total)]),
        torch.cat([a.means, b.means.to(device)]),
        torch.cat([a.covariances, b.covariances.to(device)]),
    )
    if n_components is not None or max_cost is not None:
        union = simplify(union, n_components, max_cost, cost, neighbors).parameters
    weights, means, covariances = union
    values = (weights / weights.sum(), means, covariances)
    arrays = (value.cpu().numpy() for value in values)
    found = GaussianMixture.from_parameters(*(values if isinstance(a.means_, Tensor) else arrays), **options)
    found.n_samples_seen_ = total
    return found
