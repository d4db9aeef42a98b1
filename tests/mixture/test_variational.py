"""VariationalGaussianMixture against scikit-learn's posterior; weights, precision and files."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mixture.fit_contract import blobs, check_mixture, move, rigid_motion
from mixture.variational_cases import DISTRIBUTION, PROCESS, priors, types, variational
from sklearn.mixture import BayesianGaussianMixture
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, NumericalError
from gmmtorch.files import pack_tensors, read_tensors
from gmmtorch.mixture import GaussianMixture, VariationalGaussianMixture
from gmmtorch.mixture.density import NotFittedError
from gmmtorch.mixture.em import by_type
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.initialization import initialize
from gmmtorch.mixture.estimators.variational import (
    expected_log_weights,
    expected_weights,
    unbiased_covariance,
)

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


class GivenStart(BayesianGaussianMixture):
    """scikit-learn's estimator with our start: the moments of its components, largest first."""

    def _initialize_parameters(self, X, random_state, xp=None):
        center = X.mean(0)
        found = initialize(
            "kmeans",
            torch.from_numpy(X - center),
            torch.ones(len(X), dtype=torch.float64),
            self.n_components,
            self.reg_covar,
            torch.Generator().manual_seed(0),
        )
        order = found.weights.argsort(descending=True, stable=True)
        count, means, covariances = (value[order].numpy() for value in found)
        self._estimate_weights(count * len(X))
        self._estimate_means(count * len(X), means + center)
        self._estimate_precisions(count * len(X), means + center, covariances)


# -- against scikit-learn --------------------------------------------------------------------------


@types
@pytest.mark.parametrize("dim", [1, 2, 3, 5])
@pytest.mark.parametrize("own_prior", [False, True])
@pytest.mark.parametrize("options", [{"tol": 1e-7, "max_iter": 300}, {"max_iter": 2, "reg_covar": 0.1}])
def test_equal_start_gives_the_posterior_of_scikit_learn(prior_type, dim, own_prior, options):
    x = blobs(dim)
    given = {"weight_concentration_prior_type": prior_type, **options, **(priors(dim) if own_prior else {})}
    found = variational(6, **{"prior_type": prior_type, **given}).fit(x)
    # scikit-learn's bound is not divided by the number of points.
    expected = GivenStart(n_components=6, **{**given, "tol": given.get("tol", 1e-3) * len(x)}).fit(x)
    assert found.n_iter_ == expected.n_iter_
    assert found.converged_ == expected.converged_
    for name in (
        "weights_",
        "means_",
        "covariances_",
        "precisions_",
        "weight_concentration_",
        "mean_precision_",
        "degrees_of_freedom_",
        "weight_concentration_prior_",
        "mean_precision_prior_",
        "mean_prior_",
        "degrees_of_freedom_prior_",
        "covariance_prior_",
    ):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-8, atol=1e-8)
    apart = len(x) * np.array(found.lower_bounds_) - np.array(expected.lower_bounds_)
    np.testing.assert_allclose(apart, apart[0], atol=1e-7)  # the constants that scikit-learn omits


@types
def test_float32_exponentials_change_the_posterior_little(prior_type):
    x = blobs(3)
    fast, exact = (variational(6, prior_type, dtype=dtype).fit(x) for dtype in ("float32", "float64"))
    assert fast.n_iter_ == exact.n_iter_
    np.testing.assert_allclose(fast.means_, exact.means_, atol=1e-4)
    np.testing.assert_allclose(fast.covariances_, exact.covariances_, atol=1e-4)
    np.testing.assert_allclose(fast.lower_bounds_, exact.lower_bounds_, atol=1e-5)


# -- weights of components -------------------------------------------------------------------------


def test_expected_weights_equal_monte_carlo():
    sticks = torch.tensor([[5.0, 1.5, 3.0, 1.0], [7.0, 4.0, 0.8, 0.3]], dtype=torch.float64)
    rng = np.random.default_rng(0)
    v = rng.beta(*sticks.numpy()[:, None, :].repeat(400_000, 1))
    pi = v * np.cumprod(np.concatenate([np.ones((len(v), 1)), 1 - v[:, :-1]], 1), 1)
    mean = pi.mean(0)
    np.testing.assert_allclose(expected_weights(sticks), mean / mean.sum(), atol=2e-3)
    np.testing.assert_allclose(expected_log_weights(sticks), np.log(pi).mean(0), atol=2e-2)
    flat = torch.tensor([[5.0, 1.5, 3.0]], dtype=torch.float64)
    draws = rng.dirichlet(flat[0].numpy(), 400_000)
    np.testing.assert_allclose(expected_weights(flat), draws.mean(0), atol=2e-3)
    np.testing.assert_allclose(expected_log_weights(flat), np.log(draws).mean(0), atol=2e-2)


