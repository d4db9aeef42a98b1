"""partial_fit against batch EM, the recursion of its statistics, and the density of the points."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mixture.fit_contract import CENTERS, FAR
from mixture.mixture_cases import changed_file
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mixture import GaussianMixture

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")

dims = pytest.mark.parametrize("dim", [1, 2, 3, 5])
SHARES = np.array([0.5, 0.3, 0.2])


def blobs(n: int = 300, dim: int = 2, seed: int = 0, scale: float = 1.0) -> np.ndarray:
    """Three clusters in random order; their overlap grows with `scale`. Coordinates are multiples of 2⁻²⁰."""
    rng = np.random.default_rng(seed)
    label = rng.choice(3, size=n, p=SHARES)
    points = CENTERS[label, :dim] + scale * rng.normal(size=(n, dim)) * np.linspace(0.5, 1.0, dim)
    return np.round(points * 2**20) / 2**20


def exact(**options) -> GaussianMixture:
    return GaussianMixture(**{"n_components": 3, "random_state": 0, "dtype": "float64", **options})


def assert_same(one: GaussianMixture, other: GaussianMixture, tolerance: float = 1e-9) -> None:
    for name in ("weights_", "means_", "covariances_"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=tolerance, atol=tolerance)


def is_valid(gmm: GaussianMixture) -> bool:
    eigenvalues = np.linalg.eigvalsh(gmm.covariances_)
    rounding = 1e-14 * np.abs(gmm.covariances_).max((1, 2), keepdims=True)[:, :, 0]
    return bool(
        np.isfinite(gmm.means_).all()
        and abs(gmm.weights_.sum() - 1) < 1e-9
        and (gmm.weights_ >= 0).all()
        and (eigenvalues >= 0.99 * gmm.reg_covar - rounding).all()
        and math.isfinite(gmm.lower_bound_)
    )


# -- against batch EM ---------------------------------------------------------------------------------


@dims
def test_memory_zero_makes_every_call_a_step_of_batch_em(dim):
    x, weight = blobs(dim=dim, scale=2.0), np.random.default_rng(0).random(300)
    gmm = exact()
    bounds = []
    for steps in range(1, 8):
        gmm.partial_fit(x, sample_weight=weight, memory=0)
        bounds.append(gmm.lower_bound_)
        assert_same(gmm, exact(max_iter=steps, tol=0).fit(x, sample_weight=weight))
    fitted = exact(max_iter=7, tol=0).fit(x, sample_weight=weight)
    np.testing.assert_allclose(bounds, fitted.lower_bounds_, rtol=1e-12)


def statistics_of(x: np.ndarray, weight: np.ndarray, theta: tuple) -> tuple[np.ndarray, ...]:
    """N_k, Σ γ x and Σ γ x xᵀ of a batch, by SciPy's densities."""
    logs = (multivariate_normal(m, c).logpdf(x).reshape(len(x)) for m, c in zip(*theta[1:], strict=True))
    joint = np.log(theta[0])[:, None] + np.stack(list(logs))
    gamma = np.exp(joint - logsumexp(joint, axis=0)) * weight
    return gamma.sum(1), gamma @ x, np.einsum("kn,ni,nj->kij", gamma, x, x)


def maximized(statistics: tuple[np.ndarray, ...], reg_covar: float) -> tuple[np.ndarray, ...]:
    count, first, second = statistics
    means = first / count[:, None]
    covariances = second / count[:, None, None] - np.einsum("ki,kj->kij", means, means)
    return count / count.sum(), means, covariances + reg_covar * np.eye(means.shape[1])


