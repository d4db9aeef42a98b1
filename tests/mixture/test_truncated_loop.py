"""The loop of truncated EM: its bounds, momentum, precision, and the way from cells to points."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mixture.fit_contract import check_mixture
from mixture.mixture_cases import (
    beads,
    cloud,
    direct_step,
    random_parameters,
    random_weight,
    rows_of,
    thin_wall,
)
from torch import Tensor

from gmmtorch.mixture import GaussianMixture, Parameters, Rows
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em import loop, truncated
from gmmtorch.mixture.em.by_type import log_joint
from gmmtorch.mixture.em.initialization import flat_pieces, moments_of
from gmmtorch.mixture.em.truncated import (
    Settings,
    centered_parameters,
    fit_truncated,
    group_rows,
    nearest,
    rounding,
    run_truncated,
    truncated_expectation,
)

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


# -- the loop --------------------------------------------------------------------------------------


def check_run(found: loop.EMResult, max_iter: int, slack: float = 0.0) -> None:
    assert 1 <= found.n_iter <= max_iter
    assert np.isfinite(found.lower_bounds).all()
    assert (np.diff(found.lower_bounds) >= -slack).all()
    assert all(bool(torch.isfinite(value).all()) for value in found.parameters)
    assert float(found.parameters.weights.min()) >= 0
    assert float(found.parameters.weights.sum()) == pytest.approx(1, abs=1e-9)


@settings(max_examples=60)
@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 300),
    dim=st.sampled_from([1, 2, 3, 5]),
    k=st.integers(1, 9),
    n_candidates=st.integers(2, 5),
    tol=st.sampled_from([0.0, 1e-6, 1e-3, 0.1]),
    max_iter=st.integers(1, 40),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    grain=st.sampled_from([0.0, 0.5]),
    are_points=st.booleans(),
)
def test_bounds_never_decrease_and_every_run_ends(
    seed, n, dim, k, n_candidates, tol, max_iter, dtype, grain, are_points
):
    points = cloud(n, dim, seed)
    points = (points / grain).round() * grain if grain else points  # with equal points
    weight = random_weight(n, seed)
    rows = rows_of(points, weight, are_points)
    calls: list[tuple[int, float]] = []
    setup = Settings(1e-6, tol, max_iter, dtype, n_candidates, lambda *call: calls.append(call))
    parameters = random_parameters(k, dim, seed)
    found, owner, _ = run_truncated(rows, nearest(points, parameters.means), parameters, setup)
    check_run(found, max_iter)
    assert calls == list(enumerate(found.lower_bounds, 1))
    assert owner.shape == (n,)
    assert set(owner.tolist()) <= set(range(k))
    if found.n_iter < max_iter:
        assert found.converged


@given(
    seed=st.integers(0, 10**6),
    dim=st.integers(1, 3),
    k=st.integers(1, 6),
    n_candidates=st.integers(2, 5),
    max_iter=st.integers(1, 20),
)
def test_result_is_at_least_as_good_as_the_last_bound(seed, dim, k, n_candidates, max_iter):
    points, weight, parameters = (
        cloud(400, dim, seed),
        random_weight(400, seed),
        random_parameters(k, dim, seed),
    )
    setup = Settings(1e-9, 1e-4, max_iter, torch.float64, n_candidates)
    found, owner, candidates = run_truncated(
        rows_of(points, weight), nearest(points, parameters.means), parameters, setup
    )
    joint = log_joint(found.parameters, "full")(points).T
    allowed = torch.full_like(joint, -torch.inf).scatter(1, candidates[owner], 0.0)
    bound, score = (torch.logsumexp(j, 1) @ weight / weight.sum() for j in (joint + allowed, joint))
    assert found.lower_bounds[-1] - 1e-7 <= float(bound) <= float(score) + 1e-12


def test_one_iteration_equals_one_em_step():
    points, weight, parameters = cloud(500, 3), random_weight(500), random_parameters(5, 3)
    setup = Settings(1e-6, 0.0, 1, torch.float64)
    found, *_ = run_truncated(rows_of(points, weight), nearest(points, parameters.means), parameters, setup)
    step = loop.em_step(Rows(em.quadratic_features(points), weight, False), 1e-6, torch.float64)
    expected, bound = step(parameters)
    assert found.lower_bounds == [pytest.approx(bound, rel=1e-12)]
    torch.testing.assert_close(tuple(found.parameters), tuple(expected), rtol=1e-9, atol=1e-10)


# -- momentum --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n_iter", "share"), [(10, 1.0), (100, 0.5)])
def test_momentum_converges_faster_than_em(n_iter, share, generator):
    label = torch.rand(3000, 1, generator=generator, dtype=torch.float64) < 0.5
    points = torch.randn(3000, 1, generator=generator, dtype=torch.float64) + torch.where(label, 1.0, -1.0)
    parameters = Parameters(
        torch.tensor([0.8, 0.2], dtype=torch.float64),
        torch.tensor([[-0.2], [0.3]], dtype=torch.float64),
        torch.full((2, 1, 1), 2.0, dtype=torch.float64),
    )
    rows, owner = rows_of(points), torch.zeros(3000, dtype=torch.int64)
    step = loop.em_step(Rows(em.quadratic_features(points), rows.weight, False), 0.0, torch.float64)
    plain = loop.run_em(step, parameters, tol=0.0, max_iter=n_iter)
    found, *_ = run_truncated(rows, owner, parameters, Settings(0.0, 0.0, n_iter, torch.float64))
    assert found.n_iter == n_iter
    best = loop.run_em(step, parameters, tol=0.0, max_iter=1500).lower_bounds[-1]
    assert best - plain.lower_bounds[-1] > 1e-5  # plain EM converges slowly
    assert best - found.lower_bounds[-1] < share * (best - plain.lower_bounds[-1])


class Spy:
    """An E-step of the twin that records its inputs and results, and decreases the bound at given calls."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, failing: tuple[int, ...] = ()) -> None:
        self.failing, self.given, self.dtypes, self.sets = failing, [], [], []
        monkeypatch.setattr(truncated, "is_m_step_fused", lambda *_: False)
        monkeypatch.setattr(truncated, "truncated_expectation", self)

    def __call__(self, groups, candidates, parameters, want_owner=False, *rest):
        statistics, value, owner = truncated_expectation(groups, candidates, parameters, want_owner, *rest)
        if len(self.given) in self.failing:
            value -= 1e6
        self.given.append(parameters)
        self.dtypes.append(groups.features.dtype)
        self.sets.append(candidates)
        return statistics, value, owner


