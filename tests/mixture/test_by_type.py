"""EM in many dimensions: each covariance type has an arithmetic of its own."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import scipy.special
import sklearn.mixture
import torch
from kernels.twins import Largest
from mixture.mixture_cases import random_parameters, scipy_log_joint

from gmmtorch.datasets.point_files.point_chunks import in_memory
from gmmtorch.errors import GmmTorchError, NumericalError
from gmmtorch.mixture import (
    INITIALIZATIONS,
    GaussianMixture,
    Parameters,
    VariationalGaussianMixture,
    fit_stream,
    initialize,
)
from gmmtorch.mixture import HierarchicalGaussianMixture as Tree
from gmmtorch.mixture.em import by_type, loop
from gmmtorch.mixture.em.exact import COVARIANCE_TYPES, constrain, expand, type_shape
from gmmtorch.mixture.reduction import merge_pairs

types = pytest.mark.parametrize("kind", COVARIANCE_TYPES)
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


def cloud(n: int, dim: int, k: int = 3, seed: int = 0) -> np.ndarray:
    """k clusters of different shapes that overlap."""
    rng = np.random.default_rng(seed)
    centers, label = 2 * rng.normal(size=(k, dim)) / dim**0.25, rng.integers(k, size=n)
    points: np.ndarray = centers[label] + rng.normal(size=(n, dim)) * (0.5 + rng.random((k, dim)))[label]
    points[:, 0] += 0.8 * points[:, -1]
    return points


def start(kind: str, x: np.ndarray, k: int = 3) -> dict:
    shape = type_shape(kind, k, x.shape[1])
    precisions = np.ones(shape) * (np.eye(x.shape[1]) if kind in ("full", "tied") else 1.0)
    return {
        "n_components": k,
        "covariance_type": kind,
        "weights_init": np.full(k, 1 / k),
        "means_init": x[:k],
        "precisions_init": precisions,
    }


def typed(kind: str, dim: int, k: int = 4) -> Parameters:
    return by_type.compacted(random_parameters(k, dim), kind)


# -- scikit-learn --------------------------------------------------------------------------------------


@types
@pytest.mark.parametrize("dim", [1, 3, 4, 30, 130])
@pytest.mark.parametrize("limits", [{"max_iter": 4, "tol": 0}, {"tol": 1e-6, "reg_covar": 0.1}])
def test_a_fit_and_its_queries_are_those_of_scikit_learn(kind, dim, limits):
    x, test = cloud(500, dim), cloud(60, dim, seed=0)
    options = {**limits, **start(kind, x)}
    found = GaussianMixture(dtype="float64", **options).fit(x)
    expected = sklearn.mixture.GaussianMixture(**options).fit(x)
    assert (found.n_iter_, found.converged_) == (expected.n_iter_, expected.converged_)
    for name in (
        "weights_",
        "means_",
        "covariances_",
        "precisions_",
        "precisions_cholesky_",
        "lower_bounds_",
    ):
        value = getattr(expected, name)
        np.testing.assert_allclose(getattr(found, name), value, rtol=1e-6, atol=1e-6 * np.abs(value).max())
    np.testing.assert_allclose(found.score_samples(test), expected.score_samples(test), rtol=1e-7)
    np.testing.assert_allclose(found.predict_proba(test), expected.predict_proba(test), atol=1e-7)
    assert (found.predict(test) == expected.predict(test)).all()
    for name in ("score", "bic", "aic"):
        assert getattr(found, name)(test) == pytest.approx(getattr(expected, name)(test), rel=1e-7)
    single = GaussianMixture(**options).fit(x.astype(np.float32))
    assert single.score_samples(test.astype(np.float32)).dtype == np.float32
    assert single.score(test) == pytest.approx(expected.score(test), rel=1e-4)


# -- the two forms -------------------------------------------------------------------------------------


@types
@pytest.mark.parametrize("dim", [1, 5, 21, 130])
def test_both_forms_give_the_density(kind, dim):
    points = torch.from_numpy(cloud(20, dim))
    parameters = typed(kind, dim)
    full = parameters._replace(covariances=expand(parameters.covariances, kind, 4, dim))
    factors = by_type.Factors(parameters, kind)
    for joint in (factors.linear(), factors.direct()):
        np.testing.assert_allclose(joint(points).T, scipy_log_joint(points, full), rtol=1e-9)


@types
@pytest.mark.parametrize("dim", [1, 3, 6])
def test_both_forms_give_the_moments_in_chunks_of_any_size(kind, dim, monkeypatch):
    points = torch.from_numpy(cloud(300, dim))
    weight = torch.rand(300, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    factors = by_type.Factors(typed(kind, dim), kind)
    found = []
    for elements in (1 << 17, 1):
        monkeypatch.setattr(by_type, "chunk_elements", lambda device, n=elements: n)
        for linear in (True, False):
            sums, value = by_type.expected_moments(points, weight, factors, torch.float64, linear)
            found.append((*sums.moments()[0], value))
    for other in found[1:]:
        torch.testing.assert_close(found[0], other, rtol=1e-9, atol=1e-9)
    gamma = torch.softmax(factors.direct()(points), 0) * weight
    means = gamma @ points / gamma.sum(1)[:, None]
    offset = points - means[:, None]
    scatter = (offset * gamma[..., None]).mT @ offset / gamma.sum(1)[:, None, None]
    expected = by_type.compacted(Parameters(gamma.sum(1), means, scatter), kind)
    torch.testing.assert_close(found[0][:3], tuple(expected), rtol=1e-8, atol=1e-8)


@types
@pytest.mark.parametrize("dim", [2, 5])
def test_thin_components_far_apart_keep_their_digits(kind, dim):
    rng = np.random.default_rng(0)
    parts = 1e-3 * rng.normal(size=(2, 300, dim))
    x = np.concatenate(parts + np.array([[[-1e5]], [[1e5]]]))
    first = by_type.Factors(
        Parameters(
            torch.full((2,), 0.5, dtype=torch.float64),
            torch.from_numpy(x[[0, 300]]),
            torch.full(type_shape(kind, 2, dim), 1e-6, dtype=torch.float64)
            * (torch.eye(dim, dtype=torch.float64) if kind in ("full", "tied") else 1.0),
        ),
        kind,
    )
    assert bool(first.lost_digits())
    found = GaussianMixture(2, covariance_type=kind, reg_covar=0, random_state=0).fit(x)
    order = found.means_[:, 0].argsort()
    scatter = np.stack([np.cov(part.T, ddof=0) for part in parts])
    expected = constrain(torch.from_numpy(scatter), kind, torch.ones(2))
    np.testing.assert_allclose(found.covariances.numpy()[order], expected, rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(found.means_[order], parts.mean(1) + np.array([[-1e5], [1e5]]), rtol=1e-14)
    moved = GaussianMixture(2, covariance_type=kind, reg_covar=0, random_state=0).fit(x + 7)
    assert moved.score(x + 7) == pytest.approx(found.score(x), abs=1e-6)


@types
@pytest.mark.parametrize("dim", [2, 3, 5, 30])
def test_the_density_and_the_responsibilities_have_gradients(kind, dim):
    x = torch.from_numpy(cloud(200, dim))
    mixture = GaussianMixture(3, covariance_type=kind, random_state=0).fit(x)
    points, means = x[:3].requires_grad_(), mixture.means

    def ask(points: torch.Tensor, means: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mixture._buffers["means"] = means
        return mixture(points), mixture.predict_proba(points)

    assert torch.autograd.gradcheck(ask, (points, means.clone().requires_grad_()))


@types
def test_no_array_is_larger_than_the_points_or_a_chunk(kind):
    x = torch.from_numpy(cloud(40_000, 8, 64))
    mixture = GaussianMixture(max_iter=2, tol=0, algorithm="exact", **start(kind, x.numpy(), 64))
    with Largest() as largest:
        mixture.fit(x).predict(x)
        mixture.score(x)
    assert largest.entries <= x.numel()


# -- starts, batches, states ---------------------------------------------------------------------------


@types
@pytest.mark.parametrize("method", sorted(INITIALIZATIONS))
def test_a_start_of_a_type_is_the_full_one_projected(kind, method):
    points = torch.from_numpy(cloud(300, 6))
    points = points - points.mean(0)
    weight = torch.randint(1, 4, (300,), generator=torch.Generator().manual_seed(0)).double()
    given = (points, weight, 5, 1e-4)
    found = initialize(method, *given, torch.Generator().manual_seed(0), kind)
    full = initialize(method, *given, torch.Generator().manual_seed(0))
    assert found.covariances.shape == type_shape(kind, 5, 6)
    torch.testing.assert_close(tuple(found), tuple(by_type.compacted(full, kind)), rtol=1e-8, atol=1e-9)


@types
def test_batches_blend_in_the_shape_of_the_type(kind):
    first, second = typed(kind, 6), by_type.compacted(random_parameters(4, 6, seed=5), kind)
    both = [p._replace(covariances=expand(p.covariances, kind, 4, 6)) for p in (first, second)]
    expected = merge_pairs(
        both[0]._replace(weights=0.7 * first.weights), both[1]._replace(weights=0.3 * second.weights)
    )
    found = loop.blend(first, second, 0.3, kind)
    torch.testing.assert_close(tuple(found), tuple(by_type.compacted(expected, kind)))


@types
def test_states_hold_the_shape_of_the_type_and_accept_matrices(kind):
    mixture = GaussianMixture(2, covariance_type=kind, random_state=0).fit(cloud(100, 5))
    state = mixture.state_dict()
    assert state["covariances"].shape == type_shape(kind, 2, 5)
    for covariances in (state["covariances"], mixture.covariances):
        other = GaussianMixture(2, covariance_type=kind)
        other.load_state_dict({**state, "covariances": covariances.clone()})
        assert torch.equal(other.covariances, mixture.covariances)
    sample, _ = mixture.sample(20_000, 0)
    np.testing.assert_allclose(sample.mean(0), mixture.weights_ @ mixture.means_, atol=0.1)


@types
@pytest.mark.parametrize("dim", [6, 25])
@pytest.mark.parametrize("gap", [0.0, 1e7])
def test_a_streamed_fit_of_a_type_is_that_of_all_points(kind, dim, gap):
    x = cloud(200, dim)
    x[::2] += gap
    options = {**start(kind, x), "max_iter": 3, "tol": 0, "dtype": "float64"}
    expected = GaussianMixture(**options).fit(x)
    found = fit_stream(GaussianMixture(**options), in_memory(x, chunk_points=70))
    torch.testing.assert_close(found.covariances, expected.covariances, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.lower_bounds_, expected.lower_bounds_, rtol=1e-7)


@types
def test_scores_are_those_of_scipy_where_all_shares_but_one_underflow(kind):
    parameters = typed(kind, 40, 3)
    means = parameters.means + torch.tensor([[0.0], [100.0], [-100.0]])
    mixture = GaussianMixture.from_parameters(
        parameters.weights / parameters.weights.sum(), means, parameters.covariances, covariance_type=kind
    )
    points = means.repeat(20, 1) + torch.randn(60, 40, generator=torch.Generator().manual_seed(1)).double()
    joint = scipy_log_joint(points, Parameters(mixture.weights, mixture.means, mixture.covariances))
    assert np.ptp(joint, axis=1).min() > 745  # beyond the least exponent of float64
    np.testing.assert_allclose(
        mixture.score_samples(points), scipy.special.logsumexp(joint, axis=1), rtol=1e-9
    )


# -- bad input -----------------------------------------------------------------------------------------

RNG = np.random.default_rng(3)
PAIR = np.concatenate([RNG.normal(size=(50, 6)) - 4, RNG.normal(size=(50, 6)) + 4])
BAD = {
    "more dimensions than points": RNG.normal(size=(20, 60)),
    "constant columns": np.c_[PAIR, np.full(100, 7.3), np.zeros(100)],
    "duplicated columns": np.c_[PAIR, PAIR[:, :3]] * 1e5,
    "one-hot": np.eye(12)[RNG.integers(12, size=200)],
    "float16": PAIR.astype(np.float16),
    "float32, far": (PAIR + 1e3).astype(np.float32),
    "whole numbers": (PAIR * 10).astype(int),
    "bool": PAIR > 3.5,
    "scales": PAIR * np.array([1e-6, 1e-3, 1, 1e3, 1e6, 1e6]),
    "far": PAIR + 1e8,
    "an outlier": np.r_[PAIR, np.full((1, 6), 1e8)],
    "few distinct points": np.repeat(PAIR[:3], 20, 0),
    "one distinct point": np.ones((20, 5)),
}


@types
@pytest.mark.parametrize("case", BAD)
@pytest.mark.parametrize("method", ["kmeans", "k-means++", "random", "random_from_data"])
def test_bad_tables_give_a_fit_as_good_as_that_of_scikit_learn(kind, case, method):
    x = BAD[case]
    mixture = GaussianMixture(4, covariance_type=kind, init_params=method, random_state=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mixture.fit(x)
    values = (mixture.means_, mixture.covariances_, mixture.precisions_, mixture.predict_proba(x))
    assert all(np.isfinite(value).all() for value in values)
    if case not in ("duplicated columns", "far", "an outlier"):  # where scikit-learn loses digits
        peer = sklearn.mixture.GaussianMixture(4, covariance_type=kind)
        peer.weights_, peer.means_ = mixture.weights_, mixture.means_
        peer.covariances_ = mixture.covariances_
        peer.precisions_cholesky_ = mixture.precisions_cholesky_
        rel = 1e-2 if x.dtype == np.float32 else 1e-5
        assert mixture.score(x) == pytest.approx(peer.score(x.astype(np.float64)), rel=rel)


@types
def test_numbers_too_large_to_square_are_an_error(kind):
    x = torch.from_numpy(PAIR * 1e200)
    start = {"init_params": "random_points", "random_state": 0}
    for made in (GaussianMixture(2, covariance_type=kind, **start), VariationalGaussianMixture(2), Tree()):
        with pytest.raises(GmmTorchError):
            made.fit(x)
    assert math.isfinite(GaussianMixture(2, covariance_type=kind, **start).fit(x / 1e50).score(x / 1e50))
    with pytest.raises(NumericalError, match="scale them"):
        Tree().fit(x / 1e50)


@pytest.mark.parametrize("kind", ["diag", "spherical"])
def test_a_component_of_one_point_without_regularisation_is_an_error(kind):
    x = np.r_[PAIR, np.full((1, 6), 500.0)]
    with pytest.raises(NumericalError, match="reg_covar"):
        GaussianMixture(3, covariance_type=kind, reg_covar=0, random_state=0).fit(x)