@pytest.mark.parametrize("kappa", [0.6, 0.8, 1.0])
@pytest.mark.parametrize("dim", [2, 3])
def test_statistics_follow_their_recursion(dim, kappa):
    """S ← (1 − η) S + η s in plain numpy, for batches of many sizes and weights."""
    rng = np.random.default_rng(2)
    x, weight = blobs(900, dim, scale=2.0), rng.random(900) * 3
    start = {
        "weights_init": SHARES,
        "means_init": CENTERS[:, :dim] + 0.5,
        "precisions_init": np.stack([np.eye(dim) * 0.5] * 3),
    }
    gmm = exact(**start, reg_covar=1e-2)
    theta = (SHARES, start["means_init"], np.linalg.inv(start["precisions_init"]))
    running, seen = tuple(np.zeros_like(part) for part in theta), 0.0
    for part in np.split(np.arange(900), [200, 210, 211, 500, 503]):
        gmm.partial_fit(x[part], sample_weight=weight[part], kappa=kappa)
        n = weight[part].sum()
        eta = (n / (seen + n)) ** kappa
        new = statistics_of(x[part], weight[part], theta)
        running = tuple((1 - eta) * old + eta * s / n for old, s in zip(running, new, strict=True))
        theta, seen = maximized(running, 1e-2), seen + n
        for mine, expected in zip((gmm.weights_, gmm.means_, gmm.covariances_), theta, strict=True):
            np.testing.assert_allclose(mine, expected, rtol=1e-9, atol=1e-10)
    assert gmm.n_samples_seen_ == pytest.approx(weight.sum())


# -- where it leads -------------------------------------------------------------------------------------


# -- going on from something else -----------------------------------------------------------------------


def test_fit_counts_as_its_number_of_points():
    x, more = blobs(300), blobs(100, seed=1) + 0.5
    gmm = exact().fit(x)
    before = gmm.means_.copy()
    gmm.partial_fit(more, kappa=1.0)
    assert gmm.n_samples_seen_ == 400
    moved = (gmm.weights_ @ gmm.means_) - (exact().fit(x).weights_ @ before)
    np.testing.assert_allclose(moved, (more.mean(0) - x.mean(0)) / 4, atol=1e-9)
    capped = exact().fit(x).partial_fit(more, kappa=1.0, memory=100)
    np.testing.assert_allclose(capped.weights_ @ capped.means_, (more.mean(0) + x.mean(0)) / 2, atol=1e-9)
    assert capped.n_samples_seen_ == 200
    roomy = exact().fit(x).partial_fit(more, kappa=1.0, memory=10_000)
    assert_same(roomy, gmm, 0)


def test_partial_fit_of_given_parameters_needs_memory():
    fitted = exact().fit(blobs())
    given = GaussianMixture.from_parameters(fitted.weights_, fitted.means_, fitted.covariances_)
    with pytest.raises(InvalidArgumentError, match="memory=None"):
        given.partial_fit(blobs(50, seed=1))
    np.testing.assert_array_equal(given.means_, fitted.means_)
    given.set_params(dtype="float64").partial_fit(blobs(50, seed=1), memory=300)
    assert_same(given, exact().fit(blobs()).partial_fit(blobs(50, seed=1)))
    given.partial_fit(blobs(50, seed=2))
    assert given.n_samples_seen_ == 400


def test_state_dict_has_only_the_parameters():
    gmm = exact().partial_fit(blobs())
    assert set(gmm.state_dict()) == {"weights", "means", "covariances"}
    other = exact().fit(blobs(500, seed=3))
    other.load_state_dict(gmm.state_dict())
    assert other.n_samples_seen_ is None
    assert_same(other.partial_fit(blobs(50), memory=300), gmm.partial_fit(blobs(50)))


@pytest.mark.parametrize("seen", [torch.tensor(-1.0), torch.tensor([1.0, 2.0]), torch.zeros(0)])
def test_file_with_an_invalid_count_is_rejected(tmp_path, seen):
    gmm = exact().fit(blobs())
    whole = changed_file(gmm, tmp_path, {"extra.n_samples_seen": torch.tensor(7.0).double()})
    assert GaussianMixture.load(whole).n_samples_seen_ == 7
    with pytest.raises(DataError, match="n_samples_seen"):
        GaussianMixture.load(changed_file(gmm, tmp_path, {"extra.n_samples_seen": seen.double()}))


