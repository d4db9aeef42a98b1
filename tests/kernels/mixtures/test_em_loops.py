"""Whole runs of EM in one launch, with the workers of a CPU and of a GPU, against loops over the twins' steps."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mixture.mixture_cases import cloud, random_parameters, random_weight

from gmmtorch.kernels import fused_exact_em, kernels
from gmmtorch.kernels.compiler import Team
from gmmtorch.mixture.em import loop
from gmmtorch.mixture.em.exact import Parameters, quadratic_features

TEAMS = [None, Team(1, None), Team(13, None), Team(700, None)]
"""The worker of a CPU; otherwise the phases of a GPU, with few or many workers."""

pytestmark = pytest.mark.cpu_only


@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 400),
    dim=st.sampled_from([1, 2, 3]),
    k=st.integers(1, 9),
    tol=st.sampled_from([0.0, 1e-4, 1e-2]),
    max_iter=st.integers(1, 20),
    team=st.sampled_from(TEAMS),
    guarded=st.booleans(),
)
def test_a_run_of_exact_em_is_that_of_the_twin(seed, n, dim, k, tol, max_iter, team, guarded):
    features, weight = quadratic_features(cloud(n, dim, seed)), random_weight(n, seed)
    start = random_parameters(k, dim, seed)
    with kernels("torch"):
        step = loop.natural_step(features, weight, 1e-3, torch.float64)
        expected = loop.run_em(step, start, tol=tol, max_iter=max_iter)
    found = fused_exact_em(features, weight, start, 1e-3, tol, max_iter, guarded=guarded, team=team)
    assert not found.failed
    assert found.bounds == pytest.approx(expected.lower_bounds, rel=1e-9, abs=1e-9)
    for mine, other in zip(found.mixture, expected.parameters, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("team", TEAMS)
def test_a_run_ends_before_what_it_cannot_compute(team):
    points, weight = cloud(200, 2), random_weight(200)
    start = random_parameters(3, 2)
    singular = start._replace(covariances=start.covariances.clone())
    singular.covariances[1] = 1.0
    for some, first in ((points, singular), (points + 1e8, start._replace(means=start.means + 1e8))):
        limits = quadratic_features(some), weight, first, 1e-6, 0.0, 5
        found = fused_exact_em(*limits, guarded=True, team=team)
        assert found.failed
        assert found.bounds == []
        assert all(torch.equal(a, b) for a, b in zip(found.mixture, first, strict=True))


def test_a_start_whose_sums_lose_digits_takes_the_direct_step():
    wall = torch.rand(300, 3, generator=torch.Generator().manual_seed(0)).double() * 4000.0
    wall[:, 0] *= 1e-10
    covariances = 1e6 * torch.eye(3).double().repeat(2, 1, 1)
    start = Parameters(torch.full((2,), 0.5).double(), wall[:2].clone(), covariances)
    found = fused_exact_em(
        quadratic_features(wall), torch.ones(300).double(), start, 1e-12, 0.0, 5, guarded=True
    )
    assert found.failed
    assert len(found.bounds) < 5


def test_callbacks_and_continued_runs_see_every_iteration():
    features, weight, seen = quadratic_features(cloud(300, 2)), random_weight(300), []
    step, start = loop.natural_step(features, weight, 1e-3), random_parameters(4, 2)
    whole = loop.run_em(step, start, tol=0.0, max_iter=9, on_iteration=lambda *at: seen.append(at))
    assert seen == list(enumerate(whole.lower_bounds, 1))
    half = loop.run_em(step, start, tol=0.0, max_iter=4)
    rest = loop.run_em(step, half.parameters, tol=0.0, max_iter=9, lower_bounds=half.lower_bounds)
    assert rest.lower_bounds == pytest.approx(whole.lower_bounds, abs=1e-12)
    again = loop.run_em(step, whole.parameters, tol=1e-2, previous_bound=whole.lower_bound)
    assert again.n_iter == 1
    assert again.converged
