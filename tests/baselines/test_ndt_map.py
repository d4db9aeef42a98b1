"""NDT map: the map contract, and independent computations of its moments and likelihoods."""

from __future__ import annotations

import math
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from baselines.tensor_file_contract import TensorFileContract
from hypothesis import given
from hypothesis import strategies as st
from occupancy.protocol_contract import RESOLUTION, lattice, wall_scan
from scipy.optimize import minimize_scalar

from gmmtorch.errors import MemoryLimitError
from gmmtorch.experiments.baselines.ndt_map import NDTMap, closest_on_line, combine_moments
from gmmtorch.files import read_tensors
from gmmtorch.linalg import unpack_symmetric
from gmmtorch.scan import Scan


class TestNDTMap(TensorFileContract):
    shift_tolerance = 1e-3
    turn_tolerance = 0.05
    damage: ClassVar = {
        "log_odds": [lambda v: v * math.nan],
        "gaussians": [lambda v: v * math.nan],
        "gaussian_cells": [lambda v: ~v],
    }

    def make(self) -> NDTMap:
        return NDTMap(RESOLUTION)


def stored(made: NDTMap, folder: Path) -> dict[str, torch.Tensor]:
    """The tensors of the map's file."""
    made.save(folder / "map.safetensors")
    return read_tensors(folder / "map.safetensors", "gmmtorch.ndt_map", 1)[0]