# -- frames, weights and kinds ----------------------------------------------------------------------------


@dims
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_partial_fit_far_from_the_origin_is_the_shifted_fit(dim, dtype):
    offset = FAR[:dim]
    near, far = exact(dtype=dtype), exact(dtype=dtype)
    for batch in range(30):
        x = blobs(40, dim, seed=batch)
        near.partial_fit(x)
        far.partial_fit(x + offset)
    np.testing.assert_allclose(far.means_ - offset, near.means_, atol=1e-6)
    np.testing.assert_allclose(far.covariances_, near.covariances_, rtol=1e-5, atol=1e-7)


# -- awkward batches --------------------------------------------------------------------------------------


@settings(max_examples=40)
@given(
    data=st.data(),
    dim=st.integers(1, 3),
    k=st.integers(1, 5),
    kappa=st.sampled_from([0.51, 0.7, 1.0]),
    memory=st.sampled_from([None, 0.0, 3.0]),
    reg_covar=st.sampled_from([1e-6, 1e-2]),
)
def test_small_batches_keep_the_mixture_valid(data, dim, k, kappa, memory, reg_covar):
    gmm = GaussianMixture(k, random_state=0, reg_covar=reg_covar)
    numbers = st.sampled_from([0.0, 1.0, 2.0, 1e-3, -50.0])
    for turn in range(4):
        n = data.draw(st.integers(1 if turn else k, 6 if turn else k + 4))
        x = np.array(data.draw(st.lists(numbers, min_size=n * dim, max_size=n * dim))).reshape(n, dim)
        gmm.partial_fit(x + 5e5 * (turn == 3), kappa=kappa, memory=memory)
        assert is_valid(gmm)
        assert np.isfinite(gmm.score_samples(x)).all()


def test_only_the_first_batch_needs_a_point_per_component():
    gmm = exact()
    with pytest.raises(InvalidArgumentError, match=r"n_components=3.*n_samples=2"):
        gmm.partial_fit(blobs(2))
    assert not hasattr(gmm, "means")
    gmm.partial_fit(blobs(50))
    for seed in range(30):
        gmm.partial_fit(blobs(1, seed=seed))
    assert is_valid(gmm)
    assert gmm.n_samples_seen_ == 80


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
@pytest.mark.parametrize("started", [False, True])
def test_invalid_batch_is_rejected_without_effect(kind, started):
    gmm = exact()
    if started:
        gmm.partial_fit(kind(blobs()))
        before = gmm.means.clone()
    bad = blobs(20)
    bad[7, 1] = np.nan
    for x in (bad, np.empty((0, 2)), np.zeros(4), *([np.zeros((5, 3))] if started else [])):
        with pytest.raises(ValueError, match=r"X|array|feature"):
            gmm.partial_fit(kind(x))
    for weight in (np.zeros(20), -np.ones(20), np.ones(19), np.full(20, np.nan)):
        with pytest.raises(InvalidArgumentError, match="sample_weight"):
            gmm.partial_fit(kind(blobs(20)), sample_weight=kind(weight))
    if started:
        assert torch.equal(gmm.means, before)
        assert gmm.n_samples_seen_ == 300
    else:
        assert not hasattr(gmm, "means")


@pytest.mark.parametrize("started", [False, True])
@pytest.mark.parametrize(
    ("options", "match"),
    [
        *(({"kappa": value}, "kappa=") for value in (0.5, 1.01, 0, math.nan, "slow", None)),
        *(({"memory": value}, "memory=") for value in (-1, math.inf, math.nan, "long")),
    ],
)
def test_invalid_options_are_named(started, options, match):
    gmm = exact().partial_fit(blobs()) if started else exact()
    with pytest.raises(InvalidArgumentError, match=match):
        gmm.partial_fit(blobs(), **options)


def test_another_n_components_is_rejected():
    gmm = exact().partial_fit(blobs()).set_params(n_components=4)
    with pytest.raises(InvalidArgumentError, match="n_components=4"):
        gmm.partial_fit(blobs())
