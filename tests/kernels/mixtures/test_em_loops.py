"""Whole runs of EM in one launch, by the workers of a CPU and of a GPU, against loops over twins' steps."""

from __future__ import annotations

import pytest
import torch
from hypothesis import assume, example, given
from hypothesis import strategies as st
from mixture.mixture_cases import cloud, random_parameters, random_weight, rows_of

from gmmtorch.errors import NumericalError
from gmmtorch.kernels import fused_exact_em, fused_truncated_em, kernels
from gmmtorch.kernels.compiler import Team
from gmmtorch.kernels.mixtures import em_loops, em_steps
from gmmtorch.mixture.em import loop
from gmmtorch.mixture.em.exact import Parameters, quadratic_features
from gmmtorch.mixture.em.truncated import (
    Rows,
    Settings,
    centered_parameters,
    choose_candidates,
    group_rows,
    nearest,
    run_truncated,
)

SKIPPED = 37.0  # nats, as in e_step.h
TEAMS = [None, Team(1, None), Team(13, None), Team(700, None)]
"""The worker of a CPU; otherwise the phases of a GPU with few or many workers, one by one on a CPU."""


@pytest.fixture(params=TEAMS, ids=["own", "1", "13", "700"])
def team(request, device):
    if device != "cpu" and request.param is not None:
        pytest.skip("a GPU has workers that wait")
    return request.param


@example(seed=139812, n=72, dim=3, k=6, tol=0.0, max_iter=6, workers=TEAMS[2], guarded=True)
@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 400),
    dim=st.sampled_from([1, 2, 3]),
    k=st.integers(1, 9),
    tol=st.sampled_from([0.0, 1e-4, 1e-2]),
    max_iter=st.integers(1, 20),
    workers=st.sampled_from(TEAMS),
    guarded=st.booleans(),
)
def test_a_run_of_exact_em_is_that_of_the_twin(device, seed, n, dim, k, tol, max_iter, workers, guarded):
    team = workers if device == "cpu" else None
    features, weight = quadratic_features(cloud(n, dim, seed)), random_weight(n, seed)
    start = random_parameters(k, dim, seed)
    limits = 1e-3, tol, max_iter
    mixture, bounds, failed = fused_exact_em(features, weight, start, *limits, guarded=guarded, team=team)
    expected, of_bounds = run_of_twin(features, weight, start, *limits)
    # EM can revive a component that has no more than responsibilities of the size that the kernel skips.
    raised, of_raised = run_of_twin(features, weight, start, *limits, floor=-SKIPPED)
    assume(of_raised.shape == of_bounds.shape)
    assert not failed
    mine = *mixture, of_bounds.new_tensor(bounds)
    theirs, others = (*expected, of_bounds), (*raised, of_raised)
    for own, twin, other, error in zip(mine, theirs, others, (1e-6, 1e-6, 1e-6, 1e-9), strict=True):
        assert own.shape == twin.shape
        assert bool(((own - twin).abs() <= error * (0.01 + twin.abs()) + 10 * (other - twin).abs()).all())


def run_of_twin(features, weight, start, reg_covar, tol, max_iter, floor=None):
    """The mixture and the bounds of steps of the twin, whose exponents are at least `floor`."""
    with kernels("torch"), pytest.MonkeyPatch.context() as patch:
        if floor is not None:
            patch.setattr(em_steps, "exponent_floor", lambda dtype: floor)
        step = loop.em_step(Rows(features, weight, False), reg_covar, torch.float64)
        found = loop.run_em(step, start, tol=tol, max_iter=max_iter)
    return found.parameters, features.new_tensor(found.lower_bounds)


def test_a_run_ends_before_what_it_cannot_compute(team):
    points, weight = cloud(200, 2), random_weight(200)
    start = random_parameters(3, 2)
    singular = start._replace(covariances=start.covariances.clone())
    singular.covariances[1] = 1.0
    for some, first in ((points, singular), (points + 1e8, start._replace(means=start.means + 1e8))):
        limits = quadratic_features(some), weight, first, 1e-6, 0.0, 5
        mixture, bounds, failed = fused_exact_em(*limits, guarded=True, team=team)
        assert failed
        assert bounds == []
        assert all(torch.equal(a, b) for a, b in zip(mixture, first, strict=True))


def test_a_start_whose_sums_lose_digits_takes_the_direct_step():
    wall = torch.rand(300, 3, generator=torch.Generator().manual_seed(0)).double() * 4000.0
    wall[:, 0] *= 1e-10
    covariances = 1e6 * torch.eye(3).double().repeat(2, 1, 1)
    start = Parameters(torch.full((2,), 0.5).double(), wall[:2].clone(), covariances)
    weight = torch.ones(300).double()
    _, bounds, failed = fused_exact_em(quadratic_features(wall), weight, start, 1e-12, 0.0, 5, guarded=True)
    assert failed
    assert len(bounds) < 5


def test_callbacks_and_continued_runs_see_every_iteration():
    features, weight, seen = quadratic_features(cloud(300, 2)), random_weight(300), []
    step, start = loop.em_step(Rows(features, weight, False), 1e-3), random_parameters(4, 2)
    whole = loop.run_em(step, start, tol=0.0, max_iter=9, on_iteration=lambda *at: seen.append(at))
    assert seen == list(enumerate(whole.lower_bounds, 1))
    half = loop.run_em(step, start, tol=0.0, max_iter=4)
    rest = loop.run_em(step, half.parameters, tol=0.0, max_iter=9, lower_bounds=half.lower_bounds)
    assert rest.lower_bounds == pytest.approx(whole.lower_bounds, abs=1e-12)
    again = loop.run_em(step, whole.parameters, tol=1e-2, previous_bound=whole.lower_bound)
    assert again.n_iter == 1
    assert again.converged


