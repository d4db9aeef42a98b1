"""GaussianMixture: scikit-learn's results and manners, torch's tensors and gradients."""

from __future__ import annotations

import copy
import json
import math
import pickle
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn import mixture as sklearn_mixture
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from gmmtorch.errors import (
    DataError,
    GmmTorchError,
    InvalidArgumentError,
    MissingDataError,
    NumericalError,
)
from gmmtorch.files import pack_tensors
from gmmtorch.mixture import GaussianMixture
from gmmtorch.mixture.density import NotFittedError

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")

SEEDED = ["kmeans", "random_points", "bounding_box"]
INITS = [*SEEDED, "flat_pieces"]


def blobs(n: int = 400, dim: int = 2, seed: int = 0) -> np.ndarray:
    """Three overlapping clusters of different shapes."""
    rng = np.random.default_rng(seed)
    centers = np.array([[-2.0, 0.0, 1.0], [2.0, 1.0, -1.0], [0.5, -2.5, 0.0]])[:, :dim]
    shapes = rng.normal(size=(3, dim, dim)) * 0.5 + 0.5 * np.eye(dim)
    label = rng.integers(3, size=n)
    return centers[label] + np.einsum("nij,nj->ni", shapes[label], rng.normal(size=(n, dim)))


def given_start(dim: int, k: int = 3, seed: int = 1) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(k, dim, dim)) * 0.2
    weights = rng.random(k) + 0.5
    return {
        "weights_init": weights / weights.sum(),
        "means_init": rng.normal(size=(k, dim)) * 1.5,
        "precisions_init": np.eye(dim) + root @ root.transpose(0, 2, 1),
    }


def rigid_motion(dim: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(dim, dim)))[0]
    rotation[:, 0] *= np.sign(np.linalg.det(rotation))
    matrix = np.eye(dim + 1)
    matrix[:dim, :dim], matrix[:dim, dim] = rotation, rng.normal(size=dim) * 3
    return matrix


def fitted(dim: int = 2, **options) -> GaussianMixture:
    return GaussianMixture(3, random_state=0, **options).fit(blobs(dim=dim))


