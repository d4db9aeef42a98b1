"""One iteration of extreme deconvolution, its scores and bounds against loops and autograd."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mixture.estimator_contract import MixtureContract
from mixture.fit_contract import FitContract, blobs
from mixture.mixture_cases import random_spd
from scipy.optimize import minimize
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from gmmtorch.errors import InvalidArgumentError, NumericalError
from gmmtorch.mixture import DeconvolvedGaussianMixture, GaussianMixture, Parameters
from gmmtorch.mixture.estimators import deconvolved
from gmmtorch.mixture.estimators.deconvolved import (
    Block,
    bound_variances,
    expectation,
    group_by_noise,
    maximization,
    pair_chunks,
)

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


class TestDeconvolvedGaussianMixture(MixtureContract):
    bad_parameters: ClassVar[dict[str, tuple[Any, ...]]] = {
        "max_iter": (0,),
        "thickness": (-1.0, 0.0, 1e-4, math.nan, math.inf, "thin"),
    }

    def make(self, n_components: int = 3, **options: Any) -> DeconvolvedGaussianMixture:
        return DeconvolvedGaussianMixture(n_components, **{"random_state": 0, **options})


class TestThinGaussianMixture(FitContract):
    """The thickness of every component is fixed."""

    score_tolerance = 1.5  # because the clusters are not planes

    def make(self, n_components: int = 3, **options: Any) -> DeconvolvedGaussianMixture:
        tied = {"thickness": 0.1, "reg_covar": 0.1**2}
        if options.keys() & {"thickness", "reg_covar"}:
            tied = {}
        return DeconvolvedGaussianMixture(n_components, **{"random_state": 0, **tied, **options})

    @pytest.mark.parametrize("dim", [1, 2, 3])
    def test_every_component_has_exactly_the_thickness(self, dim):
        smallest = torch.linalg.eigvalsh(self.make().fit(blobs(dim)).covariances)[:, 0]
        torch.testing.assert_close(smallest, torch.full_like(smallest, 0.01))


def random_mixture(rng: np.random.Generator, k: int, dim: int) -> Parameters:
    weights = rng.random(k) + 0.2
    return Parameters(
        *map(torch.from_numpy, (weights / weights.sum(), rng.normal(size=(k, dim)), random_spd(rng, k, dim)))
    )


def noisy_cloud(rng: np.random.Generator, n: int, dim: int) -> Block:
    cloud = (rng.normal(size=(n, dim)) * 1.5, rng.random(n) + 0.1, random_spd(rng, n, dim, 0.5))
    return Block(*map(torch.from_numpy, cloud))


def looped_em(block: Block, parameters: Parameters) -> tuple[Parameters, float]:
    """One iteration as Bovy, Hogg & Roweis write it, (14) to (16): one point and one component at a time."""
    points, weight, noise = (t.numpy() for t in block)
    pi, mu, sigma = (t.numpy() for t in parameters)
    n, (k, dim) = len(points), mu.shape
    count, mean = np.zeros(k), np.zeros((k, dim))
    total, gamma = 0.0, np.zeros((n, k))
    b, remaining = np.zeros((n, k, dim)), np.zeros((n, k, dim, dim))
    for i in range(n):
        logs = np.array(
            [
                np.log(pi[j]) + multivariate_normal(mu[j], sigma[j] + noise[i]).logpdf(points[i])
                for j in range(k)
            ]
        )
        total += weight[i] * logsumexp(logs)
        gamma[i] = weight[i] * np.exp(logs - logsumexp(logs))
        for j in range(k):
            inverse = np.linalg.inv(sigma[j] + noise[i])
            b[i, j] = mu[j] + sigma[j] @ inverse @ (points[i] - mu[j])
            remaining[i, j] = sigma[j] - sigma[j] @ inverse @ sigma[j]
            count[j] += gamma[i, j]
            mean[j] += gamma[i, j] * b[i, j]
    mean /= count[:, None]
    covariance = np.zeros((k, dim, dim))
    for j in range(k):
        for i in range(n):
            covariance[j] += gamma[i, j] * (np.outer(mean[j] - b[i, j], mean[j] - b[i, j]) + remaining[i, j])
        covariance[j] /= count[j]
    return Parameters(*map(torch.from_numpy, (count / count.sum(), mean, covariance))), total


def step(block: Block, parameters: Parameters) -> tuple[Parameters, float]:
    moments, value = expectation(block, parameters)
    return maximization(moments, parameters), float(value)


# -- one iteration ---------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [1, 2, 3, 5])
def test_iteration_equals_loops(dim):
    rng = np.random.default_rng(dim)
    block, parameters = noisy_cloud(rng, 12, dim), random_mixture(rng, 3, dim)
    (found, value), (expected, likelihood) = step(block, parameters), looped_em(block, parameters)
    assert value == pytest.approx(likelihood, rel=1e-12)
    for mine, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("dim", [1, 2, 3, 5])
def test_shared_covariance_equals_one_covariance_per_point(dim):
    rng = np.random.default_rng(dim)
    block, parameters = noisy_cloud(rng, 200, dim), random_mixture(rng, 4, dim)
    shared = block._replace(noise=block.noise[0])
    each = block._replace(noise=block.noise[:1].expand(200, -1, -1))
    (found, value), (expected, likelihood) = step(shared, parameters), step(each, parameters)
    assert value == pytest.approx(likelihood, rel=1e-10)
    for mine, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-9, atol=1e-9)


def test_chunks_do_not_change_the_iteration(monkeypatch):
    rng = np.random.default_rng(0)
    block, parameters = noisy_cloud(rng, 50, 3), random_mixture(rng, 4, 3)
    whole = step(block, parameters)
    monkeypatch.setattr(deconvolved, "_CHUNK_ELEMENTS", 12)
    chunked = step(block, parameters)
    assert whole[1] == pytest.approx(chunked[1], rel=1e-12)
    torch.testing.assert_close(whole[0].covariances, chunked[0].covariances)


def test_excluded_pairs_have_no_share(monkeypatch):
    """Thin components of a room's walls, many metres apart, with noise from 0 to 3 cm."""
    rng = np.random.default_rng(0)
    spread = np.array([0.3, 0.2, 2e-3])
    parameters = random_mixture(rng, 30, 3)
    turns = np.linalg.qr(rng.normal(size=(30, 3, 3)))[0]
    parameters = parameters._replace(
        means=parameters.means * 4,
        covariances=torch.from_numpy((turns * spread**2) @ turns.transpose(0, 2, 1)),
    )
    label = rng.integers(30, size=400)
    points = parameters.means[label] + torch.from_numpy(
        np.einsum("nij,nj->ni", turns[label] * spread, rng.normal(size=(400, 3)))
    )
    noise = torch.from_numpy(random_spd(rng, 400, 3) * rng.choice([0.0, 1e-5, 1e-3], size=(400, 1, 1)))
    points[:5] += 20  # outliers
    block = Block(points, torch.ones(400, dtype=torch.float64), noise)
    few, value = expectation(block, parameters)
    n_few = sum(len(pairs.row) for _, pairs in pair_chunks(points, noise, parameters))
    monkeypatch.setattr(deconvolved, "_NEGLIGIBLE", 1e300)
    every, expected = expectation(block, parameters)
    assert n_few < 0.5 * 400 * 30
    assert float(value) == pytest.approx(float(expected), rel=1e-13)
    for mine, theirs in zip(few, every, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-12)


