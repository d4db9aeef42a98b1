"""RiemannianGaussianMixture against EM and scikit-learn."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mixture.estimator_contract import MixtureContract
from mixture.fit_contract import FitContract, blobs
from sklearn import mixture as sklearn_mixture

from gmmtorch.errors import NumericalError
from gmmtorch.mixture import GaussianMixture
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em import loop
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.estimators.riemannian import SOLVERS, Likelihood, RiemannianGaussianMixture

solvers = pytest.mark.parametrize("solver", list(SOLVERS))


class TestRiemannianGaussianMixture(MixtureContract):
    bad_parameters: ClassVar[dict[str, tuple[Any, ...]]] = {
        "solver": ("newton", None),
        "memory": (0, 2.5),
    }

    def make(self, n_components: int = 3, **options: Any) -> RiemannianGaussianMixture:
        return RiemannianGaussianMixture(n_components, **{"random_state": 0, **options})


class TestByConjugateGradients(FitContract):
    def make(self, n_components: int = 3, **options: Any) -> RiemannianGaussianMixture:
        return RiemannianGaussianMixture(n_components, **{"random_state": 0, "solver": "cg", **options})


# -- the estimator ---------------------------------------------------------------------------------


def overlapping(seed: int = 0, n: int = 1500) -> np.ndarray:
    """Four components of equal place and size that differ only in shape."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(4, 2, 2)) * 0.3 + np.eye(2)
    label = rng.integers(4, size=n)
    return rng.normal(size=(4, 2))[label] * 0.5 + np.einsum(
        "nij,nj->ni", roots[label], rng.normal(size=(n, 2))
    )


def blurred_em_step(points: np.ndarray, reg_covar: float) -> loop.Step:
    """EM on the objective of the ascent: points as cells of covariance ε I."""
    x = torch.from_numpy(points)
    features = em.quadratic_features(x)
    dim = x.shape[1]
    rows, cols = torch.triu_indices(dim, dim)
    features[:, 1 + dim :] += reg_covar * (rows == cols)
    return loop.natural_step(features, torch.ones(len(x)).double(), 0.0, torch.float64)


@solvers
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_one_component_has_the_mean_and_covariance_plus_epsilon(solver, dim):
    points = overlapping()[:, [0]] if dim == 1 else blobs(dim)
    fit = RiemannianGaussianMixture(
        1, reg_covar=0.25, init_params="bounding_box", random_state=0, tol=1e-12, solver=solver
    ).fit(points)
    expected = np.cov(points.T, ddof=0).reshape(dim, dim) + 0.25 * np.eye(dim)
    np.testing.assert_allclose(fit.means_[0], points.mean(0), atol=1e-5)
    np.testing.assert_allclose(fit.covariances_[0], expected, atol=1e-5)


@solvers
@pytest.mark.parametrize("init_params", ["kmeans", "random_points"])
@pytest.mark.parametrize("reg_covar", [1e-6, 0.1])
def test_em_does_not_improve_the_result(solver, init_params, reg_covar):
    points = overlapping(n=500)
    fit = RiemannianGaussianMixture(
        4,
        reg_covar=reg_covar,
        tol=1e-9,
        max_iter=2000,
        init_params=init_params,
        random_state=0,
        solver=solver,
    ).fit(points)
    assert fit.converged_
    parameters = Parameters(fit.weights, fit.means, fit.covariances)
    again = loop.run_em(blurred_em_step(points, reg_covar), parameters, tol=0, max_iter=30)
    assert again.lower_bounds[0] == pytest.approx(fit.lower_bound_, abs=1e-8)
    assert 0 <= again.lower_bounds[-1] - again.lower_bounds[0] < 1e-7
    place = Likelihood(torch.from_numpy(points), torch.ones(len(points)).double(), reg_covar).at(parameters)
    assert float(place.gradient.norm()) < 1e-4
    torch.testing.assert_close(place.frames.offset.norm(dim=1), torch.ones(4).double(), rtol=0, atol=1e-3)


@solvers
@settings(max_examples=10)
@given(seed=st.integers(0, 10**6), dim=st.integers(1, 3), k=st.integers(1, 6))
def test_likelihood_never_decreases(solver, seed, dim, k):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(80, dim)) * rng.choice([1e-3, 1, 30], size=dim)
    fit = RiemannianGaussianMixture(
        k, solver=solver, init_params="random_points", random_state=seed, tol=0, max_iter=20
    )
    fit.fit(points, sample_weight=rng.random(80) + 0.1)
    assert (np.diff(fit.lower_bounds_) >= 0).all()


def test_separated_clusters_equal_em_and_scikit_learn():
    points = blobs(3, 600)
    found = RiemannianGaussianMixture(3, tol=1e-9, random_state=0).fit(points)
    expected = sklearn_mixture.GaussianMixture(3, tol=1e-9, max_iter=500, random_state=0).fit(points)
    order, their_order = found.weights_.argsort(), expected.weights_.argsort()
    for name in ("weights_", "means_", "covariances_"):
        mine, other = getattr(found, name)[order], getattr(expected, name)[their_order]
        np.testing.assert_allclose(mine, other, atol=1e-4)
    em_fit = GaussianMixture(3, tol=1e-9, max_iter=500, random_state=0).fit(points)
    assert found.score(points) == pytest.approx(em_fit.score(points), abs=1e-7)


def test_overlapping_clusters_need_a_fifth_of_the_iterations_of_em():
    points = overlapping(n=1000)
    found = RiemannianGaussianMixture(4, tol=1e-8, max_iter=3000, random_state=0).fit(points)
    em_fit = GaussianMixture(4, dtype="float64", tol=0, max_iter=5 * found.n_iter_, random_state=0).fit(
        points
    )
    assert found.lower_bound_ > em_fit.lower_bound_ - 1e-4


@solvers
def test_collapse_without_regularisation_is_an_error(solver):
    points = np.concatenate([blobs(2, 60), np.array([[40.0, 40.0], [40.0, 41.0]])])
    with pytest.raises(NumericalError, match="reg_covar"):
        RiemannianGaussianMixture(
            5, reg_covar=0, tol=0, max_iter=400, init_params="random_points", random_state=1, solver=solver
        ).fit(points)
