"""HierarchicalGaussianMixture as an estimator: its contract, likelihood, and clouds of few points."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mixture.estimator_contract import MixtureContract
from mixture.fit_contract import FAR, FitContract, blobs, check_mixture, rigid_motion
from mixture.mixture_cases import MISSING, changed_file
from mixture.tree_cases import exact, room, split_nodes
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, NumericalError
from gmmtorch.mixture import GaussianMixture, HierarchicalGaussianMixture, LaserModel, prune
from gmmtorch.mixture.estimators.tree_growth import Children, Tree, keep_children

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


class TestContract(MixtureContract):
    exact_components = False
    score_tolerance = 0.4
    bad_parameters: ClassVar[dict[str, tuple[Any, ...]]] = {
        "branching": (1, 2.5, None),
        "max_levels": (0, 1.5),
        "max_iter": (0,),
        "soft_threshold": (-0.1, 1.1, math.nan, None),
        **dict.fromkeys(
            ("tol", "reg_covar", "planarity_threshold", "thickness", "min_support", "min_gain"),
            (-1e-3, math.nan, math.inf, "small", None),
        ),
    }

    def make(self, n_components: int = 3, **options: Any) -> HierarchicalGaussianMixture:
        return HierarchicalGaussianMixture(n_components, **{"random_state": 0, "dtype": "float64", **options})


class TestContractInSinglePrecision(FitContract):
    exact_components = False
    score_tolerance = 0.4
    # In float32 EM may stop one step earlier or later.
    order_tolerance = repetition_tolerance = motion_tolerance = far_tolerance = 0.05

    def make(self, n_components: int = 3, **options: Any) -> HierarchicalGaussianMixture:
        return HierarchicalGaussianMixture(n_components, **{"random_state": 0, **options})


# -- likelihood ------------------------------------------------------------------------------------


@pytest.mark.parametrize("soft_threshold", [0.01, 0.1, 1.0])
def test_likelihood_exceeds_the_bound_of_the_level_before(soft_threshold):
    """With points assigned to some children only, the likelihood may decrease, but not below the bound."""
    points = room(2000)
    weight = np.random.default_rng(0).uniform(0.5, 2.0, len(points))
    kept, scores = [], []
    for levels in (1, 2, 3):
        tree = exact(branching=4, max_levels=levels, soft_threshold=soft_threshold)
        tree.fit(points, sample_weight=weight)
        kept.append(tree.lower_bound_)
        scores.append(np.average(tree.score_samples(points), weights=weight))
        np.testing.assert_allclose(tree.level(levels).score_samples(points), tree.score_samples(points))
    assert all(bound <= score + 1e-9 for bound, score in zip(kept, scores, strict=True))
    assert all(after >= bound for bound, after in zip(kept, scores[1:], strict=False))
    assert scores[2] > scores[0]


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_bound_never_decreases_within_a_level(dtype):
    found: list[float] = []
    tree = HierarchicalGaussianMixture(branching=6, max_levels=1, reg_covar=1e-9, dtype=dtype)
    tree.fit(room(3000), on_iteration=lambda iteration, bound: found.append(bound))
    assert found == tree.lower_bounds_
    assert len(found) > 10
    assert np.diff(found[1:-1]).min() > (-1e-3 if dtype == "float32" else -1e-10)
    assert found[1] > found[0]


def test_tree_is_nearly_as_likely_as_flat_em():
    points, fresh = room(6000), room(2000, seed=1)
    tree = HierarchicalGaussianMixture(64, random_state=0).fit(points)
    k = len(tree.weights_)
    assert 56 <= k <= 64
    flat = GaussianMixture(k, random_state=0).fit(points)
    single = GaussianMixture(1).fit(points)
    assert tree.score(fresh) > flat.score(fresh) - 0.15
    assert tree.score(fresh) > single.score(fresh) + 1.5


def test_float32_switches_to_float64_if_its_error_is_large():
    """Sheets half a millimetre thin, two hundred metres apart."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, size=(900, 3)) * [100.0, 100.0, 0.0]
    points[:, 2] = (np.arange(900) % 3) * 100.0 + 5e-4 * rng.normal(size=900)
    options: dict[str, Any] = {"branching": 3, "max_levels": 2, "reg_covar": 1e-12}
    single = HierarchicalGaussianMixture(dtype="float32", **options).fit(points)
    double = HierarchicalGaussianMixture(dtype="float64", **options).fit(points)
    assert abs(single.score(points) - double.score(points)) < 0.05
    assert np.sqrt(np.linalg.eigvalsh(single.covariances_)[:, 0]).max() < 1e-3


