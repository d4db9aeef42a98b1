"""k-means: beside scikit-learn's, and by its definition."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kernels.twins import by_both
from sklearn.cluster import KMeans
from sklearn.datasets import load_digits, load_iris

from gmmtorch.mixture.em import kmeans as module
from gmmtorch.mixture.em.initialization import distinct
from gmmtorch.mixture.em.kmeans import kmeans, spread_out


def clusters(x: np.ndarray, k: int, seed: int, n_runs: int = 1) -> tuple[np.ndarray, np.ndarray]:
    points = torch.from_numpy(x - x.mean(0))
    weight = torch.ones(len(x)).double()
    nearest, scatter = kmeans(
        points, weight, *distinct(points, weight), k, torch.Generator().manual_seed(seed), n_runs
    )
    return nearest.numpy(), scatter.numpy()


def scatter_of(x: np.ndarray, labels: np.ndarray) -> float:
    return sum(float(((x[labels == k] - x[labels == k].mean(0)) ** 2).sum()) for k in np.unique(labels))


@pytest.mark.parametrize(("table", "k"), [(load_digits, 10), (load_iris, 3), (load_iris, 40)])
def test_runs_are_as_good_as_those_of_scikit_learn(table, k):
    x = table().data
    _, ours = clusters(x, k, 0, 12)
    theirs = [KMeans(k, n_init=1, random_state=seed).fit(x).inertia_ for seed in range(12)]
    assert ours.mean() < 1.02 * np.mean(theirs)
    assert ours.min() < 1.005 * np.min(theirs)


@given(st.integers(0, 999), st.integers(2, 80), st.integers(1, 7), st.integers(1, 5), st.integers(1, 3))
def test_clusters_are_not_empty_and_improve_in_no_step_of_lloyd(seed, n, dim, k, n_runs):
    x = np.random.default_rng(seed).normal(size=(n, dim))
    k = min(k, n)
    nearest, scatter = clusters(x, k, seed, n_runs)
    for labels, value in zip(nearest, scatter, strict=True):
        assert len(np.unique(labels)) == k
        means = np.stack([x[labels == j].mean(0) for j in range(k)])
        next_labels = ((x[:, None] - means) ** 2).sum(2).argmin(1)
        assert scatter_of(x, next_labels) >= (1 - 1e-3) * scatter_of(x, labels)
        assert value == pytest.approx(scatter_of(x, labels), rel=1e-3, abs=1e-9)


def test_centers_are_distinct_points_even_if_far_ones_are_few():
    x = torch.cat([torch.zeros(500, 2), torch.arange(5.0)[:, None].expand(5, 2) * 1e8]).double()
    weight = torch.ones(505).double()
    rows, mass = distinct(x, weight)
    assert len(rows) == 5
    chosen = spread_out(x, weight, rows, mass, 5, torch.Generator().manual_seed(0), 4)
    assert all(len(set(map(tuple, x[own].tolist()))) == 5 for own in chosen)


def test_empty_clusters_continue_at_the_farthest_points(monkeypatch):
    x = np.repeat(np.array([[-9.0], [0.0], [1.0], [20.0]]), 3, 0)
    monkeypatch.setattr(module, "spread_out", lambda points, *_: torch.tensor([[0, 1, 2, 3]]))
    for labels, scatter in by_both(lambda: clusters(x, 4, 0)):  # of four centers, three are equal
        assert scatter[0] < 1e-9
        assert sorted(np.bincount(labels[0]).tolist()) == [3, 3, 3, 3]


@given(st.integers(0, 999), st.integers(2, 60), st.integers(1, 9), st.integers(1, 20))
def test_one_launch_finds_what_the_twin_finds(seed, n, dim, k):
    rng = np.random.default_rng(seed)
    weight = torch.from_numpy(rng.random(n) + 0.5)
    points = torch.from_numpy(rng.normal(size=(n, dim)))
    cloud = (points, weight, *distinct(points, weight))
    twin, fused = by_both(lambda: kmeans(*cloud, min(k, n), torch.Generator().manual_seed(seed)))
    torch.testing.assert_close(fused, twin)


def test_equal_and_extreme_points_have_clusters():
    for x in (np.repeat(np.arange(5.0), 9)[:, None] * 1e8, np.full((20, 3), 1e200), np.eye(12)):
        labels, _ = clusters(x, len(np.unique(x, axis=0)), 0, 3)
        assert all(len(np.unique(own)) == len(np.unique(x, axis=0)) for own in labels)
