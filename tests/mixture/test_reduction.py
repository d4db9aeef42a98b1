"""Merging of components and mixtures against a naive greedy loop, and Monte Carlo."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mixture.fit_contract import blobs
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, NumericalError
from gmmtorch.mixture import GaussianMixture, NotFittedError, Parameters, merge, merge_components, simplify
from gmmtorch.mixture.reduction import COSTS, Gaussians, merge_pairs

dims = pytest.mark.parametrize("dim", [1, 2, 3, 5])
costs = pytest.mark.parametrize("cost", list(COSTS))


def mixture(k: int, dim: int, seed: int = 0, spread: float = 2.0) -> Parameters:
    """Random components whose weights are supports, so they do not add up to one."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(k, dim, dim)) * 0.5
    covariances = root @ root.transpose(0, 2, 1) + 0.05 * np.eye(dim)
    parts = (rng.random(k) * 20 + 0.5, rng.normal(size=(k, dim)) * spread, covariances)
    return Parameters(*(torch.from_numpy(part) for part in parts))


def take(parameters: Parameters, index: Tensor) -> Parameters:
    return Parameters(*(value[index] for value in parameters))


def total_moments(parameters: Parameters) -> tuple[float, np.ndarray, np.ndarray]:
    """Weight, mean and covariance of the whole mixture, by loops."""
    weights, means, covariances = (value.numpy() for value in parameters)
    total = math.fsum(weights)
    mean = sum(w / total * m for w, m in zip(weights, means, strict=True))
    covariance = sum(
        w / total * (c + np.outer(m - mean, m - mean))
        for w, m, c in zip(weights, means, covariances, strict=True)
    )
    return total, mean, covariance


def assert_same_moments(one: Parameters, other: Parameters, atol: float = 1e-12) -> None:
    for mine, theirs in zip(total_moments(one), total_moments(other), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=atol)


def numpy_merge(a: tuple, b: tuple) -> tuple:
    """(w, μ, Σ) of two merged, from raw moments."""
    w = a[0] + b[0]
    mean = (a[0] * a[1] + b[0] * b[1]) / w
    second = sum(x[0] / w * (x[2] + np.outer(x[1], x[1])) for x in (a, b))
    return w, mean, second - np.outer(mean, mean)


def numpy_cost(a: tuple, b: tuple, cost: str) -> float:
    """The cost by determinants and inverses, as printed in the papers."""
    det = np.linalg.det
    if cost == "kullback_leibler":
        w, _, merged = numpy_merge(a, b)
        return 0.5 * (w * np.log(det(merged)) - a[0] * np.log(det(a[2])) - b[0] * np.log(det(b[2])))
    middle, d = (a[2] + b[2]) / 2, a[1] - b[1]
    overlap = (
        (det(a[2]) * det(b[2])) ** 0.25 / det(middle) ** 0.5 * np.exp(-d @ np.linalg.inv(middle) @ d / 8)
    )
    return 1 - overlap


paths = pytest.mark.parametrize("path", ["exact", "rounds"])
MOST_EXACT = {"exact": 10**6, "rounds": 0}
"""Values of `most_exact` that merge one pair at a time, or in rounds only."""


def numpy_greedy(parameters: Parameters, n: int, cost: str, limit: float = math.inf):
    """Remaining components as lists of old ones, and the cost of each merge, with all pairs recomputed."""
    state = [
        ([k], tuple(np.array(value[k]) for value in (w, m, c)))
        for w, m, c in [tuple(value.numpy() for value in parameters)]
        for k in range(len(w))
    ]
    spent = []
    while len(state) > n:
        table = {
            (i, j): numpy_cost(state[i][1], state[j][1], cost)
            for i in range(len(state))
            for j in range(i + 1, len(state))
        }
        (i, j), least = min(table.items(), key=lambda item: item[1])
        if least > limit:
            break
        merged = (state[i][0] + state[j][0], numpy_merge(state[i][1], state[j][1]))
        spent.append(least)
        state = [s for k, s in enumerate(state) if k not in (i, j)] + [merged]
    return [members for members, _ in state], spent


def groups(labels: Tensor) -> set[frozenset[int]]:
    return {frozenset((labels == n).nonzero().flatten().tolist()) for n in labels.unique()}


