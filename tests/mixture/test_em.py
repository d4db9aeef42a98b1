"""Exact EM as two matrix products, against scipy, loops, and arithmetic with fifty digits."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import assume, given, reject, settings
from hypothesis import strategies as st
from mixture.mixture_cases import (
    cloud,
    direct_step,
    random_parameters,
    random_weight,
    rows_of,
    scipy_log_joint,
)
from scipy.special import logsumexp
from torch import Tensor

from gmmtorch.errors import NumericalError
from gmmtorch.kernels import chunks
from gmmtorch.mixture import Parameters, Rows, pool_into_cells
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em import loop
from gmmtorch.mixture.em.by_type import Factors
from gmmtorch.mixture.em.exact import quadratic_features


def brute_force_statistics(
    points: Tensor, weight: Tensor, parameters: Parameters
) -> tuple[np.ndarray, float]:
    """N_k, Σ γ x, Σ γ x_i x_j (i ≤ j), point by point."""
    joint = scipy_log_joint(points, parameters)
    dim = points.shape[1]
    total = 0.0
    rows = np.zeros((joint.shape[1], 1 + dim + dim * (dim + 1) // 2))
    for x, p, row in zip(points.numpy(), weight.numpy(), joint, strict=True):
        norm = logsumexp(row)
        total += p * norm
        for k in range(len(row)):
            gamma = p * math.exp(row[k] - norm)
            products = [x[i] * x[j] for i in range(dim) for j in range(i, dim)]
            rows[k] += gamma * np.array([1.0, *x, *products])
    return rows, total


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_quadratic_features_are_one_x_and_products(dim):
    x = cloud(4, dim)
    for row, feature in zip(x.tolist(), quadratic_features(x).tolist(), strict=True):
        assert feature == [1.0, *row, *(row[i] * row[j] for i in range(dim) for j in range(i, dim))]
    assert em.feature_dimension(quadratic_features(x).shape[1]) == dim


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float64, 1e-11), (torch.float32, 3e-6)])
def test_expectation_equals_a_loop_over_points(dim, dtype, rtol):
    parameters = random_parameters(4, dim)
    points = cloud(60, dim)
    weight = 3 * random_weight(60, 1)
    statistics, total = em.expectation(
        quadratic_features(points), weight, em.natural_parameters(parameters), dtype
    )
    expected, expected_total = brute_force_statistics(points, weight, parameters)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(statistics.numpy(), expected, rtol=rtol, atol=rtol * scale)
    assert float(total) == pytest.approx(expected_total, rel=rtol)


def test_chunks_do_not_change_the_statistics(monkeypatch):
    parameters = random_parameters(3, 3)
    features = quadratic_features(cloud(500, 3))
    weight = random_weight(500, 1)
    natural = em.natural_parameters(parameters)
    whole = em.expectation(features, weight, natural, torch.float64)
    labels = em.most_likely_component(features, parameters)
    monkeypatch.setattr(chunks, "CHUNK_ELEMENTS", 1)  # chunks of 64 rows, the last one shorter
    parts = em.expectation(features, weight, natural, torch.float64)
    torch.testing.assert_close(parts, whole, rtol=1e-12, atol=1e-10)
    assert torch.equal(em.most_likely_component(features, parameters), labels)


@pytest.mark.parametrize("dim", [2, 3])
def test_maximization_gives_weighted_means_and_covariances(dim, generator):
    points = cloud(40, dim)
    gamma = torch.rand(40, 3, generator=generator, dtype=torch.float64)
    found = em.maximization(gamma.T @ quadratic_features(points), reg_covar=0.25)
    for k in range(3):
        w = gamma[:, k].numpy()
        covariance = np.cov(points.numpy().T, aweights=w, ddof=0) + 0.25 * np.eye(dim)
        mean = np.average(points.numpy(), axis=0, weights=w)
        np.testing.assert_allclose(found.means[k].numpy(), mean, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(found.covariances[k].numpy(), covariance, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(found.weights.numpy(), (gamma.sum(0) / gamma.sum()).numpy(), rtol=1e-12)


# -- the bound ------------------------------------------------------------------------------------


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), dim=st.integers(2, 3), k=st.integers(1, 5))
def test_log_likelihood_never_decreases(seed, dim, k):
    points = 2 * cloud(60 * k, dim, seed)
    weight = random_weight(60 * k, seed + 2)
    step = loop.em_step(rows_of(points, weight), 0.0, torch.float64)
    start = random_parameters(k, dim, seed + 1, spread=2.0, size=1.0)
    try:
        found = loop.run_em(step, start, tol=0, max_iter=15)
    except NumericalError:  # a component collapsed, because there is no regularisation
        reject()
    assume(torch.linalg.eigvalsh(found.parameters.covariances).min() > 1e-6)
    assert np.diff(found.lower_bounds).min() > -1e-12
    first = np.average(logsumexp(scipy_log_joint(points, start), axis=1), weights=weight.numpy())
    assert found.lower_bounds[0] == pytest.approx(first, rel=1e-9)


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), dim=st.integers(2, 3), k=st.integers(1, 4))
def test_bound_on_cells_never_decreases_and_is_below_the_log_likelihood(seed, dim, k):
    points = 2 * cloud(1000, dim, seed)
    cells = pool_into_cells(points, 200, 0.05)
    assert cells.weight.shape[0] < 1000
    step = loop.em_step(Rows(cells.features, cells.weight, False), 0.0, torch.float64)
    parameters = random_parameters(k, dim, seed + 1, spread=2.0, size=1.0)
    previous = -math.inf
    for _ in range(12):
        likelihood = logsumexp(scipy_log_joint(points, parameters), axis=1).mean()
        parameters, bound = step(parameters)
        assert previous - 1e-12 < bound <= likelihood + 1e-9
        previous = bound


# -- the direct form, and when it is used -----------------------------------------------------------


def loses_digits(weights: list[float], means: list[list[float]], variances: list[float]) -> bool:
    given = (torch.tensor(values).double() for values in (weights, means))
    covariances = torch.diag(torch.tensor(variances).double()).repeat(len(means), 1, 1)
    return bool(Factors(Parameters(*given, covariances), "full").lost_digits())


def test_only_used_thin_components_far_from_the_centre_lose_digits():
    thin = [1e-6, 1.0, 1.0]  # 1 mm
    assert not loses_digits([1.0], [[10.0, 10.0, 3.0]], thin)
    assert loses_digits([1.0], [[250_000.0, 0.0, 0.0]], thin)
    apart = [[0.0, 0.0], [1e6, 0.0]]
    assert not loses_digits([1.0, 0.0], apart, [1e-6, 1e-6])
    assert loses_digits([0.5, 0.5], apart, [1e-6, 1e-6])


def test_log_joint_far_from_the_origin_equals_exact_arithmetic():
    mean = [250_000.25, -40_000.5]
    covariance = [[1.25e-6, 5e-7], [5e-7, 4.0]]
    points = torch.tensor([[250_000.2509765625, -40_001.5], [250_000.25, -40_000.0]], dtype=torch.float64)
    parameters = Parameters(
        torch.tensor([0.25], dtype=torch.float64),
        torch.tensor([mean], dtype=torch.float64),
        torch.tensor([covariance], dtype=torch.float64),
    )
    with mpmath.workdps(50):
        inverse = mpmath.matrix(covariance) ** -1
        log_det = mpmath.log(mpmath.det(mpmath.matrix(covariance)))
        expected = []
        for x in points.tolist():
            d = mpmath.matrix([mpmath.mpf(a) - mpmath.mpf(b) for a, b in zip(x, mean, strict=True)])
            squared = (d.T * inverse * d)[0]
            expected.append(float(mpmath.log(0.25) - (squared + log_det) / 2 - mpmath.log(2 * mpmath.pi)))
    assert Factors(parameters, "full").direct()(points)[0].tolist() == pytest.approx(expected, abs=1e-8)


# -- components without points ----------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("direct", [False, True])
def test_component_of_weight_zero_stays_unchanged(dtype, direct):
    points = cloud(80, 2)
    start = random_parameters(3, 2)
    weights = torch.tensor([0.4, 0.0, 0.6], dtype=torch.float64)
    parameters = Parameters(weights, start.means, start.covariances)
    ones = points.new_ones(80)
    for _ in range(5):
        if direct:
            parameters, bound = direct_step(points, ones, parameters, 1e-6)
        else:
            parameters, bound = loop.em_step(rows_of(points, ones, False), 1e-6, dtype)(parameters)
        assert math.isfinite(bound)
    assert float(parameters.weights[1]) == 0
    assert torch.equal(parameters.means[1], start.means[1])
    assert torch.equal(parameters.covariances[1], start.covariances[1])
    assert all(bool(torch.isfinite(p).all()) for p in parameters)
    assert float(parameters.weights.sum()) == pytest.approx(1)


# -- the loop -------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_a_step_from_a_flat_covariance_takes_the_checked_natural_parameters(dim):
    """The fused kernel refuses a covariance of rank D − 1; the bound is then that of the checked form."""
    points = cloud(80, dim)
    features, weight = quadratic_features(points), points.new_ones(80)
    start = random_parameters(3, dim)
    start.covariances[1, :, -1] = start.covariances[1, -1, :] = 0.0
    new, bound = loop.em_step(Rows(features, weight, False), 1e-4, torch.float64)(start)
    statistics, value = em.expectation(features, weight, em.natural_parameters(start), torch.float64)
    assert bound == pytest.approx(float(value) / 80, rel=1e-12)
    expected = em.maximization(statistics, 1e-4, start)
    torch.testing.assert_close(tuple(new), tuple(expected), rtol=1e-10, atol=1e-12)
