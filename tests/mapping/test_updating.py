"""Association: counts of explained points against a loop over points and components."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mapping.random_components import counts_add_up, normal_components
from scipy.stats import chi2

from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.novelty import count_explained


def counts_by_a_loop(components, points, origin, distance, limit, max_range, frees=None):
    """Support (K,), which points are explained, and counts (K, S) by origin."""
    support = components.support.clone()
    counts = torch.zeros(len(components), components.origins.shape[0], dtype=torch.float64)
    counts[components.seen_by, components.seen_from] = components.seen_count
    explained = []
    for n, point in enumerate(points):
        shares = {}
        within = distance if frees is None or frees[n] else math.inf
        for k in range(len(components)):
            offset = point - components.means[k]
            squared = float(offset @ torch.linalg.inv(components.covariances[k]) @ offset)
            places = components.seen_from[components.seen_by == k]
            apart = float((components.origins[places] - origin).norm(dim=1).min())
            if squared < limit and apart <= within and bool(components.max_range[k]) == max_range:
                shares[k] = 1 / max(squared, 1e-6)
        for k, share in shares.items():
            places = components.seen_from[components.seen_by == k]
            nearest = places[(components.origins[places] - origin).norm(dim=1).argmin()]
            support[k] += share / sum(shares.values())
            counts[k, nearest] += share / sum(shares.values())
        explained.append(bool(shares))
    return support, explained, counts


@given(
    dim=st.sampled_from([2, 3]),
    seed=st.integers(0, 500),
    distance=st.sampled_from([0.0, 1.0, 3.0, 100.0]),
    limit=st.sampled_from([None, 2.0]),
    max_range=st.booleans(),
    asks=st.sampled_from(["all", "some", "none"]),
)
def test_association_counts_equal_a_loop(dim, seed, distance, limit, max_range, asks):
    components = normal_components(7, dim, seed, spread=0.5, empty=0.3)
    generator = torch.Generator().manual_seed(seed + 1)
    points = torch.randn(15, dim, generator=generator, dtype=torch.float64)
    origin = torch.randn(dim, generator=generator, dtype=torch.float64)
    some = torch.rand(15, generator=generator) < 0.5
    frees = {"all": None, "some": some, "none": torch.zeros_like(some)}[asks]
    found = count_explained(components, points, origin, distance, limit, max_range, frees=frees)
    bound = float(chi2.ppf(0.95, dim)) if limit is None else limit
    support, explained, counts = counts_by_a_loop(
        components, points, origin, distance, bound, max_range, frees
    )
    assert found.explained.tolist() == explained
    torch.testing.assert_close(found.components.support, support)
    got = torch.zeros_like(counts)
    got[found.components.seen_by, found.components.seen_from] = found.components.seen_count
    torch.testing.assert_close(got, counts)
    assert counts_add_up(found.components)
    gained = float(found.components.support.sum() - components.support.sum())
    assert math.isclose(gained, sum(explained), abs_tol=1e-6)


def test_association_keeps_moments_and_adds_beam_weights():
    components = normal_components(4, 3, 0)
    at_mean = components.means[:1]  # where the thesis's shares divide by zero
    found = count_explained(components, at_mean, components.origins[0], 100.0, weight=16.0)
    assert found.explained.tolist() == [True]
    assert math.isclose(float(found.components.support.sum() - components.support.sum()), 16.0)
    assert float(found.components.support[0] - components.support[0]) > 15.9
    assert torch.equal(found.components.means, components.means)
    assert torch.equal(found.components.covariances, components.covariances)
    assert torch.equal(found.components.ids, components.ids)


def test_without_components_or_points_nothing_is_explained():
    nothing = Components.empty(2)
    points = torch.zeros(3, 2, dtype=torch.float64)
    assert count_explained(nothing, points, points[0], 1.0).explained.tolist() == [False] * 3
    some = normal_components(3, 2, 0)
    found = count_explained(some, points[:0], points[0], 1.0)
    assert found.explained.shape == (0,)
    assert torch.equal(found.components.support, some.support)


@pytest.mark.parametrize("k", [1, 300])
def test_association_counts_do_not_depend_on_the_portion_size(k, monkeypatch):
    components = normal_components(k, 2, 1)
    points = torch.randn(200, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    whole = count_explained(components, points, components.origins[0], 100.0)
    monkeypatch.setattr("gmmtorch.mapping.learning.novelty._PAIRS_AT_ONCE", 7 * k)
    parts = count_explained(components, points, components.origins[0], 100.0)
    by_place = count_explained(
        components, points, components.origins[0], 100.0, frees=torch.ones(200, dtype=torch.bool)
    )
    assert torch.equal(whole.explained, parts.explained)
    torch.testing.assert_close(whole.components.support, parts.components.support)
    assert torch.equal(whole.explained, by_place.explained)
    torch.testing.assert_close(whole.components.support, by_place.components.support)