# -- truncated EM ----------------------------------------------------------------------------------


def truncated_run(rows: Rows, owner, start, settings: Settings, team, candidates=None, **more):
    limits = settings.reg_covar, settings.tol, settings.previous_bound, settings.max_iter
    given = settings.n_candidates if candidates is None else candidates
    repaired = more.pop("repaired", lambda mixture: centered_parameters(Parameters(*mixture)))
    return fused_truncated_em(
        rows.values, rows.weight, owner, start, limits, given, repaired, team=team, **more
    )


@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 400),
    dim=st.sampled_from([1, 2, 3]),
    k=st.integers(1, 12),
    n_candidates=st.integers(1, 5),
    tol=st.sampled_from([1e-5, 1e-3, 1e-2]),
    max_iter=st.integers(0, 30),
    are_points=st.booleans(),
    workers=st.sampled_from(TEAMS),
)
def test_a_run_of_truncated_em_is_that_of_the_twin(
    device, seed, n, dim, k, n_candidates, tol, max_iter, are_points, workers
):
    team = workers if device == "cpu" else None
    points, weight, start = cloud(n, dim, seed), random_weight(n, seed), random_parameters(k, dim, seed)
    rows, owner = rows_of(points, weight, are_points), nearest(points, start.means)
    settings = Settings(1e-3, tol, max_iter, torch.float64, n_candidates)
    with kernels("torch"):
        expected, owners, candidates = run_truncated(rows, owner, start, settings)
    found = truncated_run(rows, owner, start, settings, team)
    n_equal = min(len(found.bounds), expected.n_iter)
    assert found.bounds[:n_equal] == pytest.approx(expected.lower_bounds[:n_equal], rel=1e-8, abs=1e-8)
    if len(found.bounds) != expected.n_iter:  # a bound fell by rounding
        assert found.bounds[-1] == pytest.approx(expected.lower_bound, abs=1e-6)
        return
    assert found.converged == expected.converged
    for mine, other in zip(found.mixture, expected.parameters, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-5, atol=1e-7)
    assert torch.equal(found.owner, owners)
    own = owners.unique()
    assert torch.equal(found.candidates.sort(1).values[own], candidates.sort(1).values[own])


@pytest.mark.parametrize("n_candidates", [1, 6, 16])
def test_candidates_are_the_most_likely_components(team, n_candidates):
    points, start = 3 * cloud(4000, 2), random_parameters(90, 2)  # with rows that are no samples
    rows, owner = rows_of(points), nearest(points, start.means)
    with kernels("torch"):
        groups = group_rows(rows, owner, start.means, torch.float64)
        expected = choose_candidates(groups, start, n_candidates).sort(1).values
    settings = Settings(max_iter=0, n_candidates=n_candidates)
    found = truncated_run(rows, owner, start, settings, team).candidates.sort(1).values
    has_rows = groups.n_rows > 0
    assert torch.equal(found[has_rows], expected[has_rows])
    assert bool((found == torch.arange(90)[:, None]).any(1).all())
    assert bool((found[:, 1:] > found[:, :-1]).all())


def test_of_equal_components_the_first_are_candidates(team):
    points, one = cloud(900, 2), random_parameters(1, 2)
    start = Parameters(
        *(torch.cat([part] * 40) / 40**number for part, number in zip(one, (1, 0, 0), strict=True))
    )
    owner = torch.arange(900) % 39
    found = truncated_run(rows_of(points), owner, start, Settings(max_iter=0, n_candidates=5), team)
    for own, candidates in enumerate(found.candidates.sort(1).values.tolist()):
        assert candidates == sorted([own, *[k for k in range(5) if k != own][:4]])


def test_a_covariance_without_a_factor_is_repaired_or_named(team):
    points, start = cloud(300, 2), random_parameters(3, 2)
    start.covariances[1] = 1.0  # singular
    rows, owner, settings = rows_of(points), nearest(points, start.means), Settings(1e-6, 0.0, 4)
    repaired = []

    def repair(mixture):
        repaired.append(mixture[2][1].clone())
        return centered_parameters(Parameters(*mixture))

    with kernels("torch"):
        expected, *_ = run_truncated(rows, owner, start, settings)
    found = truncated_run(rows, owner, start, settings, team, repaired=repair)
    assert len(repaired) == 4  # the component has no rows, and stays
    assert found.bounds == pytest.approx(expected.lower_bounds, rel=1e-4)
    start.covariances[1] = -1.0
    with pytest.raises(NumericalError, match=r"covariances\[1\]"):
        truncated_run(rows, owner, start, settings, team)


def test_runs_in_several_launches_and_runs_that_share_rows_are_those_of_one_launch(team, monkeypatch):
    points, start, seen = cloud(500, 3), random_parameters(12, 3), []
    rows, owner, settings = (
        rows_of(points),
        nearest(points, start.means),
        Settings(1e-6, 0.0, 25, n_candidates=4),
    )
    whole = truncated_run(rows, owner, start, settings, team)
    monkeypatch.setattr(em_loops, "_MOST_ITERATIONS", 3)
    parts = truncated_run(rows, owner, start, settings, team, on_iteration=lambda *at: seen.append(at))
    assert seen == list(enumerate(whole.bounds, 1))
    shared = truncated_run(
        rows, owner, start, settings, team, summed=lambda sums: 2 * sums
    )  # two equal halves
    for other in (parts, shared):
        assert other.bounds == pytest.approx(whole.bounds, abs=1e-10)
        for mine, expected in zip(other.mixture, whole.mixture, strict=True):
            torch.testing.assert_close(mine, expected, rtol=1e-7, atol=1e-9)
