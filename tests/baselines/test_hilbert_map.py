"""Hilbert maps: the map contract, exact kernels, and scikit-learn's optimum on the same features."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
import pytest
import torch
from baselines.tensor_file_contract import TensorFileContract
from occupancy.protocol_contract import RESOLUTION, wall_scan
from sklearn.gaussian_process.kernels import RBF
from sklearn.kernel_approximation import Nystroem
from sklearn.linear_model import LogisticRegression
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.baselines.bgk_map import sparse_kernel
from gmmtorch.experiments.baselines.hilbert.hilbert_features import FourierFeatures, NystroemFeatures
from gmmtorch.experiments.baselines.hilbert.hilbert_map import Features, HilbertMap
from gmmtorch.experiments.baselines.hilbert.lattice_features import LatticeFeatures
from gmmtorch.experiments.baselines.hilbert.logistic_regression import logistic_regression
from gmmtorch.scan import Scan

LEARNING = {"gap": RESOLUTION, "alpha": 0.05, "batch_size": 512, "learning_rate": 1.0}


class TestSparse(TensorFileContract):
    shift_tolerance = 1e-4
    turn_tolerance = 0.1
    thins_scans = True
    damage: ClassVar = {"weights": [lambda v: v * math.nan]}

    def make(self) -> HilbertMap:
        return HilbertMap(
            "sparse", length=0.25, spacing=0.125, free_spacing=0.25, thin=RESOLUTION, epochs=8, **LEARNING
        )


class TestNystroem(TensorFileContract):
    """Centres are drawn from the points, in another order if the scene is rotated."""

    shift_tolerance = 1e-4
    turn_tolerance = 0.25
    thins_scans = True
    damage: ClassVar = {"weights": [lambda v: v * math.nan]}
    extrapolates = True  # up to five lengths, here 1.25 m

    def make(self) -> HilbertMap:
        return HilbertMap(
            "nystroem", length=0.25, n_features=300, free_spacing=0.5, thin=0.25, epochs=12, **LEARNING
        )

    def test_points_beyond_five_lengths_from_all_centres_are_unknown(self):
        made = self.built(wall_scan(2))
        beside = torch.tensor([[3.1, 1.6 + 5 * 0.25], [3.1, 1.5 + 3 * 0.25]], dtype=torch.float64)
        theta = made.occupancy(beside)
        assert float(theta[0]) == 0.5 != float(theta[1])
        assert made.occupancy([[300.0, -2.0]]).tolist() == [0.5]


class TestFourier(TensorFileContract):
    """Features are waves, so values in unobserved space are arbitrary and change under rotation."""

    shift_tolerance = 1e-4
    turn_tolerance = 0.5
    thins_scans = True
    damage: ClassVar = {"weights": [lambda v: v * math.nan]}
    extrapolates = True

    def make(self) -> HilbertMap:
        return HilbertMap(
            "fourier", length=0.4, n_features=300, free_spacing=0.5, thin=0.25, epochs=12, **LEARNING
        )


# -- features --------------------------------------------------------------------------------------------


def some_points(n: int, dim: int, seed: int = 0) -> Tensor:
    return 3 * torch.rand(n, dim, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def matrix(features: Features, points: Tensor) -> Tensor:
    """Φ (M, F), one feature at a time."""
    design = features.design(points)
    return torch.stack([design.dot(one) for one in torch.eye(features.count, dtype=torch.float64)], 1)


def lattice_of(points: Tensor, kernel: str, length: float, spacing: float) -> LatticeFeatures:
    made = LatticeFeatures(kernel, length, spacing, points.shape[1], 1, points.device)
    made.add_nodes(points)
    return made


def all_features(points: Tensor) -> list[Features]:
    generator, anchor = torch.Generator().manual_seed(1), points.new_ones(points.shape[1])
    return [
        FourierFeatures.drawn(40, 0.7, anchor, generator),
        NystroemFeatures.of_data(points, 40, 0.7, anchor, generator),
        lattice_of(points, "sparse", 0.8, 0.4),
        lattice_of(points, "rbf", 0.2, 0.4),
    ]


@pytest.mark.parametrize("dim", [2, 3])
def test_design_products_equal_those_of_its_matrix(dim):
    points, residuals = some_points(70, dim), torch.randn(70, dtype=torch.float64)
    for features in all_features(points):
        phi = matrix(features, points)
        design = features.design(points)
        weights = torch.randn(features.count, dtype=torch.float64)
        torch.testing.assert_close(design.dot(weights), phi @ weights)
        torch.testing.assert_close(design.transpose_dot(residuals), phi.T @ residuals)
        index = torch.tensor([3, 3, 0, 69])
        torch.testing.assert_close(design.rows(index).dot(weights), (phi @ weights)[index])
        torch.testing.assert_close(
            design.rows(index).transpose_dot(residuals[:4]), phi[index].T @ residuals[:4]
        )


@pytest.mark.parametrize("dim", [2, 3])
def test_fourier_features_approximate_the_rbf_kernel_with_the_expected_error(dim):
    points = some_points(60, dim)
    exact = torch.as_tensor(RBF(0.6)(points.numpy()))
    for n_features in (100, 1000):
        generator = torch.Generator().manual_seed(0)
        features = FourierFeatures.drawn(n_features, 0.6, points.new_zeros(dim), generator)
        phi = matrix(features, points)[:, 1:]
        error = phi @ phi.T - exact
        assert float(error.diagonal().abs().max()) < 1e-6  # cos² + sin²
        # Variance of cos(ωᵀδ), ½(1 + k(2δ)) − k(δ)², divided by the number of frequencies F/2.
        variance = (0.5 * (1 + exact**4) - exact**2) / (n_features / 2)
        assert 0.7 < float((error.square().mean() / variance.mean()).sqrt()) < 1.4


@pytest.mark.parametrize("dim", [2, 3])
def test_nystroem_features_equal_scikit_learns_up_to_a_rotation(dim):
    points = some_points(80, dim)
    centers = some_points(25, dim, 1)
    features = NystroemFeatures(centers, points.new_zeros(dim), 0.5)
    reference = Nystroem(gamma=1 / (2 * 0.5**2), n_components=25, random_state=0).fit(
        features.centers.double()
    )
    expected = reference.transform(points.numpy())
    phi = matrix(features, points).numpy()
    np.testing.assert_allclose(phi @ phi.T, expected @ expected.T, atol=2e-3)  # the ridge of 10⁻⁶
    at_centers = matrix(features, features.centers.double())
    exact = torch.as_tensor(RBF(0.5)(features.centers.double().numpy()))
    assert float((at_centers @ at_centers.T - exact).abs().max()) < 1e-5


@pytest.mark.parametrize(("kernel", "length"), [("sparse", 0.8), ("rbf", 0.25)])
@pytest.mark.parametrize("offset", [0.0, 4_000_000.0])
def test_lattice_features_are_kernels_at_the_cells_that_contain_data(kernel, length, offset):
    data, points = some_points(30, 3) + offset, some_points(200, 3, 1) * 1.5 - 1 + offset
    features = lattice_of(data, kernel, length, 0.5)
    cells = torch.unique(((data - offset) / 0.5).floor(), dim=0)
    nodes = (cells + 0.5) * 0.5 + offset
    assert sorted(nodes.tolist()) == sorted(features.table.centers().tolist())
    distance = (points[:, None] - features.table.centers()).norm(dim=2)
    if kernel == "sparse":
        expected = sparse_kernel(distance, length)
    else:
        expected = torch.exp(-(distance**2) / (2 * length**2))
        expected[expected < 1e-3] = 0
    torch.testing.assert_close(features.design(points).dense(), expected, rtol=1e-6, atol=1e-7)
    assert torch.equal(features.design(points).in_reach(), (expected > 0).any(1))
    assert 0 < int(features.design(points).in_reach().sum()) < 200


# -- learning --------------------------------------------------------------------------------------------


def labelled_points(n: int = 400) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(2)
    points = some_points(n, 2)
    odds = 4 * (points[:, 0] * 2).sin() + 2 * points[:, 1] - 3
    return points, torch.rand(n, generator=generator, dtype=torch.float64) < torch.sigmoid(odds)


def penalised_loss(phi: Tensor, is_hit: Tensor, w: Tensor, alpha: float, l1_ratio: float) -> float:
    """−ln likelihood of labels, with the penalty of the weights. phi: (N, F)."""
    theta = torch.sigmoid(phi @ w)
    likelihood = torch.where(is_hit, theta, 1 - theta)
    penalty = l1_ratio * w.abs().sum() + (1 - l1_ratio) / 2 * w.square().sum()
    return float(alpha * penalty - likelihood.log().sum())


@pytest.mark.parametrize(("kind", "l1_ratio"), [(0, 1.0), (1, 0.5), (2, 0.0)])
def test_logistic_regression_reaches_scikit_learns_optimum(kind, l1_ratio):
    points, is_hit = labelled_points()
    features = all_features(points)[kind]
    design, phi = features.design(points), matrix(features, points)
    alpha = 1.5
    reference = LogisticRegression(
        C=1 / alpha, l1_ratio=l1_ratio, solver="saga", fit_intercept=False, max_iter=20_000, tol=1e-6
    )
    reference.fit(phi.numpy(), is_hit.numpy())
    best = torch.as_tensor(reference.coef_[0])
    optimum = penalised_loss(phi, is_hit, best, alpha, l1_ratio)
    weights = logistic_regression(
        design,
        is_hit,
        torch.zeros(features.count, dtype=torch.float64),
        alpha=alpha,
        l1_ratio=l1_ratio,
        epochs=1500,
        batch_size=400,
        learning_rate=0.5,
        generator=torch.Generator().manual_seed(0),
    )
    reached = penalised_loss(phi, is_hit, weights, alpha, l1_ratio)
    start = 400 * math.log(2)
    assert -1e-6 * optimum < reached - optimum < 1e-3 * (start - optimum)
    assert float((torch.sigmoid(design.dot(weights)) - torch.sigmoid(design.dot(best))).abs().max()) < 0.03
    if l1_ratio == 1 and kind != 1:  # Nyström features are nearly dependent, so the zeros are not unique
        assert torch.equal(weights.abs() < 1e-3, best.abs() < 1e-3)
        assert bool((weights == 0).any())


def test_small_batches_reach_the_optimum_in_few_epochs():
    points, is_hit = labelled_points(4000)
    features = lattice_of(points, "sparse", 0.8, 0.4)
    design = features.design(points)
    phi = design.dense()
    reference = LogisticRegression(C=1.0, fit_intercept=False, max_iter=5000)
    reference.fit(phi.numpy(), is_hit.numpy())
    optimum = penalised_loss(phi, is_hit, torch.as_tensor(reference.coef_[0]), 1.0, 0.0)
    weights = logistic_regression(
        design,
        is_hit,
        torch.zeros(features.count, dtype=torch.float64),
        alpha=1.0,
        l1_ratio=0.0,
        epochs=5,
        batch_size=64,
        learning_rate=0.5,
        generator=torch.Generator().manual_seed(0),
    )
    gained = 4000 * math.log(2) - penalised_loss(phi, is_hit, weights, 1.0, 0.0)
    assert gained > 0.98 * (4000 * math.log(2) - optimum)


# -- the map ---------------------------------------------------------------------------------------------


def test_hilbert_map_rejects_a_lattice_with_gaps():
    made = HilbertMap(length=0.1, spacing=0.5)
    with pytest.raises(InvalidArgumentError, match="gaps"):
        made.insert(wall_scan(2))


def test_a_loaded_lattice_grows_and_keeps_its_occupancy(tmp_path):
    made = TestSparse().built(wall_scan(2))
    made.save(tmp_path / "map.safetensors")
    loaded = HilbertMap.load(tmp_path / "map.safetensors")
    elsewhere = Scan([[20.0, 20.0]], [20.0, 18.0])
    loaded.insert(elsewhere)
    theta = loaded.occupancy([[3.0625, 0.1875], [20.0, 20.0], [20.0, 19.0], [10.0, 10.0]])
    assert theta[0] > 0.6
    assert theta[1] > 0.5 > theta[2]
    assert theta[3] == 0.5
