"""Gaussian process map: the map contract, and scikit-learn's processes block by block."""

from __future__ import annotations

import itertools
import math
from typing import ClassVar

import numpy as np
import pytest
import torch
from baselines.tensor_file_contract import TensorFileContract
from occupancy.protocol_contract import RESOLUTION, lattice, move, shifted, wall_scan
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.baselines.gp_map import GPMap, gp_regression
from gmmtorch.experiments.baselines.samples import thinned_samples
from gmmtorch.scan import Scan


class TestGPMap(TensorFileContract):
    shift_tolerance = 1e-3
    turn_tolerance = 0.1
    thins_scans = True
    damage: ClassVar = {"fused": [lambda v: -v.abs() - 1, lambda v: v.repeat(1, 2)]}

    def make(self) -> GPMap:
        return GPMap(RESOLUTION)

    @pytest.mark.parametrize("dim", [2, 3])
    def test_occupancy_moves_with_a_scene_shifted_by_whole_cells(self, dim):
        """Blocks have separate processes and do not move with the scene: occupancy matches on average."""
        matrix = shifted(dim, (0.125, -0.375, 0.25))
        expected = self.ask(self.built(wall_scan(dim)), lattice(dim))
        theta = self.ask(self.built(wall_scan(dim).transformed(matrix)), move(matrix, lattice(dim)))
        assert float((theta - expected).square().mean().sqrt()) <= self.turn_tolerance


def sklearn_process(length: float, variance: float, noise: float) -> GaussianProcessRegressor:
    kernel = ConstantKernel(variance, "fixed") * Matern(length, "fixed", nu=1.5)
    return GaussianProcessRegressor(kernel, alpha=noise, optimizer=None)


# -- regression -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(
    ("length", "variance", "noise"), [(1.0, 1.0, 0.01), (0.2, 2.5, 0.1), (5.0, 0.3, 0.01)]
)
def test_gp_regression_with_padding_equals_scikit_learn(dim, length, variance, noise, generator):
    sizes = [1, 7, 40]
    positions = torch.randn(3, 40, dim, generator=generator, dtype=torch.float64)
    values = torch.randn(3, 40, generator=generator, dtype=torch.float64)
    is_sample = torch.arange(40) < torch.tensor(sizes)[:, None]
    query = torch.randn(3, 25, dim, generator=generator, dtype=torch.float64)
    means, variances = gp_regression(
        positions, values, is_sample, query, length=length, variance=variance, noise=noise
    )
    for row, size in enumerate(sizes):
        peer = sklearn_process(length, variance, noise).fit(positions[row, :size], values[row, :size])
        mean, deviation = peer.predict(query[row].numpy(), return_std=True)
        np.testing.assert_allclose(means[row], mean, atol=1e-9)
        np.testing.assert_allclose(variances[row], deviation**2, atol=1e-9)


# -- the map --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_gp_map_equals_a_committee_of_scikit_learn_processes(dim):
    """Each cell: scikit-learn on the samples of each block, fused over neighbouring blocks and scans."""
    generator = torch.Generator().manual_seed(dim)
    made = GPMap(0.25, length=0.8, noise=0.05, free_resolution=0.4, known_variance=0.3, block_side=2)
    precision: dict[tuple[int, ...], float] = {}
    weighted: dict[tuple[int, ...], float] = {}
    for _ in range(2):
        scan = Scan(
            2 * torch.rand(6, dim, generator=generator, dtype=torch.float64),
            torch.rand(dim, generator=generator, dtype=torch.float64),
        )
        made.insert(scan)
        samples, is_hit = thinned_samples(scan, 0.4, 0.25)
        blocks: dict[tuple[int, ...], list[int]] = {}
        for index, sample in enumerate(samples.tolist()):
            blocks.setdefault(tuple(math.floor(x / 0.5) for x in sample), []).append(index)
        for block, members in blocks.items():
            peer = sklearn_process(0.8, 1.0, 0.05)
            peer.fit(samples[members].numpy(), np.where(is_hit[members].numpy(), 1.0, -1.0))
            for axis, step in [(0, 0), *itertools.product(range(dim), (-1, 1))]:
                neighbour = [x + (step if a == axis else 0) for a, x in enumerate(block)]
                for corner in itertools.product((0, 1), repeat=dim):
                    cell = tuple(2 * b + c for b, c in zip(neighbour, corner, strict=True))
                    mean, deviation = peer.predict([[(x + 0.5) * 0.25 for x in cell]], return_std=True)
                    precision[cell] = precision.get(cell, 1 / 1000.0) + 1 / deviation[0] ** 2 - 1
                    weighted[cell] = weighted.get(cell, 0.0) + mean[0] / deviation[0] ** 2
    cells = list(precision)
    expected = [
        1 / (1 + math.exp(-100 * 0.001 * weighted[cell])) if precision[cell] >= 1 / 0.3 else 0.5
        for cell in cells
    ]
    theta = made.occupancy((torch.tensor(cells).double() + 0.5) * 0.25)
    torch.testing.assert_close(theta, torch.tensor(expected, dtype=torch.float64), rtol=1e-4, atol=1e-5)
    assert 0.1 < sum(x == 0.5 for x in expected) / len(expected) < 0.9


# -- bad input ------------------------------------------------------------------------------------------


def test_gp_map_rejects_too_many_samples_per_block():
    scan = Scan(torch.rand(3000, 2, generator=torch.Generator().manual_seed(0)), torch.zeros(2))
    with pytest.raises(InvalidArgumentError, match="ds_resolution"):
        GPMap(1.0, ds_resolution=1e-6).insert(scan)
