"""The lower bound and the predictive density of variational mixtures against exact evidence."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mixture.fit_contract import blobs
from mixture.variational_cases import DISTRIBUTION, PROCESS, priors, types, variational
from scipy import integrate, special, stats

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


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


@types
def test_bound_with_regularisation_decreases_only_slightly(prior_type):
    wall = blobs(3) * [1.0, 1.0, 0.005]
    bounds = variational(6, prior_type, tol=0, max_iter=60).fit(wall).lower_bounds_
    assert np.diff(bounds).min() > -1e-4
    assert bounds[-1] > bounds[0]


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


def test_log_marginal_equals_quadrature():
    x, prior = np.array([[0.3], [-0.4], [1.1]]), priors(1)
    beta, dof = prior["mean_precision_prior"], prior["degrees_of_freedom_prior"]
    m0, w0 = float(prior["mean_prior"][0]), 1 / float(prior["covariance_prior"][0, 0])

    mean = np.linspace(-10, 10, 2001)
    precision = np.exp(np.linspace(-14, 5, 1501))[:, None]  # trapezoidal rule in its logarithm
    density = stats.norm(m0, (beta * precision) ** -0.5).pdf(mean)
    density *= stats.wishart(dof, w0).pdf(precision[:, 0])[:, None] * precision
    for point in x:
        density *= stats.norm(mean, precision**-0.5).pdf(point)
    value = integrate.trapezoid(integrate.trapezoid(density, mean), np.log(precision[:, 0]))
    assert math.log(value) == pytest.approx(log_marginal(x, prior), abs=1e-4)


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
    mixture = variational(3, DISTRIBUTION, reg_covar=0, n_init=5, tol=1e-9, max_iter=500, **prior).fit(x)
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


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_prediction_of_one_component_is_the_ratio_of_evidences(dim):
    x, prior = blobs(dim, 12), priors(dim)
    mixture = variational(1, DISTRIBUTION, reg_covar=0, **prior).fit(x)
    for point in blobs(dim, 4, seed=2):
        longer = variational(1, DISTRIBUTION, reg_covar=0, **prior).fit(np.vstack([x, point]))
        expected = 13 * longer.lower_bound_ - 12 * mixture.lower_bound_
        assert float(mixture.score_samples_predictive(point[None])[0]) == pytest.approx(expected, abs=1e-9)


def test_predictions_are_differentiable():
    mixture = variational(3).fit(torch.from_numpy(blobs(2, 40)))
    x = torch.from_numpy(blobs(2, 5, seed=1)).requires_grad_()
    assert torch.autograd.gradcheck(mixture.score_samples_predictive, x)
