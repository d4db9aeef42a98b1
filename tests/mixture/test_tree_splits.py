"""Which nodes of a tree of mixtures are split, and into how many."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from mixture.tree_cases import exact, room, split_nodes

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mixture import LaserModel
from gmmtorch.mixture.estimators.tree_growth import Children, keep_children

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


# -- limits of the splits --------------------------------------------------------------------------


def test_flat_or_thin_nodes_are_not_split():
    points = room(2500)
    n_free = len(exact(min_gain=0.0).fit(points).weights_)
    for options in ({"planarity_threshold": 3e-3}, {"thickness": 0.02}):
        tree = exact(min_gain=0.0, **options).fit(points)
        variance = np.linalg.eigvalsh(tree.node_covariances_)
        flat = variance[:, 0] < options.get("planarity_threshold", 0.0) * variance.sum(1)
        flat |= variance[:, 0] < options.get("thickness", 0.0) ** 2
        assert flat.any()
        assert not flat[split_nodes(tree)].any()
        assert len(tree.weights_) < n_free / 2
    assert len(exact(planarity_threshold=1.0).fit(points).weights_) == 1


def test_weak_children_are_removed_in_favour_of_siblings():
    weights = torch.tensor([[0.7, 0.25, 0.05], [0.04, 0.03, 0.93], [0.5, 0.5, 0.0]]).double()
    children = Children(weights, torch.zeros(3, 3, 2), torch.zeros(3, 3, 2, 2))
    support = weights * torch.tensor([[100.0], [100.0], [3.0]])
    found = keep_children(children, support >= 6.0).weights
    expected = [[0.7 / 0.95, 0.25 / 0.95, 0.0], [0.0, 0.0, 1.0], [0.5, 0.5, 0.0]]
    torch.testing.assert_close(found, torch.tensor(expected).double())


@pytest.mark.parametrize("min_support", [5.0, 40.0])
def test_leaves_have_min_support(min_support):
    points = room(1000)
    tree = exact(min_support=min_support, min_gain=0.0).fit(points)
    support = tree.weights_ * 1000
    assert len(support) > 5
    assert support.min() > 0.5 * min_support  # min_support applies to members, whose path weights differ
    assert tree.weights_.sum() == pytest.approx(1, abs=1e-12)


def test_split_must_gain_min_gain_per_parameter():
    points = np.random.default_rng(0).normal(size=(3000, 3))  # one Gaussian
    assert len(exact().fit(points).weights_) == 1
    assert len(exact(min_gain=0.0).fit(points).weights_) > 20
    few, many = exact(min_gain=math.log(3000) / 2).fit(room(3000)), exact().fit(room(3000))
    assert 4 <= len(few.weights_) < len(many.weights_) < 300


def test_split_must_gain_tol_a_point():
    points = np.random.default_rng(0).uniform(size=(2000, 1))
    assert len(exact(min_gain=0.0, branching=2, max_levels=1, tol=1e-3).fit(points).weights_) == 2
    assert len(exact(min_gain=0.0, branching=2, max_levels=1, tol=0.2).fit(points).weights_) == 1


@pytest.mark.parametrize("places", [1, 2, 5])
def test_number_of_leaves_is_limited_by_distinct_points(places):
    at = np.random.default_rng(0).normal(size=(places, 3))
    points = np.repeat(at, 20, axis=0)
    tree = exact().fit(points)
    assert len(tree.weights_) == places
    order = np.lexsort(tree.means_.T), np.lexsort(at.T)
    np.testing.assert_allclose(tree.means_[order[0]], at[order[1]], atol=1e-9)
    np.testing.assert_allclose(tree.weights_, 1 / places)


# -- the largest number of leaves ------------------------------------------------------------------


@pytest.mark.parametrize("branching", [2, 3, 8])
@pytest.mark.parametrize("n_components", [1, 2, 3, 7, 9, 20, 100])
def test_number_of_leaves_is_close_below_n_components(n_components, branching):
    tree = exact(n_components, branching=branching, max_levels=9, min_support=1.0, min_gain=0.0)
    k = len(tree.fit(room(1500)).weights_)
    assert 0.9 * n_components <= k <= n_components


def test_limited_splits_go_where_they_gain_most():
    """Two clusters of equal weight and width: one evenly filled, the other with dots on a grid."""
    rng = np.random.default_rng(0)
    even = rng.uniform(-2, 2, size=(1000, 2)) + np.array([20.0, 0.0])
    dots = rng.integers(-2, 3, size=(1000, 2)) * 0.8 + 0.02 * rng.normal(size=(1000, 2))
    points = np.concatenate([even, dots])
    few, all_of_it = (exact(n, branching=2, max_levels=8, min_gain=0.0).fit(points) for n in (24, None))
    assert (all_of_it.means_[:, 0] > 10).sum() > 50
    assert (few.means_[:, 0] > 10).sum() == 8  # of sixteen nodes on the fourth level
    assert (few.means_[:, 0] < 10).sum() == 16


# -- pruning by density (thesis 2.1.4) -------------------------------------------------------------


def two_walls() -> tuple[np.ndarray, LaserModel]:
    """Points of two far apart walls around the origin, and a few stray points between them; the sensor."""
    laser = LaserModel(angular_step=0.002)
    along = np.linspace(-0.8, 0.8, 800)
    walls = [np.stack([np.full(800, side * 4.0), 4 * np.tan(along)], 1) for side in (-1, 1)]
    stray = np.stack([np.linspace(-3, 3, 9), np.full(9, 3.0)], 1)
    noise = np.random.default_rng(0).normal(0, 0.01, (1609, 2))
    return np.concatenate([*walls, stray]) + noise, laser


def test_sparse_children_lose_their_points_to_their_siblings():
    points, laser = two_walls()
    options: dict[str, Any] = {"branching": 3, "max_levels": 1, "min_gain": 0.0, "min_support": 2.0}
    plain = exact(**options).fit(points)
    assert len(plain.weights_) == 3
    least = float(np.min(plain.weights_))
    assert least < 0.02  # the stray points
    pruned = exact(min_density_share=0.2, sensor=laser, **options).fit(points, origins=np.zeros(2))
    assert len(pruned.weights_) == 2
    assert np.sum(pruned.weights_) == pytest.approx(1)
    assert np.min(pruned.weights_) > 0.4
    again = exact(min_density_share=1e-9, sensor=laser, **options).fit(points, origins=np.zeros((1, 2)))
    np.testing.assert_array_equal(again.means_, plain.means_)


def test_a_tree_of_sparse_children_is_one_node():
    points, laser = two_walls()
    found = exact(min_density_share=1e6, sensor=laser).fit(points, origins=np.zeros(2))
    assert len(found.weights_) == 1


@pytest.mark.parametrize(
    ("options", "origins", "said"),
    [
        ({"min_density_share": 0.1}, np.zeros(2), "min_density_share=0.1 needs .* sensor"),
        ({"min_density_share": 0.1, "sensor": LaserModel()}, None, "origins in fit"),
        ({"min_density_share": 0.1, "sensor": LaserModel()}, np.zeros(3), r"origins has shape \(3,\)"),
        ({"min_density_share": -1.0}, None, "min_density_share=-1"),
        ({"sensor": "lidar"}, None, "sensor='lidar'"),
    ],
)
def test_invalid_options_of_density_are_named(options, origins, said):
    with pytest.raises(InvalidArgumentError, match=said):
        exact(**options).fit(two_walls()[0], origins=origins)
