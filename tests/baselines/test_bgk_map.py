"""BGK inference on a grid and from points: the map contract, and a double loop."""

from __future__ import annotations

import math
from typing import ClassVar

import pytest
import torch
from baselines.tensor_file_contract import TensorFileContract
from hypothesis import given
from hypothesis import strategies as st
from occupancy.protocol_contract import RESOLUTION, lattice, wall_scan

from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.experiments.baselines.bgk_map import BGKMap, BGKPointsMap, kernel_offsets, sparse_kernel
from gmmtorch.experiments.baselines.samples import thinned_samples
from gmmtorch.files import read_tensors
from gmmtorch.scan import Scan


class TestBGKMap(TensorFileContract):
    shift_tolerance = 1e-4
    turn_tolerance = 0.05
    thins_scans = True
    damage: ClassVar = {
        "sums": [lambda v: -v - 1, lambda v: v * math.nan, lambda v: v[:1].repeat(len(v) + 1, 1)],
        "blocks": [torch.zeros_like, lambda v: -v - 1],
        "cells": [lambda v: v[:, :-1]],
        "anchor": [lambda v: v + 2**60],
    }

    def make(self) -> BGKMap:
        return BGKMap(RESOLUTION)


class TestBGKPointsMap(TensorFileContract):
    shift_tolerance = 1e-4
    turn_tolerance = 0.05
    thins_scans = True

    def make(self) -> BGKPointsMap:
        return BGKPointsMap(RESOLUTION)


def random_scans(dim: int, n_scans: int = 3, n: int = 20) -> list[Scan]:
    generator = torch.Generator().manual_seed(dim)

    def draw(rows: int) -> torch.Tensor:
        return 2 * torch.rand(rows, dim, generator=generator, dtype=torch.float64) - 1

    return [Scan(draw(n), 0.1 * draw(1)[0], draw(3)) for _ in range(n_scans)]


def kernel(distance: float, length: float) -> float:
    """Melkumyan & Ramos 2009, (8), with Python floats."""
    r = distance / length
    if r >= 1:
        return 0.0
    return (2 + math.cos(2 * math.pi * r)) / 3 * (1 - r) + math.sin(2 * math.pi * r) / (2 * math.pi)


def by_double_loop(point: list[float], scans: list[Scan], made: BGKMap | BGKPointsMap) -> float:
    """θ at a point from all samples of all scans."""
    sums = {True: made.prior, False: made.prior}
    for scan in scans:
        samples, is_hit = thinned_samples(scan, made.free_resolution, made.ds_resolution)
        for sample, hit in zip(samples.tolist(), is_hit.tolist(), strict=True):
            sums[hit] += made.scale * kernel(math.dist(point, sample), made.length)
    return sums[True] / (sums[True] + sums[False])


# -- the kernel ---------------------------------------------------------------------------------------


@given(st.floats(0, 10), st.floats(1e-3, 1e3))
def test_sparse_kernel_equals_its_formula_and_is_positive_definite(distance, length):
    value = float(sparse_kernel(torch.tensor(distance, dtype=torch.float64), length))
    assert value == pytest.approx(kernel(distance, length), abs=1e-12)
    assert 0 <= value <= 1
    x = length * torch.linspace(0, 3, 20, dtype=torch.float64)
    assert float(torch.linalg.eigvalsh(sparse_kernel((x[:, None] - x).abs(), length)).min()) > -1e-10


# -- inference ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("length", [0.06, 0.15, 0.4])
def test_bgk_map_agrees_with_a_double_loop_over_all_samples(dim, length):
    made = BGKMap(0.1, length=length, prior=0.01, scale=0.7, free_resolution=0.3, ds_resolution=0.1)
    scans = random_scans(dim)
    for scan in scans:
        made.insert(scan)
    near = torch.randint(-1, 2, (60, dim), generator=torch.Generator().manual_seed(1))
    cells = torch.cat([scan.points for scan in scans]).div(0.1).floor().long() + near * (length > 0.1)
    centers = (cells.double() + 0.5) * 0.1
    expected = [by_double_loop(center, scans, made) for center in centers.tolist()]
    corner = centers + 0.04  # the same cell
    torch.testing.assert_close(
        made.occupancy(corner), torch.tensor(expected, dtype=torch.float64), rtol=1e-5, atol=1e-6
    )
    assert len({round(x, 3) for x in expected}) > 2


