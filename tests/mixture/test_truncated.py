"""GaussianMixture with truncated EM against EM over all components."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from mixture.fit_contract import FitContract, check_mixture
from mixture.mixture_cases import (
    beads,
    cloud,
    random_parameters,
    random_weight,
    room,
    rows_of,
    scipy_log_joint,
)
from scipy.special import logsumexp
from torch import Tensor

from gmmtorch import GaussianMixture, fit_stream
from gmmtorch.datasets.point_files.point_chunks import in_memory
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import chunks
from gmmtorch.mixture import Checkpoint, Parameters, Processes, Rows, gaussian_mixture
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em import loop, truncated
from gmmtorch.mixture.em.initialization import flat_pieces
from gmmtorch.mixture.em.truncated import (
    Settings,
    choose_candidates,
    fit_truncated,
    group_rows,
    nearest,
    truncated_expectation,
)

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


# -- the estimator ---------------------------------------------------------------------------------


def same_start(centers: np.ndarray, variance: float = 1.0) -> dict[str, Any]:
    k, dim = centers.shape
    return {
        "weights_init": np.full(k, 1 / k),
        "means_init": centers + 0.3,
        "precisions_init": np.tile(np.eye(dim) / variance, (k, 1, 1)),
    }


@pytest.mark.parametrize("dim", [2, 3, 5])
@pytest.mark.parametrize(("gap", "tolerance"), [(8.0, 1e-4), (2.5, 0.01)])
def test_equal_start_is_as_likely_as_exact_em(dim, gap, tolerance):
    x, centers = beads(3000, 30, dim, gap)
    options = {**same_start(centers), "tol": 1e-5, "max_iter": 500}
    exact = GaussianMixture(30, algorithm="exact", **options).fit(x)
    found = GaussianMixture(30, algorithm="truncated", **options).fit(x)
    assert found.lower_bound_ <= found.score(x) + 1e-4
    assert found.score(x) > exact.score(x) - tolerance  # overlapping clusters may give a better optimum
    if gap == 8.0:
        np.testing.assert_allclose(found.means_, exact.means_, atol=0.01)
        np.testing.assert_allclose(found.covariances_, exact.covariances_, atol=0.02)


def test_auto_selects_truncated_for_many_pairs_only(monkeypatch):
    called: list[int] = []

    def learn(rows, owner, parameters, setup):
        called.append(len(owner))
        return fit_truncated(rows, owner, parameters, setup)

    monkeypatch.setattr(gaussian_mixture, "fit_truncated", learn)
    monkeypatch.setattr(gaussian_mixture, "_MANY_PAIRS", 48 * 500)
    x = room(500)
    for k, n in ((47, 500), (48, 499)):
        GaussianMixture(k, max_iter=2, init_params="flat_pieces").fit(x[:n])
    assert called == []
    GaussianMixture(48, max_iter=2, init_params="flat_pieces").fit(x)
    assert called == [500]
    GaussianMixture(48, max_iter=2, init_params="flat_pieces", algorithm="exact").fit(x)
    assert called == [500]


def test_component_without_points_gets_weight_zero():
    x, centers = beads(900, 20)
    centers[3] += 1e4
    fit = GaussianMixture(20, **same_start(centers), algorithm="truncated", max_iter=20).fit(x)
    check_mixture(fit, x, at_most=20)
    assert fit.weights_[3] < 1e-12


@pytest.mark.parametrize("algorithm", ["exact", "truncated"])
def test_cells_in_more_than_three_dimensions_are_rejected(algorithm):
    with pytest.raises(InvalidArgumentError, match=r"^max_cells=20 .* 4\b"):
        GaussianMixture(2, max_cells=20, algorithm=algorithm).fit(cloud(50, 4))


@pytest.mark.parametrize("algorithm", ["exact", "truncated"])
@pytest.mark.parametrize("init", ["kmeans", "flat_pieces"])
def test_fewer_cells_than_components_give_copies(algorithm, init):
    x = room(400)
    fit = GaussianMixture(8, max_cells=3, algorithm=algorithm, init_params=init, random_state=0).fit(x)
    check_mixture(fit, x, at_most=8)
    assert len(np.unique(fit.means_.round(6), axis=0)) <= 3


# -- the contract ----------------------------------------------------------------------------------


class TestTruncatedGaussianMixture(FitContract):
    # The E-step is in float32.
    order_tolerance = motion_tolerance = repetition_tolerance = far_tolerance = 2e-3

    def make(self, n_components: int = 3, **options: Any) -> GaussianMixture:
        return GaussianMixture(n_components, **{"random_state": 0, "algorithm": "truncated", **options})


class TestTruncatedGaussianMixtureInFloat64(TestTruncatedGaussianMixture):
    order_tolerance = motion_tolerance = repetition_tolerance = far_tolerance = 1e-6

    def make(self, n_components: int = 3, **options: Any) -> GaussianMixture:
        return super().make(n_components, **{"init_params": "flat_pieces", "dtype": "float64", **options})


class TestGaussianMixtureOnCells(FitContract):
    motion_tolerance = None  # cells are aligned with the axes

    @pytest.fixture(autouse=True)
    def _up_to_three_dimensions(self, request):
        callspec = getattr(request.node, "callspec", None)
        if callspec is not None and callspec.params.get("dim", 0) > 3:
            pytest.skip("cells need at most three dimensions")

    def make(self, n_components: int = 3, **options: Any) -> GaussianMixture:
        usual = {"random_state": 0, "max_cells": 50, "init_params": "flat_pieces"}
        return GaussianMixture(n_components, **{**usual, **options})


class Halves(Processes):
    """Two threads that act as two processes of a group, each with half of the rows."""

    size = 2

    def __init__(self, rank: int, barrier: threading.Barrier, board: list[Tensor | None]) -> None:
        self.rank, self._barrier, self._board = rank, barrier, board

    def sum(self, tensor: Tensor) -> Tensor:
        self._board[self.rank] = tensor
        self._barrier.wait(timeout=60)
        first, second = self._board
        total = first + second
        self._barrier.wait(timeout=60)
        return total


@pytest.mark.parametrize("n", [700, 3000])  # on all points, and on a sample first
def test_processes_that_share_rows_give_the_result_of_one(n):
    points = torch.from_numpy(beads(n, 5)[0])
    points = points[torch.randperm(n, generator=torch.Generator().manual_seed(1))]
    weight = torch.ones(n, dtype=torch.float64)
    first, owner = flat_pieces(points, weight, 5, 1e-6)
    setup = Settings(1e-6, 1e-6, 60, torch.float64)  # all components are candidates
    separate = fit_truncated(Rows(points, weight), owner, first, setup)
    barrier, board = threading.Barrier(2), [None, None]

    def work(rank: int) -> loop.EMResult:
        mine = slice(rank, None, 2)
        shared = replace(setup, processes=Halves(rank, barrier, board))
        return fit_truncated(Rows(points[mine], weight[mine]), owner[mine], first, shared)

    with ThreadPoolExecutor(2) as pool:
        one, other = pool.map(work, range(2))
    assert all(torch.equal(a, b) for a, b in zip(one.parameters, other.parameters, strict=True))
    tolerance = 1e-9 if n == 700 else 1e-3  # the processes draw another sample
    assert one.lower_bounds[-1] == pytest.approx(separate.lower_bounds[-1], abs=tolerance)
    if n == 700:
        torch.testing.assert_close(one.parameters.means, separate.parameters.means, rtol=1e-8, atol=1e-8)


@pytest.mark.filterwarnings("ignore:EM did not converge")
def test_streamed_truncated_em_is_as_good_as_exact_em():
    points = beads(3000, 60)[0]
    source = in_memory(torch.from_numpy(points), "beads", chunk_points=500)
    options = {"random_state": 0, "init_params": "flat_pieces", "reg_covar": 1e-6}
    streamed = fit_stream(GaussianMixture(60, algorithm="truncated", **options), source)
    exact = GaussianMixture(60, algorithm="exact", **options).fit(points)
    assert streamed.score(torch.from_numpy(points)) == pytest.approx(exact.score(points), abs=0.02)
    with pytest.raises(InvalidArgumentError, match="checkpoint"):
        fit_stream(GaussianMixture(60, algorithm="truncated"), source, checkpoint=Checkpoint(Path("never")))


dims = pytest.mark.parametrize("dim", [1, 2, 3, 5])


# -- the E-step ------------------------------------------------------------------------------------


@dims
@pytest.mark.parametrize("m", [1, 3, 8])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("are_points", [True, False])
def test_e_step_over_candidates_equals_brute_force(dim, m, dtype, are_points, monkeypatch):
    monkeypatch.setattr(chunks, "CHUNK_ELEMENTS", 500)  # several chunks
    monkeypatch.setattr(truncated, "_BUILD_ROWS", 70)
    k, n = 8, 300
    tolerance = {torch.float64: 1e-10, torch.float32: 1e-4}[dtype]
    points, weight, parameters = cloud(n, dim), random_weight(n), random_parameters(k, dim, seed=2)
    generator = torch.Generator().manual_seed(1)
    owner = torch.randint(0, k, (n,), generator=generator)
    candidates = torch.stack([torch.randperm(k, generator=generator)[:m] for _ in range(k)])
    groups = group_rows(rows_of(points, weight, are_points), owner, parameters.means, dtype)
    statistics, total, owners = truncated_expectation(groups, candidates, parameters, want_owner=True)

    joint = scipy_log_joint(points, parameters)
    offered = np.zeros((n, k), dtype=bool)
    np.put_along_axis(offered, candidates[owner].numpy(), True, axis=1)
    allowed = np.where(offered, joint, -np.inf)
    norm = logsumexp(allowed, axis=1)
    value = (weight.numpy() * norm).sum()
    assert total == pytest.approx(value, rel=tolerance)
    assert m == k or total < (weight.numpy() * logsumexp(joint, axis=1)).sum()
    assert (owners.numpy() == allowed.argmax(1)).all()
    gamma = np.exp(allowed - norm[:, None]) * weight.numpy()[:, None]
    for component in range(k):
        local = em.quadratic_features(points - parameters.means[component]).numpy()
        expected = (gamma[:, component, None] * local).sum(0)
        np.testing.assert_allclose(statistics[component], expected, atol=tolerance * n)


# -- candidates ------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_candidates_are_the_owner_and_the_most_likely_components(dtype):
    k, m, n = 40, 5, 250  # few rows in each group, so that the sample has all of them
    points, parameters = 2 * cloud(n, 2), random_parameters(k, 2)
    joint = scipy_log_joint(points, parameters)
    owner = torch.from_numpy(joint.argmax(1))
    groups = group_rows(rows_of(points), owner, parameters.means, dtype)
    assert int(groups.n_rows.max()) <= 64
    candidates = choose_candidates(groups, parameters, m)
    assert candidates.shape == (k, m)
    relative = joint - joint.max(1, keepdims=True)
    for group in range(k):
        assert group in candidates[group]
        assert len(set(candidates[group].tolist())) == m
        own = relative[(owner == group).numpy()]
        if len(own) == 0:
            continue
        score = own.max(0)
        score[group] = np.inf
        assert set(candidates[group].tolist()) == set(np.argsort(score)[-m:].tolist())


@pytest.mark.parametrize("reverse", [False, True])
def test_candidate_sample_covers_a_group_in_any_row_order(reverse):
    along = torch.linspace(-10, 10, 5000, dtype=torch.float64)
    points = torch.stack([along.flip(0) if reverse else along, 0 * along], 1)
    means = torch.zeros(20, 2, dtype=torch.float64)
    means[1, 0], means[2, 0] = -11.0, 11.0
    means[3:, 0], means[3:, 1] = torch.tensor([-11.0, 11.0]).repeat(9)[:17], 5.0 + torch.arange(17)
    covariances = torch.eye(2, dtype=torch.float64).repeat(20, 1, 1)
    covariances[0, 0, 0] = 16.0
    parameters = Parameters(torch.full((20,), 0.05, dtype=torch.float64), means, covariances)
    groups = group_rows(rows_of(points), torch.zeros(5000, dtype=torch.int64), means, torch.float32)
    assert sorted(choose_candidates(groups, parameters, 3)[0].tolist()) == [0, 1, 2]


def test_nearest_equals_brute_force():
    points, means = cloud(200, 3), cloud(11, 3, seed=1)
    assert torch.equal(nearest(points, means), torch.cdist(points, means).argmin(1))