def run_on_beads(max_iter: int) -> loop.EMResult:
    points, _ = beads(1500, 20)
    rows = rows_of(torch.from_numpy(points - points.mean(0)))
    first, owner = flat_pieces(rows.points, rows.weight, 20, 1e-6)
    found, *_ = run_truncated(rows, owner, first, Settings(1e-6, 0.0, max_iter, torch.float64))
    check_run(found, max_iter)
    return found


@pytest.mark.parametrize("failing", [(2,), (5, 6)])  # without and with momentum
def test_candidates_that_decrease_the_bound_are_replaced_by_the_old_ones(monkeypatch, failing):
    spy = Spy(monkeypatch, failing)
    found = run_on_beads(max_iter=20)
    assert found.n_iter == 20
    old, new = spy.sets[failing[0] - 1], spy.sets[failing[0]]
    assert all(given is new for given in spy.sets[failing[0] : failing[-1] + 1])
    assert all(given is old for given in spy.sets[failing[-1] + 1 :])  # permanently


def test_run_ends_if_the_em_step_decreases_the_bound(monkeypatch):
    Spy(monkeypatch, failing=(3, 4))
    found = run_on_beads(max_iter=12)
    assert found.converged
    assert found.n_iter == 3


# -- rounding --------------------------------------------------------------------------------------


def two_halves(points: Tensor) -> Parameters:
    """Components of the two halves of a cloud, cut along x."""
    beyond = (points[:, 0] > 0).long()
    weight = points.new_ones(len(points))
    return moments_of(em.quadratic_features(points), weight, beyond, 2, 1e-6)


