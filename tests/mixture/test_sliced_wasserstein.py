"""Sliced Wasserstein mixtures against quadrature, closed forms, finite differences and EM."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mixture.estimator_contract import MixtureContract
from mixture.fit_contract import blobs
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.stats import norm
from torch import Tensor

from gmmtorch.errors import NumericalError
from gmmtorch.mixture import GaussianMixture, Parameters, SlicedWassersteinGaussianMixture, initialize
from gmmtorch.mixture.estimators import sliced_wasserstein as lines
from gmmtorch.mixture.estimators.sliced_wasserstein import (
    LEVELS,
    Shape,
    Slices,
    differentiate,
    mixture_quantiles,
    random_directions,
    slice_cloud,
    transport,
)

UP = torch.ones(1, 1).double()
"""The only direction on the line."""


class TestSlicedWassersteinGaussianMixture(MixtureContract):
    motion_tolerance = None  # directions do not rotate with the cloud, and Adam depends on the axes
    score_tolerance = 0.6  # because the fit does not maximise the likelihood
    bad_parameters: ClassVar[dict[str, tuple[Any, ...]]] = {
        "max_iter": (0,),
        "n_projections": (0, 2.5, None),
        "learning_rate": (0, -0.1, math.nan, "slow"),
    }

    def make(self, n_components: int = 3, **options: Any) -> SlicedWassersteinGaussianMixture:
        # A short descent that stays near a good start; other tests run whole descents.
        short = {"n_projections": 16, "max_iter": 4, "learning_rate": 0.02}
        return SlicedWassersteinGaussianMixture(n_components, **{"random_state": 0, **short, **options})


def random_line(k: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Weights (K,), means and deviations (1, K) of a mixture on the line, with some narrow components."""
    rng = np.random.default_rng(seed)
    weights = torch.from_numpy(rng.dirichlet(np.ones(k)))
    return weights, *(torch.from_numpy(v[None]) for v in (rng.normal(size=k) * 2, 0.02 + rng.random(k) ** 3))


def level_masses() -> np.ndarray:
    """Mass between two levels. A cloud of as many points with these weights is summarised exactly."""
    return np.diff(0.5 * (1 - np.cos(np.pi * np.arange(LEVELS + 1) / LEVELS)))


def random_cloud(seed: int) -> np.ndarray:
    """Values (J,), one for each level."""
    rng = np.random.default_rng(seed)
    return np.sort(rng.normal(size=LEVELS) * rng.choice([0.3, 3]) + rng.normal())


def sliced(values: np.ndarray, weight: np.ndarray | None = None) -> Slices:
    weight = np.ones(len(values)) if weight is None else weight
    return slice_cloud(torch.from_numpy(values[:, None]), torch.from_numpy(weight), UP)


def exact_cost(values: np.ndarray, weights: Tensor, means: Tensor, deviations: Tensor) -> float:
    """W₂² of a mixture and a cloud with `level_masses`, by adaptive quadrature over x, cell by cell."""
    w, m, s = weights.numpy(), means[0].numpy(), deviations[0].numpy()
    low, high = (m - 12 * s).min(), (m + 12 * s).max()
    levels = level_masses().cumsum()
    cuts = [brentq(lambda x, t=t: w @ norm.cdf((x - m) / s) - t, low, high, xtol=1e-14) for t in levels[:-1]]
    cells = zip([low, *cuts], [*cuts, high], values, strict=True)
    knots = np.sort((m[:, None] + s[:, None] * np.array([-3, 0, 3])).ravel())
    total = 0.0
    for a, b, u in cells:
        total += quad(
            lambda x, u=u: (x - u) ** 2 * (w @ (norm.pdf((x - m) / s) / s)),
            a, b, points=knots[(knots > a) & (knots < b)], limit=200,
        )[0]  # fmt: skip
    return total


@pytest.fixture
def many_steps(monkeypatch):
    """Computes quantiles to rounding."""
    monkeypatch.setattr(lines, "_NEWTON_STEPS", 40)


# -- clouds along lines ------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [1, 2, 3, 5])
def test_random_directions_are_uniform_unit_vectors(dim, generator):
    directions = random_directions(4000, dim, generator)
    assert directions.shape == (1 if dim == 1 else 4000, dim)
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(len(directions)).double())
    second = directions.T @ directions / len(directions)
    torch.testing.assert_close(second, torch.eye(dim).double() / dim, rtol=0, atol=0.02)