def assert_same_components(one: Parameters, other: Parameters, **tolerance: float) -> None:
    """Equal up to the order of the components."""
    first, second = (value[0].shape[0] for value in (one, other))
    assert first == second
    nearest = torch.cdist(one.means, other.means).argmin(1)
    assert len(nearest.unique()) == first
    for mine, theirs in zip(one, take(other, nearest), strict=True):
        torch.testing.assert_close(mine, theirs, **{"rtol": 1e-8, "atol": 1e-9, **tolerance})


# -- greedy merging --------------------------------------------------------------------------------


@costs
@dims
@pytest.mark.parametrize("n", [1, 4, 11])
def test_greedy_merging_equals_a_naive_loop(cost, dim, n):
    parameters = mixture(16, dim, seed=dim)
    members, spent = numpy_greedy(parameters, n, cost)
    found = simplify(parameters, n, cost=cost)
    assert groups(found.labels) == {frozenset(group) for group in members}
    if cost == "kullback_leibler":
        assert found.bound == pytest.approx(sum(spent), rel=1e-9)


@costs
def test_max_cost_stops_where_a_naive_loop_stops(cost):
    parameters = mixture(16, 2, seed=3)
    _, spent = numpy_greedy(parameters, 1, cost)
    limit = (sorted(spent)[6] + sorted(spent)[7]) / 2
    members, _ = numpy_greedy(parameters, 1, cost, limit)
    found = simplify(parameters, max_cost=limit, cost=cost)
    assert 1 < len(members) < 16
    assert groups(found.labels) == {frozenset(group) for group in members}
    more = simplify(parameters, n_components=len(members) + 2, max_cost=limit, cost=cost)
    assert len(more.parameters.weights) == len(members) + 2


@costs
@paths
def test_result_is_the_merge_of_its_members(cost, path):
    parameters = mixture(90, 3)
    found = simplify(parameters, 17, cost=cost, most_exact=MOST_EXACT[path])
    merged = merge_components(*parameters, found.labels, 17)
    for mine, expected in zip(found.parameters, merged, strict=True):
        torch.testing.assert_close(mine, expected, rtol=1e-9, atol=1e-10)
    first = [int((found.labels == n).nonzero()[0]) for n in range(17)]
    assert first == sorted(first)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("n", [20, 100, 250])
def test_rounds_cost_little_more_than_greedy_merging(dim, n):
    parameters = mixture(300, dim, spread=6.0)
    exact = simplify(parameters, n, most_exact=MOST_EXACT["exact"])
    rounds = simplify(parameters, n, most_exact=MOST_EXACT["rounds"])
    assert len(rounds.parameters.weights) == n
    assert rounds.bound < 1.05 * exact.bound


@costs
@paths
def test_no_pair_below_max_cost_remains(cost, path):
    limit = {"kullback_leibler": 4.0, "hellinger": 0.4}[cost]
    found = simplify(
        mixture(120, 2, spread=6.0), max_cost=limit, cost=cost, neighbors=119, most_exact=MOST_EXACT[path]
    )
    left = Gaussians.of(found.parameters)
    i, j = torch.triu_indices(len(left.weights), len(left.weights), 1)
    assert float(COSTS[cost](left.at(i), left.at(j)).min()) > limit