def test_extreme_outlier_still_has_a_component():
    points = np.concatenate([blobs(2), [[1e9, -3e9]]])
    noise = np.tile(np.eye(2) * 1e-4, (241, 1, 1))
    mixture = DeconvolvedGaussianMixture(3, random_state=0).fit(blobs(2))
    scores = mixture.score_samples(points, noise)
    assert np.isfinite(scores).all()
    assert scores[-1] < -1e18


def test_points_with_equal_covariances_are_grouped():
    rng = np.random.default_rng(0)
    block, parameters = noisy_cloud(rng, 3000, 2), random_mixture(rng, 3, 2)
    kinds = torch.from_numpy(rng.integers(3, size=3000))
    noise = block.noise[:3][kinds]
    parts = group_by_noise(block.points, block.weight, noise)
    assert [part.noise.ndim for part in parts] == [2, 2, 2]
    assert sum(len(part.points) for part in parts) == 3000
    together = deconvolved.deconvolution_step(parts)(parameters)
    apart = deconvolved.deconvolution_step([block._replace(noise=noise)])(parameters)
    assert together[1] == pytest.approx(apart[1], rel=1e-10)
    torch.testing.assert_close(together[0].covariances, apart[0].covariances, rtol=1e-9, atol=1e-9)
    assert len(group_by_noise(*block)) == 1  # all covariances differ


