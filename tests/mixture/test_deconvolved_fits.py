"""Fits of noisy points against plain EM and the noise-free truth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mixture.fit_contract import blobs
from mixture.mixture_cases import random_spd
from torch import Tensor
from torch.distributions import MultivariateNormal

from gmmtorch.errors import InvalidArgumentError, NumericalError
from gmmtorch.mixture import DeconvolvedGaussianMixture, GaussianMixture

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


# -- whole fits ------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("noise", [None, "shared", "each"])
def test_fit_without_noise_equals_plain_em(dim, noise):
    points = blobs(dim)
    zero = {None: None, "shared": np.zeros((dim, dim)), "each": np.zeros((len(points), dim, dim))}[noise]
    options = {"reg_covar": 0.0, "tol": 0.0, "max_iter": 40, "random_state": 0}
    weight = np.random.default_rng(0).random(len(points))
    mine = DeconvolvedGaussianMixture(3, **options).fit(points, None, weight, zero)
    plain = GaussianMixture(3, dtype="float64", **options).fit(points, sample_weight=weight)
    np.testing.assert_allclose(mine.lower_bounds_, plain.lower_bounds_, atol=1e-8)
    np.testing.assert_allclose(mine.weights_, plain.weights_, atol=1e-8)
    np.testing.assert_allclose(mine.means_, plain.means_, atol=1e-8)
    np.testing.assert_allclose(mine.covariances_, plain.covariances_, atol=1e-8)


@st.composite
def noisy_fits(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
    dim, seed = draw(st.integers(1, 3)), draw(st.integers(0, 10_000))
    rng = np.random.default_rng(seed)
    n = draw(st.integers(4, 40))
    scale = 10.0 ** rng.uniform(-2, 1, size=n)
    points = np.round(rng.normal(size=(n, dim)) * 2, draw(st.integers(0, 3)))  # duplicates, with few digits
    noise = random_spd(rng, n, dim) * scale[:, None, None]
    noise[rng.random(n) < 0.3] = 0
    reg = draw(st.sampled_from([1e-6, 1e-3, 0.01]))
    thickness = draw(st.sampled_from([None, reg**0.5, 0.1, 1.0]))
    options = {"n_components": draw(st.integers(1, 4)), "reg_covar": reg, "thickness": thickness}
    return points, rng.random(n) + 1e-3, noise, options


@given(case=noisy_fits())
def test_likelihood_never_decreases(case):
    points, weight, noise, options = case
    mixture = DeconvolvedGaussianMixture(tol=0.0, max_iter=25, random_state=0, **options)
    mixture.fit(points, None, weight, noise)
    bounds = np.array(mixture.lower_bounds_)
    assert np.isfinite(bounds).all()
    assert (np.diff(bounds) >= -1e-9 * (1 + np.abs(bounds[1:]))).all()
    assert len(bounds) == 25
    variances = np.linalg.eigvalsh(mixture.covariances_)
    reg, thickness = options["reg_covar"], options["thickness"]
    assert (variances >= reg * (1 - 1e-9)).all()
    if thickness is not None:
        assert (variances[:, 0] <= thickness**2 * (1 + 1e-6)).all()


def log_likelihood(parameters: list[Tensor], points: Tensor, noise: Tensor) -> Tensor:
    """Mean log-likelihood by torch's own normal density, as a function of free parameters for autograd."""
    logits, means, roots = parameters
    total = roots @ roots.mT + noise[:, None]
    joint = torch.log_softmax(logits, 0) + MultivariateNormal(means, total).log_prob(points[:, None])
    return torch.logsumexp(joint, 1).mean()


@pytest.mark.parametrize("dim", [2, 3])
def test_gradient_is_zero_at_the_result(dim):
    rng = np.random.default_rng(0)
    points = torch.from_numpy(blobs(dim, 300))
    noise = torch.from_numpy(random_spd(rng, 300, dim, 0.05))
    mixture = DeconvolvedGaussianMixture(3, tol=0.0, max_iter=300, random_state=0)
    mixture.fit(points, noise_covariances=noise)
    free = [mixture.weights.log(), mixture.means, torch.linalg.cholesky(mixture.covariances)]
    free = [value.clone().requires_grad_() for value in free]
    value = log_likelihood(free, points, noise)
    value.backward()
    assert float(value.detach()) == pytest.approx(mixture.lower_bound_, abs=1e-9)
    assert max(float(f.grad.abs().max()) for f in free) < 1e-6
    with torch.no_grad():  # elsewhere the gradient is not zero
        free[1] += 0.05
    free[1].grad = None
    log_likelihood(free, points, noise).backward()
    assert float(free[1].grad.abs().max()) > 1e-2