def moments(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Count, mean and scatter of points (N, D)."""
    n = torch.tensor(float(points.shape[0]), dtype=torch.float64)
    mean = points.mean(0) if points.shape[0] else points.new_zeros(points.shape[1])
    return n, mean, (points - mean).T @ (points - mean)


# -- moments ---------------------------------------------------------------------------------------------


@given(st.integers(0, 10**6), st.lists(st.integers(0, 9), min_size=1, max_size=6), st.integers(2, 3))
def test_combined_moments_equal_those_of_all_points(seed, sizes, dim):
    generator = torch.Generator().manual_seed(seed)
    parts = [5 + torch.randn(size, dim, generator=generator, dtype=torch.float64) for size in sizes]
    state = moments(torch.empty(0, dim, dtype=torch.float64))
    for part in parts:
        state = combine_moments(*state, *moments(part))
    for made, expected in zip(state, moments(torch.cat(parts)), strict=True):
        torch.testing.assert_close(made, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_cell_stores_the_moments_of_its_returns(dim, tmp_path):
    """One cell with several scans from inside it, so that it has no misses, against numpy."""
    generator = torch.Generator().manual_seed(dim)
    made = NDTMap(1.0)
    clouds = [500 + 0.99 * torch.rand(n, dim, generator=generator, dtype=torch.float64) for n in (3, 1, 40)]
    for cloud in clouds:
        made.insert(Scan(cloud, torch.full((dim,), 500.5, dtype=torch.float64)))
    points = torch.cat(clouds).numpy()
    tensors = stored(made, tmp_path)
    n, mean, scatter = tensors["gaussians"][0].double().split([1, dim, dim * (dim + 1) // 2])
    assert float(n) == 44
    assert float(tensors["log_odds"]) == pytest.approx(44 * math.log(1.5), rel=1e-6)
    np.testing.assert_allclose(mean + 500.5, points.mean(0), atol=1e-6)
    covariance = unpack_symmetric(scatter[None], dim)[0] / 43
    np.testing.assert_allclose(covariance, np.cov(points.T), rtol=1e-4, atol=1e-6)


def test_older_returns_lose_weight_above_max_points(tmp_path, generator):
    old = torch.rand(1000, 2, generator=generator).double() * 0.2
    new = 0.7 + torch.rand(100, 2, generator=generator).double() * 0.2
    means = []
    for limit in (100, 10**9):
        made = NDTMap(1.0, max_points=limit)
        for cloud in (old, new):
            made.insert(Scan(cloud, torch.tensor([0.5, 0.5]).double()))
        means.append(stored(made, tmp_path)["gaussians"][0, 1] + 0.5)
    assert float(means[0]) == pytest.approx(0.45, abs=0.02)  # half old, half new
    assert float(means[1]) == pytest.approx((1000 * 0.1 + 100 * 0.8) / 1100, abs=0.02)


# -- beams -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_closest_on_line_equals_a_numerical_search(dim):
    generator = torch.Generator().manual_seed(dim)
    start, end, mean = torch.randn(3, 8, dim, generator=generator, dtype=torch.float64)
    factor = torch.randn(8, dim, dim, generator=generator, dtype=torch.float64)
    precision = factor @ factor.transpose(1, 2) + 0.1 * torch.eye(dim)
    share, point, likelihood = closest_on_line(start, end, mean, precision)
    for k in range(8):

        def cost(t: float, k: int = k) -> float:
            difference = start[k] + t * (end[k] - start[k]) - mean[k]
            return float(difference @ precision[k] @ difference)

        best = minimize_scalar(cost, bracket=(-1.0, 1.0), tol=1e-12)
        assert float(share[k]) == pytest.approx(best.x, abs=1e-6)
        assert float(likelihood[k]) == pytest.approx(math.exp(-0.5 * best.fun), abs=1e-9)
        torch.testing.assert_close(point[k], start[k] + share[k] * (end[k] - start[k]))


N_RETURNS = 20


def sheet(n: int = N_RETURNS) -> Scan:
    """Returns of a thin, level sheet in the cell [1, 2) × [0, 1), observed from above."""
    x = 1.2 + 0.6 * torch.linspace(0, 1, n, dtype=torch.float64)
    y = 0.3 + 0.01 * (torch.arange(n) % 3).double()
    return Scan(torch.stack([x, y], 1), torch.tensor([1.5, 0.9], dtype=torch.float64))


def log_odds_at(made: NDTMap, point: list[float]) -> float:
    """Log-odds of a cell of a map with infinite spread, whose occupancy is that of the cell."""
    theta = made.occupancy([point])[0]
    return math.log(theta / (1 - theta))


def test_a_beam_adds_log_odds_by_its_likelihood_of_crossing_the_gaussian():
    before = N_RETURNS * math.log(1.5)
    beside, through = (NDTMap(1.0, min_deviation=0.001, spread=math.inf) for _ in range(2))
    for made, height in ((beside, 0.8), (through, 0.31)):
        made.insert(sheet())
        level = Scan(torch.tensor([[6.5, height]]).double(), torch.tensor([-3.5, height]).double())
        made.insert(level)
        assert log_odds_at(made, [4.5, 0.5]) == pytest.approx(-0.2)  # a cell without a Gaussian
        assert log_odds_at(made, [6.5, 0.5]) == pytest.approx(math.log(1.5))
    assert log_odds_at(beside, [1.5, 0.5]) == pytest.approx(before, rel=1e-6)
    likelihood = 1.0  # the mean lies on the beam, five metres before its end
    free = 0.5 + 0.1 * likelihood
    assert log_odds_at(through, [1.5, 0.5]) == pytest.approx(before + math.log((1 - free) / free), rel=1e-4)


def test_the_gaussian_of_a_cell_that_becomes_free_is_deleted(tmp_path):
    made = NDTMap(1.0, max_log_odds=2.0)
    made.insert(sheet())
    assert float(made.occupancy([[1.5, 0.31]])[0]) > 0.8
    beam = Scan(torch.tensor([[6.5, 0.31]]).double().repeat(20, 1), torch.tensor([-3.5, 0.31]).double())
    made.insert(beam)
    assert float(made.occupancy([[1.5, 0.31]])[0]) < 0.5
    assert len(stored(made, tmp_path)["gaussians"]) == 1  # only that of the beam's end


def test_occupancy_decreases_with_the_mahalanobis_distance():
    scan, spread = sheet(), 2.0
    made = NDTMap(1.0, spread=spread, min_deviation=0.005)
    made.insert(scan)
    query = torch.tensor([[1.5, 0.31], [1.5, 0.34], [1.7, 0.32], [1.5, 0.7]], dtype=torch.float64)
    covariance = np.cov(scan.points.numpy().T)
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values, max(1e-3 * values[-1], 0.005**2))
    difference = (query.numpy() - scan.points.numpy().mean(0)) @ vectors
    cell = 1 / (1 + math.exp(-N_RETURNS * math.log(1.5)))
    expected = cell * np.exp(-0.5 * (difference**2 / values).sum(1) / spread**2)
    np.testing.assert_allclose(made.occupancy(query.numpy()), expected, rtol=1e-3, atol=1e-9)
    whole = NDTMap(1.0, spread=math.inf)
    whole.insert(scan)
    np.testing.assert_allclose(whole.occupancy(query.numpy()), cell, rtol=1e-7)


# -- bad input -------------------------------------------------------------------------------------------


def test_ndt_map_rejects_scans_that_exceed_memory():
    with pytest.raises(MemoryLimitError, match="resolution"):
        NDTMap(0.1, memory_limit=1000).insert(wall_scan(3))
    far = Scan(torch.full((1, 3), 500.0).double(), torch.zeros(3).double())
    with pytest.raises(MemoryLimitError, match="max_range"):
        NDTMap(0.001).insert(far)
    NDTMap(0.001, max_range=1.0).insert(far)


def test_ndt_map_accepts_beams_of_zero_length_and_equal_returns():
    origin = torch.tensor([0.3, 0.3, 0.3]).double()
    made = NDTMap(0.1)
    for _ in range(3):
        made.insert(Scan(origin.repeat(10, 1), origin))
    theta = made.occupancy(lattice(3))
    assert bool(((theta >= 0) & (theta <= 1)).all())
    assert float(made.occupancy(origin[None])[0]) > 0.5