def test_slice_cloud_averages_the_quantile_function(generator):
    points = torch.randn(37, 3, generator=generator, dtype=torch.float64)
    weight = torch.rand(37, generator=generator, dtype=torch.float64)
    found = slice_cloud(points, weight, random_directions(5, 3, generator))
    edges = np.concatenate([[0], level_masses().cumsum()])
    for direction, values, power in zip(found.directions, found.values, found.power, strict=True):
        coordinates = (points @ direction).numpy()
        order = coordinates.argsort()
        reached = (weight.numpy()[order] / float(weight.sum())).cumsum()
        fine = np.linspace(0, 1, 400_001)[:-1] + 1 / 800_000
        quantile = coordinates[order][np.minimum(np.searchsorted(reached, fine), 36)]
        cell = np.searchsorted(edges, fine) - 1
        expected = np.bincount(cell, quantile, LEVELS) / np.bincount(cell, minlength=LEVELS)
        np.testing.assert_allclose(values[5:-5], expected[5:-5], atol=0.02)
        mass = level_masses()
        assert float(values @ torch.from_numpy(mass)) == pytest.approx(
            float((weight @ (points @ direction)) / weight.sum())
        )
        assert float(power) == pytest.approx(float(values.square() @ torch.from_numpy(mass)))


def test_slice_cloud_is_exact_for_the_masses_of_the_levels():
    values = random_cloud(0)
    np.testing.assert_allclose(sliced(values, level_masses()).values[0], values, rtol=1e-9, atol=1e-9)


# -- transport along a line --------------------------------------------------------------------------


@pytest.mark.parametrize(("k", "seed"), [(1, 0), (2, 1), (6, 2)])
def test_transport_cost_equals_quadrature(k, seed, many_steps):
    values, mixture = random_cloud(seed), random_line(k, seed)
    found = float(transport(sliced(values, level_masses()), *mixture)[0])
    assert found == pytest.approx(exact_cost(values, *mixture), rel=1e-6, abs=1e-8)


@pytest.mark.parametrize(("mean", "deviation"), [(0.0, 1.0), (0.5, 2.0), (-3.0, 0.1), (0.0, 0.9)])
def test_transport_cost_between_gaussians_equals_the_closed_form(mean, deviation):
    """(m − m')² + (s − s')², for a cloud of the quantiles of a standard normal."""
    cloud = sliced(norm.ppf((np.arange(100_000) + 0.5) / 100_000))
    mixture = (torch.tensor(v).double() for v in ([1.0], [[mean]], [[deviation]]))
    cost, _, by_mean, by_deviation = transport(cloud, *mixture)
    assert float(cost) == pytest.approx(mean**2 + (deviation - 1) ** 2, abs=2e-4)
    assert float(by_mean) == pytest.approx(2 * mean, abs=1e-6)
    assert float(by_deviation) == pytest.approx(2 * (deviation - 1), abs=2e-4)