@types
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_unneeded_components_lose_their_weight(prior_type, dim):
    x = blobs(dim, 600)
    mixture = variational(12, prior_type, max_iter=500, tol=1e-6, weight_concentration_prior=1e-3).fit(x)
    assert mixture.n_components_used_ == 3
    assert np.sum(mixture.support_) == pytest.approx(600)
    assert np.sort(mixture.weights_)[-3:].sum() > 0.99
    check_mixture(mixture, x, at_most=12)
    labels = mixture.predict(x)
    assert len(np.unique(labels)) == 3


def test_large_concentration_keeps_more_components():
    x = blobs(2, 300)
    few, many = (
        variational(12, DISTRIBUTION, weight_concentration_prior=gamma, max_iter=300, tol=1e-5).fit(x)
        for gamma in (1e-3, 1e3)
    )
    assert few.n_components_used_ < many.n_components_used_


# -- weights of points -----------------------------------------------------------------------------


@settings(max_examples=30)
@given(total=st.sampled_from([1e-12, 1e-3, 0.5, 1.0, 1.5, 1e12]), dim=st.integers(1, 3), n=st.integers(1, 6))
def test_any_total_weight_gives_a_valid_mixture(total, dim, n):
    x = np.random.default_rng(n).normal(size=(n, dim))
    for prior_type in (PROCESS, DISTRIBUTION):
        mixture = variational(min(n, 3), prior_type).fit(x, sample_weight=np.full(n, total / n))
        check_mixture(mixture, x, at_most=3)
        assert np.isfinite(mixture.score_samples_predictive(x)).all()


@settings(max_examples=30)
@given(
    gamma=st.sampled_from([1e-300, 1e-9, 1.0, 1e9]),
    beta=st.sampled_from([1e-300, 1e-9, 1.0, 1e9]),
    dof=st.sampled_from([2.0 + 1e-9, 3.0, 1e9]),
    variance=st.sampled_from([1e-12, 1.0, 1e12]),
    prior_type=st.sampled_from([PROCESS, DISTRIBUTION]),
    dtype=st.sampled_from(["float32", "float64"]),
)
def test_extreme_priors_give_a_valid_mixture(gamma, beta, dof, variance, prior_type, dtype):
    mixture = variational(
        5,
        prior_type,
        weight_concentration_prior=gamma,
        mean_precision_prior=beta,
        degrees_of_freedom_prior=dof,
        covariance_prior=variance * np.eye(3),
        dtype=dtype,
    )
    x = blobs(3, 40)
    check_mixture(mixture.fit(x), x, at_most=5)
    assert np.isfinite(mixture.score_samples_predictive(x)).all()


# -- precision -------------------------------------------------------------------------------------


