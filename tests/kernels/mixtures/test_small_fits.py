"""Whole fits of small tables in one launch: beside the loops of `mixture.em`, and scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest
import sklearn.mixture
import torch
from hypothesis import given
from hypothesis import strategies as st
from kernels.twins import by_both
from torch import Tensor

from gmmtorch import GaussianMixture, VariationalGaussianMixture
from gmmtorch.errors import NumericalError
from gmmtorch.kernels import fused_em, fused_moments, is_small, kernels
from gmmtorch.kernels.mixtures import small_fits
from gmmtorch.mixture.em.by_type import moments_of_labels
from gmmtorch.mixture.em.exact import COVARIANCE_TYPES, type_shape

pytestmark = pytest.mark.cpu_only

kinds = pytest.mark.parametrize("kind", COVARIANCE_TYPES)


def table(n: int, dim: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(3, dim)) * 4
    return centers[rng.integers(3, size=n)] + rng.normal(size=(n, dim)) * (0.3 + rng.random(dim))


def fit(x: np.ndarray, k: int, kind: str, **options) -> GaussianMixture:
    options = {"random_state": 0, "dtype": "float64", "init_params": "kmeans", "tol": 1e-6} | options
    return GaussianMixture(k, covariance_type=kind, algorithm="exact", **options).fit(x)


def assert_equal(one: GaussianMixture, other: GaussianMixture, rtol: float = 1e-7) -> None:
    assert one.n_iter_ == other.n_iter_
    assert one.converged_ == other.converged_
    for name in ("weights_", "means_", "covariances_", "lower_bounds_"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol, 1e-9)


@kinds
@given(st.integers(0, 999), st.integers(4, 60), st.integers(1, 10), st.integers(1, 6))
def test_a_fit_is_that_of_the_twin(kind, seed, n, dim, k):
    x, weight = table(n, dim, seed), np.random.default_rng(seed).random(n) + 0.5

    def run() -> GaussianMixture:
        options = {"max_iter": 15, "reg_covar": 1e-2, "tol": 1e-3, "random_state": seed, "dtype": "float64"}
        return GaussianMixture(min(k, n), covariance_type=kind, **options).fit(x, sample_weight=weight)

    assert_equal(*by_both(run), rtol=1e-6)


@kinds
@pytest.mark.parametrize("dim", [1, 4, 7, 16])
def test_a_fit_is_that_of_scikit_learn(kind, dim):
    x = table(150, dim)
    start = {"means_init": x[:4], "weights_init": np.full(4, 0.25)}
    options = {"tol": 1e-5, "max_iter": 40, "init_params": "random_from_data"}
    size = type_shape(kind, 4, dim)
    start["precisions_init"] = np.ones(size) * (np.eye(dim) if kind in ("full", "tied") else 1)
    assert is_small(torch.from_numpy(x), torch.ones(150).double(), 4, kind)
    ours = fit(x, 4, kind, **start, **options)
    peer = sklearn.mixture.GaussianMixture(4, covariance_type=kind, **start, **options).fit(x)
    assert ours.n_iter_ == peer.n_iter_
    np.testing.assert_allclose(ours.means_, peer.means_, 1e-6, 1e-9)
    np.testing.assert_allclose(ours.covariances_, peer.covariances_, 1e-6, 1e-9)
    np.testing.assert_allclose(ours.lower_bound_, peer.lower_bound_, 1e-9)


@kinds
def test_far_and_thin_components_keep_their_digits(kind):
    x = table(90, 5) * 1e-4 + np.repeat(np.eye(3, 5), 30, 0) * 1e5
    ours, twin = by_both(lambda: fit(x, 3, kind, reg_covar=0.0))
    assert_equal(ours, twin, 1e-4)
    expected = np.stack([np.cov(part.T, bias=True) for part in np.split(x, 3)])
    if kind == "full":
        order = ours.means_.argmax(1)
        np.testing.assert_allclose(ours.covariances_[order.argsort()], expected, 1e-3, 1e-12)


@kinds
def test_moments_of_labels_are_those_of_the_twin(kind):
    x, labels = torch.from_numpy(table(70, 6)), torch.arange(70) % 3
    weight = torch.linspace(0.5, 2, 70, dtype=torch.float64)
    found = fused_moments(x, weight, labels, 3, kind, 0.0)
    count, means, covariances = moments_of_labels(x, weight, labels, 3, kind)
    for one, other in zip(found, (count / count.sum(), means, covariances), strict=True):
        torch.testing.assert_close(one, other)


@kinds
def test_starts_in_one_launch_are_those_one_by_one(kind):
    x, generator = table(80, 4), torch.Generator().manual_seed(3)
    singles = [fit(x, 5, kind, random_state=generator, init_params="random_from_data") for _ in range(4)]
    reported: list[int] = []
    options = {"random_state": torch.Generator().manual_seed(3), "init_params": "random_from_data"}
    batch = GaussianMixture(5, covariance_type=kind, n_init=4, tol=1e-6, **options)
    batch.fit(x, on_iteration=lambda iteration, bound: reported.append(iteration))
    best = max(singles, key=lambda mixture: mixture.lower_bound_)
    assert_equal(batch, best)
    assert reported == [i for mixture in singles for i in range(1, mixture.n_iter_ + 1)]


@pytest.mark.parametrize("products", [1, 3000])
def test_launches_of_few_iterations_give_the_same_fit(products, monkeypatch):
    x = table(100, 4)
    whole = fit(x, 4, "full", n_init=3)
    monkeypatch.setattr(small_fits, "_PRODUCTS_OF_A_LAUNCH", products)
    assert_equal(fit(x, 4, "full", n_init=3), whole)


@kinds
def test_a_fit_that_continues_is_that_of_one_run(kind):
    x = table(100, 4)
    whole = fit(x, 4, kind, max_iter=100)
    assert fit(x, 4, kind, max_iter=100, tol=0.0).n_iter_ == 100
    parts = GaussianMixture(4, covariance_type=kind, max_iter=3, warm_start=True, random_state=0, tol=1e-6)
    while not parts.fit(x).converged_:
        pass
    np.testing.assert_allclose(parts.means_, whole.means_, 1e-6)


def test_an_iteration_that_the_kernel_cannot_do_is_one_of_the_twin():
    x = torch.from_numpy(table(20, 2))
    good = torch.tensor([0.5, 0.5]).double(), x[:2].clone(), torch.eye(2).double().expand(2, 2, 2)
    bad = (
        torch.tensor([0.5, 0.5]).double(),
        x[:2].clone(),
        torch.eye(2).double() * torch.tensor([[[1.0]], [[-1.0]]]),
    )
    stacked: tuple[Tensor, ...] = tuple(torch.stack(pair) for pair in zip(good, bad, strict=True))
    found = fused_em(x, torch.ones(20).double(), stacked, "full", 1e-6, 0.0, 5)
    assert found.failed == [False, True]
    assert [len(bounds) for bounds in found.bounds] == [5, 0]
    assert torch.equal(found.covariances[1], bad[2])
    with pytest.raises(NumericalError, match="reg_covar"):
        fit(np.repeat(np.arange(3.0)[:, None], 9, 0) * np.ones(5), 3, "full", reg_covar=0.0)


@kinds
@pytest.mark.parametrize("prior", ["dirichlet_process", "dirichlet_distribution"])
def test_a_variational_fit_is_that_of_the_twin(kind, prior):
    x = table(60, 4)

    def run() -> VariationalGaussianMixture:
        options = {"weight_concentration_prior_type": prior, "random_state": 0, "dtype": "float64"}
        return VariationalGaussianMixture(5, covariance_type=kind, tol=1e-6, **options).fit(x)

    assert_equal(*by_both(run), rtol=1e-6)


def test_the_choice_depends_on_the_size_and_on_the_device():
    x = torch.zeros(100, 4, dtype=torch.float64)
    assert is_small(x, x[:, 0], 3, "tied")
    assert not is_small(x.float(), x[:, 0], 3, "tied")
    assert not is_small(x, x[:, 0], 1 << 20, "tied")
    with kernels("torch"):
        assert not is_small(x, x[:, 0], 3, "tied")