@settings(max_examples=40)
@given(
    seed=st.integers(0, 10**6),
    dim=st.integers(1, 4),
    k=st.integers(1, 40),
    n=st.integers(1, 40),
    cost=st.sampled_from(list(COSTS)),
    path=st.sampled_from(["exact", "rounds"]),
    zeros=st.sampled_from(["none", "half", "all"]),
    copies=st.booleans(),
)
def test_simplify_keeps_weight_mean_and_covariance(seed, dim, k, n, cost, path, zeros, copies):
    parameters = mixture(k, dim, seed)
    if zeros != "none":
        parameters.weights[1 if zeros == "half" else 0 :: 2 if zeros == "half" else 1] = 0
    if copies:
        parameters = take(parameters, torch.arange(k) // 3)
    found = simplify(parameters, n, cost=cost, most_exact=MOST_EXACT[path])
    assert len(found.parameters.weights) == min(n, k)
    assert sorted(found.labels.unique().tolist()) == list(range(min(n, k)))
    assert_same_moments(found.parameters, parameters, atol=1e-10)
    assert bool((torch.linalg.eigvalsh(found.parameters.covariances) > 0).all())
    assert bool((found.parameters.weights >= 0).all())


# -- symmetries ------------------------------------------------------------------------------------


@costs
@paths
@pytest.mark.parametrize("regular", [False, True], ids=["random", "many ties"])
def test_result_does_not_depend_on_the_order_of_components(cost, path, regular):
    if regular:  # a lattice of equal components, with many ties
        lattice = torch.cartesian_prod(torch.arange(8.0), torch.arange(8.0)).double()
        parameters = Parameters(
            torch.ones(64).double(), lattice, 0.1 * torch.eye(2).double().repeat(64, 1, 1)
        )
    else:
        parameters = mixture(64, 2)
    order = torch.from_numpy(np.random.default_rng(0).permutation(64))
    one = simplify(parameters, 13, cost=cost, most_exact=MOST_EXACT[path])
    other = simplify(take(parameters, order), 13, cost=cost, most_exact=MOST_EXACT[path])
    back = torch.empty_like(order)
    back[order] = torch.arange(64)
    assert groups(one.labels) == groups(other.labels[back])
    assert_same_components(one.parameters, other.parameters, rtol=0, atol=0)
    assert one.bound == other.bound


@costs
@paths
@pytest.mark.parametrize("offset", [0.0, 5e5])
def test_simplify_commutes_with_motions(cost, path, offset):
    parameters = mixture(64, 3)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).double())[0]
    moved = Parameters(
        parameters.weights,
        parameters.means @ rotation.T + offset,
        rotation @ parameters.covariances @ rotation.T,
    )
    one = simplify(parameters, 13, cost=cost, most_exact=MOST_EXACT[path])
    other = simplify(moved, 13, cost=cost, most_exact=MOST_EXACT[path])
    assert torch.equal(one.labels, other.labels)
    torch.testing.assert_close(
        one.parameters.means @ rotation.T + offset, other.parameters.means, atol=1e-8, rtol=0
    )
    torch.testing.assert_close(
        rotation @ one.parameters.covariances @ rotation.T, other.parameters.covariances, atol=1e-7, rtol=0
    )


def test_cost_scales_with_the_weights():
    parameters = mixture(30, 2)
    one = simplify(parameters, max_cost=3.0)
    other = simplify(parameters._replace(weights=parameters.weights / 100), max_cost=0.03)
    assert 1 < len(one.parameters.weights) < 30
    assert torch.equal(one.labels, other.labels)
    assert other.bound == pytest.approx(one.bound / 100)


# -- degenerate and invalid input ------------------------------------------------------------------


def test_components_that_are_not_merged_keep_their_exact_values():
    parameters = mixture(40, 3)
    parameters = parameters._replace(means=parameters.means + 5e5)
    found = simplify(parameters, 40)
    assert all(torch.equal(*pair) for pair in zip(found.parameters, parameters, strict=True))
    assert found.labels.tolist() == list(range(40))
    assert found.bound == 0
    assert len(simplify(parameters, 100).parameters.weights) == 40
    assert len(simplify(parameters, max_cost=0.0).parameters.weights) == 40


@paths
@pytest.mark.parametrize("k", [0, 1])
def test_zero_or_one_component_stays_unchanged(path, k):
    parameters = take(mixture(3, 2), torch.arange(k))
    found = simplify(parameters, 1, most_exact=MOST_EXACT[path])
    assert all(torch.equal(*pair) for pair in zip(found.parameters, parameters, strict=True))
    assert (found.labels.tolist(), found.bound) == ([0] * k, 0.0)


@costs
@pytest.mark.parametrize("k", [50, 600])
def test_equal_components_become_one(cost, k):
    parameters = take(mixture(1, 3), torch.zeros(k, dtype=torch.int64))
    found = simplify(parameters, max_cost=1e-6, cost=cost)
    assert len(found.parameters.weights) == 1
    assert float(found.parameters.weights) == pytest.approx(k * float(parameters.weights[0]))
    torch.testing.assert_close(found.parameters.means, parameters.means[:1])
    torch.testing.assert_close(found.parameters.covariances, parameters.covariances[:1])
    assert found.bound == pytest.approx(0, abs=1e-6)