@pytest.mark.parametrize(("size", "dtype"), [(0.2, torch.float32), (30.0, torch.float64)])
def test_large_thin_cloud_uses_float64_and_equals_em(size, dtype, monkeypatch):
    points = thin_wall(4000, size)
    rows, parameters = rows_of(points), two_halves(points)
    setup = Settings(1e-6, 0.0, 1)
    owner = nearest(points, parameters.means)
    spy = Spy(monkeypatch)
    found, *_ = run_truncated(rows, owner, parameters, setup)
    assert spy.dtypes == [dtype]
    expected, total = direct_step(points, rows.weight, parameters, 1e-6)
    tolerance = 1e-8 if dtype == torch.float64 else 1e-3
    assert found.lower_bounds[0] == pytest.approx(float(total) / 4000, abs=tolerance)
    least, truth = (torch.linalg.eigvalsh(p.covariances)[:, 0] for p in (found.parameters, expected))
    torch.testing.assert_close(least, truth, rtol=100 * tolerance, atol=0)


def test_components_that_become_thin_switch_to_float64(monkeypatch):
    points = thin_wall(4000, 30.0)
    rows, parameters = rows_of(points), two_halves(points)
    parameters = parameters._replace(covariances=parameters.covariances + torch.eye(3, dtype=torch.float64))
    owner = nearest(points, parameters.means)
    spy = Spy(monkeypatch)
    found, *_ = run_truncated(rows, owner, parameters, Settings(1e-6, 0.0, 2))
    assert spy.dtypes == [torch.float32, torch.float64]
    for at, bound in zip(spy.given, found.lower_bounds, strict=True):
        score = torch.logsumexp(log_joint(at, "full")(points), 0).mean()
        assert bound == pytest.approx(float(score), abs=1e-4)
    thinnest = torch.linalg.eigvalsh(found.parameters.covariances)[:, 0]
    torch.testing.assert_close(thinnest, torch.full_like(thinnest, 1.01e-6), rtol=0.01, atol=0)


def test_large_thin_piece_of_low_weight_switches_to_float64(monkeypatch):
    rng = np.random.default_rng(0)
    blobs = 0.05 * rng.normal(size=(40_000, 3)) + 5 * rng.random((40, 3))[rng.integers(40, size=40_000)]
    points = torch.cat([torch.from_numpy(blobs), thin_wall(20, 20.0)])
    owner = torch.cat([torch.zeros(40_000, dtype=torch.int64), torch.ones(20, dtype=torch.int64)])
    of_wall = points[40_000:]
    covariances = torch.stack([torch.cov(points[:40_000].T), torch.cov(of_wall.T, correction=0)])
    covariances[1] += 1e-6 * torch.eye(3, dtype=torch.float64)
    parameters = Parameters(
        torch.tensor([0.9995, 0.0005], dtype=torch.float64),
        torch.stack([points[:40_000].mean(0), of_wall.mean(0)]),
        covariances,
    )
    groups = group_rows(rows_of(points), owner, parameters.means, torch.float32)
    average, worst = rounding(groups, centered_parameters(parameters))
    assert average < 0.02 < worst
    # Brute force of ε/2 E‖x‖² tr Σ⁻¹, group by group.
    half_eps = torch.finfo(torch.float32).eps / 2
    errors, counts = [], []
    for k, own in enumerate((points[:40_000], of_wall)):
        spread = float((own - parameters.means[k]).square().sum(1).mean())
        errors.append(half_eps * spread * float(torch.linalg.inv(covariances[k]).trace()))
        counts.append(len(own))
    assert worst == pytest.approx(max(errors), rel=1e-4)
    assert average == pytest.approx(np.average(errors, weights=counts), rel=1e-4)
    spy = Spy(monkeypatch)
    run_truncated(rows_of(points), owner, parameters, Settings(max_iter=1))
    assert spy.dtypes == [torch.float64]


