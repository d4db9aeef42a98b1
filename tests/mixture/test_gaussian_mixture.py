"""GaussianMixture: scikit-learn's results, starts, kinds of arrays, awkward clouds and gradients."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import torch
from mixture.mixture_cases import DtypeRecorder, blobs, fitted, given_start
from sklearn import mixture as sklearn_mixture
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from torch import Tensor

from gmmtorch.errors import (
    InvalidArgumentError,
)
from gmmtorch.kernels import kernels
from gmmtorch.mixture import GaussianMixture

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
SEEDED = ["kmeans", "random_points", "bounding_box"]
INITS = [*SEEDED, "flat_pieces"]


# -- against scikit-learn --------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_float32_gives_nearly_the_result_of_scikit_learn(dim):
    x = blobs(dim=dim)
    found = GaussianMixture(3, **given_start(dim), dtype="float32").fit(x)
    reference = sklearn_mixture.GaussianMixture(3, **given_start(dim)).fit(x)
    assert found.n_iter_ == reference.n_iter_
    for name in ("weights_", "means_", "covariances_"):
        np.testing.assert_allclose(getattr(found, name), getattr(reference, name), rtol=1e-4, atol=1e-4)
    assert found.score(x) == pytest.approx(reference.score(x), abs=1e-5)


@pytest.mark.parametrize("init", INITS)
@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_float64_fit_and_queries_create_no_float32_tensor(init, kind):
    x = kind(blobs(200))
    with DtypeRecorder() as recorder:
        gmm = GaussianMixture(3, random_state=0, dtype="float64", init_params=init, max_iter=5)
        gmm.fit(x, sample_weight=kind(np.linspace(0.5, 2, 200)))
        gmm.score_samples(x), gmm.predict_proba(x), gmm.predict(x), gmm.bic(x), gmm.sample(5)
        gmm.precisions_  # noqa: B018
    assert recorder.seen.keys() == {torch.float64}, recorder.seen


def test_dtype_recorder_detects_float32():
    with kernels("torch"), DtypeRecorder() as recorder:
        GaussianMixture(2, random_state=0, dtype="float32").fit(blobs(100))
    assert torch.float32 in recorder.seen


# -- kinds -----------------------------------------------------------------------------------------


def test_queries_return_the_kind_of_their_input():
    x = blobs()
    gmm = fitted()
    found = gmm.score_samples(torch.from_numpy(x))
    assert isinstance(found, Tensor)
    assert torch.equal(found, torch.from_numpy(gmm.score_samples(x)))


def test_integers_lists_and_half_precision_are_accepted():
    x = torch.from_numpy(10 * blobs()).long()
    gmm = GaussianMixture(2, random_state=0).fit(x)
    assert torch.equal(gmm.score_samples(x), gmm.score_samples(x.double()))
    assert torch.equal(gmm.means, GaussianMixture(2, random_state=0).fit(x.numpy()).means)
    assert gmm.score_samples(x.numpy().tolist()).dtype == np.float64
    assert gmm.score_samples(x.half()).dtype == torch.float16


# -- frames ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("init", INITS)
@pytest.mark.parametrize("length", [2.0, 0.05, 1e-3])
def test_thin_pieces_500_km_apart_are_fitted_in_one_cloud(init, length):
    rng = np.random.default_rng(0)
    piece = np.stack([rng.normal(size=400) * 1e-3, rng.uniform(-length, length, 400)], 1)
    piece = np.round(piece * 2**24) / 2**24  # so that adding the offset is exact
    shifts = np.array([[-250_000.0, 0.0], [250_000.0, 4096.0]])
    gmm = GaussianMixture(2, init_params=init, random_state=0, n_init=5, reg_covar=1e-8, max_iter=300)
    gmm.fit(np.concatenate([piece + shift for shift in shifts]))
    for shift in shifts:
        k = np.abs(gmm.means_ - shift).sum(1).argmin()
        np.testing.assert_allclose(gmm.means_[k] - shift, piece.mean(0), atol=1e-8)
        expected = np.cov(piece.T, ddof=0) + 1e-8 * np.eye(2)
        np.testing.assert_allclose(gmm.covariances_[k], expected, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize(
    "matrix",
    [
        np.eye(4),
        np.eye(3)[:2],
        np.diag([2.0, 1.0, 1.0]),
        np.full((3, 3), np.nan),
        [[1, 0, np.nan], [0, 1, 0], [0, 0, 1]],
        np.diag([1.0, -1.0, 1.0]),
    ],
    ids=["3D", "2x3", "scaled", "nan", "nan translation", "mirror"],
)
def test_moved_rejects_a_matrix_that_is_not_rigid(matrix):
    with pytest.raises(InvalidArgumentError, match="transform"):
        fitted().moved(matrix)


# -- starts ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("init", SEEDED)
def test_n_init_keeps_the_best_start(init):
    x = blobs(300)
    options = {"init_params": init, "max_iter": 4, "dtype": "float64"}
    one_by_one = torch.Generator().manual_seed(5)
    each = [GaussianMixture(6, random_state=one_by_one, **options).fit(x) for _ in range(4)]
    bounds = [gmm.lower_bound_ for gmm in each]
    best = GaussianMixture(6, random_state=torch.Generator().manual_seed(5), n_init=4, **options).fit(x)
    assert len(set(bounds)) > 1
    assert best.lower_bound_ == max(bounds)
    assert (best.means_ == each[int(np.argmax(bounds))].means_).all()


def test_fits_without_a_seed_differ():
    x = blobs()
    fits = [GaussianMixture(5, init_params="random_points", max_iter=1).fit(x).means_ for _ in range(2)]
    assert not (fits[0] == fits[1]).all()


def test_em_starts_from_given_means():
    x = blobs()
    means = given_start(2)["means_init"]
    gmm = GaussianMixture(3, means_init=means, max_iter=1, random_state=0, dtype="float64").fit(x)
    k_means = GaussianMixture(3, max_iter=1, random_state=0, dtype="float64").fit(x)
    assert not np.allclose(gmm.means_, k_means.means_)
    both = GaussianMixture(
        3, means_init=torch.from_numpy(means), max_iter=1, random_state=0, dtype="float64"
    ).fit(x)
    assert (both.means_ == gmm.means_).all()


@pytest.mark.parametrize(
    ("n_components", "dim", "words"), [(5, 2, ("n_components",)), (3, 3, ("warm_start", "X"))]
)
def test_warm_start_with_another_shape_is_rejected_or_restarts(n_components, dim, words):
    gmm = GaussianMixture(3, warm_start=True, random_state=0).fit(blobs())
    gmm.set_params(n_components=n_components)
    try:
        gmm.fit(blobs(dim=dim))
    except InvalidArgumentError as error:
        assert any(word in str(error) for word in words)  # noqa: PT017 - either result is correct
    else:
        assert gmm.means_.shape == (n_components, dim)


# -- awkward clouds --------------------------------------------------------------------------------


def all_finite(gmm: GaussianMixture) -> bool:
    values = (gmm.weights_, gmm.means_, gmm.covariances_, gmm.lower_bound_)
    return all(bool(np.isfinite(v).all()) for v in values)


@pytest.mark.parametrize("init", INITS)
def test_more_components_than_distinct_points_share_weights(init):
    x = np.repeat([[0.0, 0.0], [1.0, 0.0], [0.0, 5.0]], [10, 20, 30], axis=0)
    gmm = GaussianMixture(7, init_params=init, random_state=0, max_iter=200, tol=1e-9).fit(x)
    assert all_finite(gmm)
    assert gmm.weights_.sum() == pytest.approx(1)
    # The optimum: a component of variance reg_covar at each place, with its share of the points.
    expected = np.log(np.array([1, 2, 3]) / 6) - math.log(2 * math.pi * 1e-6)
    if init != "bounding_box":  # from which two places may end in one component
        np.testing.assert_allclose(gmm.score_samples(x[[0, 10, 30]]), expected, atol=1e-4)


@pytest.mark.parametrize("init", INITS)
@pytest.mark.parametrize(("dim", "rank"), [(2, 0), (2, 1), (3, 1), (3, 2)])
def test_equal_collinear_and_coplanar_points_give_flat_components(init, dim, rank):
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(dim, dim)))[0]
    x = rng.normal(size=(200, rank)) @ basis[:rank] + 7.0
    gmm = GaussianMixture(2, init_params=init, random_state=0).fit(x)
    assert all_finite(gmm)
    smallest = np.linalg.eigvalsh(gmm.covariances_)[:, : dim - rank]
    np.testing.assert_allclose(smallest, 1e-6, rtol=1e-3)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("init_params", []),
        ("dtype", torch.float64),
        ("weights_init", np.ones(2)),
        ("weights_init", np.array([1.0, -1.0, 1.0])),
        ("weights_init", np.array([1.0, np.nan, 1.0])),
        ("weights_init", np.zeros(3)),
        ("means_init", np.zeros((3, 3))),
        ("means_init", np.full((3, 2), np.inf)),
        ("precisions_init", np.zeros((3, 2))),
    ],
)
def test_invalid_given_starts_are_named(name, value):
    with pytest.raises(InvalidArgumentError, match=name):
        GaussianMixture(**{"n_components": 3, name: value}).fit(blobs())


def test_indefinite_precisions_init_is_named():
    with pytest.raises(InvalidArgumentError, match=r"precisions_init\[1\]"):
        GaussianMixture(2, precisions_init=np.stack([np.eye(2), -np.eye(2)])).fit(blobs())


# -- samples ---------------------------------------------------------------------------------------


def test_samples_depend_on_the_seed():
    gmm = fitted()
    assert (gmm.sample(5)[0] == gmm.sample(5)[0]).all()
    assert (gmm.sample(5, random_state=3)[0] == gmm.sample(5, random_state=3)[0]).all()
    assert not (gmm.sample(5, random_state=3)[0] == gmm.sample(5, random_state=4)[0]).all()


# -- torch -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_scores_and_responsibilities_are_differentiable(dim):
    gmm = fitted(dim)
    x = torch.from_numpy(blobs(5, dim, seed=4)).requires_grad_()
    assert torch.autograd.gradcheck(gmm.score_samples, x)
    assert torch.autograd.gradcheck(gmm.predict_proba, x)


def test_mixture_works_as_a_module_of_a_network():
    network = torch.nn.Sequential(torch.nn.Linear(4, 2).double(), fitted())
    points = torch.zeros(5, 4, dtype=torch.float64)
    out = network(points)
    out.sum().backward()
    assert network[0].weight.grad is not None
    other = torch.nn.Sequential(torch.nn.Linear(4, 2).double(), GaussianMixture(3))
    other.load_state_dict(network.state_dict())
    assert torch.equal(other(points), out)


# -- scikit-learn's tools --------------------------------------------------------------------------


def test_mixture_works_in_pipelines_and_grid_search():
    x = blobs() * [100.0, 0.01]
    pipeline = make_pipeline(StandardScaler(), GaussianMixture(3, random_state=0, dtype="float64")).fit(x)
    direct = GaussianMixture(3, random_state=0, dtype="float64").fit(StandardScaler().fit_transform(x))
    assert pipeline.score(x) == pytest.approx(direct.score(StandardScaler().fit_transform(x)))
    search = GridSearchCV(GaussianMixture(random_state=0), {"n_components": [1, 3]}, cv=3).fit(blobs(600))
    assert search.best_params_ == {"n_components": 3}


# -- files -----------------------------------------------------------------------------------------


def test_far_float32_points_warn_and_float64_points_do_not():
    points = np.random.default_rng(0).normal(size=(200, 3))
    far = points + 5e5
    with pytest.warns(UserWarning, match=r"float32 and up to 5e\+05.*use float64"):
        GaussianMixture(2, random_state=0).fit(far.astype(np.float32))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        GaussianMixture(2, random_state=0, max_iter=500).fit(far)
        GaussianMixture(2, random_state=0, max_iter=500).fit(points.astype(np.float32))


@pytest.mark.parametrize("scale", [1e-30, 1e-9, 1e15, 1e39, 1e300])
def test_weights_that_lose_digits_are_rejected(scale):
    x = blobs()
    with pytest.raises(InvalidArgumentError, match=r"sample_weight has a mean of .* scale it"):
        GaussianMixture(3).fit(x, sample_weight=np.full(len(x), scale))


@pytest.mark.parametrize("scale", [1e-5, 1e11])
def test_weight_scale_does_not_change_the_fit(scale):
    x = blobs()
    start = given_start(2)
    plain = GaussianMixture(3, **start).fit(x)
    scaled = GaussianMixture(3, **start).fit(x, sample_weight=np.full(len(x), scale))
    np.testing.assert_allclose(scaled.means_, plain.means_, rtol=1e-6)
