"""Moments and costs of merged components against quadrature."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mixture.reduction_cases import assert_same_moments, costs, dims, mixture, numpy_cost, take, total_moments
from scipy.integrate import quad
from scipy.stats import norm

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.reduction import COSTS, Gaussians, merge_components, merge_pairs

# -- moments ---------------------------------------------------------------------------------------


@dims
def test_merged_group_has_the_moments_of_its_members(dim):
    parameters = mixture(20, dim)
    labels = torch.from_numpy(np.random.default_rng(1).permutation(np.arange(20) % 4))
    merged = merge_components(*parameters, labels, 4)
    for group in range(4):
        expected = total_moments(take(parameters, labels == group))
        for value, moment in zip(take(merged, torch.tensor(group)), expected, strict=True):
            np.testing.assert_allclose(value.numpy(), moment, rtol=1e-10, atol=1e-12)


@settings(max_examples=40)
@given(
    seed=st.integers(0, 10**6),
    dim=st.integers(1, 5),
    k=st.integers(1, 12),
    offset=st.sampled_from([0.0, 5e5]),
    exponents=st.lists(st.integers(-12, 9), min_size=12, max_size=12),
)
def test_merge_components_keeps_the_moments_of_the_mixture(seed, dim, k, offset, exponents):
    parameters = mixture(k, dim, seed)
    weights = 10.0 ** torch.tensor(exponents[:k]).double()
    parameters = Parameters(weights, parameters.means + offset, parameters.covariances)
    labels = torch.from_numpy(
        np.unique(np.random.default_rng(seed).integers(3, size=k), return_inverse=True)[1]
    )
    merged = merge_components(*parameters, labels, int(labels.max()) + 1)
    assert_same_moments(merged, parameters, atol=1e-9)


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


def pair_cost(parameters: Parameters, cost: str) -> float:
    given = Gaussians.of(parameters)
    return float(COSTS[cost](given.at(slice(0, 1)), given.at(slice(1, 2))))


@pytest.mark.parametrize("seed", range(4))
def test_kullback_leibler_bound_equals_quadrature(seed):
    parameters = mixture(2, 1, seed)
    (w,), (mean,), (variance,) = (
        value.flatten().tolist()
        for value in merge_components(*parameters, torch.zeros(2, dtype=torch.int64), 1)
    )
    merged, expected, truth = norm(mean, math.sqrt(variance)), 0.0, 0.0
    parts = [norm(float(m), float(c) ** 0.5) for m, c in zip(*parameters[1:], strict=True)]
    low = min(part.ppf(1e-12) for part in parts)
    high = max(part.ppf(1 - 1e-12) for part in parts)
    for weight, part in zip(parameters.weights.tolist(), parts, strict=True):
        divergence = quad(
            lambda x, g=part: g.pdf(x) * (g.logpdf(x) - merged.logpdf(x)), low, high, limit=200
        )[0]
        expected += weight * divergence

    def density(x: float) -> float:
        return sum(a / w * g.pdf(x) for a, g in zip(parameters.weights.tolist(), parts, strict=True))

    truth = (
        w * quad(lambda x: density(x) * (math.log(density(x)) - merged.logpdf(x)), low, high, limit=200)[0]
    )
    bound = pair_cost(parameters, "kullback_leibler")
    assert bound == pytest.approx(expected, rel=1e-6)
    assert 0 < truth < bound


@pytest.mark.parametrize("seed", range(4))
def test_squared_hellinger_equals_quadrature_in_1d(seed):
    parameters = mixture(2, 1, seed, spread=1.0)
    a, b = (norm(float(m), float(c) ** 0.5) for m, c in zip(*parameters[1:], strict=True))
    overlap = quad(lambda x: math.sqrt(a.pdf(x) * b.pdf(x)), -30, 30, limit=400)[0]
    assert pair_cost(parameters, "hellinger") == pytest.approx(1 - overlap, abs=1e-7)


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


def test_merging_weight_zero_costs_nothing():
    parameters = mixture(2, 2)
    parameters.weights[0] = 0
    assert pair_cost(parameters, "kullback_leibler") == 0