@pytest.mark.parametrize("k", [4, 24])  # all components are candidates, or not
def test_thin_walls_500_km_apart_are_fitted_independently(k):
    wall = thin_wall(1200, 3.0)
    offset = torch.tensor([5e5, -2e5, 1e3], dtype=torch.float64)
    options: dict[str, Any] = {"algorithm": "truncated", "init_params": "flat_pieces", "tol": 1e-5}
    separate = GaussianMixture(k // 2, **options).fit(wall)
    both = GaussianMixture(k, **options).fit(torch.cat([wall + offset, wall - offset]))
    check_mixture(both, torch.cat([wall + offset, wall - offset]).numpy(), at_most=k)
    score = float(both.score_samples(wall + offset).mean())
    assert score + np.log(2) == pytest.approx(float(separate.score_samples(wall).mean()), abs=0.05)


# -- from cells or a sample to all points ----------------------------------------------------------


def recorded_runs(patch: pytest.MonkeyPatch) -> list[Rows]:
    """The rows of each run of EM from now on."""
    runs, run = [], truncated.run_truncated
    patch.setattr(truncated, "run_truncated", lambda rows, *rest: (runs.append(rows), run(rows, *rest))[1])
    return runs


@settings(max_examples=30)
@example(  # new candidates on the points would decrease the bound
    seed=9, k=6, dim=2, grain=0.0, max_iter=4, tol=0.0, n_candidates=2, dtype=torch.float64
)
@given(
    seed=st.integers(0, 10**6),
    k=st.integers(1, 7),
    dim=st.integers(1, 3),
    grain=st.sampled_from([0.0, 0.05, 0.25]),
    max_iter=st.integers(2, 30),
    tol=st.sampled_from([0.0, 1e-4, 1e-2]),
    n_candidates=st.integers(2, 7),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_bounds_never_decrease_from_cells_to_points(seed, k, dim, grain, max_iter, tol, n_candidates, dtype):
    points = cloud(1200, dim, seed) + 3 * (torch.arange(1200) % 4)[:, None]
    points = (points / grain).round() * grain if grain else points
    points = points - points.mean(0)
    weight = random_weight(1200, seed)
    first, owner = flat_pieces(points, weight, k, 1e-6)
    k = first.weights.shape[0]
    calls: list[tuple[int, float]] = []
    setup = Settings(1e-6, tol, max_iter, dtype, n_candidates, lambda *call: calls.append(call))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(truncated, "_MANY_POINTS", 1000)
        runs = recorded_runs(patch)
        found = fit_truncated(Rows(points, weight), owner, first, setup)
    assert [rows.are_points for rows in runs] == [False, True]
    assert float(runs[0].weight.sum()) == pytest.approx(float(weight.sum()))
    check_run(found, max_iter, slack=1e-6 if dtype == torch.float32 else 1e-10)
    assert calls == list(enumerate(found.lower_bounds, 1))


def test_few_points_or_many_dimensions_are_not_pooled(monkeypatch):
    monkeypatch.setattr(truncated, "_MANY_POINTS", 1000)
    monkeypatch.setattr(truncated, "pool_into_cells", None)  # a call would fail
    for points, k, max_iter in ((cloud(900, 2), 2, 9), (cloud(1200, 4), 2, 9), (cloud(1200, 2), 20, 9)):
        fit_truncated(
            rows_of(points),
            torch.zeros(len(points), dtype=torch.int64),
            random_parameters(k, points.shape[1]),
            Settings(max_iter=max_iter),
        )
    cells = Rows(em.quadratic_features(cloud(1200, 2)), torch.ones(1200, dtype=torch.float64), False)
    fit_truncated(cells, torch.zeros(1200, dtype=torch.int64), random_parameters(2, 2), Settings())


def test_many_points_start_on_a_sample_without_its_bounds(monkeypatch):
    points = torch.from_numpy(beads(6000, 5)[0])
    first, owner = flat_pieces(points, torch.ones(6000).double(), 5, 1e-6)
    runs, seen = recorded_runs(monkeypatch), []
    setup = Settings(on_iteration=lambda *at: seen.append(at))
    found = fit_truncated(rows_of(points), owner, first, setup)
    sample, whole = runs
    assert sample.weight.shape[0] == 2000
    assert len(torch.unique(sample.values, dim=0)) == 2000
    assert whole.weight.shape[0] == 6000
    assert seen == list(enumerate(found.lower_bounds, 1))
    assert found.lower_bounds == sorted(found.lower_bounds)
