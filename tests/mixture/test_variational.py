"""VariationalGaussianMixture against scikit-learn's posterior; weights, precision and files."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mixture.fit_contract import blobs, check_mixture, move, rigid_motion
from mixture.mixture_cases import MISSING, changed_file
from scipy import special, stats
from sklearn.mixture import BayesianGaussianMixture
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, NumericalError
from gmmtorch.kernels import kernels
from gmmtorch.mixture import GaussianMixture, NotFittedError, VariationalGaussianMixture, initialize
from gmmtorch.mixture.em import by_type
from gmmtorch.mixture.em.variational_bayes import expected_log_weights, expected_weights, unbiased_covariance

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


PROCESS, DISTRIBUTION = "dirichlet_process", "dirichlet_distribution"


types = pytest.mark.parametrize("prior_type", [PROCESS, DISTRIBUTION])


def variational(k: int, prior_type: str = PROCESS, **options: Any) -> VariationalGaussianMixture:
    given = {"random_state": 0, "dtype": "float64", "weight_concentration_prior_type": prior_type, **options}
    return VariationalGaussianMixture(k, **given)


def priors(dim: int, seed: int = 0) -> dict[str, Any]:
    """A prior with no default value."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(dim, dim)) * 0.3 + np.eye(dim)
    return {
        "weight_concentration_prior": 0.7,
        "mean_precision_prior": 0.3,
        "mean_prior": rng.normal(size=dim),
        "degrees_of_freedom_prior": dim + 1.5,
        "covariance_prior": root @ root.T,
    }


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
            self.covariance_type,
        )
        order = found.weights.argsort(descending=True, stable=True)
        count, means = (value[order].numpy() for value in found[:2])
        covariances = found.covariances if self.covariance_type == "tied" else found.covariances[order]
        covariances = covariances.numpy()
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
@pytest.mark.parametrize("kind", ["tied", "diag", "spherical"])
@pytest.mark.parametrize("dim", [2, 5])
def test_posterior_of_a_type_is_that_of_scikit_learn(prior_type, kind, dim):
    x, options = blobs(dim), {"covariance_type": kind, "tol": 0, "max_iter": 20, "reg_covar": 1e-3}
    found = variational(5, prior_type, **options).fit(x)
    expected = GivenStart(n_components=5, weight_concentration_prior_type=prior_type, **options).fit(x)
    for name in ("weights_", "means_", "covariances_", "degrees_of_freedom_", "covariance_prior_"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-8, atol=1e-8)
    assert bool((np.diff(found.lower_bounds_) > -1e-6).all())


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
    forms, step = [], by_type.em_step
    monkeypatch.setattr(by_type.Factors, "lost_digits", lambda self: torch.tensor(True))
    monkeypatch.setattr(
        by_type, "em_step", lambda *args, linear: forms.append(linear) or step(*args, linear=linear)
    )
    with kernels("torch"):
        mixture = variational(5, prior_type, max_iter=15, tol=0).fit(x, sample_weight=weight)
    assert forms == [True, False] * 15
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
        ("prior_concentration", MISSING),
    ],
)
def test_file_with_an_invalid_posterior_is_rejected(tmp_path, name, value):
    path = changed_file(variational(3).fit(blobs(2)), tmp_path, {f"extra.{name}": value})
    with pytest.raises(DataError, match=rf"m\.safetensors.*{name}"):
        VariationalGaussianMixture.load(path)


def test_state_dict_with_an_invalid_posterior_is_rejected():
    state = variational(3).fit(blobs(2)).state_dict()
    state["mean_precision"] = -state["mean_precision"]
    with pytest.raises(InvalidArgumentError, match="mean_precision"):
        variational(3).load_state_dict(state)


# -- the lower bound -------------------------------------------------------------------------------


@types
@settings(max_examples=10)
@given(seed=st.integers(0, 10**6), dim=st.integers(1, 3), k=st.integers(1, 6), own_prior=st.booleans())
def test_bound_never_decreases(prior_type, seed, dim, k, own_prior):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(30, dim)) * rng.choice([0.1, 1.0, 5.0], size=(30, 1))
    weight = rng.random(30) * 3
    given = priors(dim, seed) if own_prior else {}
    mixture = variational(
        k,
        prior_type,
        tol=0,
        max_iter=40,
        reg_covar=0,
        init_params="random_points",
        random_state=seed,
        **given,
    )
    bounds = np.array(mixture.fit(x, sample_weight=weight).lower_bounds_)
    assert len(bounds) == 40
    assert (np.diff(bounds) > -1e-9 * np.abs(bounds).max()).all()


