"""Mixture reduction: merge the pairs of components whose merge costs least.

The cost of a merge is Runnalls' bound on the Kullback–Leibler divergence (IEEE Trans. AES 43(3),
2007) or the squared Hellinger distance. Up to a few hundred components are merged greedily: always
the cheapest of all pairs. More components are merged in rounds. A round considers pairs of near
neighbours and merges disjoint pairs in which each component is the other's cheapest partner, as one
batch. Except in the last round, greedy merging takes the same pairs. A fused kernel does all rounds in one
launch; its twin is here.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.arrays import as_tensor
from gmmtorch.errors import InvalidArgumentError, check_choice, check_number, check_whole
from gmmtorch.kernels import is_fused, is_pair_merges_fused, pair_merges
from gmmtorch.linalg import as_tensors, check_symmetric, on_cpu, pack_symmetric, safe_cholesky
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.validation import checked_parameter

if TYPE_CHECKING:  # an estimator imports scikit-learn, which `simplify` does not need
    from gmmtorch.mixture.estimator import MixtureEstimator
    from gmmtorch.mixture.gaussian_mixture import GaussianMixture

_MOST_EXACT = 512  # components up to which all pairs are considered
_PAIRS_AT_ONCE = 1 << 16
_SPREAD = 0x9E3779B97F4A7C15 - (1 << 64)  # odd, so that products of whole numbers, modulo 2^64, are distinct


class MergedInRounds(NamedTuple):
    """J components, merged from K.

    parameters: of the J, in the order of their first members. labels (K,): the one that each was merged into.
    first, members (J,): row of the first member, and number of members.
    """

    parameters: Parameters
    labels: Tensor
    first: Tensor
    members: Tensor


class Reduction(NamedTuple):
    """The reduced mixture.

    labels (K,): the component that each given component was merged into. bound: Runnalls' bound on the
    total cost (see `kullback_leibler_bound`), whichever cost selected the merges.
    """

    parameters: Parameters
    labels: Tensor
    bound: float


def simplify(
    parameters: Parameters | MixtureEstimator,
    n_components: int | None = None,
    max_cost: float | None = None,
    cost: str = "kullback_leibler",
    neighbors: int = 8,
    most_exact: int | None = None,
) -> Reduction:
    """Merge the cheapest pairs until few enough components, or only expensive pairs, are left.

    Total weight, mean and covariance of the mixture do not change. Components that are not merged keep
    their exact values. The result lists components in the order of their first given member. Otherwise
    the order of the given components has no effect.

    Args:
        parameters: a fitted mixture; or weights (K,), not negative, which need not add up to one (supports
            in points are allowed); means (K, D); covariances (K, D, D). K may be 0.
        n_components, max_cost: stop at this number of components, and if every merge costs more.
        cost: "kullback_leibler" (`kullback_leibler_bound`: nats times the unit of the weights) or
            "hellinger" (`squared_hellinger`: 0 to 1), which merges similar components of any weight.
        neighbors: nearest components, by distance of the means, that a component may merge with in a
            round. Used above `most_exact` components only.
        most_exact: up to this number of components (None: 512), all pairs are considered and merged one at
            a time. With 0 all merges are in rounds: many times faster, with nearly the same result.

    Raises `InvalidArgumentError` for neither n_components nor max_cost, an invalid option, or parameters that
    are not a mixture; `NumericalError` for a covariance that is not positive definite.
    """
    weights, means, covariances = _checked(parameters)
    if n_components is None and max_cost is None:
        raise InvalidArgumentError("n_components=None and max_cost=None: give at least one as the limit.")
    least = 1 if n_components is None else check_whole("n_components", n_components, 1)
    limit: object = math.inf if max_cost is None else max_cost
    if not isinstance(limit, numbers.Real) or not float(limit) >= 0:
        raise InvalidArgumentError(f"max_cost={max_cost!r} must be a number of at least 0.")
    check_choice("cost", cost, COSTS)
    check_whole("neighbors", neighbors, 1)
    exact = check_whole("most_exact", _MOST_EXACT if most_exact is None else most_exact, 0)

    # Sorted by their values, so that the given order has no effect.
    columns = torch.cat([means, pack_symmetric(covariances), weights[:, None]], 1).cpu().numpy()
    order = torch.from_numpy(np.lexsort(columns.T[::-1])).to(means.device)
    given = Parameters(weights[order], means[order], covariances[order])
    found = merge_in_rounds(given, max(least, exact), float(limit), cost, neighbors)
    left, labels = Gaussians.of(found.parameters), found.labels
    if left.weights.shape[0] <= exact:
        left, merged = _merge_greedily(left, least, float(limit), COSTS[cost])
        labels = merged[labels]
    bound = given.weights @ (left.half_log_dets[labels] - Gaussians.of(given).half_log_dets)
    labels, kept = _in_order_given(torch.empty_like(labels).scatter_(0, order, labels), left.weights.shape[0])
    return Reduction(Parameters(*left.at(kept)[:3]), labels, max(0.0, float(bound)))


def merge_in_rounds(
    parameters: Parameters,
    n_components: int = 1,
    max_cost: float = math.inf,
    cost: str = "kullback_leibler",
    neighbors: int = 8,
    device: torch.device | None = None,
) -> MergedInRounds:
    """The same as `simplify` with most_exact=0, of float64 parameters that are not checked.

    Components at one place, or with equal costs, are merged in an order that depends on that of the rows.
    device: where the rounds run; None: where the parameters are, as the result is.
    """
    weights, means, covariances = parameters
    k, here = len(means), means.device
    places, along = on_cpu(means)[0].numpy(), np.arange(k)
    if n_components < k:
        along = places[:, (places.max(0) - places.min(0)).argmax()].argsort(kind="stable")
        found = None
        if is_fused(*parameters) and is_pair_merges_fused(means.shape[1]):
            at, rule = device or here, (n_components, max_cost, cost == "hellinger", neighbors)
            w, m, c, rows = (
                part.to(at, non_blocking=True) for part in (*parameters, torch.from_numpy(along))
            )
            found = pair_merges(rows, w, m, c, *rule)
        if found is not None:
            lead, n_members, *made = found
            is_first = lead == np.arange(k)
            begins = np.flatnonzero(is_first)
            whole = as_tensors((is_first.cumsum() - 1)[lead], begins, n_members[begins])
            values = as_tensors(*(part[begins] for part in made))
            return MergedInRounds(Parameters(*(v.to(here) for v in values)), *(r.to(here) for r in whole))
    order, numbers = torch.from_numpy(along).to(here), torch.arange(k, device=here)
    left = Gaussians.of(Parameters(weights[order], means[order], covariances[order]))
    merged, labels = _merge_in_rounds(left, n_components, max_cost, COSTS[cost], neighbors)
    labels, kept = _in_order_given(torch.empty_like(labels).scatter_(0, order, labels), len(merged.weights))
    first = numbers.new_full(kept.shape, k).scatter_reduce_(0, labels, numbers, "amin")
    members = torch.bincount(labels, minlength=len(kept))
    return MergedInRounds(Parameters(*merged.at(kept)[:3]), labels, first, members)


def _merge_greedily(
    given: Gaussians, min_components: int, limit: float, cost: Cost
) -> tuple[Gaussians, Tensor]:
    """Merge the cheapest of all pairs repeatedly; also returns the new component of each old one (K,)."""
    state = Gaussians(*(value.clone() for value in given))
    k = state.weights.shape[0]
    owner = torch.arange(k, device=state.weights.device)
    present = torch.ones(k, dtype=torch.bool, device=state.weights.device)
    i, j = torch.triu_indices(k, k, 1, device=state.weights.device)
    costs = state.weights.new_full((k, k), torch.inf)
    costs[i, j] = costs[j, i] = _pair_costs(state, i, j, cost)
    for _ in range(k - min_components):
        kept, removed = divmod(int(costs.argmin()), k)
        if not float(costs[kept, removed]) <= limit:
            break
        merged = state.at(slice(kept, kept + 1)).merged(state.at(slice(removed, removed + 1)))
        for value, new in zip(state, merged, strict=True):
            value[kept] = new[0]
        owner[owner == removed] = kept
        present[removed] = False
        costs[removed] = costs[:, removed] = torch.inf
        row = cost(merged, state).masked_fill_(~present, torch.inf)
        row[kept] = torch.inf
        costs[kept] = costs[:, kept] = row
    left, labels = torch.unique(owner, return_inverse=True)
    return state.at(left), labels


def _merge_in_rounds(
    state: Gaussians, min_components: int, limit: float, cost: Cost, neighbors: int
) -> tuple[Gaussians, Tensor]:
    """Merge many disjoint cheap pairs of near neighbours per round; also returns labels (K,)."""
    labels = torch.arange(state.weights.shape[0], device=state.weights.device)
    while (k := state.weights.shape[0]) > min_components:
        i, j = _near_pairs(state.means, neighbors)
        costs = _pair_costs(state, i, j, cost)
        cheap = costs <= limit
        i, j = _mutual_choices(i[cheap], j[cheap], costs[cheap], k)
        if len(i) == 0:
            break
        # Only the cheaper half is merged: the merges may create cheaper partners for the rest.
        n_merges = min((len(i) + 1) // 2, k - min_components)
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
    """Rows i < j (P,) of means (K, D) that are near neighbours, each pair once.

    If more means coincide than the neighbour search returns, it finds only some of them. Each row at the
    place of the next one is therefore also paired with that one.
    """
    from scipy.spatial import cKDTree

    k, device = means.shape[0], means.device
    positions = means.cpu().numpy()
    found = cKDTree(positions).query(positions, k=min(neighbors + 1, k))[1]
    nearest = torch.as_tensor(found, device=device).reshape(k, -1)
    rows = torch.arange(k, device=device)
    same = (means[1:] == means[:-1]).all(1)
    a = torch.cat([rows[:, None].expand_as(nearest).reshape(-1), rows[:-1][same]])
    b = torch.cat([nearest.reshape(-1), rows[1:][same]])
    keys = torch.unique(torch.minimum(a, b)[a != b] * k + torch.maximum(a, b)[a != b])
    return keys // k, keys % k


def _mutual_choices(i: Tensor, j: Tensor, costs: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The pairs i, j (P,) in which each component is the other's cheapest partner, the cheapest pair first.

    No component occurs in two of these pairs, and the cheapest of all pairs is one of them.
    """
    # Of pairs with equal costs, any order will do but that of rows, in which each blocks the next one.
    order = (((i << 32) + j) * _SPREAD).argsort()
    order = order[costs[order].argsort(stable=True)]
    i, j = i[order], j[order]
    rank = torch.arange(len(i), device=i.device)
    best = rank.new_full((k,), len(i))
    best.scatter_reduce_(0, i, rank, "amin").scatter_reduce_(0, j, rank, "amin")
    mutual = (best[i] == rank) & (best[j] == rank)
    return i[mutual], j[mutual]