def test_distant_thin_components_lose_no_digits():
    """Natural parameters would cancel here. The other form is used, and equals plain moments for R = 0."""
    rng = np.random.default_rng(0)
    sheet = np.array([1.0, 1.0, 1e-4])
    points = np.concatenate([c + rng.normal(size=(300, 3)) * sheet for c in ((-3e4, 0, 0), (3e4, 0, 0))])
    mixture = DeconvolvedGaussianMixture(2, reg_covar=0.0, random_state=0).fit(points)
    smallest = np.linalg.eigvalsh(mixture.covariances_)[:, 0]
    parts = (points[:300], points[300:])
    expected = [np.linalg.eigvalsh(np.cov(part.T, bias=True))[0] for part in parts]
    np.testing.assert_allclose(np.sort(smallest), np.sort(expected), rtol=1e-4)


# -- scores ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("shared", [True, False])
def test_score_of_measurements_includes_their_noise(dim, shared):
    rng = np.random.default_rng(0)
    points = blobs(dim) + 1e5
    mixture = DeconvolvedGaussianMixture(3, random_state=0).fit(points)
    noise = random_spd(rng, len(points), dim, 0.3)
    given = noise[0] if shared else noise
    expected = [
        logsumexp(
            [
                np.log(w) + multivariate_normal(m, c + noise[0 if shared else i]).logpdf(x)
                for w, m, c in zip(mixture.weights_, mixture.means_, mixture.covariances_, strict=True)
            ]
        )
        for i, x in enumerate(points)
    ]
    np.testing.assert_allclose(mixture.score_samples(points, given), expected, atol=1e-8)
    np.testing.assert_allclose(
        mixture.score_samples(points, np.zeros((dim, dim))), mixture.score_samples(points), atol=1e-7
    )


def test_score_of_measurements_is_differentiable():
    points = torch.from_numpy(blobs(3, 20))
    noise = torch.eye(3, dtype=torch.float64).expand(20, 3, 3) * 0.1
    mixture = DeconvolvedGaussianMixture(2, random_state=0).fit(points)
    points.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: mixture.score_samples(x, noise), (points,))


# -- bounded variances -----------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("bounds", [(0.0, 0.3), (0.2, 0.3), (0.25, 0.25), (0.5, None), (0.0, None)])
def test_bound_variances_is_the_constrained_maximum(dim, bounds):
    """Nelder–Mead over all covariances within the limits finds none that is more likely."""
    low, high = bounds
    rng = np.random.default_rng(dim)
    scatter = random_spd(rng, 1, dim)[0]
    found = bound_variances(torch.from_numpy(scatter)[None], low**2, high)[0].numpy()

    def cost(covariance: np.ndarray) -> float:
        return np.linalg.slogdet(covariance)[1] + np.trace(np.linalg.inv(covariance) @ scatter)

    def inside(x: np.ndarray) -> np.ndarray:
        """Any parameters as a covariance within the limits."""
        root = np.zeros((dim, dim))
        root[np.tril_indices(dim)] = x
        variances, directions = np.linalg.eigh(root @ root.T)
        variances = np.maximum(variances, max(low**2, 1e-9))
        if high is not None:
            variances[0] = min(variances[0], high**2)
        return (directions * variances) @ directions.T

    best = min(
        minimize(
            lambda x: cost(inside(x)),
            rng.normal(size=dim * (dim + 1) // 2),
            method="Nelder-Mead",
            options={"maxiter": 2000, "xatol": 1e-5, "fatol": 1e-8},
        ).fun
        for _ in range(3)
    )
    assert cost(found) <= best + 1e-7
    assert cost(found) == pytest.approx(best, abs=1e-3)  # the search comes close


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
