"""`GaussianMixture` and `VariationalGaussianMixture` pass `estimator_contract`."""

from __future__ import annotations

import importlib.util
import inspect
import math
import subprocess
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import pytest
from mixture.estimator_contract import MixtureContract
from mixture.fit_contract import FitContract
from sklearn.utils.estimator_checks import estimator_checks_generator

from gmmtorch.mixture import GaussianMixture, VariationalGaussianMixture


class TestGaussianMixture(MixtureContract):
    bad_parameters: ClassVar[dict[str, tuple[Any, ...]]] = {
        "algorithm": ("fast",),
        "max_cells": (0, 2.5, "many"),
    }

    def make(self, n_components: int = 3, **options: Any) -> GaussianMixture:
        return GaussianMixture(n_components, **{"random_state": 0, **options})


class TestVariationalGaussianMixture(MixtureContract):
    score_tolerance = 1.2  # because the default prior is as wide as the cloud
    bad_parameters: ClassVar[dict[str, tuple[Any, ...]]] = {
        "weight_concentration_prior_type": ("dirichlet", None),
        "weight_concentration_prior": (0, -1.0, math.inf, "small"),
        "mean_precision_prior": (0, math.nan),
        "degrees_of_freedom_prior": (0, 1.0, "many"),
        "mean_prior": ([0.0], [0.0, math.nan], [[0.0, 0.0]]),
        "covariance_prior": ([[1.0]], [[1.0, 0.5], [0.2, 1.0]], [[math.inf, 0.0], [0.0, 1.0]]),
    }

    def make(self, n_components: int = 3, **options: Any) -> VariationalGaussianMixture:
        return VariationalGaussianMixture(n_components, **{"random_state": 0, **options})


class TestVariationalGaussianMixtureWithDirichletWeights(FitContract):
    score_tolerance = 1.2

    def make(self, n_components: int = 3, **options: Any) -> VariationalGaussianMixture:
        kind = {"weight_concentration_prior_type": "dirichlet_distribution"}
        return VariationalGaussianMixture(n_components, **{"random_state": 0, **kind, **options})


def test_one_estimator_does_not_load_the_others():
    code = (
        "import sys, gmmtorch as gt; gt.GaussianMap; assert 'sklearn' not in sys.modules; gt.GaussianMixture;"
        "assert 'sklearn.cluster' not in sys.modules;"
        "print([name for name in sys.modules if name.startswith('gmmtorch.mixture.estimators.')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# -- the checks of any estimator --------------------------------------------------------------------

CHECKS = [
    pytest.param(estimator, check, id=f"{kind.__name__}-{i}-{getattr(check, 'func', check).__name__}")
    for kind in (GaussianMixture, VariationalGaussianMixture)
    for i, (estimator, check) in enumerate(estimator_checks_generator(kind(), mark=None, legacy=True))
]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("estimator", "check"), CHECKS)
def test_scikit_learn_check(estimator, check):
    check(estimator)


def test_there_are_many_checks():
    assert len(CHECKS) > 80


# -- scikit-learn's own tests of its mixtures -------------------------------------------------------

PRIVATE = "tests functions that are private to scikit-learn"
EXCEPTED = {
    "gaussian_mixture": {
        "test_suffstat_sk_full": PRIVATE,
        "test_suffstat_sk_tied": PRIVATE,
        "test_suffstat_sk_diag": PRIVATE,
        "test_gaussian_suffstat_sk_spherical": PRIVATE,
        "test_compute_log_det_cholesky": PRIVATE,
        "test_gaussian_mixture_log_probabilities": PRIVATE,
        "test_gaussian_mixture_precisions_init": PRIVATE,
        "test_gaussian_mixture_all_init_does_not_estimate_gaussian_parameters": PRIVATE,
        "test_gaussian_mixture_precisions_init_diag": (
            "expects the clusters of scikit-learn's k-means with the same seed, in their order"
        ),
        "test_check_weights": "expects a message that exchanges the largest and the smallest weight",
        "test_gaussian_mixture_raises_where_array_api_not_implemented": (
            "expects an error for tensors, which are accepted"
        ),
    },
    "bayesian_mixture": {
        "test_log_dirichlet_norm": PRIVATE,
        "test_log_wishart_norm": PRIVATE,
        "test_compare_covar_type": PRIVATE,
    },
    "mixture": {},
}
"""Tests that do not run on our estimators, and why."""


class OurGaussianMixture(GaussianMixture):
    """With the private method that scikit-learn's tests of the information criteria call."""

    def _n_parameters(self) -> int:
        return self.n_parameters()


class OurBayesianGaussianMixture(VariationalGaussianMixture):
    pass


OurGaussianMixture.__name__ = "GaussianMixture"
OurBayesianGaussianMixture.__name__ = "BayesianGaussianMixture"


def load(name: str) -> ModuleType:
    """scikit-learn's `test_<name>`, a fresh copy, with our estimators in place of its own."""
    import sklearn.mixture

    theirs = sklearn.mixture.GaussianMixture, sklearn.mixture.BayesianGaussianMixture
    found = importlib.util.find_spec(f"sklearn.mixture.tests.test_{name}")
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    try:
        sklearn.mixture.GaussianMixture = OurGaussianMixture
        sklearn.mixture.BayesianGaussianMixture = OurBayesianGaussianMixture
        found.loader.exec_module(module)
    finally:
        sklearn.mixture.GaussianMixture, sklearn.mixture.BayesianGaussianMixture = theirs
    return module


def functions(name: str, module: ModuleType) -> Iterator[tuple[str, Any]]:
    for key, value in vars(module).items():
        if key.startswith("test_") and inspect.isfunction(value):
            yield key, value


def on_cpu_tensors(function: Any) -> Any:
    """The array API test with torch tensors on the CPU alone, of the many libraries and devices."""
    marks = [mark for mark in function.pytestmark if "array_namespace" not in mark.args[0]]
    names = "array_namespace, device_name, dtype_name"
    function.pytestmark = [*marks, pytest.mark.parametrize(names, [("torch", "cpu", "float64")]).mark]
    return pytest.mark.usefixtures("_array_api")(function)


@pytest.fixture
def _array_api(monkeypatch):
    monkeypatch.setenv("SCIPY_ARRAY_API", "1")


SLOW = {"test_init", "test_monotonic_likelihood"}  # above two seconds
MODULES = {name: load(name) for name in EXCEPTED}
for _name, _module in MODULES.items():
    for _key, _function in functions(_name, _module):
        if _key not in EXCEPTED[_name]:
            if _key == "test_gaussian_mixture_array_api_compliance":
                _function = on_cpu_tensors(_function)
            if _key in SLOW:
                _function = pytest.mark.slow(_function)
            globals()[f"test_{_name}__{_key.removeprefix('test_')}"] = _function


@pytest.fixture
def global_dtype() -> type:
    return np.float64


@pytest.fixture
def global_random_seed() -> int:
    return 0


def test_exceptions_are_existing_tests():
    for name, module in MODULES.items():
        assert EXCEPTED[name].keys() <= {key for key, _ in functions(name, module)}
    assert sum(len(names) for names in EXCEPTED.values()) == 14
