"""GaussianMap.from_components: stored values, evidence and bad input."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from mapping.map_cases import assert_same_components, given_parts, sightings
from occupancy.protocol_contract import dims, lattice, wall_scan
from scipy.stats import multivariate_normal

from gmmtorch.errors import GmmTorchError
from gmmtorch.mapping.codec.quantization import quantized
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.query_options import METHODS
from gmmtorch.occupancy.grid import VoxelGrid

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


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("means", torch.zeros(4)),
        ("means", torch.zeros(4, 2, 1)),
        ("means", torch.full((4, 2), math.nan)),
        ("covariances", torch.zeros(3, 2, 2)),
        ("covariances", torch.full((4, 2, 2), math.inf)),
        ("covariances", -torch.eye(2).repeat(4, 1, 1)),
        ("covariances", torch.tensor([[1.0, 0.9], [-0.9, 1.0]]).repeat(4, 1, 1)),
        ("support", torch.ones(3)),
        ("support", -torch.ones(4)),
        ("support", torch.full((4,), math.nan)),
        ("origins", torch.zeros(3, 2)),
        ("origins", torch.zeros(4, 3)),
        ("origins", torch.full((4, 2), math.nan)),
        ("origins", [[([0.0, 0.0], 1.0)]] * 3),
        ("origins", [[([0.0, 0.0], 1.0)]] * 5),
        ("origins", [[([0.0, 0.0], 0.0)]] * 4),
        ("origins", [[([0.0, 0.0], 2.0), ([1.0, 0.0], -1.0)]] * 4),
        ("origins", [[]] * 4),
        ("max_range", [True]),
        ("robot", -1),
        ("robot", "r2"),
        ("robot", 1.5),
    ],
)
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