# -- degenerate clouds -----------------------------------------------------------------------------


@settings(max_examples=40)
@given(data=st.data(), dim=st.integers(1, 3), n=st.integers(1, 60))
def test_any_cloud_of_few_places_is_fitted(data, dim, n):
    """Deep trees of lattices with repeated points, of any scale and far from the origin."""
    scale, offset = data.draw(
        st.sampled_from([(1.0, 0.0), (1e-6, 0.0), (1e3, 5e5), (1e-3, -1e6), (1e6, 0.0)])
    )
    rng = np.random.default_rng(data.draw(st.integers(0, 999)))
    points = offset + scale * rng.integers(0, data.draw(st.sampled_from([1, 2, 4, 20])), size=(n, dim))
    weight = rng.choice([1e-3, 1.0, 50.0], size=n)
    options = {
        "branching": data.draw(st.sampled_from([2, 3, 8])),
        "min_support": data.draw(st.sampled_from([0.0, 1.0, 4.0])),
        "min_gain": data.draw(st.sampled_from([0.0, 1.0])),
        "soft_threshold": data.draw(st.sampled_from([0.0, 0.1, 1.0])),
        "dtype": data.draw(st.sampled_from(["float32", "float64"])),
    }
    tree = HierarchicalGaussianMixture(max_levels=3, max_iter=20, **options).fit(points, sample_weight=weight)
    check_mixture(tree, points, at_most=n)
    for level in range(1, tree.n_levels_ + 1):
        check_mixture(tree.level(level), points, at_most=n)
    assert (tree.weights > 0).all()


def test_fit_without_regularisation_is_valid_or_rejected():
    tree = exact(reg_covar=0.0, max_levels=2).fit(room(1000))
    check_mixture(tree, room(1000), at_most=64)
    with pytest.raises(NumericalError, match="reg_covar"):
        exact(reg_covar=0.0).fit(np.ones((20, 3)))


# -- levels ----------------------------------------------------------------------------------------


@st.composite
def trees(draw: st.DrawFn) -> list[int]:
    """Parents, level by level."""
    levels = [[-1] * draw(st.integers(1, 3))]
    for _ in range(draw(st.integers(0, 4))):
        first = sum(map(len, levels[:-1]))
        counts = [draw(st.integers(0, 3)) for _ in levels[-1]]
        below = [first + i for i, n in enumerate(counts) for _ in range(n)]
        if not below:
            break
        levels.append(below)
    return [parent for level in levels for parent in level]


@given(parents=trees())
def test_levels_and_leaves_of_random_trees(parents):
    def depth(node: int) -> int:
        return 1 if parents[node] < 0 else 1 + depth(parents[node])

    n = len(parents)
    tree = Tree(torch.tensor(parents), *(torch.zeros(n, *shape) for shape in ((), (2,), (2, 2))))
    assert tree.levels().tolist() == [depth(node) for node in range(n)]
    leaves = [node for node in range(n) if node not in parents]
    assert tree.leaves().tolist() == leaves
    for level in range(1, 6):
        expected = [i for i in range(n) if depth(i) == level or (i in leaves and depth(i) < level)]
        assert tree.at_level(level).tolist() == expected


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_every_level_is_a_mixture_of_the_whole_cloud(kind):
    points, fresh = kind(room(4000)), kind(room(1000, seed=1))
    tree = HierarchicalGaussianMixture(branching=5, max_levels=3, random_state=0).fit(points)
    assert tree.n_levels_ == 3
    sizes, scores = [], []
    for level in range(1, 4):
        mixture = tree.level(level)
        assert type(mixture) is GaussianMixture
        assert type(mixture.means_) is type(points)
        check_mixture(mixture, np.asarray(points), at_most=5**level)
        sizes.append(mixture.n_components)
        scores.append(mixture.score(fresh))
        np.testing.assert_allclose(mixture.weights @ mixture.means, np.asarray(points).mean(0), atol=0.02)
    assert sizes == sorted(set(sizes))
    assert scores == sorted(scores)
    assert sizes[0] == 5
    assert torch.equal(tree.level(3).means, tree.means)
    weights, parents = np.asarray(tree.node_weights_), np.asarray(tree.node_parents_)
    for node in split_nodes(HierarchicalGaussianMixture().fit(np.asarray(points))):
        if (parents == node).any():
            assert weights[parents == node].sum() == pytest.approx(weights[node], rel=1e-9)
    assert len(weights) == len(tree.node_means_) == len(tree.node_covariances_) == len(tree.node_levels_)
    for level, message in ((0, "at least 1"), (4, "n_levels_=3"), (1.5, "whole number")):
        with pytest.raises(InvalidArgumentError, match=f"^level={level}.*{message}"):
            tree.level(level)