def test_flat_components_can_be_merged():
    """Exactly coplanar, without thickness."""
    parameters = mixture(30, 3)
    flat = torch.diag(torch.tensor([1.0, 1.0, 0.0]).double())
    found = simplify(
        Parameters(parameters.weights, parameters.means @ flat, flat @ parameters.covariances @ flat), 4
    )
    assert all(bool(torch.isfinite(value).all()) for value in found.parameters)
    assert float(found.parameters.covariances[:, 2].abs().max()) == 0


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"covariances": -torch.eye(2).double().repeat(4, 1, 1)}, NumericalError, r"covariances\[0\]"),
        ({"covariances": torch.zeros(4, 2, 2).double()}, NumericalError, r"covariances\[0\]"),
        ({"covariances": torch.ones(4, 2, 2).double().triu() * 2}, InvalidArgumentError, "covariances"),
        ({"covariances": torch.ones(4, 2).double()}, InvalidArgumentError, "covariances"),
        ({"means": torch.full((4, 2), math.nan).double()}, InvalidArgumentError, "means"),
        ({"means": torch.zeros(4).double()}, InvalidArgumentError, "means"),
        ({"weights": torch.tensor([1.0, -1.0, 1.0, 1.0])}, InvalidArgumentError, r"weights\[1\]=-1"),
        ({"weights": torch.full((4,), math.inf)}, InvalidArgumentError, "weights"),
        ({"weights": torch.ones(3)}, InvalidArgumentError, "weights"),
    ],
)
def test_invalid_mixture_is_rejected(change, error, match):
    with pytest.raises(error, match=match):
        simplify(mixture(4, 2)._replace(**change), 2)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({}, "n_components=None and max_cost=None"),
        ({"n_components": 0}, "n_components=0"),
        ({"n_components": 2.5}, "n_components=2.5"),
        ({"max_cost": -1.0}, "max_cost=-1"),
        ({"max_cost": math.nan}, "max_cost=nan"),
        ({"max_cost": "low"}, "max_cost='low'"),
        ({"n_components": 2, "cost": "cheap"}, "cost='cheap'"),
        ({"n_components": 2, "neighbors": 0}, "neighbors=0"),
    ],
)
def test_invalid_options_are_named(options, match):
    with pytest.raises(InvalidArgumentError, match=match):
        simplify(mixture(4, 2), **options)


# -- estimators ------------------------------------------------------------------------------------


def test_merge_is_the_weighted_sum_of_the_densities():
    a = GaussianMixture(3, random_state=0).fit(blobs(2, 300, 0))
    b = GaussianMixture(2, random_state=0).fit(blobs(2, 100, 1) + 1)
    union = merge(a, b, 300, 100)
    points = blobs(2, 50, 2)
    expected = np.log(0.75 * np.exp(a.score_samples(points)) + 0.25 * np.exp(b.score_samples(points)))
    assert union.n_components == 5
    np.testing.assert_allclose(union.score_samples(points), expected, rtol=1e-9)
    assert union.n_samples_seen_ == 400
    same = merge(a, b, 400, 0, max_cost=1e-12)
    np.testing.assert_allclose(same.score_samples(points), a.score_samples(points), rtol=1e-9)


def test_merged_halves_are_nearly_as_good_as_the_whole():
    halves = [blobs(2, 2000, seed) for seed in (0, 1)]
    a, b = (GaussianMixture(3, random_state=0).fit(half) for half in halves)
    whole = GaussianMixture(3, random_state=0).fit(np.concatenate(halves))
    merged = merge(a, b, 2000, 2000, n_components=3)
    assert merged.n_components == 3
    assert merged.score(blobs(2, 1000, 2)) == pytest.approx(whole.score(blobs(2, 1000, 2)), abs=0.005)
    assert merge(a, b, 2000, 2000, max_cost=0.01).n_components == 3
    assert merge(a, b, 2000, 2000, max_cost=0.1, cost="hellinger").n_components == 3


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_merge_has_the_kind_of_the_first_and_can_continue(kind):
    a = GaussianMixture(3, random_state=0).fit(kind(blobs(2, 300, 0)))
    b = GaussianMixture(3, random_state=0).fit(blobs(2, 100, 1))
    merged = merge(a, b, 300, 100, n_components=3, reg_covar=1e-3, random_state=5)
    assert type(merged.means_) is type(a.means_)
    assert (merged.reg_covar, merged.random_state) == (1e-3, 5)
    merged.partial_fit(kind(blobs(2, 50, 2)))
    assert merged.n_samples_seen_ == 450


