"""HierarchicalGaussianMixture as an estimator: its contract, likelihood, and clouds of few points."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mixture.estimator_contract import MixtureContract
from mixture.fit_contract import FitContract, check_mixture
from mixture.tree_cases import exact, room
from torch import Tensor

from gmmtorch import datasets
from gmmtorch.errors import NumericalError
from gmmtorch.mixture import GaussianMixture, HierarchicalGaussianMixture

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


class TestContract(MixtureContract):
    exact_components = False
    score_tolerance = 0.4
    bad_parameters: ClassVar[dict[str, tuple[Any, ...]]] = {
        "branching": (1, 2.5, None),
        "max_levels": (0, 1.5),
        "max_iter": (0,),
        "soft_threshold": (-0.1, 1.1, math.nan, None),
        **dict.fromkeys(
            ("tol", "reg_covar", "planarity_threshold", "thickness", "min_support", "min_gain"),
            (-1e-3, math.nan, math.inf, "small", None),
        ),
    }

    def make(self, n_components: int = 3, **options: Any) -> HierarchicalGaussianMixture:
        return HierarchicalGaussianMixture(n_components, **{"random_state": 0, "dtype": "float64", **options})


class TestContractInSinglePrecision(FitContract):
    exact_components = False
    score_tolerance = 0.4
    # In float32 EM may stop one step earlier or later.
    order_tolerance = repetition_tolerance = motion_tolerance = far_tolerance = 0.05

    def make(self, n_components: int = 3, **options: Any) -> HierarchicalGaussianMixture:
        return HierarchicalGaussianMixture(n_components, **{"random_state": 0, **options})


# -- likelihood ------------------------------------------------------------------------------------


@pytest.mark.parametrize("soft_threshold", [0.01, 0.1, 1.0])
def test_likelihood_exceeds_the_bound_of_the_level_before(soft_threshold):
    """With points assigned to some children only, the likelihood may decrease, but not below the bound."""
    points = room(2000)
    weight = np.random.default_rng(0).uniform(0.5, 2.0, len(points))
    kept, scores = [], []
    for levels in (1, 2, 3):
        tree = exact(branching=4, max_levels=levels, soft_threshold=soft_threshold)
        tree.fit(points, sample_weight=weight)
        kept.append(tree.lower_bound_)
        scores.append(np.average(tree.score_samples(points), weights=weight))
        np.testing.assert_allclose(tree.level(levels).score_samples(points), tree.score_samples(points))
    assert all(bound <= score + 1e-9 for bound, score in zip(kept, scores, strict=True))
    assert all(after >= bound for bound, after in zip(kept, scores[1:], strict=False))
    assert scores[2] > scores[0]


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_bound_never_decreases_within_a_level(dtype):
    found: list[float] = []
    tree = HierarchicalGaussianMixture(branching=6, max_levels=1, reg_covar=1e-9, dtype=dtype)
    tree.fit(room(3000), on_iteration=lambda iteration, bound: found.append(bound))
    assert found == tree.lower_bounds_
    assert len(found) > 10
    assert np.diff(found[1:-1]).min() > (-1e-3 if dtype == "float32" else -1e-10)
    assert found[1] > found[0]


def test_tree_is_nearly_as_likely_as_flat_em():
    points, fresh = room(6000), room(2000, seed=1)
    tree = HierarchicalGaussianMixture(64, random_state=0).fit(points)
    k = len(tree.weights_)
    assert 56 <= k <= 64
    flat = GaussianMixture(k, random_state=0).fit(points)
    single = GaussianMixture(1).fit(points)
    assert tree.score(fresh) > flat.score(fresh) - 0.15
    assert tree.score(fresh) > single.score(fresh) + 1.5


def test_float32_switches_to_float64_if_its_error_is_large():
    """Sheets half a millimetre thin, two hundred metres apart."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, size=(900, 3)) * [100.0, 100.0, 0.0]
    points[:, 2] = (np.arange(900) % 3) * 100.0 + 5e-4 * rng.normal(size=900)
    options: dict[str, Any] = {"branching": 3, "max_levels": 2, "reg_covar": 1e-12}
    single = HierarchicalGaussianMixture(dtype="float32", **options).fit(points)
    double = HierarchicalGaussianMixture(dtype="float64", **options).fit(points)
    assert abs(single.score(points) - double.score(points)) < 0.05
    assert np.sqrt(np.linalg.eigvalsh(single.covariances_)[:, 0]).max() < 1e-3


# -- degenerate clouds -----------------------------------------------------------------------------


@settings(max_examples=40)
@given(data=st.data(), dim=st.integers(1, 3), n=st.integers(1, 60))
def test_any_cloud_of_few_places_is_fitted(data, dim, n):
    """Deep trees of lattices with repeated points, of any scale and far from the origin."""
    scale, offset = data.draw(
        st.sampled_from([(1.0, 0.0), (1e-6, 0.0), (1e3, 5e5), (1e-3, -1e6), (1e6, 0.0)])
    )
    rng = np.random.default_rng(data.draw(st.integers(0, 999)))
    points = offset + scale * rng.integers(0, data.draw(st.sampled_from([1, 2, 4, 20])), size=(n, dim))
    weight = rng.choice([1e-3, 1.0, 50.0], size=n)
    options = {
        "branching": data.draw(st.sampled_from([2, 3, 8])),
        "min_support": data.draw(st.sampled_from([0.0, 1.0, 4.0])),
        "min_gain": data.draw(st.sampled_from([0.0, 1.0])),
        "soft_threshold": data.draw(st.sampled_from([0.0, 0.1, 1.0])),
        "dtype": data.draw(st.sampled_from(["float32", "float64"])),
    }
    tree = HierarchicalGaussianMixture(max_levels=3, max_iter=20, **options).fit(points, sample_weight=weight)
    check_mixture(tree, points, at_most=n)
    for level in range(1, tree.n_levels_ + 1):
        check_mixture(tree.level(level), points, at_most=n)
    assert (tree.weights > 0).all()


def test_fit_without_regularisation_is_valid_or_rejected():
    tree = exact(reg_covar=0.0, max_levels=2).fit(room(1000))
    check_mixture(tree, room(1000), at_most=64)
    with pytest.raises(NumericalError, match="reg_covar"):
        exact(reg_covar=0.0).fit(np.ones((20, 3)))


# -- real scans ------------------------------------------------------------------------------------


def held_out(points: Tensor, n: int) -> tuple[Tensor, Tensor]:
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    return points[order[:n]], points[order[n : n + n // 4]]


@pytest.mark.real_data
@pytest.mark.parametrize("name", ["hall", "bunny"])
def test_real_surfaces_are_nearly_as_likely_as_flat_em(real_data: Path, name: str):
    if name == "hall":
        cloud = datasets.load("scan_folder", path=real_data / "hall")[0].points
    else:
        cloud = datasets.load("mesh", path=real_data / "meshes" / "bunny.ply")[0].points
    points, fresh = held_out(cloud.double(), 15_000)
    tree = HierarchicalGaussianMixture(64, random_state=0).fit(points)
    assert len(tree.weights) > 56
    flat = GaussianMixture(len(tree.weights), random_state=0).fit(points)
    scores = [tree.level(level).score(fresh) for level in range(1, tree.n_levels_ + 1)]
    assert scores == sorted(scores)
    assert tree.score(fresh) > flat.score(fresh) - 0.3
    assert tree.score(fresh) > GaussianMixture(8, random_state=0).fit(points).score(fresh) + 0.3
