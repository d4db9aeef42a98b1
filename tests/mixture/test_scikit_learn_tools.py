"""Mixtures within scikit-learn's tools: pipelines, searches, parallel jobs, outputs, the array API."""

from __future__ import annotations

import joblib
import numpy as np
import pytest
import scipy.sparse
import sklearn
import torch
from sklearn.datasets import load_iris
from sklearn.decomposition import PCA
from sklearn.metrics import adjusted_rand_score
from sklearn.model_selection import GridSearchCV, KFold, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mixture import GaussianMixture, VariationalGaussianMixture

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
IRIS = load_iris()
FOLDS = KFold(3, shuffle=True, random_state=0)
both = pytest.mark.parametrize("made", [GaussianMixture, VariationalGaussianMixture])


@both
def test_search_in_parallel_jobs_chooses_by_the_score_of_the_pipeline(made):
    pipeline = make_pipeline(StandardScaler(), PCA(3), made(2, random_state=0))
    name = made.__name__.lower()
    grid = {f"{name}__n_components": [1, 3], f"{name}__covariance_type": ["full", "spherical"]}
    search = GridSearchCV(pipeline, grid, cv=FOLDS, n_jobs=2).fit(IRIS.data)
    for parameters, found in zip(
        search.cv_results_["params"], search.cv_results_["mean_test_score"], strict=True
    ):
        one = cross_val_score(pipeline.set_params(**parameters), IRIS.data, cv=FOLDS).mean()
        assert found == pytest.approx(one, rel=1e-6)
    assert search.best_params_[f"{name}__covariance_type"] == "full"
    assert search.score(IRIS.data) == search.best_estimator_.score(IRIS.data)


def test_jobs_of_joblib_give_the_fit_of_this_process():
    jobs = [joblib.delayed(GaussianMixture(3, random_state=seed).fit)(IRIS.data) for seed in range(2)]
    for seed, found in enumerate(joblib.Parallel(2)(jobs)):
        expected = GaussianMixture(3, random_state=seed).fit(IRIS.data)
        np.testing.assert_allclose(found.means_, expected.means_, rtol=1e-9)


@both
def test_tables_of_a_pipeline_name_the_columns_of_the_mixture(made):
    pandas = pytest.importorskip("pandas")
    table = pandas.DataFrame(IRIS.data, columns=IRIS.feature_names)
    pipeline = make_pipeline(StandardScaler(), made(3, random_state=0)).set_output(transform="pandas")
    pipeline.fit(table)
    assert list(pipeline[-1].feature_names_in_) == IRIS.feature_names
    plain = make_pipeline(StandardScaler(), made(3, random_state=0)).fit(IRIS.data)
    np.testing.assert_array_equal(pipeline.predict(table), plain.predict(IRIS.data))


@both
def test_pipeline_of_tensors_gives_tensors(made, monkeypatch):
    monkeypatch.setenv("SCIPY_ARRAY_API", "1")
    x = torch.from_numpy(IRIS.data)
    with sklearn.config_context(array_api_dispatch=True):
        pipeline = make_pipeline(StandardScaler(), made(3, random_state=0)).fit(x)
        labels, shares = pipeline.predict(x), pipeline.predict_proba(x)
    assert isinstance(labels, torch.Tensor)
    assert isinstance(shares, torch.Tensor)
    assert isinstance(pipeline[-1].means_, torch.Tensor)
    plain = make_pipeline(StandardScaler(), made(3, random_state=0)).fit(IRIS.data)
    np.testing.assert_allclose(shares.numpy(), plain.predict_proba(IRIS.data), atol=1e-6)
    assert adjusted_rand_score(IRIS.target, labels.numpy()) > 0.5


@both
def test_sparse_tables_and_more_components_than_points_are_errors(made):
    with pytest.raises(TypeError, match=r"[Ss]parse"):
        made(2).fit(scipy.sparse.csr_array(IRIS.data))
    with pytest.raises(InvalidArgumentError, match="n_components=151"):
        made(151).fit(IRIS.data)