def parameters_of(mixture: Parameters | MixtureEstimator, name: str) -> Parameters:
    """Parameters of a mixture or of a fitted estimator, as tensors without gradients.

    Raises `InvalidArgumentError` for anything else, `NotFittedError` for an estimator without parameters.
    """
    check_fitted = getattr(mixture, "_fitted", None)
    if check_fitted is not None:
        check_fitted()
        return Parameters(mixture.weights, mixture.means, mixture.covariances)
    if not isinstance(mixture, tuple) or len(mixture) != len(Parameters._fields):
        raise InvalidArgumentError(
            f"{name} is a {type(mixture).__name__}; give a fitted mixture, or Parameters(weights (K,), "
            "means (K, D), covariances (K, D, D))."
        )
    named = zip(Parameters._fields, mixture, strict=True)
    return Parameters(*(as_tensor(value, field, torch.float64).detach() for field, value in named))


def _checked(parameters: Parameters | MixtureEstimator) -> Parameters:
    """The parameters in float64. Raises unless they are a mixture; the weights need not add up to one."""
    parameters = parameters_of(parameters, "parameters")
    means = parameters.means
    if means.ndim != 2 or means.shape[1] == 0:
        raise InvalidArgumentError(f"means has shape {tuple(means.shape)}; expected (K, D).")
    k, dim = means.shape
    given = zip(parameters, ((k,), (k, dim), (k, dim, dim)), Parameters._fields, strict=True)
    checked = Parameters(*(checked_parameter(*values, means.device) for values in given))
    if bool((checked.weights < 0).any()):
        first = int((checked.weights < 0).nonzero()[0])
        raise InvalidArgumentError(f"weights[{first}]={float(checked.weights[first])} must be at least 0.")
    check_symmetric(checked.covariances, "covariances")
    return checked


