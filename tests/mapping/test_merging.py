"""Merging under a budget or an error bound, and which origins are kept."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mapping.random_components import counts_add_up, estimated_bytes, normal_components, total_moments
from scipy.stats import chi2

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping import Components, count_explained
from gmmtorch.mapping.learning.merging import UNNUMBERED, compact, compact_to_bytes, limit_origins


def pair(offset: float, deviation: float = 0.1, flags: tuple[bool, bool] = (False, False)) -> Components:
    """Two equal components, `offset` metres apart, of ten points each."""
    means = torch.tensor([[1.0, 2.0], [1.0 + offset, 2.0]], dtype=torch.float64)
    return Components(
        means=means,
        covariances=(deviation**2 * torch.eye(2, dtype=torch.float64)).repeat(2, 1, 1),
        support=torch.tensor([10.0, 10.0], dtype=torch.float64),
        max_range=torch.tensor(flags),
        ids=torch.tensor([[7, 4], [7, 5]]),
        origins=torch.zeros(1, 2, dtype=torch.float64),
        seen_by=torch.tensor([0, 1]),
        seen_from=torch.tensor([0, 0]),
        seen_count=torch.tensor([10.0, 10.0], dtype=torch.float64),
    ).checked()


@given(
    k=st.integers(1, 60),
    dim=st.sampled_from([2, 3]),
    seed=st.integers(0, 1000),
    limit=st.integers(2, 60),
    empty=st.sampled_from([0.0, 0.3, 1.0]),
)
def test_merging_keeps_the_moments_of_hits_and_no_returns_and_the_budget(k, dim, seed, limit, empty):
    given_ = normal_components(k, dim, seed, empty=empty)
    left = compact(given_, limit).checked()
    assert len(left) == min(k, limit)
    assert counts_add_up(left)
    for flag in (False, True):
        before = total_moments(given_, given_.max_range == flag)
        after = total_moments(left, left.max_range == flag)
        for a, b in zip(before, after, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


def test_unmerged_components_keep_every_bit_and_their_id():
    far = normal_components(12, 3, 0, spread=100.0)
    near = replace(far, means=far.means.clone())
    near.means[1] = near.means[0] + 0.01
    left = compact(near, 11)
    fresh = left.ids[:, 1] == UNNUMBERED
    assert int(fresh.sum()) == 1
    for row in (~fresh).nonzero().squeeze(1).tolist():
        old = int(left.ids[row, 1])
        for name in ("means", "covariances", "support", "max_range"):
            assert torch.equal(getattr(left, name)[row], getattr(near, name)[old])


def test_surface_components_never_merge_with_no_return_components():
    both = pair(0.0, flags=(False, True))
    assert len(compact(both, max_cost=0.9)) == 2
    left = compact(both, 1)
    assert left.max_range.tolist() == [False]
    assert left.origins.shape[0] == 1
    assert counts_add_up(left)


def test_merges_above_the_cost_limit_are_not_made():
    # Equal covariances: H² = 1 − exp(−δ²/8σ²).
    offset, deviation = 0.05, 0.1
    squared = 1 - math.exp(-((offset / deviation) ** 2) / 8)
    assert len(compact(pair(offset, deviation), max_cost=squared * 1.01)) == 1
    assert len(compact(pair(offset, deviation), max_cost=squared * 0.99)) == 2


def test_the_cheapest_pair_by_support_is_merged_first():
    # Two pairs equally far apart; the light one is cheaper to merge.
    heavy, light = pair(0.1), pair(0.1)
    light = replace(
        light, means=light.means + 50, support=light.support / 10, seen_count=light.seen_count / 10
    )
    left = compact(Components.concatenate([heavy, light]), 3)
    assert sorted(left.support.tolist()) == [2.0, 10.0, 10.0]


@pytest.mark.parametrize("bad", [{}, {"max_components": 0}, {"max_components": 2, "max_cost": -1.0}])
def test_invalid_limits_are_refused(bad):
    with pytest.raises(InvalidArgumentError):
        compact(normal_components(3, 2, 0), **bad)


def test_empty_and_single_components_are_returned_unchanged():
    nothing = Components.empty(3)
    assert len(compact(nothing, 5, 0.5)) == len(limit_origins(nothing, 2)) == 0
    assert len(compact_to_bytes(nothing, 1, 2, None, estimated_bytes)) == 0


# -- origins --------------------------------------------------------------------------------------


def kept_by_a_loop(components: Components, limit: int, mean: float | None) -> set[tuple[int, int]]:
    """The origins to keep, found greedily one after the other."""
    first, further = set(), []
    for k in range(len(components)):
        rows = [e for e in range(len(components.seen_by)) if int(components.seen_by[e]) == k]
        places = {e: components.origins[components.seen_from[e]] for e in rows}
        mine: list[int] = []
        while rows and len(mine) < limit:
            adds = [
                math.sqrt(float(components.seen_count[e]))
                * min((float((places[e] - places[m]).norm()) for m in mine), default=1.0)
                for e in rows
            ]
            best = rows.pop(adds.index(max(adds)))
            if mine:
                further.append((max(adds), (k, int(components.seen_from[best]))))
            else:
                first.add((k, int(components.seen_from[best])))
            mine.append(best)
    if mean is None:
        return first | {key for _, key in further}
    return first | {key for _, key in sorted(further)[::-1][: int(mean * len(components)) - len(first)]}


@given(
    k=st.integers(1, 12),
    dim=st.sampled_from([2, 3]),
    seed=st.integers(0, 1000),
    limit=st.integers(1, 6),
    mean=st.sampled_from([None, 1.0, 1.7, 3.0]),
)
def test_limit_origins_equals_a_greedy_loop(k, dim, seed, limit, mean):
    given_ = normal_components(k, dim, seed, n_origins=7)
    left = limit_origins(given_, limit, mean).checked()
    table = {tuple(row): i for i, row in enumerate(given_.origins.tolist())}
    got = {
        (int(by), table[tuple(left.origins[viewpoint].tolist())])
        for by, viewpoint in zip(left.seen_by, left.seen_from, strict=True)
    }
    assert len(got) <= min(limit, mean or limit) * k
    assert counts_add_up(left)
    assert torch.equal(torch.unique(left.seen_from), torch.arange(left.origins.shape[0]))
    within = len(given_.seen_by) <= (mean or limit) * k and int(torch.bincount(given_.seen_by).max()) <= limit
    assert got == (
        {*zip(given_.seen_by.tolist(), given_.seen_from.tolist(), strict=True)}
        if within
        else kept_by_a_loop(given_, limit, mean)
    )


# -- bytes ----------------------------------------------------------------------------------------


@given(
    k=st.integers(1, 80),
    seed=st.integers(0, 100),
    max_bytes=st.integers(330, 2500),
    empty=st.sampled_from([0, 0.5]),
)
def test_compact_to_bytes_keeps_the_byte_budget(k, seed, max_bytes, empty):
    given_ = normal_components(k, 3, seed, empty=empty)
    left = compact_to_bytes(given_, max_bytes, 3, None, estimated_bytes)
    assert len(left) >= 1
    assert estimated_bytes(left) <= max_bytes
    if estimated_bytes(limit_origins(given_, 3)) <= max_bytes:
        assert len(left) == k
    else:
        # The unused bytes are fewer than one more component takes.
        assert len(left) == 1 or estimated_bytes(left) > 0.7 * max_bytes - 100
        assert len(left) == 1 or bool((left.ids[:, 1] == UNNUMBERED).all())


@pytest.mark.parametrize(("limit", "mean"), [(0, None), (2, 0.5), (2, math.nan)])
def test_invalid_numbers_of_origins_are_refused(limit, mean):
    with pytest.raises(InvalidArgumentError, match="_origins="):
        limit_origins(normal_components(3, 2, 0), limit, mean)


# -- association: counts of explained points against a loop over points and components -------------------


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
    assert found[1].tolist() == explained
    torch.testing.assert_close(found[0].support, support)
    got = torch.zeros_like(counts)
    got[found[0].seen_by, found[0].seen_from] = found[0].seen_count
    torch.testing.assert_close(got, counts)
    assert counts_add_up(found[0])
    gained = float(found[0].support.sum() - components.support.sum())
    assert math.isclose(gained, sum(explained), abs_tol=1e-6)


def test_without_components_or_points_nothing_is_explained():
    nothing = Components.empty(2)
    points = torch.zeros(3, 2, dtype=torch.float64)
    assert count_explained(nothing, points, points[0], 1.0)[1].tolist() == [False] * 3
    some = normal_components(3, 2, 0)
    found = count_explained(some, points[:0], points[0], 1.0)
    assert found[1].shape == (0,)
    assert torch.equal(found[0].support, some.support)


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
    assert torch.equal(whole[1], parts[1])
    torch.testing.assert_close(whole[0].support, parts[0].support)
    assert torch.equal(whole[1], by_place[1])
    torch.testing.assert_close(whole[0].support, by_place[0].support)
