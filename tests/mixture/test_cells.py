"""Cells: points summed into few cells, with their exact moments."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mixture.mixture_cases import cloud

from gmmtorch.kernels import kernels
from gmmtorch.mixture import GaussianMixture
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em import loop
from gmmtorch.mixture.em.exact import quadratic_features
from gmmtorch.mixture.em.partition import pool_into_cells


@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 300),
    dim=st.integers(2, 3),
    limit=st.integers(1, 300),
    finest=st.sampled_from([1e-3, 0.1, 1.0]),
)
def test_cells_conserve_moments_within_the_limit(seed, n, dim, limit, finest):
    points = cloud(n, dim, seed)
    cells = pool_into_cells(points, limit, finest)
    assert cells.weight.shape[0] <= limit
    assert float(cells.weight.min()) >= 1
    assert float(cells.weight.sum()) == n
    torch.testing.assert_close(
        (cells.features * cells.weight[:, None]).sum(0),
        quadratic_features(points).sum(0),
        rtol=1e-11,
        atol=1e-11,
    )


def test_each_cell_is_the_exact_mean_of_its_points():
    points = (cloud(200, 3, 0) * 1024).round() / 1024
    cells = pool_into_cells(points, 40, 0.01)
    for cell in range(cells.weight.shape[0]):
        own = [[Fraction(x) for x in row] for row in points[cells.member == cell].tolist()]
        assert len(own) == int(cells.weight[cell])
        products = [(i, j) for i in range(3) for j in range(i, 3)]
        expected = [Fraction(1)]
        expected += [sum(row[i] for row in own) / len(own) for i in range(3)]
        expected += [sum(row[i] * row[j] for row in own) / len(own) for i, j in products]
        # Sums of these numbers are exact in float64, so only the division may round.
        assert cells.features[cell].tolist() == [float(x) for x in expected]


@pytest.mark.parametrize("dim", [2, 3])
def test_cells_have_the_finest_side(dim):
    points = cloud(3000, dim, 1)
    cells = pool_into_cells(points, 2999, 0.3)
    assert cells.weight.shape[0] < 2999
    low = points.amin(0).numpy()
    keys = {tuple(k) for k in np.floor((points.numpy() - low) / 0.3).astype(int)}
    assert cells.weight.shape[0] == len(keys)
    for cell in range(cells.weight.shape[0]):
        own = points[cells.member == cell]
        assert float((own.amax(0) - own.amin(0)).max()) <= 0.3 + 1e-12


def test_distant_outlier_gets_its_own_cell():
    points = torch.cat([cloud(500, 3, 0), torch.full((1, 3), 5e5, dtype=torch.float64)])
    cells = pool_into_cells(points, 100, 0.01)
    assert int(cells.weight[cells.member[-1]]) == 1  # the outlier has its own cell
    assert float(cells.weight.sum()) == 501
    torch.testing.assert_close(
        (cells.features * cells.weight[:, None]).sum(0), quadratic_features(points).sum(0), rtol=1e-12, atol=0
    )


def test_cells_do_not_depend_on_the_order_of_points():
    points = cloud(400, 2, 3)
    order = torch.randperm(400, generator=torch.Generator().manual_seed(1))
    cells, shuffled = pool_into_cells(points, 60, 0.01), pool_into_cells(points[order], 60, 0.01)
    torch.testing.assert_close(cells.features, shuffled.features, rtol=1e-12, atol=1e-12)
    assert torch.equal(cells.member[order], shuffled.member)


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("limit", [30, 1000])
def test_integer_weights_equal_repeated_points(dim, limit):
    points = cloud(200, dim, 5)
    weight = torch.randint(1, 4, (200,), generator=torch.Generator().manual_seed(0)).double()
    weighted = pool_into_cells(points, min(limit, 199), 1e-3, weight)
    repeated = pool_into_cells(points.repeat_interleave(weight.long(), 0), min(limit, 199), 1e-3)
    torch.testing.assert_close(weighted.features, repeated.features, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(weighted.weight, repeated.weight)
    assert torch.equal(weighted.member.repeat_interleave(weight.long()), repeated.member)


def test_equal_points_share_one_cell():
    cells = pool_into_cells(torch.zeros(50, 3, dtype=torch.float64), 5, 0.0)
    assert cells.weight.tolist() == [50.0]
    assert cells.member.tolist() == [0] * 50
    assert cells.features.tolist() == [[1.0] + [0.0] * 9]


@given(seed=st.integers(0, 10**6), dim=st.integers(1, 3), k=st.integers(1, 5), limit=st.integers(5, 80))
def test_em_on_cells_keeps_the_moments_of_the_cloud(seed, dim, k, limit):
    points = cloud(300, dim, seed)
    points = points - points.mean(0)
    cells = pool_into_cells(points, limit, 1e-3)
    generator = torch.Generator().manual_seed(seed)
    first = em.Parameters(
        torch.full((k,), 1 / k, dtype=torch.float64),
        torch.randn(k, dim, generator=generator, dtype=torch.float64),
        torch.eye(dim, dtype=torch.float64).repeat(k, 1, 1),
    )
    step = loop.natural_step(cells.features, cells.weight, 0.0, torch.float64)
    found = loop.run_em(step, first, tol=0.0, max_iter=8)
    assert (np.diff(found.lower_bounds) >= -1e-10).all()
    weights, means, covariances = found.parameters
    torch.testing.assert_close(weights @ means, points.mean(0), rtol=0, atol=1e-9)
    second = covariances + means[:, :, None] * means[:, None, :]
    expected = points.T @ points / 300
    torch.testing.assert_close(torch.einsum("k,kij->ij", weights, second), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("algorithm", ["exact", "truncated"])
@pytest.mark.parametrize("init", ["kmeans", "flat_pieces"])
def test_fit_with_one_cell_per_point_equals_fit_of_points(algorithm, init):
    points = cloud(300, 3, 1).numpy()
    options = {"algorithm": algorithm, "init_params": init, "random_state": 0, "dtype": "float64"}
    plain = GaussianMixture(20, **options).fit(points)
    for limit in (300, 5000):
        pooled = GaussianMixture(20, max_cells=limit, **options).fit(points)
        np.testing.assert_allclose(pooled.lower_bounds_, plain.lower_bounds_, rtol=1e-9)
        np.testing.assert_allclose(pooled.means_, plain.means_, atol=1e-6)
        np.testing.assert_allclose(pooled.covariances_, plain.covariances_, atol=1e-6)


def test_fit_of_cells_is_nearly_as_likely_as_fit_of_points():
    centers = 6 * cloud(12, 3, 7)
    points = (centers.repeat(400, 1) + 0.5 * cloud(4800, 3, 8)).numpy()
    plain = GaussianMixture(12, init_params="flat_pieces", tol=1e-5).fit(points)
    pooled = GaussianMixture(12, init_params="flat_pieces", tol=1e-5, max_cells=1000).fit(points)
    assert pooled.lower_bound_ < pooled.score(points)
    assert pooled.score(points) > plain.score(points) - 0.1
    assert pooled.n_samples_seen_ == 4800


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("kind", ["any", "equal", "lattice"])
@pytest.mark.parametrize("limit", [1, 40, 1500])
def test_fused_cells_are_those_of_the_twin(dim, kind, limit):
    points = cloud(2000, dim, 5)
    if kind == "equal":
        points[:] = points[0].clone()
    if kind == "lattice":  # points on the planes between cells
        points = (points * 4).round() / 4
    weight, found = 1 + torch.arange(2000).double() % 3, []
    for choice in ("torch", "fused"):
        with kernels(choice):
            found.append(pool_into_cells(points, limit, 0.25, weight))
    assert torch.equal(found[1].member, found[0].member)
    torch.testing.assert_close(found[1], found[0], rtol=1e-12, atol=1e-12)