def log_marginal(x: np.ndarray, prior: dict[str, Any]) -> float:
    """log p(X) of one Gaussian under its prior, as a chain of Student-t predictions."""
    dim = x.shape[1]
    beta, dof = prior["mean_precision_prior"], prior["degrees_of_freedom_prior"]
    mean, scatter = np.array(prior["mean_prior"], float), np.array(prior["covariance_prior"], float)
    total = 0.0
    for point in x:
        df = dof + 1 - dim
        total += stats.multivariate_t(mean, scatter * (1 + beta) / (beta * df), df).logpdf(point)
        scatter = scatter + beta / (beta + 1) * np.outer(point - mean, point - mean)
        mean = (beta * mean + point) / (beta + 1)
        beta, dof = beta + 1, dof + 1
    return float(total)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_bound_of_one_component_is_the_evidence(dim):
    x, prior = blobs(dim, 12), priors(dim)
    mixture = variational(1, DISTRIBUTION, reg_covar=0, **prior).fit(x)
    assert mixture.lower_bound_ * 12 == pytest.approx(log_marginal(x, prior), rel=1e-10)


def test_bound_of_one_stick_is_the_evidence_of_all_points():
    x, prior = blobs(2, 12), priors(2)
    bound = variational(1, PROCESS, reg_covar=0, **prior).fit(x).lower_bound_ * 12
    gamma = prior["weight_concentration_prior"]
    chance = special.betaln(1 + 12, gamma) - special.betaln(1, gamma)  # log E[v¹²], v ~ Beta(1, γ₀)
    assert bound == pytest.approx(chance + log_marginal(x, prior), rel=1e-10)


def assignments(n: int, k: int) -> np.ndarray:
    return np.array(list(itertools.product(range(k), repeat=n)))


@pytest.mark.parametrize("spread", [0.2, 3.0])
def test_bound_is_close_below_the_enumerated_evidence(spread):
    x = blobs(2, 6, seed=3) * [spread, 1.0]
    prior = {**priors(2), "covariance_prior": 0.1 * np.eye(2)}
    gamma = prior["weight_concentration_prior"]
    terms = []
    for label in assignments(6, 3):
        count = np.bincount(label, minlength=3)
        weight = special.gammaln(3 * gamma) - special.gammaln(3 * gamma + 6)
        weight += (special.gammaln(gamma + count) - special.gammaln(gamma)).sum()
        terms.append(weight + sum(log_marginal(x[label == j], prior) for j in range(3)))
    evidence = special.logsumexp(terms)
    options = {"reg_covar": 0, "n_init": 5, "init_params": "random", "tol": 1e-9, "max_iter": 500}
    mixture = variational(3, DISTRIBUTION, **options, **prior).fit(x)
    bound = mixture.lower_bound_ * 6
    # The bound covers one of the 3! orders of the components, and only part of it.
    assert evidence - math.log(6) - 3 < bound < evidence


def test_bound_of_sticks_is_below_the_enumerated_evidence_of_the_process():
    x = blobs(2, 6, seed=3)
    prior = {**priors(2), "covariance_prior": 0.1 * np.eye(2)}
    gamma = prior["weight_concentration_prior"]
    partitions = [
        label
        for label in assignments(6, 6)
        if all(v <= max([-1, *label[:i]]) + 1 for i, v in enumerate(label))
    ]
    assert len(partitions) == 203  # Bell's number
    terms = []
    for label in partitions:  # the Chinese restaurant process
        blocks = [x[label == j] for j in range(label.max() + 1)]
        weight = len(blocks) * math.log(gamma) + special.gammaln(gamma) - special.gammaln(gamma + 6)
        terms.append(weight + sum(special.gammaln(len(b)) + log_marginal(b, prior) for b in blocks))
    evidence = special.logsumexp(terms)
    options = {"reg_covar": 0, "n_init": 5, "tol": 1e-9, "max_iter": 500}
    bound = variational(4, PROCESS, **options, **prior).fit(x).lower_bound_ * 6
    assert evidence - 6 < bound < evidence


# -- the predictive density ------------------------------------------------------------------------


@types
def test_predictive_density_is_a_mixture_of_student_t(prior_type):
    x, fresh = blobs(3, 60), blobs(3, 40, seed=1) * 2
    mixture = variational(4, prior_type).fit(x)
    beta, nu = mixture.mean_precision_, mixture.degrees_of_freedom_
    parts = []
    for k in range(4):
        df = nu[k] + 1 - 3
        scale = mixture.covariances_[k] * nu[k] * (1 + beta[k]) / (beta[k] * df)
        parts.append(stats.multivariate_t(mixture.means_[k], scale, df).logpdf(fresh))
    expected = special.logsumexp(np.array(parts).T, b=mixture.weights_, axis=1)
    np.testing.assert_allclose(mixture.score_samples_predictive(fresh), expected, rtol=1e-9)
    as_tensor = mixture.score_samples_predictive(torch.from_numpy(fresh).float())
    assert as_tensor.dtype == torch.float32


def test_predictions_are_differentiable():
    mixture = variational(3).fit(torch.from_numpy(blobs(2, 40)))
    x = torch.from_numpy(blobs(2, 5, seed=1)).requires_grad_()
    assert torch.autograd.gradcheck(mixture.score_samples_predictive, x)