# -- against scikit-learn ---------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("options", [{}, {"tol": 1e-6, "max_iter": 300}, {"max_iter": 3}, {"reg_covar": 0.1}])
def test_the_same_start_gives_scikit_learns_result(dim, options):
    x, test = blobs(dim=dim), blobs(100, dim, seed=9)
    ours = GaussianMixture(3, **given_start(dim), dtype="float64", **options).fit(x)
    theirs = sklearn_mixture.GaussianMixture(3, **given_start(dim), **options).fit(x)
    assert ours.n_iter_ == theirs.n_iter_
    assert ours.converged_ == theirs.converged_
    assert ours.lower_bound_ == pytest.approx(theirs.lower_bound_, rel=1e-6)
    for name in ("weights_", "means_", "covariances_", "precisions_"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(ours.score_samples(test), theirs.score_samples(test), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(ours.predict_proba(test), theirs.predict_proba(test), atol=1e-6)
    assert (ours.predict(test) == theirs.predict(test)).all()
    for name in ("score", "bic", "aic"):
        assert getattr(ours, name)(test) == pytest.approx(getattr(theirs, name)(test), rel=1e-6)


@pytest.mark.parametrize("dim", [2, 3])
def test_in_float32_the_result_is_close(dim):
    x = blobs(dim=dim)
    ours = GaussianMixture(3, **given_start(dim), dtype="float32").fit(x)
    theirs = sklearn_mixture.GaussianMixture(3, **given_start(dim)).fit(x)
    assert ours.n_iter_ == theirs.n_iter_
    for name in ("weights_", "means_", "covariances_"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-4, atol=1e-4)
    assert ours.score(x) == pytest.approx(theirs.score(x), abs=1e-5)


def test_from_k_means_it_is_as_good_as_scikit_learn():
    x = blobs(600, 3)
    ours = GaussianMixture(3, random_state=0, n_init=3).fit(x)
    theirs = sklearn_mixture.GaussianMixture(3, random_state=0, n_init=3).fit(x)
    assert ours.score(x) == pytest.approx(theirs.score(x), abs=5e-3)


class DtypeRecorder(TorchDispatchMode):
    """Notes every floating dtype that goes into or comes out of an operation."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: dict[torch.dtype, set[str]] = {}

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        for leaf in tree_leaves((args, kwargs, result)):
            if isinstance(leaf, Tensor) and leaf.is_floating_point():
                self.seen.setdefault(leaf.dtype, set()).add(str(func))
        return result


@pytest.mark.parametrize("init", INITS)
@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_with_float64_no_float32_tensor_arises_anywhere(init, kind):
    x = kind(blobs(200))
    with DtypeRecorder() as recorder:
        gmm = GaussianMixture(3, random_state=0, dtype="float64", init_params=init, max_iter=5)
        gmm.fit(x, sample_weight=kind(np.linspace(0.5, 2, 200)))
        gmm.score_samples(x), gmm.predict_proba(x), gmm.predict(x), gmm.bic(x), gmm.sample(5)
        gmm.precisions_  # noqa: B018
    assert recorder.seen.keys() == {torch.float64}, recorder.seen


def test_the_recorder_does_see_float32():
    with DtypeRecorder() as recorder:
        GaussianMixture(2, random_state=0, dtype="float32").fit(blobs(100))
    assert torch.float32 in recorder.seen


# -- weights ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("init", INITS)
def test_a_whole_weight_is_a_point_repeated(init):
    x = blobs(150)
    weight = np.random.default_rng(0).integers(1, 4, 150)
    options = {"random_state": 3, "init_params": init, "dtype": "float64", "max_iter": 20}
    weighted = GaussianMixture(3, **options).fit(x, sample_weight=weight)
    repeated = GaussianMixture(3, **options).fit(np.repeat(x, weight, axis=0))
    np.testing.assert_allclose(weighted.means_, repeated.means_, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(weighted.covariances_, repeated.covariances_, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(weighted.lower_bounds_, repeated.lower_bounds_, rtol=1e-10)


@pytest.mark.parametrize("init", INITS)
def test_weight_zero_is_absence(init):
    x = blobs(150)
    weight = (np.random.default_rng(0).random(150) > 0.3).astype(float)
    polluted = np.where(weight[:, None] > 0, x, 1e3)
    options = {"random_state": 3, "init_params": init, "dtype": "float64", "max_iter": 20}
    weighted = GaussianMixture(3, **options).fit(polluted, sample_weight=weight)
    without = GaussianMixture(3, **options).fit(x[weight > 0])
    np.testing.assert_allclose(weighted.means_, without.means_, rtol=1e-10, atol=1e-10)
    assert weighted.lower_bound_ == pytest.approx(without.lower_bound_, rel=1e-10)


def test_only_the_ratios_of_the_weights_matter():
    x = blobs(150)
    weight = np.random.default_rng(0).random(150) + 0.1
    options = {**given_start(2), "dtype": "float64", "max_iter": 10}
    one = GaussianMixture(3, **options).fit(x, sample_weight=weight)
    other = GaussianMixture(3, **options).fit(x, sample_weight=1000 * weight)
    np.testing.assert_allclose(one.means_, other.means_, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "weight",
    [[1.0, -1.0, 1.0], [1.0, float("nan"), 1.0], [1.0, float("inf"), 1.0], [0.0] * 3, [1.0] * 2, [[1.0] * 3]],
)
@pytest.mark.parametrize("kind", [np.array, torch.tensor])
def test_bad_weights_are_named(weight, kind):
    with pytest.raises(InvalidArgumentError, match="sample_weight"):
        GaussianMixture().fit(blobs(3), sample_weight=kind(weight))


# -- kinds -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dtype", "expected"), [(np.float64, np.float64), (np.float32, np.float32), (int, np.float64)]
)
def test_arrays_in_arrays_out(dtype, expected):
    x = (10 * blobs()).astype(dtype)
    gmm = GaussianMixture(3, random_state=0).fit(x)
    assert all(
        isinstance(v, np.ndarray) for v in (gmm.weights_, gmm.means_, gmm.covariances_, gmm.precisions_)
    )
    assert gmm.score_samples(x).dtype == expected
    assert gmm.predict_proba(x).dtype == expected
    assert np.issubdtype(gmm.predict(x).dtype, np.integer)
    points, labels = gmm.sample(4)
    assert isinstance(points, np.ndarray)
    assert isinstance(labels, np.ndarray)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.float16])
def test_tensors_in_tensors_out(dtype):
    x = torch.from_numpy(blobs()).to(dtype)
    gmm = GaussianMixture(3, random_state=0).fit(x)
    assert all(isinstance(v, Tensor) for v in (gmm.weights_, gmm.means_, gmm.covariances_, gmm.precisions_))
    assert gmm.score_samples(x).dtype == dtype
    assert gmm.predict_proba(x).dtype == dtype
    assert gmm.predict(x).dtype == torch.int64
    assert all(isinstance(v, Tensor) for v in gmm.sample(4))


def test_queries_answer_in_their_own_kind_whatever_was_fitted():
    x = blobs()
    gmm = fitted()
    ours = gmm.score_samples(torch.from_numpy(x))
    assert isinstance(ours, Tensor)
    assert torch.equal(ours, torch.from_numpy(gmm.score_samples(x)))


def test_integer_tensors_are_taken():
    x = torch.from_numpy(10 * blobs()).long()
    gmm = GaussianMixture(2, random_state=0).fit(x)
    assert torch.equal(gmm.score_samples(x), gmm.score_samples(x.double()))


def test_lists_are_taken():
    assert fitted().score_samples([[0.0, 1.0]]).shape == (1,)


def test_points_with_a_gradient_can_be_fitted():
    x = torch.from_numpy(blobs())
    expected = GaussianMixture(3, random_state=0).fit(x)
    gmm = GaussianMixture(3, random_state=0).fit(x.clone().requires_grad_())
    assert torch.equal(gmm.means, expected.means)
    assert not gmm.means.requires_grad


def test_fitting_leaves_the_points_as_they_were():
    x = torch.from_numpy(blobs())
    before = x.clone()
    GaussianMixture(3, random_state=0).fit(x)
    assert torch.equal(x, before)


# -- frames ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_500_km_away_is_the_same_fit_moved(dim, dtype):
    x = np.round(blobs(dim=dim) * 2**20) / 2**20  # so that adding the offset rounds nothing
    offset = np.array([500_000.0, -4_000_000.0, 250.0])[:dim]
    near = GaussianMixture(3, random_state=0, dtype=dtype).fit(x)
    far = GaussianMixture(3, random_state=0, dtype=dtype).fit(x + offset)
    np.testing.assert_allclose(far.means_ - offset, near.means_, atol=1e-7)
    np.testing.assert_allclose(far.covariances_, near.covariances_, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(far.score_samples(x + offset), near.score_samples(x), atol=1e-6)
    assert far.n_iter_ == near.n_iter_


@pytest.mark.parametrize("init", INITS)
@pytest.mark.parametrize("length", [2.0, 0.05, 1e-3])
def test_thin_pieces_500_km_apart_are_learned_in_one_cloud(init, length):
    rng = np.random.default_rng(0)
    piece = np.stack([rng.normal(size=400) * 1e-3, rng.uniform(-length, length, 400)], 1)
    piece = np.round(piece * 2**24) / 2**24  # so that adding the offset rounds nothing
    shifts = np.array([[-250_000.0, 0.0], [250_000.0, 4096.0]])
    gmm = GaussianMixture(2, init_params=init, random_state=0, n_init=5, reg_covar=1e-8, max_iter=300)
    gmm.fit(np.concatenate([piece + shift for shift in shifts]))
    for shift in shifts:
        k = np.abs(gmm.means_ - shift).sum(1).argmin()
        np.testing.assert_allclose(gmm.means_[k] - shift, piece.mean(0), atol=1e-8)
        expected = np.cov(piece.T, ddof=0) + 1e-8 * np.eye(2)
        np.testing.assert_allclose(gmm.covariances_[k], expected, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_moving_commutes_with_fitting_and_scoring(dim):
    x, motion, start = blobs(dim=dim), rigid_motion(dim), given_start(dim)
    rotation, translation = motion[:dim, :dim], motion[:dim, dim]
    moved_start = {
        "weights_init": start["weights_init"],
        "means_init": start["means_init"] @ rotation.T + translation,
        "precisions_init": rotation @ start["precisions_init"] @ rotation.T,
    }
    moved_x = x @ rotation.T + translation
    one = GaussianMixture(3, **start, dtype="float64").fit(x).transform(motion)
    other = GaussianMixture(3, **moved_start, dtype="float64").fit(moved_x)
    np.testing.assert_allclose(one.means_, other.means_, atol=1e-9)
    np.testing.assert_allclose(one.covariances_, other.covariances_, atol=1e-9)
    np.testing.assert_allclose(
        one.score_samples(moved_x),
        GaussianMixture(3, **start, dtype="float64").fit(x).score_samples(x),
        atol=1e-9,
    )


def test_a_motion_leaves_the_original_where_it_was():
    gmm = fitted()
    before = gmm.means_.copy()
    moved = gmm.transform(rigid_motion(2))
    assert (gmm.means_ == before).all()
    assert moved.lower_bound_ == gmm.lower_bound_
    assert isinstance(moved.means_, np.ndarray)


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
def test_what_is_no_rigid_motion_is_refused(matrix):
    with pytest.raises(InvalidArgumentError, match="transform"):
        fitted().transform(matrix)


# -- starts ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("init", SEEDED)
def test_n_init_keeps_the_best_of_its_starts(init):
    x = blobs(300)
    options = {"init_params": init, "max_iter": 4, "dtype": "float64"}
    one_by_one = torch.Generator().manual_seed(5)
    each = [GaussianMixture(6, random_state=one_by_one, **options).fit(x) for _ in range(4)]
    bounds = [gmm.lower_bound_ for gmm in each]
    best = GaussianMixture(6, random_state=torch.Generator().manual_seed(5), n_init=4, **options).fit(x)
    assert len(set(bounds)) > 1
    assert best.lower_bound_ == max(bounds)
    assert (best.means_ == each[int(np.argmax(bounds))].means_).all()


@pytest.mark.parametrize("init", SEEDED)
def test_every_seeded_initialization_finds_the_clusters(init):
    x = np.concatenate([blobs(200) * 0.2 + c for c in ([-20, 0], [20, 0], [0, 30])])
    gmm = GaussianMixture(3, init_params=init, n_init=8, random_state=0, max_iter=200).fit(x)
    np.testing.assert_allclose(np.sort(gmm.weights_), [1 / 3] * 3, atol=1e-6)
    for part in np.split(x, 3):
        assert np.abs(gmm.means_ - part.mean(0)).sum(1).min() < 1e-6


@pytest.mark.parametrize("init", SEEDED)
def test_the_seed_decides_whatever_its_kind(init):
    x = blobs()
    options = {"init_params": init, "max_iter": 3}

    def fit(state) -> np.ndarray:
        return GaussianMixture(5, random_state=state, **options).fit(x).means_

    assert (fit(7) == fit(7)).all()
    assert (fit(7) == fit(np.int64(7))).all()
    assert (fit(7) == fit(torch.Generator().manual_seed(7))).all()
    assert (fit(np.random.RandomState(7)) == fit(np.random.RandomState(7))).all()
    assert not (fit(7) == fit(8)).all()
    assert not (fit(np.random.RandomState(7)) == fit(np.random.RandomState(8))).all()


@pytest.mark.parametrize("state", [-1, 1.5, "seed", 2**64])
def test_bad_seeds_are_named(state):
    with pytest.raises(InvalidArgumentError, match="random_state"):
        GaussianMixture(random_state=state).fit(blobs())


def test_without_a_seed_fits_differ():
    x = blobs()
    fits = [GaussianMixture(5, init_params="random_points", max_iter=1).fit(x).means_ for _ in range(2)]
    assert not (fits[0] == fits[1]).all()


def test_given_means_alone_are_where_em_begins():
    x = blobs()
    means = given_start(2)["means_init"]
    gmm = GaussianMixture(3, means_init=means, max_iter=1, random_state=0, dtype="float64").fit(x)
    k_means = GaussianMixture(3, max_iter=1, random_state=0, dtype="float64").fit(x)
    assert not np.allclose(gmm.means_, k_means.means_)
    both = GaussianMixture(
        3, means_init=torch.from_numpy(means), max_iter=1, random_state=0, dtype="float64"
    ).fit(x)
    assert (both.means_ == gmm.means_).all()


def test_warm_start_goes_on_where_the_last_fit_stopped():
    x = blobs()
    options = {**given_start(2), "tol": 0.0, "dtype": "float64"}
    straight = GaussianMixture(3, max_iter=10, **options).fit(x)
    halves = GaussianMixture(3, max_iter=5, warm_start=True, **options).fit(x).fit(x)
    np.testing.assert_allclose(halves.means_, straight.means_, rtol=1e-9, atol=1e-9)
    again = GaussianMixture(3, max_iter=5, **options).fit(x).fit(x)
    assert not np.allclose(again.means_, straight.means_, atol=1e-6)


def test_warm_start_with_another_number_of_components_is_no_silent_mix_up():
    gmm = GaussianMixture(3, warm_start=True, random_state=0).fit(blobs())
    gmm.set_params(n_components=5)
    try:
        gmm.fit(blobs())
    except InvalidArgumentError as error:
        assert "n_components" in str(error)  # noqa: PT017 - either answer is right
    else:
        assert gmm.means_.shape == (5, 2)


def test_warm_start_in_another_dimension_is_no_silent_mix_up():
    gmm = GaussianMixture(3, warm_start=True, random_state=0).fit(blobs())
    try:
        gmm.fit(blobs(dim=3))
    except InvalidArgumentError as error:
        assert "warm_start" in str(error) or "X" in str(error)  # noqa: PT017 - either answer is right
    else:
        assert gmm.means_.shape == (3, 3)


def test_progress_is_reported():
    seen: list[tuple[int, float]] = []
    gmm = GaussianMixture(3, random_state=0).fit(
        blobs(), on_iteration=lambda i, bound: seen.append((i, bound))
    )
    assert seen == list(enumerate(gmm.lower_bounds_, 1))
    assert gmm.n_iter_ == len(seen)
    assert gmm.lower_bound_ == seen[-1][1]


@pytest.mark.filterwarnings("default::sklearn.exceptions.ConvergenceWarning")
def test_not_converging_warns_with_a_remedy_and_tol_zero_does_not():
    with pytest.warns(ConvergenceWarning, match="max_iter=2"):
        GaussianMixture(3, random_state=0, max_iter=2, tol=1e-9).fit(blobs())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        GaussianMixture(3, random_state=0, max_iter=2, tol=0).fit(blobs())


# -- awkward clouds -----------------------------------------------------------------------------------


def all_finite(gmm: GaussianMixture) -> bool:
    values = (gmm.weights_, gmm.means_, gmm.covariances_, gmm.lower_bound_)
    return all(bool(np.isfinite(v).all()) for v in values)


def test_more_components_than_points_is_refused_by_name():
    with pytest.raises(InvalidArgumentError, match=r"n_components=5.*n_samples=4"):
        GaussianMixture(5).fit(blobs(4))
    with pytest.raises(InvalidArgumentError, match=r"n_components=3.*n_samples=2"):
        GaussianMixture(3).fit(blobs(4), sample_weight=np.array([1, 0, 0, 1]))


@pytest.mark.parametrize("init", INITS)
def test_as_many_components_as_points_works(init):
    gmm = GaussianMixture(6, init_params=init, random_state=0).fit(blobs(6))
    assert all_finite(gmm)


@pytest.mark.parametrize("init", INITS)
def test_more_components_than_distinct_points_share_the_weight(init):
    x = np.repeat([[0.0, 0.0], [1.0, 0.0], [0.0, 5.0]], [10, 20, 30], axis=0)
    gmm = GaussianMixture(7, init_params=init, random_state=0, max_iter=200, tol=1e-9).fit(x)
    assert all_finite(gmm)
    assert gmm.weights_.sum() == pytest.approx(1)
    # The best density there is: each place a spike of variance reg_covar, and its share of the points.
    expected = np.log(np.array([1, 2, 3]) / 6) - math.log(2 * math.pi * 1e-6)
    if init != "bounding_box":  # whose starts may leave a place to share a component with another
        np.testing.assert_allclose(gmm.score_samples(x[[0, 10, 30]]), expected, atol=1e-4)


@pytest.mark.parametrize("init", INITS)
def test_one_point_is_a_component_of_the_least_variance(init):
    gmm = GaussianMixture(1, init_params=init, random_state=0, reg_covar=1e-4).fit([[3.0, -2.0, 5.0]])
    np.testing.assert_allclose(gmm.means_, [[3.0, -2.0, 5.0]], rtol=1e-12)
    np.testing.assert_allclose(gmm.covariances_[0], 1e-4 * np.eye(3), rtol=1e-9)
    assert gmm.weights_.tolist() == [1.0]


@pytest.mark.parametrize("init", INITS)
def test_equal_points_are_a_component_of_the_least_variance(init):
    gmm = GaussianMixture(2, init_params=init, random_state=0).fit(np.full((50, 2), 0.1))
    assert all_finite(gmm)
    np.testing.assert_allclose(
        gmm.covariances_, np.broadcast_to(1e-6 * np.eye(2), (2, 2, 2)), rtol=1e-6, atol=1e-15
    )


@pytest.mark.parametrize("init", INITS)
@pytest.mark.parametrize(("dim", "rank"), [(2, 1), (3, 1), (3, 2)])
def test_collinear_and_coplanar_points_are_flat_components(init, dim, rank):
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(dim, dim)))[0]
    x = rng.normal(size=(200, rank)) @ basis[:rank] + 7.0
    gmm = GaussianMixture(2, init_params=init, random_state=0).fit(x)
    assert all_finite(gmm)
    smallest = np.linalg.eigvalsh(gmm.covariances_)[:, : dim - rank]
    np.testing.assert_allclose(smallest, 1e-6, rtol=1e-3)


def test_a_collapse_without_regularization_says_what_to_do():
    with pytest.raises(NumericalError, match="reg_covar"):
        GaussianMixture(1, reg_covar=0, random_state=0).fit(np.zeros((5, 2)))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_rows_that_are_not_finite_are_refused(value, kind):
    x = blobs(20)
    x[7, 1] = value
    with pytest.raises(ValueError, match=r"X\[7\]|Input X contains"):
        GaussianMixture().fit(kind(x))
    with pytest.raises(ValueError, match=r"X\[7\]|Input X contains"):
        fitted().score_samples(kind(x))


@pytest.mark.parametrize("shape", [(0, 2), (5, 0), (5,), (2, 2, 2), ()])
@pytest.mark.parametrize("kind", [np.zeros, torch.zeros])
def test_what_is_not_a_table_of_points_is_refused(shape, kind):
    with pytest.raises(ValueError, match=r"X|shape|array|sample|feature|dimension"):
        GaussianMixture().fit(kind(shape))


@pytest.mark.parametrize("kind", [np.zeros, torch.zeros])
def test_queries_of_another_dimension_are_refused(kind):
    with pytest.raises(ValueError, match="X has 3 features, but GaussianMixture is expecting 2"):
        fitted().score_samples(kind((4, 3)))


def test_complex_points_are_refused():
    with pytest.raises(InvalidArgumentError, match="complex"):
        GaussianMixture().fit(torch.zeros(4, 2, dtype=torch.complex64))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("n_components", v) for v in (0, -1, 1.5, "3")),
        *(("tol", v) for v in (-1e-3, float("nan"), float("inf"), "x")),
        *(("reg_covar", v) for v in (-1e-6, float("nan"), None)),
        *(("max_iter", v) for v in (0, 2.5)),
        *(("n_init", v) for v in (0, None)),
        ("init_params", "magic"),
        ("init_params", None),
        ("init_params", []),
        ("dtype", "float16"),
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
def test_bad_parameters_are_named_with_their_value(name, value):
    with pytest.raises(InvalidArgumentError, match=name):
        GaussianMixture(**{"n_components": 3, name: value}).fit(blobs())


def test_indefinite_given_precisions_are_named():
    with pytest.raises(NumericalError, match=r"precisions_init\[1\]"):
        GaussianMixture(2, precisions_init=np.stack([np.eye(2), -np.eye(2)])).fit(blobs())


@pytest.mark.parametrize(
    "ask",
    [
        lambda g: g.score_samples(blobs()),
        lambda g: g.predict(blobs()),
        lambda g: g.predict_proba(torch.zeros(1, 2)),
        lambda g: g.bic(blobs()),
        lambda g: g.sample(),
        lambda g: g.save("never"),
    ],
)
def test_before_fitting_every_question_says_so(ask):
    with pytest.raises(NotFittedError, match="fit"):
        ask(GaussianMixture())


@pytest.mark.parametrize(
    "name", ["means_", "weights_", "covariances_", "precisions_", "lower_bound_", "n_iter_"]
)
def test_before_fitting_there_are_no_fitted_attributes(name):
    assert not hasattr(GaussianMixture(), name)
    assert hasattr(fitted(), name)


# -- samples -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_samples_have_the_moments_of_their_components(dim):
    gmm = fitted(dim)
    n = 100_000
    points, labels = gmm.sample(n, random_state=1)
    assert (np.diff(labels) >= 0).all()
    np.testing.assert_allclose(np.bincount(labels) / n, gmm.weights_, atol=5 / math.sqrt(n))
    for k in range(3):
        own = points[labels == k]
        scale = np.sqrt(np.diagonal(gmm.covariances_[k]))
        error = np.abs(own.mean(0) - gmm.means_[k]) / scale * math.sqrt(len(own))
        assert error.max() < 5  # standard errors
        spread = (np.cov(own.T) - gmm.covariances_[k]) / np.outer(scale, scale) * math.sqrt(len(own))
        assert np.abs(spread).max() < 8


def test_samples_follow_the_seed():
    gmm = fitted()
    assert (gmm.sample(5)[0] == gmm.sample(5)[0]).all()
    assert (gmm.sample(5, random_state=3)[0] == gmm.sample(5, random_state=3)[0]).all()
    assert not (gmm.sample(5, random_state=3)[0] == gmm.sample(5, random_state=4)[0]).all()


@pytest.mark.parametrize("n", [0, -3])
def test_no_samples_is_refused(n):
    with pytest.raises(InvalidArgumentError, match="n_samples"):
        fitted().sample(n)


# -- torch -----------------------------------------------------------------------------------------


def test_calling_the_module_scores():
    gmm = fitted()
    x = torch.from_numpy(blobs())
    assert torch.equal(gmm(x), gmm.score_samples(x))


@pytest.mark.parametrize("dim", [2, 3])
def test_scores_and_responsibilities_are_differentiable_in_the_points(dim):
    gmm = fitted(dim)
    x = torch.from_numpy(blobs(5, dim, seed=4)).requires_grad_()
    assert torch.autograd.gradcheck(gmm.score_samples, x)
    assert torch.autograd.gradcheck(gmm.predict_proba, x)


def test_scores_are_differentiable_far_out_too():
    gmm = GaussianMixture(2, random_state=0).fit(np.concatenate([blobs(50), blobs(50) + 5e5]))
    x = torch.from_numpy(blobs(3)).requires_grad_()
    assert torch.autograd.gradcheck(gmm.score_samples, x)


def test_the_state_is_the_parameters_and_can_be_restored():
    gmm, other = fitted(), GaussianMixture(3, random_state=1, max_iter=1).fit(blobs(seed=5))
    assert set(gmm.state_dict()) == {"weights", "means", "covariances"}
    assert list(gmm.parameters()) == []
    other.load_state_dict(gmm.state_dict())
    assert (other.score_samples(blobs()) == gmm.score_samples(blobs())).all()


def test_as_part_of_a_network_it_moves_and_saves_with_it():
    network = torch.nn.Sequential(torch.nn.Linear(4, 2).double(), fitted())
    out = network(torch.zeros(5, 4, dtype=torch.float64))
    out.sum().backward()
    assert network[0].weight.grad is not None
    assert "1.means" in network.state_dict()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_a_cast_of_the_module_leaves_it_working(dtype):
    gmm = fitted()
    expected = gmm.score_samples(blobs())
    gmm.to(dtype)
    np.testing.assert_allclose(gmm.score_samples(blobs()), expected, rtol=2e-2, atol=2e-2)
    assert gmm.sample(3)[0].shape == (3, 2)


def test_moving_to_the_same_device_changes_nothing():
    gmm = fitted()
    expected = gmm.score_samples(blobs())
    assert gmm.to("cpu") is gmm
    assert (gmm.score_samples(blobs()) == expected).all()


# -- scikit-learn's tools ---------------------------------------------------------------------------


@pytest.mark.parametrize("state", [None, 3, np.random.RandomState(3), torch.Generator().manual_seed(3)])
def test_a_clone_is_unfitted_and_has_the_same_parameters(state):
    gmm = GaussianMixture(4, random_state=state, means_init=np.zeros((4, 2)), tol=0.5).fit(blobs())
    other = clone(gmm)
    assert not hasattr(other, "weights")
    assert (other.n_components, other.tol) == (4, 0.5)
    assert (other.means_init == 0).all()
    other.set_params(means_init=None).fit(blobs())


def test_pipelines_and_searches_take_it():
    x = blobs() * [100.0, 0.01]
    pipeline = make_pipeline(StandardScaler(), GaussianMixture(3, random_state=0, dtype="float64")).fit(x)
    direct = GaussianMixture(3, random_state=0, dtype="float64").fit(StandardScaler().fit_transform(x))
    assert pipeline.score(x) == pytest.approx(direct.score(StandardScaler().fit_transform(x)))
    search = GridSearchCV(GaussianMixture(random_state=0), {"n_components": [1, 3]}, cv=3).fit(blobs(600))
    assert search.best_params_ == {"n_components": 3}


@pytest.mark.parametrize("copier", [lambda g: pickle.loads(pickle.dumps(g)), copy.deepcopy])
def test_copies_answer_the_same(copier):
    gmm = fitted()
    other = copier(gmm)
    assert other is not gmm
    assert (other.score_samples(blobs()) == gmm.score_samples(blobs())).all()
    assert other.get_params().keys() == gmm.get_params().keys()
    unfitted = copier(GaussianMixture(4))
    assert unfitted.n_components == 4
    assert not hasattr(unfitted, "means_")


def test_it_prints_its_parameters():
    assert "n_components=3" in repr(GaussianMixture(3))
    assert "n_components=3" in repr(fitted())


# -- given parameters -------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_a_mixture_of_given_parameters_is_a_fitted_one(kind, tmp_path):
    gmm = fitted()
    parts = (kind(p.copy()) for p in (gmm.weights_, gmm.means_, gmm.covariances_))
    other = GaussianMixture.from_parameters(*parts, tol=0.5, lower_bounds=[-3.0, -2.0], converged=False)
    assert (other.n_components, other.tol, other.n_iter_, other.lower_bound_, other.converged_) == (
        3,
        0.5,
        2,
        -2.0,
        False,
    )
    assert (other.score_samples(blobs()) == gmm.score_samples(blobs())).all()
    assert isinstance(other.means_, Tensor) == (kind is torch.from_numpy)
    other.save(tmp_path / "m.safetensors")
    assert torch.equal(GaussianMixture.load(tmp_path / "m.safetensors").means, gmm.means)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("weights", [0.5, 0.6]),
        ("weights", [1.5, -0.5]),
        ("weights", [1.0]),
        ("means", [[0.0, 0.0], [np.nan, 0.0]]),
        ("means", [0.0, 1.0]),
        ("covariances", np.eye(2)),
        ("covariances", np.stack([np.eye(2), -np.eye(2)])),
    ],
)
def test_given_parameters_that_are_no_mixture_are_refused(name, value):
    sound = {"weights": [0.5, 0.5], "means": np.zeros((2, 2)), "covariances": np.stack([np.eye(2)] * 2)}
    GaussianMixture.from_parameters(**{k: np.asarray(v) for k, v in sound.items()})
    with pytest.raises(GmmTorchError, match=name):
        GaussianMixture.from_parameters(**{k: np.asarray(v) for k, v in {**sound, name: value}.items()})


# -- files -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_what_is_loaded_is_what_was_saved(tmp_path, kind):
    x = kind(blobs())
    gmm = GaussianMixture(3, random_state=0, tol=1e-4, dtype="float64").fit(x)
    gmm.save(tmp_path / "m.safetensors")
    other = GaussianMixture.load(tmp_path / "m.safetensors")
    for name in ("weights", "means", "covariances"):
        assert torch.equal(getattr(other, name), getattr(gmm, name))
    for name in ("lower_bounds_", "lower_bound_", "n_iter_", "converged_", "n_features_in_"):
        assert getattr(other, name) == getattr(gmm, name)
    assert other.get_params() == gmm.get_params()
    assert type(other.means_) is type(gmm.means_)
    assert (other.score_samples(x) == gmm.score_samples(x)).all()
    assert (other.sample(3)[0] == gmm.sample(3)[0]).all()


def test_parameters_that_json_lacks_do_not_prevent_saving(tmp_path):
    start = {name: torch.from_numpy(value) for name, value in given_start(2).items()}
    gmm = GaussianMixture(
        3, **start, random_state=torch.Generator().manual_seed(0), tol=np.float32(0.01)
    ).fit(blobs())
    gmm.save(tmp_path / "m.safetensors")
    assert torch.equal(GaussianMixture.load(tmp_path / "m.safetensors").means, gmm.means)


def sound_parts() -> tuple[dict[str, Tensor], dict]:
    gmm = fitted()
    tensors = {name: getattr(gmm, name).clone() for name in ("weights", "means", "covariances")}
    facts = {"lower_bounds": [-1.0], "converged": True, "arrays": True, "parameters": {"n_components": 3}}
    return tensors, facts


def write_parts(folder: Path, tensors: dict[str, Tensor], facts: dict) -> Path:
    path = folder / "m.safetensors"
    path.write_bytes(pack_tensors(tensors, "gmmtorch.mixture", 1, **facts))
    return path


def test_the_parts_that_the_hostile_files_start_from_are_sound(tmp_path):
    assert GaussianMixture.load(write_parts(tmp_path, *sound_parts())).n_components == 3


@pytest.mark.parametrize(
    "change",
    [
        {"weights": torch.tensor([0.5, 0.6, -0.1], dtype=torch.float64)},
        {"weights": torch.ones(3, dtype=torch.float64)},
        {"weights": torch.ones(2, dtype=torch.float64) / 2},
        {"weights": torch.ones(3) / 3},
        {"weights": torch.full((3,), float("nan"), dtype=torch.float64)},
        {"means": torch.zeros(3, dtype=torch.float64)},
        {"means": torch.zeros(0, 2, dtype=torch.float64)},
        {"means": torch.zeros(3, 0, dtype=torch.float64)},
        {"means": torch.full((3, 2), float("inf"), dtype=torch.float64)},
        {"means": None},
        {"covariances": torch.zeros(3, 2, dtype=torch.float64)},
        {"covariances": -torch.eye(2, dtype=torch.float64).repeat(3, 1, 1)},
        {"covariances": torch.tensor([[1.0, 0.9], [-0.9, 1.0]], dtype=torch.float64).repeat(3, 1, 1)},
    ],
    ids=lambda c: next(iter(c)),
)
def test_a_file_whose_numbers_are_no_mixture_is_refused(tmp_path, change):
    tensors, facts = sound_parts()
    tensors = {k: v for k, v in {**tensors, **change}.items() if v is not None}
    with pytest.raises(DataError, match=r"m\.safetensors"):
        GaussianMixture.load(write_parts(tmp_path, tensors, facts))


@pytest.mark.parametrize(
    "change",
    [
        {"lower_bounds": "text"},
        {"lower_bounds": None},
        {"parameters": 7},
        {"parameters": "text"},
        {"arrays": None, "parameters": None},
    ],
)
def test_a_file_whose_facts_are_damaged_is_refused(tmp_path, change):
    tensors, facts = sound_parts()
    with pytest.raises(DataError, match=r"m\.safetensors"):
        GaussianMixture.load(write_parts(tmp_path, tensors, {**facts, **change}))


@pytest.mark.parametrize("name", ["lower_bounds", "converged", "arrays", "parameters"])
def test_a_file_that_lacks_a_fact_is_refused(tmp_path, name):
    tensors, facts = sound_parts()
    facts.pop(name)
    with pytest.raises(DataError, match=name):
        GaussianMixture.load(write_parts(tmp_path, tensors, facts))


def test_parameters_of_a_later_version_are_passed_over(tmp_path):
    tensors, facts = sound_parts()
    facts["parameters"] = {"n_components": 3, "unheard_of": 1, "tol": 0.5}
    assert GaussianMixture.load(write_parts(tmp_path, tensors, facts)).tol == 0.5


def test_a_missing_or_foreign_file_is_named(tmp_path):
    with pytest.raises(MissingDataError, match=r"gmmtorch\.mixture"):
        GaussianMixture.load(tmp_path / "none.safetensors")
    path = tmp_path / "x.safetensors"
    path.write_bytes(pack_tensors({}, "gmmtorch.map", 1))
    with pytest.raises(DataError, match=r"gmmtorch\.map"):
        GaussianMixture.load(path)


@pytest.fixture(scope="module")
def sound_bytes(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("sound") / "m.safetensors"
    fitted().save(path)
    return path.read_bytes()


def test_a_file_cut_anywhere_is_refused(tmp_path, sound_bytes):
    path = tmp_path / "m.safetensors"
    for length in range(0, len(sound_bytes), 7):
        path.write_bytes(sound_bytes[:length])
        with pytest.raises(DataError):
            GaussianMixture.load(path)


@settings(max_examples=150)
@given(place=st.integers(0, 10**6), value=st.integers(0, 255))
def test_a_damaged_file_is_refused_or_is_a_mixture(tmp_path, sound_bytes, place, value):
    data = bytearray(sound_bytes)
    data[place % len(data)] = value
    path = tmp_path / "m.safetensors"
    path.write_bytes(data)
    try:
        gmm = GaussianMixture.load(path)
    except GmmTorchError:
        return
    assert bool(torch.isfinite(torch.as_tensor(gmm.score_samples(torch.zeros(2, 2)))).all())
    json.dumps(gmm.get_params(), default=str)


def test_float32_points_far_out_warn_and_float64_ones_do_not():
    points = np.random.default_rng(0).normal(size=(200, 3))
    far = points + 5e5
    with pytest.warns(UserWarning, match=r"float32 and up to 5e\+05.*use float64"):
        GaussianMixture(2, random_state=0).fit(far.astype(np.float32))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        GaussianMixture(2, random_state=0, max_iter=500).fit(far)
        GaussianMixture(2, random_state=0, max_iter=500).fit(points.astype(np.float32))


def test_a_state_dict_restores_into_a_fresh_mixture():
    points = torch.from_numpy(np.random.default_rng(0).normal(size=(200, 3)))
    fitted = GaussianMixture(3, random_state=0).fit(points)
    network = torch.nn.ModuleDict({"map": GaussianMixture(3)})
    network.load_state_dict(torch.nn.ModuleDict({"map": fitted}).state_dict())
    assert torch.equal(network["map"].score_samples(points), fitted.score_samples(points))


def test_how_many_points_a_given_mixture_stands_for_is_not_known():
    gmm = fitted()
    given_one = GaussianMixture.from_parameters(gmm.weights_, gmm.means_, gmm.covariances_)
    assert given_one.n_samples_seen_ is None
    assert gmm.n_samples_seen_ == 400


@pytest.mark.parametrize("scale", [1e-30, 1e-9, 1e15, 1e39, 1e300])
def test_weights_that_would_lose_digits_are_refused(scale):
    x = blobs()
    with pytest.raises(InvalidArgumentError, match=r"sample_weight has a mean of .* scale it"):
        GaussianMixture(3).fit(x, sample_weight=np.full(len(x), scale))


@pytest.mark.parametrize("scale", [1e-5, 1e11])
def test_large_and_small_weights_that_do_not_are_as_good_as_ones(scale):
    x = blobs()
    start = given_start(2)
    plain = GaussianMixture(3, **start).fit(x)
    scaled = GaussianMixture(3, **start).fit(x, sample_weight=np.full(len(x), scale))
    np.testing.assert_allclose(scaled.means_, plain.means_, rtol=1e-6)