@settings(max_examples=12)
@given(seed=st.integers(0, 10**6), k=st.integers(1, 8))
def test_two_newton_steps_give_nearly_the_transport_cost(seed, k):
    values, mixture = random_cloud(seed), random_line(k, seed)
    cloud = sliced(values, level_masses())
    found, *_ = transport(cloud, *mixture)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lines, "_NEWTON_STEPS", 40)
        best, *_ = transport(cloud, *mixture)
    assert float(found) <= float(best) + 1e-9  # other cuts give a lower bound
    assert float(found) == pytest.approx(float(best), rel=1e-2, abs=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_mixture_quantiles_have_their_levels(seed, many_steps):
    """Components of 1 mm next to components of 1 m, with gaps between them."""
    rng = np.random.default_rng(seed)
    weights = torch.from_numpy(rng.dirichlet(np.full(20, 0.3)))
    means = torch.from_numpy(rng.normal(size=(3, 20)) * 10)
    deviations = torch.from_numpy(rng.random((3, 20)) ** 4 + 1e-3)
    levels = torch.from_numpy(level_masses().cumsum()[:-1])
    cuts = mixture_quantiles(levels, weights, means, deviations)
    reached = norm.cdf((cuts[:, :, None] - means[:, None]) / deviations[:, None]) @ weights.numpy()
    np.testing.assert_allclose(reached, levels.expand(3, -1), atol=1e-9)
    assert (cuts.diff(dim=1) >= 0).all()


def test_chunks_do_not_change_the_result(monkeypatch, generator):
    points, weight = torch.randn(50, 3, generator=generator).double(), torch.ones(50).double()
    directions = random_directions(7, 3, generator)
    weights = torch.full((4,), 0.25).double()
    means = torch.randn(7, 4, generator=generator).double()
    whole = slice_cloud(points, weight, directions)
    cost = transport(whole, weights, means, means.abs() + 0.1)
    monkeypatch.setattr(lines, "_BLOCK_ELEMENTS", 1)
    parts = slice_cloud(points, weight, directions)
    torch.testing.assert_close(parts, whole)
    torch.testing.assert_close(transport(parts, weights, means, means.abs() + 0.1), cost)


# -- the descent -------------------------------------------------------------------------------------


def random_shape(generator: torch.Generator, k: int = 3, dim: int = 3) -> tuple[Shape, Parameters]:
    root = torch.randn(k, dim, dim, generator=generator, dtype=torch.float64)
    first = Parameters(
        torch.softmax(torch.randn(k, generator=generator, dtype=torch.float64), 0),
        torch.randn(k, dim, generator=generator, dtype=torch.float64),
        root @ root.mT + 0.1 * torch.eye(dim).double(),
    )
    return Shape(first), first


def test_shape_starts_at_the_given_mixture(generator):
    shape, first = random_shape(generator)
    with torch.no_grad():
        torch.testing.assert_close(shape(), first)


def test_derivatives_by_a_shape_equal_finite_differences(generator, many_steps):
    shape, _ = random_shape(generator)
    points = torch.randn(60, 3, generator=generator, dtype=torch.float64)
    slices = slice_cloud(points, torch.ones(60).double(), random_directions(4, 3, generator))
    with torch.no_grad():
        for parameter in shape.parameters():
            parameter += 0.3 * torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
    differentiate(shape, slices)
    gradients = [parameter.grad.clone() for parameter in shape.parameters()]
    for parameter, gradient in zip(shape.parameters(), gradients, strict=True):
        change = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
        costs = []
        for h in (1e-5, -1e-5):
            with torch.no_grad():
                parameter += h * change
            costs.append(differentiate(shape, slices))
            with torch.no_grad():
                parameter -= h * change
        assert (costs[0] - costs[1]) / 2e-5 == pytest.approx(float((gradient * change).sum()), rel=1e-5)


def distance(points: np.ndarray, parameters: Parameters, n: int = 300) -> float:
    """SW² (m²) along directions that are independent of the fit."""
    center = torch.from_numpy(points.mean(0))
    directions = random_directions(n, points.shape[1], torch.Generator().manual_seed(12345))
    cloud = slice_cloud(torch.from_numpy(points) - center, torch.ones(len(points)).double(), directions)
    weights, means, covariances = parameters
    return differentiate(Shape(Parameters(weights, means - center, covariances)), cloud)


def parameters_of(mixture: Any) -> Parameters:
    return Parameters(mixture.weights, mixture.means, mixture.covariances)


# -- the estimator -----------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_single_gaussian_is_found(dim):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(1500, dim)) @ (rng.normal(size=(dim, dim)) + np.eye(dim)) + 5
    options = {"n_projections": 64, "init_params": "bounding_box", "random_state": 0}
    fit = SlicedWassersteinGaussianMixture(1, **options).fit(points)
    covariance = np.cov(points.T).reshape(dim, dim)
    spread = math.sqrt(covariance.trace() / dim)
    np.testing.assert_allclose(fit.means_[0], points.mean(0), atol=0.02 * spread)
    np.testing.assert_allclose(fit.covariances_[0], covariance, atol=0.05 * spread**2)


def rings(n: int = 600) -> np.ndarray:
    """Two rings, which need more than four components."""
    rng = np.random.default_rng(0)
    angle, radius = rng.random(n) * 2 * np.pi, rng.choice([1.0, 2.0], n) + 0.05 * rng.normal(size=n)
    return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_result_is_closer_than_the_start_and_on_average_than_em():
    points, init_params = rings(), "random_points"
    center = torch.from_numpy(points.mean(0))
    reached, of_em = [], []
    for seed in range(3):
        options = {"init_params": init_params, "random_state": seed}
        fit = SlicedWassersteinGaussianMixture(8, n_projections=32, max_iter=40, **options).fit(points)
        first = initialize(
            init_params, torch.from_numpy(points) - center, torch.ones(len(points)).double(), 8, 1e-6,
            torch.Generator().manual_seed(seed),
        )  # fmt: skip
        em_fit = GaussianMixture(8, tol=1e-6, max_iter=500, **options).fit(points)
        reached.append(distance(points, parameters_of(fit)))
        of_em.append(distance(points, parameters_of(em_fit)))
        assert reached[-1] < 0.95 * distance(points, first._replace(means=first.means + center))
        assert -fit.lower_bound_ == pytest.approx(reached[-1], rel=0.5)
    assert np.mean(reached) < np.mean(of_em)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_fit_does_not_depend_on_the_unit_of_length():
    points, scale = blobs(2), 1e4
    options = {"n_projections": 16, "random_state": 0, "max_iter": 20}
    fit = SlicedWassersteinGaussianMixture(3, reg_covar=1e-6, **options).fit(points)
    other = SlicedWassersteinGaussianMixture(3, reg_covar=1e-6 * scale**2, **options).fit(scale * points)
    np.testing.assert_allclose(other.means_, scale * fit.means_, rtol=1e-5, atol=1e-6 * scale)
    np.testing.assert_allclose(
        other.covariances_, scale**2 * fit.covariances_, rtol=1e-4, atol=1e-7 * scale**2
    )
    assert other.lower_bound_ == pytest.approx(scale**2 * fit.lower_bound_, rel=1e-4)


def test_single_point_without_regularisation_is_an_error():
    with pytest.raises(NumericalError, match="reg_covar"):
        SlicedWassersteinGaussianMixture(1, reg_covar=0, random_state=0).fit(np.ones((5, 3)))


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_fit_works_under_no_grad():
    with torch.no_grad():
        fit = SlicedWassersteinGaussianMixture(3, n_projections=16, max_iter=3, random_state=0).fit(blobs(2))
    assert fit.n_iter_ == 3