@types
def test_direct_form_gives_the_same_fit(prior_type, monkeypatch):
    x = blobs(3)
    weight = np.random.default_rng(1).random(len(x)) + 0.5
    expected = variational(5, prior_type, max_iter=15, tol=0).fit(x, sample_weight=weight)
    calls = []
    direct = by_type.direct_step
    monkeypatch.setattr(em, "is_ill_conditioned", lambda parameters: True)
    monkeypatch.setattr(by_type, "direct_step", lambda *args: calls.append(1) or direct(*args))
    mixture = variational(5, prior_type, max_iter=15, tol=0).fit(x, sample_weight=weight)
    assert len(calls) == 15
    for name, value in mixture.state_dict().items():
        torch.testing.assert_close(value, expected.state_dict()[name], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(mixture.lower_bounds_, expected.lower_bounds_, rtol=1e-9)


def test_prior_covariance_of_a_flat_cloud_has_a_thickness():
    flat = torch.from_numpy(blobs(3) * [1.0, 1.0, 0.0])
    flat = flat - flat.mean(0)
    weight = torch.ones(len(flat), dtype=torch.float64)
    covariance = unbiased_covariance(flat, weight, 1e-6).numpy()
    np.testing.assert_allclose(covariance, np.cov(flat.numpy().T) + np.diag([0, 0, 1e-6]), atol=1e-12)
    check_mixture(variational(2).fit(flat), flat.numpy(), at_most=2)
    with pytest.raises(NumericalError, match="reg_covar"):
        variational(1, reg_covar=0).fit(np.ones((5, 2)))


# -- starts and attributes -------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_attributes_have_the_kind_of_the_points(kind):
    mixture = variational(3).fit(kind(blobs(2)))
    first, second = mixture.weight_concentration_
    values = [first, second, mixture.mean_precision_, mixture.degrees_of_freedom_, mixture.support_]
    assert all(isinstance(value, Tensor) == (kind is torch.from_numpy) for value in values)
    assert all(value.shape == (3,) for value in values)
    assert variational(3, DISTRIBUTION).fit(blobs(2)).weight_concentration_.shape == (3,)
    assert isinstance(mixture.mean_precision_prior_, float)


# -- motions, copies and files ---------------------------------------------------------------------


@types
@pytest.mark.parametrize("dim", [2, 3])
def test_moved_moves_the_whole_posterior(prior_type, dim):
    x, motion, prior = blobs(dim), rigid_motion(dim), priors(dim)
    rotation = motion[:dim, :dim]
    turned = {
        **prior,
        "mean_prior": move(motion, prior["mean_prior"][None])[0],
        "covariance_prior": rotation @ prior["covariance_prior"] @ rotation.T,
    }
    moved = variational(3, prior_type, **prior).fit(x).moved(motion)
    other = variational(3, prior_type, **turned).fit(move(motion, x))
    for name, value in moved.state_dict().items():
        torch.testing.assert_close(value, other.state_dict()[name], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(
        moved.score_samples_predictive(move(motion, x)),
        variational(3, prior_type, **prior).fit(x).score_samples_predictive(x),
        atol=1e-8,
    )


def test_mixture_of_given_parameters_has_no_posterior(tmp_path):
    fitted = variational(3).fit(blobs(2))
    parts = (fitted.weights_, fitted.means_, fitted.covariances_)
    bare = VariationalGaussianMixture.from_parameters(*parts)
    assert (bare.score_samples(blobs(2)) == fitted.score_samples(blobs(2))).all()
    with pytest.raises(NotFittedError, match="posterior"):
        bare.score_samples_predictive(blobs(2))
    bare.save(tmp_path / "m.safetensors")
    assert not hasattr(VariationalGaussianMixture.load(tmp_path / "m.safetensors"), "mean_precision_")
    assert not hasattr(bare.moved(np.eye(3)), "mean_precision_")
    fitted.load_state_dict(bare.state_dict())  # removes the posterior, which is of another mixture
    assert not hasattr(fitted, "mean_precision_")
    with pytest.raises(NotFittedError, match="fit"):
        variational(3).score_samples_predictive(blobs(2))


def test_gaussian_mixture_reads_the_file_without_the_posterior(tmp_path):
    mixture = variational(3).fit(blobs(2))
    mixture.save(tmp_path / "m.safetensors")
    plain = GaussianMixture.load(tmp_path / "m.safetensors")
    assert set(plain.state_dict()) == {"weights", "means", "covariances"}
    assert torch.equal(plain.means, mixture.means)
    plain.save(tmp_path / "plain.safetensors")
    assert torch.equal(VariationalGaussianMixture.load(tmp_path / "plain.safetensors").means, mixture.means)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("concentration", torch.ones(3, 3, dtype=torch.float64)),
        ("concentration", torch.zeros(2, 3, dtype=torch.float64)),
        ("mean_precision", torch.ones(2, dtype=torch.float64)),
        ("mean_precision", torch.ones(3)),
        ("mean_precision", torch.full((3,), math.nan, dtype=torch.float64)),
        ("degrees_of_freedom", torch.ones(3, dtype=torch.float64)),
        ("prior_mean", torch.ones(3, dtype=torch.float64)),
        ("prior_covariance", torch.ones(2, 2, dtype=torch.int64)),
        ("prior_concentration", None),
    ],
)
def test_file_with_an_invalid_posterior_is_rejected(tmp_path, name, value):
    path = tmp_path / "m.safetensors"
    variational(3).fit(blobs(2)).save(path)
    tensors, facts = read_tensors(path, "gmmtorch.mixture", 1)
    sound = pack_tensors(tensors, "gmmtorch.mixture", 1, **facts)
    path.write_bytes(sound)
    VariationalGaussianMixture.load(path)
    tensors.pop(f"extra.{name}")
    path.write_bytes(
        pack_tensors(
            {**tensors, **({} if value is None else {f"extra.{name}": value})}, "gmmtorch.mixture", 1, **facts
        )
    )
    with pytest.raises(DataError, match=rf"m\.safetensors.*{name}"):
        VariationalGaussianMixture.load(path)


def test_state_dict_with_an_invalid_posterior_is_rejected():
    state = variational(3).fit(blobs(2)).state_dict()
    state["mean_precision"] = -state["mean_precision"]
    with pytest.raises(InvalidArgumentError, match="mean_precision"):
        variational(3).load_state_dict(state)