@pytest.mark.parametrize("dim", [2, 3])
def test_bgk_points_map_agrees_with_a_double_loop_over_all_samples(dim):
    made = BGKPointsMap(0.1, length=0.4, prior=0.01, ds_resolution=1e-4, free_resolution=0.3)
    scans = random_scans(dim)
    for scan in scans:
        made.insert(scan)
    points = 2.4 * torch.rand(60, dim, generator=torch.Generator().manual_seed(1)).double() - 1.2
    expected = [by_double_loop(x, scans, made) for x in points.tolist()]
    torch.testing.assert_close(
        made.occupancy(points), torch.tensor(expected, dtype=torch.float64), rtol=1e-5, atol=1e-6
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_kernel_offsets_contain_all_cells_in_reach(dim):
    offsets = {tuple(row) for row in kernel_offsets(0.23, 0.1, dim).tolist()}
    sample = 0.1 * torch.rand(200, dim, generator=torch.Generator().manual_seed(0)).double()
    cells = torch.cartesian_prod(*[torch.arange(-5, 6)] * dim)
    distance = ((cells + 0.5) * 0.1 - sample[:, None]).norm(dim=2)
    reached = {tuple(row) for row in cells[(distance < 0.23).any(0)].tolist()}
    assert reached <= offsets
    assert len(offsets) < len(cells)


# -- a budget of points -------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("max_points", [16, 50, 150])
def test_max_points_limits_the_samples_and_keeps_their_total_weight(dim, max_points, tmp_path):
    made, whole = BGKPointsMap(RESOLUTION, max_points=max_points), BGKPointsMap(RESOLUTION)
    for seed in range(3):
        made.insert(wall_scan(dim, seed))
        whole.insert(wall_scan(dim, seed))
        assert made.n_points <= max_points < whole.n_points
    assert made.nbytes < whole.nbytes
    weights = []
    for one, name in ((whole, "whole"), (made, "map")):
        one.save(tmp_path / f"{name}.safetensors")
        tensors, _ = read_tensors(tmp_path / f"{name}.safetensors", "gmmtorch.bgk_points_map", 1)
        weights.append(sum(float(tensors[f"{label}_samples"][:, 0].sum()) for label in ("hit", "free")))
    assert weights[0] == pytest.approx(weights[1], rel=1e-5)
    loaded = BGKPointsMap.load(tmp_path / "map.safetensors")
    assert torch.equal(loaded.occupancy(lattice(dim)), made.occupancy(lattice(dim)))
    if max_points == 150:  # enough to separate the wall from the space before it
        assert made.occupancy([[3.06, 0.2, 0.1][:dim]])[0] > made.occupancy([[1.5, 0.2, 0.3][:dim]])[0]


def test_bgk_points_map_takes_about_16_bytes_per_point():
    made = BGKPointsMap(RESOLUTION, max_points=1000)
    for seed in range(3):
        made.insert(wall_scan(3, seed))
    assert 16 * made.n_points < made.nbytes < 24 * made.n_points + 2500


# -- bad input ----------------------------------------------------------------------------------------


def test_bgk_map_rejects_options_that_exceed_memory_or_range():
    scan = wall_scan(3)
    with pytest.raises(MemoryLimitError, match="length"):
        BGKMap(0.001, length=1.0, free_resolution=1.0).insert(scan)
    with pytest.raises(MemoryLimitError, match="free_resolution"):
        BGKMap(0.1, free_resolution=1e-6).insert(scan)
    with pytest.raises(MemoryLimitError, match="resolution"):
        BGKMap(0.1, memory_limit=1000).insert(scan)
    with pytest.raises(InvalidArgumentError, match="coarser"):
        BGKMap(0.001, length=0.002, free_resolution=1e5).insert(
            Scan(torch.tensor([[1e6, 0, 0]]).double(), torch.zeros(3).double())
        )
