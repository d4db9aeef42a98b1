"""Components: given to GaussianMap.from_components, selected and summed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from invalid_values import each_value
from mapping.map_cases import assert_same_components, given_parts, sightings
from mapping.random_components import counts_add_up, normal_components
from occupancy.protocol_contract import dims, lattice, wall_scan
from scipy.stats import multivariate_normal
from torch import Tensor

from gmmtorch import Components, GaussianMap, GmmTorchError, VoxelGrid
from gmmtorch.mapping import METHODS, quantized, summed

PARTS = ("means", "covariances", "support", "origins")


@dims
def test_given_components_are_kept_exactly_with_one_origin_each(dim):
    parts = given_parts(dim)
    made = GaussianMap.from_components(**parts, max_range=[True, False, False, True], robot=7)
    for found in (made, made.components()):
        for name in PARTS:
            assert torch.equal(getattr(found, name), parts[name])
        assert found.max_range.tolist() == [True, False, False, True]
        assert found.ids.tolist() == [[7, i] for i in range(4)]
    expected = zip(parts["origins"], parts["support"], strict=True)
    assert sightings(made.components()) == [{tuple(o.tolist()): float(n)} for o, n in expected]


@dims
def test_given_components_are_rounded_by_the_quantized_codec(dim):
    exact = GaussianMap.from_components(**given_parts(dim))
    made = GaussianMap.from_components(**given_parts(dim), codec="quantized")
    assert_same_components(made.components(), quantized(exact.components()))
    assert made.nbytes < exact.nbytes / 2


def test_given_components_may_be_arrays_and_lists():
    parts = given_parts()
    first = GaussianMap.from_components(**parts)
    for convert in (lambda t: t.numpy(), lambda t: t.tolist()):
        other = GaussianMap.from_components(**{k: convert(v) for k, v in parts.items()})
        assert torch.equal(first.occupancy(lattice(2)), other.occupancy(lattice(2)))


@pytest.mark.parametrize("as_array", [False, True])
def test_overwriting_given_arrays_does_not_change_the_map(as_array):
    parts = given_parts()
    flags = torch.zeros(4, dtype=torch.bool)
    given = {k: v.numpy() if as_array else v for k, v in parts.items()}
    made = GaussianMap.from_components(**given, max_range=flags)
    for value in (*parts.values(), flags):
        value.fill_(1)
    assert_same_components(made.components(), GaussianMap.from_components(**given_parts()).components())


def test_several_origins_share_the_support_in_proportion_to_their_counts():
    parts = given_parts(k=2)
    a, b, c = ([0.0, 0.0], [1.0, 0.0], [0.0, 2.0])
    made = GaussianMap.from_components(
        parts["means"], parts["covariances"], parts["support"], [[(a, 1.0), (b, 3.0)], [(c, 5.0)]]
    )
    assert sightings(made.components()) == [{(0.0, 0.0): 2.5, (1.0, 0.0): 7.5}, {(0.0, 2.0): 20.0}]


@pytest.mark.parametrize(("method", "tolerance"), [("flux", 1e-3), ("monte_carlo", 0.05)])
def test_hits_of_given_components_follow_their_density(method, tolerance):
    mean, covariance = np.array([2.0, 0.4]), np.array([[0.02, 0.01], [0.01, 0.05]])
    made = GaussianMap.from_components(
        mean[None], covariance[None], [100.0], [[0.1, 0.1]], n_samples=1 << 17, cutoff=5.0
    )
    grid = VoxelGrid((1.5, -0.5), 0.25, (5, 8))
    low = grid.centers().numpy() - 0.125
    normal = multivariate_normal(mean, covariance)
    expected = [100 * normal.cdf(a + 0.25, lower_limit=a) for a in low]
    hits = made.evidence(grid, method).hits.flatten().numpy()
    np.testing.assert_allclose(hits, expected, atol=tolerance)


INCONSISTENT = {
    "means": [torch.zeros(4), torch.zeros(4, 2, 1), torch.full((4, 2), math.nan)],
    "covariances": [
        torch.zeros(3, 2, 2),
        torch.full((4, 2, 2), math.inf),
        -torch.eye(2).repeat(4, 1, 1),
        torch.tensor([[1.0, 0.9], [-0.9, 1.0]]).repeat(4, 1, 1),
    ],
    "support": [torch.ones(3), -torch.ones(4), torch.full((4,), math.nan)],
    "origins": [
        torch.zeros(3, 2),
        torch.zeros(4, 3),
        torch.full((4, 2), math.nan),
        [[([0.0, 0.0], 1.0)]] * 3,
        [[([0.0, 0.0], 1.0)]] * 5,
        [[([0.0, 0.0], 0.0)]] * 4,
        [[([0.0, 0.0], 2.0), ([1.0, 0.0], -1.0)]] * 4,
        [[]] * 4,
    ],
    "max_range": [[True]],
    "robot": [-1, "r2", 1.5],
}


@pytest.mark.parametrize(("name", "value"), each_value(INCONSISTENT))
def test_inconsistent_components_are_refused(name, value):
    with pytest.raises(GmmTorchError, match=name if name == "robot" else None):
        GaussianMap.from_components(**{**given_parts(), name: value})


@dims
@pytest.mark.parametrize("method", METHODS)
def test_zero_given_components_make_an_empty_map(dim, method):
    none = torch.zeros(0, dim)
    made = GaussianMap.from_components(none, torch.zeros(0, dim, dim), torch.zeros(0), none)
    assert made.occupancy(lattice(dim), method=method).unique().tolist() == [0.5]
    made.insert(wall_scan(dim))
    assert made.components().ids[:, 1].tolist() == list(range(made.n_components))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("sampling", ["sobol", "stratified", "plain"])
def test_components_of_zero_support_give_no_evidence(sampling, method):
    made = GaussianMap.from_components(
        torch.zeros(1, 2), torch.eye(2)[None], torch.zeros(1), torch.ones(1, 2), sampling=sampling
    )
    assert made.occupancy(lattice(2), method=method).unique().tolist() == [0.5]


def test_more_than_255_origins_are_stored(tmp_path):
    k, n = 2, 300
    parts = given_parts(k=k)
    seen = [[([0.01 * i, float(j)], 1.0 + i) for i in range(n)] for j in range(k)]
    for codec in ("float", "quantized"):
        made = GaussianMap.from_components(
            parts["means"], parts["covariances"], parts["support"], seen, codec=codec
        )
        made.save(tmp_path / "m.safetensors")
        loaded = GaussianMap.load(tmp_path / "m.safetensors")
        assert_same_components(loaded.components(), made.components())
        assert loaded.seen_count.shape == (k * n,)
        np.testing.assert_allclose(loaded.origins.numpy(), made.origins.numpy(), atol=2**-9)


# -- selected and summed ---------------------------------------------------------------------------------


@pytest.mark.parametrize("rows", [[4, 0, 11, 7], [], list(range(12)), list(range(11, -1, -1)), [5]])
def test_selected_components_equal_those_of_a_loop(rows: list[int]) -> None:
    components = normal_components(12, 3, seed=1, empty=0.3)
    # Sightings in any order, and a component without any.
    order = torch.randperm(len(components.seen_by), generator=torch.Generator().manual_seed(0))
    order = order[components.seen_by[order] != 7]
    shuffled = {n: getattr(components, n)[order] for n in ("seen_by", "seen_from", "seen_count")}
    components = replace(components, **shuffled)
    chosen = components.selected(torch.tensor(rows, dtype=torch.int64)).checked()
    assert len(chosen) == len(rows)
    for place, row in enumerate(rows):
        for name in ("means", "covariances", "support", "max_range", "ids"):
            assert torch.equal(getattr(chosen, name)[place], getattr(components, name)[row])
        assert list(sightings(chosen)[place].items()) == list(sightings(components)[row].items())
    assert torch.equal(chosen.origins, components.origins)


def batch(ids: list[tuple[int, int]], counts: list[float], seed: int) -> Components:
    """Components with these ids and counts and one origin."""
    components = normal_components(len(ids), 3, seed, n_origins=1)
    support = torch.tensor(counts, dtype=torch.float64)
    return replace(
        components, ids=torch.tensor(ids, dtype=torch.int64), support=support, seen_count=support.clone()
    )


def test_summed_counts_equal_those_of_a_dictionary() -> None:
    parts = [
        batch([(1, 0), (1, 1), (1, 2)], [3.0, 5.0, 7.0], 0),
        batch([(0, 9), (0, 3)], [11.0, 13.0], 1),
        batch([(1, 1), (0, 3), (1, 1)], [0.5, 0.25, 2.0], 2),
    ]
    found = summed(Components.concatenate(parts)).checked()
    totals: dict[tuple[int, int], float] = {}
    first: dict[tuple[int, int], Tensor] = {}
    for part in parts:
        for key, count, mean in zip(part.ids.tolist(), part.support.tolist(), part.means, strict=True):
            totals[tuple(key)] = totals.get(tuple(key), 0.0) + count
            first.setdefault(tuple(key), mean)
    assert [tuple(key) for key in found.ids.tolist()] == sorted(totals)
    assert found.support.tolist() == [totals[key] for key in sorted(totals)]
    assert torch.equal(found.means, torch.stack([first[key] for key in sorted(totals)]))
    assert counts_add_up(found)


def test_summing_distinct_or_no_components_changes_nothing() -> None:
    alone = batch([(0, 0), (0, 4), (2, 1)], [1.0, 2.0, 3.0], 0)
    found = summed(alone)
    for name in ("means", "support", "ids", "seen_by", "seen_from", "seen_count"):
        assert torch.equal(getattr(found, name), getattr(alone, name))
    assert len(summed(Components.empty(3))) == 0