def test_noise_free_sheets_are_found():
    """Two sheets, 1 mm thick, measured with noise of 1 to 6 cm that differs by point and direction."""
    rng = np.random.default_rng(0)
    n = 4000
    true = np.diag([0.5, 0.3, 1e-3]) ** 2
    centers = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.5]])
    label = rng.integers(2, size=n)
    noise = random_spd(rng, n, 3, 0.02)
    error = np.einsum("nij,nj->ni", np.linalg.cholesky(noise), rng.normal(size=(n, 3)))
    points = centers[label] + rng.multivariate_normal(np.zeros(3), true, n) + error
    options = {"tol": 1e-7, "max_iter": 200, "random_state": 0}
    mixture = DeconvolvedGaussianMixture(2, **options).fit(points, noise_covariances=noise)
    order = mixture.means_[:, 2].argsort()
    np.testing.assert_allclose(mixture.means_[order], centers, atol=0.03)
    for found in mixture.covariances_:
        np.testing.assert_allclose(np.diag(found)[:2], np.diag(true)[:2], rtol=0.08)
        assert found[2, 2] ** 0.5 < 0.008
    plain = GaussianMixture(2, **options).fit(points)
    assert (plain.covariances_[:, 2, 2] ** 0.5 > 0.03).all()
    fresh_noise = noise[:100]
    mine = mixture.score_samples(points[:100], fresh_noise)
    assert mine.mean() > plain.score_samples(points[:100]).mean()


def test_thick_surface_has_its_noise_free_covariance():
    rng = np.random.default_rng(1)
    true, noise = np.array([[0.5, 0.1], [0.1, 0.3]]), np.array([[0.2, -0.1], [-0.1, 0.4]])
    points = rng.multivariate_normal([1, 2], true + noise, 40_000)
    mixture = DeconvolvedGaussianMixture(1, tol=1e-9, max_iter=200, random_state=0)
    mixture.fit(points, noise_covariances=noise)
    np.testing.assert_allclose(mixture.covariances_[0], np.cov(points.T, bias=True) - noise, atol=1e-3)
    np.testing.assert_allclose(mixture.covariances_[0], true, atol=0.02)


# -- arguments -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("noise", "said"),
    [
        (np.zeros((239, 2, 2)), r"shape \(239, 2, 2\)"),
        (np.zeros((3, 3)), r"shape \(3, 3\)"),
        (np.zeros(240), r"shape \(240,\)"),
        (np.full((2, 2), np.nan), r"\[0\] has NaN"),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), "not symmetric"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "negative eigenvalue"),
        (-np.eye(2), "negative eigenvalue"),
    ],
)
def test_invalid_noise_is_named(noise, said):
    mixture = DeconvolvedGaussianMixture(2, random_state=0)
    for kind in (np.asarray, torch.from_numpy):
        with pytest.raises(InvalidArgumentError, match=f"^noise_covariances.*{said}"):
            mixture.fit(kind(blobs(2)), noise_covariances=kind(noise))
    mixture.fit(blobs(2))
    with pytest.raises(InvalidArgumentError, match=f"^noise_covariances.*{said}"):
        mixture.score_samples(blobs(2), noise)


def test_noise_of_points_of_weight_zero_is_excluded():
    rng = np.random.default_rng(0)
    points, noise = blobs(2), random_spd(rng, 240, 2, 0.2)
    present = rng.random(240) > 0.4
    weighted = DeconvolvedGaussianMixture(2, random_state=0).fit(points, None, present.astype(float), noise)
    without = DeconvolvedGaussianMixture(2, random_state=0).fit(points[present], None, None, noise[present])
    assert torch.equal(weighted.means, without.means)


def test_collapse_without_regularisation_is_an_error():
    with pytest.raises(NumericalError, match="reg_covar"):
        DeconvolvedGaussianMixture(1, reg_covar=0.0).fit(np.ones((5, 2)))
    with pytest.raises(NumericalError, match="reg_covar"):
        DeconvolvedGaussianMixture(1, reg_covar=0.0).fit(
            np.ones((5, 2)), noise_covariances=np.zeros((5, 2, 2))
        )