def test_tree_of_one_node_is_one_gaussian():
    tree = exact(1).fit(blobs(2))
    assert tree.n_levels_ == 1
    assert tree.node_parents_.tolist() == [-1]
    np.testing.assert_allclose(tree.means_[0], blobs(2).mean(0))
    np.testing.assert_allclose(tree.covariances_[0], np.cov(blobs(2).T, bias=True) + 1e-6 * np.eye(2))
    assert tree.lower_bound_ == pytest.approx(tree.score(blobs(2)))


def test_mixture_of_given_parameters_has_one_level():
    whole = exact(branching=3, max_levels=2).fit(blobs(2))
    tree = HierarchicalGaussianMixture.from_parameters(whole.weights_, whole.means_, whole.covariances_)
    assert tree.n_levels_ == 1
    assert torch.equal(tree.level(1).means, whole.means)
    assert (tree.node_parents_ == -1).all()
    pruned, kept = prune(whole, 240, min_support=20.0)
    assert pruned.n_levels_ == 1
    assert len(pruned.weights_) == int(kept.sum())


# -- motions, copies and files ---------------------------------------------------------------------


def deep() -> HierarchicalGaussianMixture:
    return HierarchicalGaussianMixture(branching=3, max_levels=3, random_state=0).fit(room(600) + FAR[:3])


def assert_same_tree(one: HierarchicalGaussianMixture, other: HierarchicalGaussianMixture) -> None:
    assert one.n_levels_ == other.n_levels_ > 1
    assert (one.node_parents_ == other.node_parents_).all()
    for level in range(1, one.n_levels_ + 1):
        assert torch.equal(one.level(level).covariances, other.level(level).covariances)


def test_files_and_states_keep_the_tree(tmp_path):
    path = tmp_path / "tree.safetensors"
    for tree in (deep(), exact(100).fit(room(600))):
        assert len(tree.weights_) < 100
        tree.save(path)
        loaded = HierarchicalGaussianMixture.load(path)
        assert loaded.get_params() == tree.get_params()
        restored = HierarchicalGaussianMixture(2).fit(blobs(2))
        restored.load_state_dict(tree.state_dict())
        for other in (loaded, restored):
            assert_same_tree(other, tree)
        assert torch.equal(GaussianMixture.load(path).means, tree.means)


def test_moved_moves_the_tree():
    tree, motion = deep(), rigid_motion(3)
    moved = tree.moved(motion)
    points = room(50, seed=2) + FAR[:3]
    at = points @ motion[:3, :3].T + motion[:3, 3]
    for level in range(1, tree.n_levels_ + 1):
        expected = tree.level(level).score_samples(points)
        np.testing.assert_allclose(moved.level(level).score_samples(at), expected, atol=1e-6)
    assert_same_tree(tree, deep())


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("parents", lambda p: torch.cat([p.new_tensor([len(p) - 1]), p[1:]])),  # a cycle
        ("parents", lambda p: torch.where(torch.arange(len(p)) == 3, 3, p)),  # its own parent
        ("parents", lambda p: torch.where(torch.arange(len(p)) == 0, -2, p)),
        ("parents", lambda p: torch.cat([p[:-1], p.new_tensor([len(p)])])),
        ("weights", lambda w: torch.cat([w[:-1], w.new_tensor([0.5])])),  # not those of the mixture
        ("parents", Tensor.double),
        ("parents", lambda p: p[None]),
        ("means", lambda m: m[:-1].clone()),
        ("means", lambda m: MISSING),
        ("covariances", Tensor.float),
    ],
)
def test_file_with_an_invalid_tree_is_rejected(tmp_path, name, change):
    tree = deep()
    value = change(getattr(tree._tree(), name).clone())
    with pytest.raises(DataError, match=r"m\.safetensors"):
        HierarchicalGaussianMixture.load(changed_file(tree, tmp_path, {f"extra.node_{name}": value}))


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
