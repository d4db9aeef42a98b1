"""Posteriors and priors for the tests of variational mixtures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gmmtorch.mixture import VariationalGaussianMixture

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