def _in_order_given(labels: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Labels (K,) renumbered by first occurrence, and the old label (n,) of each new one."""
    rows = torch.arange(labels.shape[0], device=labels.device)
    first = rows.new_full((n,), labels.shape[0]).scatter_reduce_(0, labels, rows, "amin")
    kept = first.argsort()
    return torch.empty_like(kept).scatter_(0, kept, torch.arange(n, device=labels.device))[labels], kept


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
    """Merge two fitted mixtures of equal dimension into one mixture of the points that both were fitted to.

    The result is on the device, and has the array kind, of `a`.

    Args:
        weight_a, weight_b: number of points that each mixture stands for.
        n_components, max_cost, cost, neighbors: how the union is simplified, see `simplify`. The weights
            add up to one, so max_cost is in nats per point. Without n_components and max_cost, it is not.
        options: constructor options of the resulting `GaussianMixture`.

    Raises `NotFittedError` for a mixture without parameters, and `InvalidArgumentError` for different
    dimensions, weights that are negative or both zero, and arguments that `simplify` rejects.
    """
    from gmmtorch.mixture.gaussian_mixture import GaussianMixture

    for name, mixture in (("a", a), ("b", b)):
        if not hasattr(mixture, "_fitted"):
            raise InvalidArgumentError(
                f"{name} is a {type(mixture).__name__}; give a fitted mixture, or use "
                "GaussianMixture.from_parameters(weights, means, covariances)."
            )
    dims = a._fitted().shape[1], b._fitted().shape[1]
    if dims[0] != dims[1]:
        raise InvalidArgumentError(
            f"a is a mixture in {dims[0]}D, b in {dims[1]}D; both must have the same dimension."
        )
    check_number("weight_a", weight_a)
    check_number("weight_b", weight_b)
    total = float(weight_a) + float(weight_b)
    if total == 0:
        raise InvalidArgumentError("weight_a and weight_b are both zero; at least one must be above zero.")
    device = a.means.device
    union = Parameters(
        torch.cat([a.weights * (weight_a / total), b.weights.to(device) * (weight_b / total)]),
        torch.cat([a.means, b.means.to(device)]),
        torch.cat([a.covariances, b.covariances.to(device)]),
    )
    if n_components is not None or max_cost is not None:
        union = simplify(union, n_components, max_cost, cost, neighbors).parameters
    values = (union.weights / union.weights.sum(), *union[1:])
    arrays = (value.cpu().numpy() for value in values)
    found = GaussianMixture.from_parameters(*(values if isinstance(a.means_, Tensor) else arrays), **options)
    found.n_samples_seen_ = total
    return found


def merge_components(
    weights: Tensor, means: Tensor, covariances: Tensor, labels: Tensor, n: int
) -> Parameters:
    """Merge each group of components into one component.

    w = Σ w_i, μ = Σ w_i μ_i / w and Σ = Σ (w_i/w)(Σ_i + (μ_i − μ)(μ_i − μ)ᵀ). The mean and covariance
    of the whole mixture do not change.

    weights: (K,), not negative; they need not add up to one, so supports (points) are allowed. If all weights
    of a group are zero, its members count equally. labels: (K,) whole numbers, the group of each component.
    n: number of groups. Raises `InvalidArgumentError` for labels outside 0 … n − 1, or an empty group.
    """
    if labels.shape != weights.shape or (
        labels.numel() and not 0 <= int(labels.min()) <= int(labels.max()) < n
    ):
        raise InvalidArgumentError(
            f"labels has shape {tuple(labels.shape)}; expected one whole number of 0 … n − 1 = {n - 1} for "
            f"each of {weights.shape[0]} components."
        )
    members = torch.bincount(labels, minlength=n)
    if bool((members == 0).any()):
        raise InvalidArgumentError(
            f"labels leaves {int((members == 0).sum())} of n={n} groups empty; number them without gaps."
        )
    total = weights.new_zeros(n).index_add_(0, labels, weights)
    share = torch.where(total[labels] > 0, weights / total[labels], 1 / members[labels])
    mean = means.new_zeros(n, means.shape[1]).index_add_(0, labels, share[:, None] * means)
    offset = means - mean[labels]
    scatter = share[:, None, None] * (covariances + offset[:, :, None] * offset[:, None, :])
    covariance = torch.zeros_like(covariances[:n]).index_add_(0, labels, scatter)
    return Parameters(total, mean, covariance)


def merge_pairs(first: Parameters, second: Parameters) -> Parameters:
    """Merge each component of `first` (P of them) with the component of `second` in the same row.

    Without cancellation: with a = w₁/w and b = w₂/w, Σ = a Σ₁ + b Σ₂ + ab (μ₁ − μ₂)(μ₁ − μ₂)ᵀ. If both
    weights are zero, both components count equally.
    """
    weight = first.weights + second.weights
    b = torch.where(weight > 0, second.weights / weight, 0.5)[:, None]
    offset = second.means - first.means
    mean = first.means + b * offset
    scatter = (1 - b)[:, None] * b[:, None] * offset[:, :, None] * offset[:, None, :]
    within = (1 - b)[:, None] * first.covariances + b[:, None] * second.covariances
    return Parameters(weight, mean, within + scatter)


class Gaussians(NamedTuple):
    """Weighted Gaussians (K,) with ½ log|Σ| (K,) of each, which the costs use repeatedly."""

    weights: Tensor
    means: Tensor
    covariances: Tensor
    half_log_dets: Tensor

    @classmethod
    def of(cls, parameters: Parameters) -> Gaussians:
        return cls(*parameters, _half_log_det(safe_cholesky(parameters.covariances)))

    def at(self, index: Tensor | slice) -> Gaussians:
        return Gaussians(*(value[index] for value in self))

    def merged(self, other: Gaussians) -> Gaussians:
        """Each component merged with the one in the same row of `other`."""
        return Gaussians.of(merge_pairs(Parameters(*self[:3]), Parameters(*other[:3])))


def _half_log_det(factors: Tensor) -> Tensor:
    return factors.diagonal(dim1=-2, dim2=-1).log().sum(-1)


Cost = Callable[[Gaussians, Gaussians], Tensor]
"""Cost (P,) of merging P components with P others, row by row; either side may be a single component."""


def kullback_leibler_bound(first: Gaussians, second: Gaussians) -> Tensor:
    """Runnalls' bound B = ½ [(w₁+w₂) log|Σ| − w₁ log|Σ₁| − w₂ log|Σ₂|], Σ of the merged pair, (P,).

    B is an upper bound of w KL(p‖q), with p the mixture (of total weight w) before the merge and q the
    mixture after it. The unit is nats per point if weights add up to one, and nats if weights are
    supports in points. The bounds of successive merges add up to a bound for all of them.
    Source: Runnalls, IEEE Trans. AES 43(3), 2007.
    """
    half_log_det = first.merged(second).half_log_dets
    cost = first.weights * (half_log_det - first.half_log_dets)
    return (cost + second.weights * (half_log_det - second.half_log_dets)).clamp_min(0)


def squared_hellinger(first: Gaussians, second: Gaussians) -> Tensor:
    """H² = 1 − |Σ₁|^¼ |Σ₂|^¼ |Σ|^−½ exp(−⅛ (μ₁−μ₂)ᵀ Σ⁻¹ (μ₁−μ₂)), Σ = ½(Σ₁+Σ₂), (P,).

    0 for equal Gaussians, 1 for Gaussians without overlap. Weights have no effect.
    """
    factors = safe_cholesky((first.covariances + second.covariances) / 2)
    offset = (first.means - second.means)[:, :, None]
    squared = torch.linalg.solve_triangular(factors, offset, upper=False).square().sum((1, 2))
    log_overlap = (first.half_log_dets + second.half_log_dets) / 2 - _half_log_det(factors) - squared / 8
    return -torch.expm1(log_overlap.clamp_max(0))


COSTS: dict[str, Cost] = {"kullback_leibler": kullback_leibler_bound, "hellinger": squared_hellinger}