@pytest.mark.parametrize(
    ("weights", "match"),
    [
        ((-1, 2), "weight_a=-1"),
        ((1, math.inf), "weight_b=inf"),
        ((0, 0), "both zero"),
        (("a", 1), "weight_a='a'"),
    ],
)
def test_invalid_weights_of_mixtures_are_named(weights, match):
    a = GaussianMixture(1).fit(blobs(2, 10))
    with pytest.raises(InvalidArgumentError, match=match):
        merge(a, a, *weights)


def test_incompatible_mixtures_are_rejected():
    a, b = (GaussianMixture(1).fit(blobs(dim, 10)) for dim in (2, 3))
    with pytest.raises(InvalidArgumentError, match="2D, b in 3D"):
        merge(a, b, 1, 1)
    with pytest.raises(NotFittedError, match="fit"):
        merge(a, GaussianMixture(), 1, 1)
    with pytest.raises(InvalidArgumentError, match="n_components=0"):
        merge(a, a, 1, 1, n_components=0)


# -- moments ---------------------------------------------------------------------------------------


@settings(max_examples=40)
@given(
    seed=st.integers(0, 10**6),
    dim=st.integers(1, 5),
    k=st.integers(1, 12),
    offset=st.sampled_from([0.0, 5e5]),
    exponents=st.lists(st.integers(-12, 9), min_size=12, max_size=12),
)
def test_merged_groups_have_the_moments_of_their_members(seed, dim, k, offset, exponents):
    parameters = mixture(k, dim, seed)
    weights = 10.0 ** torch.tensor(exponents[:k]).double()
    parameters = Parameters(weights, parameters.means + offset, parameters.covariances)
    labels = torch.from_numpy(
        np.unique(np.random.default_rng(seed).integers(3, size=k), return_inverse=True)[1]
    )
    merged = merge_components(*parameters, labels, int(labels.max()) + 1)
    for group in range(len(merged.weights)):
        members = take(parameters, labels == group)
        assert_same_moments(take(merged, torch.tensor([group])), members, atol=1e-9)


def test_group_without_weight_counts_members_equally():
    parameters = Parameters(torch.zeros(2), torch.tensor([[0.0], [2.0]]), torch.ones(2, 1, 1))
    merged = merge_components(*(p.double() for p in parameters), torch.zeros(2, dtype=torch.int64), 1)
    assert [value.flatten().tolist() for value in merged] == [[0.0], [1.0], [2.0]]
    pair = merge_pairs(
        *(take(Parameters(*(p.double() for p in parameters)), torch.tensor([k])) for k in (0, 1))
    )
    assert [value.flatten().tolist() for value in pair] == [[0.0], [1.0], [2.0]]


@pytest.mark.parametrize("labels", [[0, 0, 2], [0, 1, 3], [-1, 0, 1], [0, 1]])
def test_invalid_labels_are_rejected(labels):
    with pytest.raises(InvalidArgumentError, match="labels"):
        merge_components(*mixture(3, 2), torch.tensor(labels), 3)


# -- costs -----------------------------------------------------------------------------------------


@costs
@dims
def test_costs_of_pairs_equal_the_printed_formulas(cost, dim):
    parameters = mixture(12, dim)
    given = Gaussians.of(parameters)
    i, j = torch.triu_indices(12, 12, 1)
    rows = [tuple(value[k].numpy() for value in parameters) for k in range(12)]
    expected = [numpy_cost(rows[a], rows[b], cost) for a, b in zip(i.tolist(), j.tolist(), strict=True)]
    found = COSTS[cost](given.at(i), given.at(j))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(COSTS[cost](given.at(j), given.at(i)), expected, rtol=1e-9, atol=1e-12)
    one_to_all = COSTS[cost](given.at(slice(0, 1)), given)
    np.testing.assert_allclose(one_to_all[1:], expected[:11], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(one_to_all[0], 0, atol=1e-12)
