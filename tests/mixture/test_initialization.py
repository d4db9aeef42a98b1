"""Starting parameters of EM."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from mixture.mixture_cases import cloud, thin_wall
from torch import Tensor

from gmmtorch.mixture.em import initialization
from gmmtorch.mixture.em.exact import Parameters, quadratic_features
from gmmtorch.mixture.em.initialization import (
    INITIALIZATIONS,
    distinct_points,
    flat_pieces,
    initialize,
    moments_of,
    replicated,
)
from gmmtorch.mixture.em.partition import pool_into_cells

METHODS = sorted(INITIALIZATIONS)
SEEDED = [method for method in METHODS if method != "flat_pieces"]


def begin(method: str, points: Tensor, k: int, weight: Tensor | None = None, seed: int = 0):
    weight = points.new_ones(len(points)) if weight is None else weight
    return initialize(method, points, weight, k, 1e-6, torch.Generator().manual_seed(seed))


def test_distinct_points_are_sorted_with_summed_weights():
    points = torch.tensor([[1.0, 2.0], [0.0, 5.0], [1.0, 2.0], [1.0, -3.0]], dtype=torch.float64)
    rows, weight = distinct_points(points, torch.tensor([1.0, 2.0, 3.0, 0.5], dtype=torch.float64))
    assert rows.tolist() == [[0.0, 5.0], [1.0, -3.0], [1.0, 2.0]]
    assert weight.tolist() == [2.0, 0.5, 4.0]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dim", [2, 3])
def test_start_is_a_mixture_within_the_cloud(method, dim):
    points = cloud(300, dim)
    weights, means, covariances = begin(method, points, 7)
    assert (weights.shape, means.shape, covariances.shape) == ((7,), (7, dim), (7, dim, dim))
    assert float(weights.min()) > 0
    assert float(weights.sum()) == pytest.approx(1)
    assert float(torch.linalg.eigvalsh(covariances).min()) > 0
    assert bool(((means >= points.amin(0)) & (means <= points.amax(0))).all())


@pytest.mark.parametrize("method", SEEDED)
def test_start_depends_on_the_seed(method):
    points = cloud(200, 2)
    first, again, other = begin(method, points, 5), begin(method, points, 5), begin(method, points, 5, seed=1)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first.means, other.means)


@pytest.mark.parametrize("method", METHODS)
def test_integer_weights_equal_repeated_points_in_any_order(method):
    points = cloud(100, 3)
    weight = torch.randint(1, 4, (100,), generator=torch.Generator().manual_seed(2)).double()
    repeated = points.repeat_interleave(weight.long(), 0)
    shuffled = repeated[torch.randperm(len(repeated), generator=torch.Generator().manual_seed(3))]
    found, same = begin(method, points, 6, weight), begin(method, shuffled, 6)
    torch.testing.assert_close(tuple(found), tuple(same), rtol=1e-10, atol=1e-12)


def test_random_points_are_drawn_by_weight():
    points = torch.arange(4.0, dtype=torch.float64)[:, None].expand(4, 2)
    weight = torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=torch.float64)
    drawn = [float(begin("random_points", points, 1, weight, seed).means[0, 0]) for seed in range(800)]
    shares = np.bincount(np.array(drawn, dtype=int), minlength=4) / 800
    np.testing.assert_allclose(shares, [0.1, 0.2, 0.3, 0.4], atol=0.07)  # four standard errors


@pytest.mark.parametrize("method", ["random_points", "bounding_box"])
@pytest.mark.parametrize("dim", [2, 3])
def test_isotropic_starts_have_the_reduced_variance_of_the_cloud(method, dim):
    points = cloud(500, dim)
    covariances = begin(method, points, 4).covariances
    variance = points.numpy().var(axis=0).mean() * 4 ** (-2 / dim) + 1e-6
    expected = np.broadcast_to(variance * np.eye(dim), (4, dim, dim))
    np.testing.assert_allclose(covariances.numpy(), expected, rtol=1e-10)


def test_kmeans_start_has_the_moments_of_the_clusters():
    centers = torch.tensor([[-9.0, 0.0], [0.0, 9.0], [9.0, 0.0]], dtype=torch.float64)
    points = torch.cat(
        [center + 0.3 * cloud(n, 2, n) for center, n in zip(centers, (30, 50, 20), strict=True)]
    )
    weights, means, covariances = begin("kmeans", points, 3)
    order = means[:, 0].argsort()
    np.testing.assert_allclose(weights[order].numpy(), [0.3, 0.5, 0.2], rtol=1e-10)
    for i, own in zip(order, points.split([30, 50, 20]), strict=True):
        np.testing.assert_allclose(means[i].numpy(), own.numpy().mean(0), atol=1e-10)
        expected = np.cov(own.numpy().T, ddof=0) + 1e-6 * np.eye(2)
        np.testing.assert_allclose(covariances[i].numpy(), expected, rtol=1e-8, atol=1e-11)


def test_kmeans_restarts_keep_the_clustering_of_least_scatter():
    points = cloud(400, 2)

    def scatter(method: str, seed: int) -> float:
        weights, _, covariances = begin(method, points, 25, seed=seed)
        return float((weights * covariances.diagonal(dim1=-2, dim2=-1).sum(1)).sum())

    once, restarted = (
        [scatter(method, seed) for seed in range(6)] for method in ("kmeans", "kmeans_restarts")
    )
    assert all(many <= one + 1e-12 for one, many in zip(once, restarted, strict=True))
    assert min(restarted) < min(once)


# -- flat pieces -------------------------------------------------------------------------------------


def check_moments(found: Parameters, labels: Tensor, points: np.ndarray, weight: np.ndarray) -> None:
    """Check that each component has the weight, mean and covariance of the points of its label."""
    dim = points.shape[1]
    for k, (share, mean, covariance) in enumerate(zip(*found, strict=True)):
        own, p = points[labels.numpy() == k], weight[labels.numpy() == k]
        assert float(share) == pytest.approx(p.sum() / weight.sum(), rel=1e-9)
        center = np.average(own, axis=0, weights=p)
        np.testing.assert_allclose(mean, center, rtol=1e-12, atol=1e-9)
        offset = own - center
        expected = np.einsum("n,ni,nj->ij", p / p.sum(), offset, offset) + 1e-6 * np.eye(dim)
        np.testing.assert_allclose(covariance, expected, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("dim", [1, 2, 3, 5])
@pytest.mark.parametrize("pooled", [False, True])
def test_flat_pieces_have_the_moments_of_their_points(dim, pooled, monkeypatch):
    if pooled:
        monkeypatch.setattr(initialization, "_FEWEST_CELLS", 100)
    points = cloud(600, dim)
    weight = torch.rand(600, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 0.1
    found, labels = flat_pieces(points, weight, 12, 1e-6)
    assert found.weights.shape == (12,)
    assert labels.shape == (600,)
    assert sorted(set(labels.tolist())) == list(range(12))
    check_moments(found, labels, points.numpy(), weight.numpy())


def test_flat_pieces_of_cells_have_the_moments_of_their_points():
    points, weight = cloud(600, 3), torch.ones(600, dtype=torch.float64)
    cells = pool_into_cells(points, 150, 1e-3)
    means = cells.features[:, 1:4].contiguous()
    found, labels = flat_pieces(means, cells.weight, 10, 1e-6, cells.features)
    assert labels.shape == (len(means),)
    check_moments(found, labels[cells.member], points.numpy(), weight.numpy())


def test_moments_of_distant_thin_pieces_keep_their_digits():
    wall = thin_wall(500, 3.0, noise=1e-3).numpy()
    points = torch.from_numpy(np.concatenate([wall - 250_000.0, wall + 250_000.0]))
    labels = torch.arange(2).repeat_interleave(500)
    weight = torch.ones(1000, dtype=torch.float64)
    found = moments_of(quadratic_features(points), weight, labels, 2, 0.0, points)
    for covariance in found.covariances:
        np.testing.assert_allclose(covariance, np.cov(wall.T, ddof=0), atol=1e-10)


@pytest.mark.parametrize("k", [3, 4, 7])
def test_replicated_components_share_the_weight(k):
    weights = torch.tensor([0.5, 0.3, 0.2], dtype=torch.float64)
    found = Parameters(weights, cloud(3, 2), torch.eye(2, dtype=torch.float64).repeat(3, 1, 1))
    many, copy = replicated(found, k)
    assert many.weights.shape == (k,)
    assert torch.equal(many.means, found.means[copy])
    sums = torch.zeros(3, dtype=torch.float64).index_add_(0, copy, many.weights)
    torch.testing.assert_close(sums, weights)
