"""`GaussianMixture` and `VariationalGaussianMixture` pass `estimator_contract`."""

from __future__ import annotations

import math
import subprocess
import sys
from typing import Any, ClassVar

from mixture.estimator_contract import MixtureContract
from mixture.fit_contract import FitContract

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
