"""Covariance types, and what else users of scikit-learn's classes and tools rely on."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import sklearn
import torch
from mixture.mixture_cases import blobs, given_start
from sklearn.datasets import load_iris
from sklearn.decomposition import PCA
from sklearn.metrics import adjusted_rand_score
from sklearn.model_selection import GridSearchCV, KFold, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils._param_validation import InvalidParameterError

from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.mixture import GaussianMixture, VariationalGaussianMixture
from gmmtorch.mixture.em.exact import COVARIANCE_TYPES, compact, constrain, type_shape

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
types = pytest.mark.parametrize("kind", COVARIANCE_TYPES)
estimators = pytest.mark.parametrize("estimator", [GaussianMixture, VariationalGaussianMixture])


def cloud(n: int = 300, seed: int = 0) -> np.ndarray:
    return blobs(n, 3, seed)


def start(kind: str) -> dict[str, Any]:
    """Initial parameters of the type."""
    given = given_start(3)
    precisions = compact(constrain(torch.from_numpy(given["precisions_init"]), kind), kind)
    return {**given, "covariance_type": kind, "precisions_init": precisions.numpy()}


# -- shapes and other operations ---------------------------------------------------------------------


@types
@estimators
def test_files_and_motions_keep_the_type(estimator, kind, tmp_path):
    x = cloud()
    found = estimator(2, covariance_type=kind, random_state=0).fit(x)
    found.save(tmp_path / "m.safetensors")
    loaded = estimator.load(tmp_path / "m.safetensors")
    assert loaded.covariance_type == kind
    assert np.array_equal(loaded.covariances_, found.covariances_)
    motion = np.eye(4)
    motion[:2, :2] = [[0.6, -0.8], [0.8, 0.6]]
    moved = loaded.moved(motion)
    assert moved.covariance_type == ("full" if kind == "diag" else kind)
    np.testing.assert_allclose(moved.score_samples(x @ motion[:3, :3].T), found.score_samples(x), atol=1e-9)
    moved.save(tmp_path / "moved.safetensors")
    assert estimator.load(tmp_path / "moved.safetensors").covariances_.shape == moved.covariances_.shape


@types
def test_given_parameters_have_the_shape_of_the_type_or_are_full(kind):
    fitted = GaussianMixture(2, covariance_type=kind, random_state=0).fit(cloud())
    arrays = fitted.weights_, fitted.means_
    for covariances in (fitted.covariances_, fitted.covariances.numpy()):
        same = GaussianMixture.from_parameters(*arrays, covariances, covariance_type=kind)
        assert torch.equal(same.covariances, fitted.covariances)
    other = np.array([[[2.0, 0.1, 0], [0.1, 1, 0], [0, 0, 1]], np.eye(3)])
    if kind != "full":
        with pytest.raises(InvalidArgumentError, match="covariance_type"):
            GaussianMixture.from_parameters(*arrays, other, covariance_type=kind)


@types
def test_batches_of_all_points_give_an_em_step(kind):
    x = cloud()
    once = GaussianMixture(3, max_iter=1, dtype="float64", **start(kind)).fit(x)
    batch = GaussianMixture(3, dtype="float64", **start(kind)).partial_fit(x)
    np.testing.assert_allclose(batch.covariances_, once.covariances_, rtol=1e-9)
    assert batch.partial_fit(cloud(seed=3)).covariances_.shape == type_shape(kind, 3, 3)


def test_truncated_em_rejects_other_types():
    with pytest.raises(InvalidArgumentError, match="truncated"):
        GaussianMixture(2, algorithm="truncated", covariance_type="diag").fit(cloud())


# -- iterations --------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{"algorithm": "truncated"}, {"max_cells": 200}, {"dtype": "float32"}])
def test_repeated_warm_starts_converge_with_any_algorithm(options):
    mixture = GaussianMixture(3, warm_start=True, max_iter=1, random_state=0, **options)
    assert any(mixture.fit(cloud()).converged_ for _ in range(100))


@types
def test_repeated_warm_starts_of_variational_bayes_converge_to_the_same_posterior(kind):
    x = cloud()
    options = {"covariance_type": kind, "random_state": 0, "dtype": "float64"}
    once = VariationalGaussianMixture(5, **options).fit(x)
    parts = VariationalGaussianMixture(5, warm_start=True, max_iter=1, **options)
    n_fits = next(i for i in range(1, 200) if parts.fit(x).converged_)
    assert n_fits == once.n_iter_
    np.testing.assert_allclose(parts.covariances_, once.covariances_, rtol=1e-7)
    assert np.diff(once.lower_bounds_).min() > -1e-9


@estimators
def test_max_iter_zero_returns_the_start_without_a_warning(estimator):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mixture = estimator(3, max_iter=0, n_init=2, random_state=0).fit(cloud())
    assert (mixture.n_iter_, mixture.lower_bounds_, mixture.lower_bound_) == (0, [], -math.inf)
    assert not mixture.converged_
    assert np.isfinite(mixture.score(cloud()))


@estimators
def test_verbose_prints_iterations(estimator, capsys):
    estimator(3, random_state=0, verbose=0).fit(cloud())
    assert capsys.readouterr().out == ""
    fitted = estimator(3, random_state=0, verbose=1, verbose_interval=2).fit(cloud())
    lines = capsys.readouterr().out.splitlines()
    steps = [f"  Iteration {i}" for i in range(2, fitted.n_iter_ + 1, 2)]
    assert lines == ["Initialization 0", *steps, "Initialization converged."]
    estimator(3, random_state=0, verbose=2, verbose_interval=1, max_iter=2, tol=1e-9).fit(cloud())
    assert "ll change" in (out := capsys.readouterr().out)
    assert "did not converge" in out


# -- errors, names and repr --------------------------------------------------------------------------


@estimators
@pytest.mark.parametrize(
    ("name", "value"), [("tol", -1), ("covariance_type", "round"), ("verbose_interval", 0), ("max_iter", -1)]
)
def test_invalid_parameters_raise_the_error_of_scikit_learn(estimator, name, value):
    with pytest.raises(
        InvalidParameterError, match=f"The '{name}' parameter of {estimator.__name__} must be"
    ) as e:
        estimator(**{name: value}).fit(cloud())
    assert isinstance(e.value, GmmTorchError)


class Table(np.ndarray):
    """An array with the names of its columns."""

    names: list[str]


def table(values: np.ndarray, *names: str) -> Table:
    found = values.view(Table)
    found.names = list(names)
    return found


def test_names_of_columns_are_stored_and_compared(tmp_path, monkeypatch):
    def names_of(X: object) -> np.ndarray | None:
        return np.array(X.names, dtype=object) if isinstance(X, Table) else None

    monkeypatch.setattr("sklearn.utils.validation._get_feature_names", names_of)
    x = cloud()
    mixture = GaussianMixture(2, random_state=0).fit(table(x, "east", "north", "up"))
    assert list(mixture.feature_names_in_) == ["east", "north", "up"]
    mixture.save(tmp_path / "m.safetensors")
    for same in (mixture, GaussianMixture.load(tmp_path / "m.safetensors"), mixture.moved(np.eye(4))):
        assert (
            same.predict(table(x, "east", "north", "up")) == mixture.predict(table(x, "east", "north", "up"))
        ).all()
        with pytest.raises(ValueError, match="feature names"):
            same.predict(table(x, "north", "east", "up"))
    same.load_state_dict(mixture.state_dict())
    assert not hasattr(same, "feature_names_in_")
    assert not hasattr(mixture.fit(torch.from_numpy(x)), "feature_names_in_")


def test_repr_is_one_line_with_the_changed_parameters():
    assert repr(GaussianMixture()) == "GaussianMixture()"
    mixture = GaussianMixture(3, covariance_type="diag", max_iter=7, means_init=np.zeros((3, 2)), tol=1e-5)
    assert repr(mixture) == (
        "GaussianMixture(covariance_type='diag', max_iter=7, means_init=<ndarray of shape (3, 2)>, "
        "n_components=3, tol=1e-05)"
    )
    assert "\n" not in repr(VariationalGaussianMixture(3, init_params="random", reg_covar=1e-4, verbose=1))


@pytest.mark.parametrize("init", ["random", "random_from_data", "k-means++"])
def test_initializations_of_scikit_learn(init):
    x = cloud()
    mixture = GaussianMixture(3, init_params=init, random_state=0, max_iter=0).fit(x)
    if init == "random":
        np.testing.assert_allclose(mixture.means_, np.tile(x.mean(0), (3, 1)), atol=0.5)
        np.testing.assert_allclose(mixture.weights_, 1 / 3, atol=0.05)
    else:
        assert all((np.abs(x - mean).max(1) < 1e-9).any() for mean in mixture.means_)
        np.testing.assert_allclose(mixture.covariances_, np.tile(1e-6 * np.eye(3), (3, 1, 1)))


# -- pipelines, searches, parallel jobs, the array API ------------------------------------------------

IRIS = load_iris()
FOLDS = KFold(3, shuffle=True, random_state=0)


@estimators
def test_search_in_parallel_jobs_chooses_by_the_score_of_the_pipeline(estimator):
    pipeline = make_pipeline(StandardScaler(), PCA(3), estimator(2, random_state=0))
    name = estimator.__name__.lower()
    grid = {f"{name}__covariance_type": ["full", "spherical"]}
    search = GridSearchCV(pipeline, grid, cv=FOLDS, n_jobs=2).fit(IRIS.data)
    for parameters, found in zip(
        search.cv_results_["params"], search.cv_results_["mean_test_score"], strict=True
    ):
        one = cross_val_score(pipeline.set_params(**parameters), IRIS.data, cv=FOLDS).mean()
        assert found == pytest.approx(one, rel=1e-6)
    assert search.best_params_[f"{name}__covariance_type"] == "full"
    assert search.score(IRIS.data) == search.best_estimator_.score(IRIS.data)


@estimators
def test_tables_of_a_pipeline_name_the_columns_of_the_mixture(estimator):
    pandas = pytest.importorskip("pandas")
    table = pandas.DataFrame(IRIS.data, columns=IRIS.feature_names)
    pipeline = make_pipeline(StandardScaler(), estimator(3, random_state=0)).set_output(transform="pandas")
    pipeline.fit(table)
    assert list(pipeline[-1].feature_names_in_) == IRIS.feature_names
    plain = make_pipeline(StandardScaler(), estimator(3, random_state=0)).fit(IRIS.data)
    np.testing.assert_array_equal(pipeline.predict(table), plain.predict(IRIS.data))


@estimators
def test_pipeline_of_tensors_gives_tensors(estimator, monkeypatch):
    monkeypatch.setenv("SCIPY_ARRAY_API", "1")
    x = torch.from_numpy(IRIS.data)
    with sklearn.config_context(array_api_dispatch=True):
        pipeline = make_pipeline(StandardScaler(), estimator(3, random_state=0)).fit(x)
        labels, shares = pipeline.predict(x), pipeline.predict_proba(x)
    assert isinstance(labels, torch.Tensor)
    assert isinstance(shares, torch.Tensor)
    assert isinstance(pipeline[-1].means_, torch.Tensor)
    plain = make_pipeline(StandardScaler(), estimator(3, random_state=0)).fit(IRIS.data)
    np.testing.assert_allclose(shares.numpy(), plain.predict_proba(IRIS.data), atol=1e-6)
    assert adjusted_rand_score(IRIS.target, labels.numpy()) > 0.5


@estimators
def test_sparse_tables_and_more_components_than_points_are_errors(estimator):
    with pytest.raises(InvalidArgumentError, match=r"^X is sparse, a csr_array; give X.toarray"):
        estimator(2).fit(scipy.sparse.csr_array(IRIS.data))
    with pytest.raises(InvalidArgumentError, match="n_components=151"):
        estimator(151).fit(IRIS.data)
