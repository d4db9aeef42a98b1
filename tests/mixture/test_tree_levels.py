"""Levels, leaves, motions and files of a tree of mixtures."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mixture.fit_contract import FAR, blobs, check_mixture, rigid_motion
from mixture.tree_cases import exact, room, split_nodes

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.files import pack_tensors, read_tensors
from gmmtorch.mixture import GaussianMixture, HierarchicalGaussianMixture, prune
from gmmtorch.mixture.estimators.hierarchical import check_tree
from gmmtorch.mixture.estimators.tree_growth import Tree

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


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


def broken(change: str, tree: Tree) -> Tree:
    parents, weights, means, covariances = (value.clone() for value in tree)
    if change == "cycle":
        parents[0] = len(parents) - 1
    elif change == "self":
        parents[3] = 3
    elif change == "negative":
        parents[0] = -2
    elif change == "beyond":
        parents[-1] = len(parents)
    elif change == "leaves":
        parents[-1] = -1
        weights[-1] = 0.5
    elif change == "type":
        parents = parents.double()
    elif change == "short":
        means = means[:-1]
    elif change == "single":
        covariances = covariances.float()
    elif change == "shape":
        parents = parents[None]
    return Tree(parents, weights, means, covariances)


@pytest.mark.parametrize(
    "change", ["cycle", "self", "negative", "beyond", "leaves", "type", "short", "single", "shape"]
)
def test_file_with_an_invalid_tree_is_rejected(tmp_path, change):
    tree, path = deep(), tmp_path / "tree.safetensors"
    tree.save(path)
    tensors, facts = read_tensors(path, "gmmtorch.mixture", 1)
    check_tree(tree._tree(), tree.weights)
    names = HierarchicalGaussianMixture._extra_names
    tensors |= {f"extra.{n}": v for n, v in zip(names, broken(change, tree._tree()), strict=True)}
    path.write_bytes(pack_tensors(tensors, "gmmtorch.mixture", 1, **facts))
    with pytest.raises(DataError, match=r"tree\.safetensors"):
        HierarchicalGaussianMixture.load(path)


def test_file_with_an_incomplete_tree_is_rejected(tmp_path):
    tree, path = deep(), tmp_path / "tree.safetensors"
    tree.save(path)
    tensors, facts = read_tensors(path, "gmmtorch.mixture", 1)
    del tensors["extra.node_means"]
    path.write_bytes(pack_tensors(tensors, "gmmtorch.mixture", 1, **facts))
    with pytest.raises(DataError, match="node_means"):
        HierarchicalGaussianMixture.load(path)
