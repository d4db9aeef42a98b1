"""Hilbert maps and Bayesian Hilbert maps: the map contract, features, and independent posteriors."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
import torch
from baselines.tensor_file_contract import TensorFileContract, check_damaged_files_are_refused
from occupancy.protocol_contract import RESOLUTION, lattice, open_scan, wall_scan
from sklearn.gaussian_process.kernels import RBF
from sklearn.kernel_approximation import Nystroem
from sklearn.linear_model import LogisticRegression
from torch import Tensor
from torch.distributions import MultivariateNormal, kl_divergence

from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.experiments.baselines import BayesianHilbertMap, HilbertMap
from gmmtorch.experiments.baselines.bgk_map import sparse_kernel
from gmmtorch.experiments.baselines.hilbert_features import (
    LatticeDesign,
    LatticeFeatures,
    fourier_features,
    nystroem_centers,
    nystroem_features,
)
from gmmtorch.experiments.baselines.hilbert_map import (
    Features,
    Posterior,
    fit_posterior,
    jaakkola_lambda,
    logistic_regression,
    moderated,
    moments,
    variational_step,
)
from gmmtorch.experiments.baselines.samples import beam_samples
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
        fourier_features(torch.randn(20, points.shape[1], generator=generator) / 0.7, anchor),
        nystroem_features(nystroem_centers(points - anchor, 40, 0.7, generator), anchor, 0.7),
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
        frequencies = torch.randn(n_features // 2, dim, generator=generator) / 0.6
        features = fourier_features(frequencies, points.new_zeros(dim))
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
    features = nystroem_features(centers, points.new_zeros(dim), 0.5)
    centers = features.tensors["centers"].double()
    reference = Nystroem(gamma=1 / (2 * 0.5**2), n_components=25, random_state=0).fit(centers)
    expected = reference.transform(points.numpy())
    phi = matrix(features, points).numpy()
    np.testing.assert_allclose(phi @ phi.T, expected @ expected.T, atol=2e-3)  # the ridge of 10⁻⁶
    at_centers = matrix(features, centers)
    exact = torch.as_tensor(RBF(0.5)(centers.numpy()))
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


@pytest.mark.parametrize(
    "made", [HilbertMap(length=0.1, spacing=0.5), BayesianHilbertMap(100.0, spacing=1.0)]
)
def test_lattices_and_hinges_with_gaps_are_rejected(made):
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


class TestMeanField(TensorFileContract):
    shift_tolerance = 1e-4
    turn_tolerance = 0.1
    overshoot = 0.1
    thins_scans = True
    damage: ClassVar = {"means": [lambda v: v * math.inf], "precisions": [lambda v: -v - 1]}

    def make(self) -> BayesianHilbertMap:
        return BayesianHilbertMap(
            160.0, spacing=RESOLUTION, free_spacing=0.25, gap=RESOLUTION, thin=RESOLUTION, n_iter=2
        )


# -- inference -------------------------------------------------------------------------------------------


def problem(n: int, n_features: int, seed: int = 0) -> tuple[LatticeDesign, Tensor]:
    """Points along a line of hinges, 0.4 m apart, with overlapping kernels, and labels that vary along it."""
    generator = torch.Generator().manual_seed(seed)
    x = 0.4 * n_features * torch.rand(n, generator=generator, dtype=torch.float64)
    points = torch.stack([x, torch.full_like(x, 0.2)], 1)
    features = LatticeFeatures("rbf", 0.3, 0.4, 2, 2, points.device)
    features.add_nodes(points)
    assert features.count == n_features
    odds = 3 * (2 * x).sin() + 0.5
    return features.design(points), torch.rand(n, generator=generator, dtype=torch.float64) < torch.sigmoid(
        odds
    )


def prior_of(n_features: int, full: bool, variance: float = 4.0) -> Posterior:
    precision = torch.full((n_features,), 1 / variance, dtype=torch.float64)
    return Posterior(torch.zeros_like(precision), precision.diag() if full else precision)


def exact_posterior(
    design: LatticeDesign, is_hit: Tensor, variance: float
) -> tuple[float, Tensor, Tensor, Tensor]:
    """ln p(y), mean and covariance of the weights, and mean of σ(wᵀφ), by quadrature on a grid."""
    phi = design.dense()
    axis = torch.linspace(-12, 12, 401, dtype=torch.float64)
    w = torch.cartesian_prod(*[axis] * phi.shape[1]).reshape(-1, phi.shape[1])
    sign = torch.where(is_hit, 1.0, -1.0).double()
    log = torch.nn.functional.logsigmoid((w @ phi.T) * sign).sum(1)
    log = log - 0.5 * w.square().sum(1) / variance - 0.5 * w.shape[1] * math.log(2 * math.pi * variance)
    cell = (axis[1] - axis[0]) ** w.shape[1]
    total = torch.logsumexp(log, 0)
    weight = (log - total).exp()
    mean = weight @ w
    covariance = ((w - mean) * weight[:, None]).T @ (w - mean)
    return float(total + cell.log()), mean, covariance, weight @ torch.sigmoid(w @ phi.T)


def evidence_bound(design: LatticeDesign, is_hit: Tensor, prior: Posterior, posterior: Posterior) -> float:
    """Lower bound of ln p(y) with the optimal ξ for this posterior (Jaakkola & Jordan 2000).

    Σ ln σ(ξ) − ξ/2 + (y − ½) E[wᵀφ] − KL(posterior ‖ prior), with ξ² = E[(wᵀφ)²].
    """
    mean, variance = moments(design, posterior)
    xi = (mean.square() + variance).sqrt()
    fit = torch.nn.functional.logsigmoid(xi) - 0.5 * xi + (is_hit.double() - 0.5) * mean
    one, other = (MultivariateNormal(x.mean, precision_matrix=x.precision) for x in (posterior, prior))
    return float(fit.sum() - kl_divergence(one, other))


def test_jaakkola_lambda_equals_its_formula():
    xi = torch.tensor([1e-9, 1e-3, 0.5, 3.0, 40.0], dtype=torch.float64)
    expected = (torch.sigmoid(xi) - 0.5) / (2 * xi)
    torch.testing.assert_close(jaakkola_lambda(xi)[1:], expected[1:])
    torch.testing.assert_close(jaakkola_lambda(torch.zeros(1).double()), torch.tensor([0.125]).double())


@pytest.mark.parametrize("n_features", [1, 2])
@pytest.mark.parametrize("n", [1, 10, 60])
def test_variational_posterior_is_close_to_quadrature(n_features, n):
    design, is_hit = problem(max(n, 8), n_features)
    design, is_hit = design.rows(torch.arange(n)), is_hit[:n]
    prior = prior_of(n_features, full=True)
    evidence, mean, covariance, theta = exact_posterior(design, is_hit, 4.0)
    posterior = fit_posterior(design, is_hit, prior, "full", 100)
    bound = evidence_bound(design, is_hit, prior, posterior)
    assert bound <= evidence + 1e-9
    assert bound > evidence - 0.35 * n_features
    deviation = covariance.diagonal().sqrt()
    assert float(((posterior.mean - mean) / deviation).abs().max()) < 0.25
    found = torch.linalg.inv(posterior.precision).diagonal().sqrt()
    assert bool((found < 1.05 * deviation).all())  # the bound underestimates the variance
    assert bool((found > 0.6 * deviation).all())
    assert float((moderated(*moments(design, posterior)) - theta).abs().max()) < 0.05


def test_evidence_bound_is_highest_at_its_posterior(generator):
    design, is_hit = problem(100, 4)
    prior = prior_of(4, full=True)
    best = fit_posterior(design, is_hit, prior, "full", 300)
    bound = evidence_bound(design, is_hit, prior, best)
    for _ in range(20):
        mean = best.mean + 0.05 * torch.randn(4, generator=generator, dtype=torch.float64)
        assert evidence_bound(design, is_hit, prior, replace(best, mean=mean)) < bound
    for scale in (0.9, 1.1):
        other = Posterior(best.mean, best.precision * scale)
        assert evidence_bound(design, is_hit, prior, other) < bound


def test_mean_field_has_the_full_mean_and_the_diagonal_precision():
    design, is_hit = problem(80, 6)
    xi = torch.linspace(0.1, 4, 80, dtype=torch.float64)
    full = variational_step(design, is_hit, prior_of(6, full=True), xi, "full")
    found = variational_step(design, is_hit, prior_of(6, full=False), xi, "mean_field")
    torch.testing.assert_close(found.mean, full.mean, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found.precision, full.precision.diagonal())


def test_diagonal_form_equals_its_formula_and_is_exact_without_overlap():
    design, is_hit = problem(80, 6)
    xi, prior = torch.linspace(0.1, 4, 80, dtype=torch.float64), prior_of(6, full=False)
    found = variational_step(design, is_hit, prior, xi, "diagonal")
    phi, lam = design.dense().numpy(), jaakkola_lambda(xi).numpy()
    variance = 1 / (1 / 4.0 + 2 * (phi.T**2 * lam).sum(1))
    np.testing.assert_allclose(1 / found.precision.numpy(), variance)
    np.testing.assert_allclose(found.mean.numpy(), variance * (phi.T @ (is_hit.numpy() - 0.5)))
    separate = LatticeFeatures("rbf", 0.1, 0.4, 2, 2, torch.device("cpu"))
    points = torch.tensor([[0.2, 0.2], [1.0, 0.2], [1.05, 0.2], [2.6, 0.2]], dtype=torch.float64)
    separate.add_nodes(points)
    labels = torch.tensor([True, False, False, True])
    one = fit_posterior(separate.design(points), labels, prior_of(3, full=False), "diagonal", 20)
    other = fit_posterior(separate.design(points), labels, prior_of(3, full=True), "full", 20)
    torch.testing.assert_close(one.mean, other.mean)


def test_moderated_approximates_the_mean_of_the_sigmoid():
    nodes, weights = np.polynomial.hermite_e.hermegauss(80)
    for m in (-4.0, -0.5, 0.0, 2.0):
        for v in (0.01, 1.0, 20.0):
            mean = float((weights / (1 + np.exp(-(m + math.sqrt(v) * nodes)))).sum() / weights.sum())
            found = float(moderated(torch.tensor(m).double(), torch.tensor(v).double()))
            assert abs(found - mean) < 0.02


# -- the map ---------------------------------------------------------------------------------------------


def full_map(**options: float) -> BayesianHilbertMap:
    return BayesianHilbertMap(
        20.0, spacing=0.3, covariance="full", free_spacing=0.3, gap=0.125, thin=0.25, **options
    )


def test_the_posterior_of_each_scan_is_the_prior_of_the_next(generator):
    made = full_map()
    scans = [wall_scan(2), wall_scan(2, 1, (1.3, -0.7, 0.3)), open_scan(2)]
    previous = Posterior(torch.empty(0).double(), torch.empty(0, 0).double())
    earlier = torch.empty(0, 2).double()
    for scan in scans:
        points, is_hit = beam_samples(scan, 0.3, gap=0.125, thin=0.25, generator=generator)
        made.insert(scan)
        # Hinges are matched by position, because their order changes when hinges are added.
        rows = torch.cdist(earlier, made.hinges).argmin(1) if len(earlier) else torch.empty(0).long()
        mean, precision = torch.zeros(len(made.hinges)).double(), torch.eye(len(made.hinges)).double() / 10
        mean[rows] = previous.mean
        precision[rows[:, None], rows] = previous.precision
        features = LatticeFeatures("rbf", (2 * made.gamma) ** -0.5, made.spacing, 2, 2, points.device)
        features.add_nodes(made.hinges)
        design, prior = features.design(points), Posterior(mean, precision)
        expected = fit_posterior(design, is_hit, prior, "full", made.n_iter)
        torch.testing.assert_close(made.posterior.mean, expected.mean, rtol=1e-3, atol=1e-3)
        previous, earlier = made.posterior, made.hinges


def test_a_map_with_full_covariance_is_saved_and_continues(tmp_path):
    made = full_map()
    for scan in (Scan(torch.empty(0, 2), torch.zeros(2)), open_scan(2)):
        made.insert(scan)
        made.save(tmp_path / "map.safetensors")
        assert made.nbytes == (tmp_path / "map.safetensors").stat().st_size
        loaded = BayesianHilbertMap.load(tmp_path / "map.safetensors")
        assert torch.equal(loaded.occupancy(lattice(2)), made.occupancy(lattice(2)))
    for seed in range(4):
        loaded.insert(wall_scan(2, seed))
    theta = loaded.occupancy([[3.0625, 0.2], [2.0, 0.2], [-3.0, 0.2], [math.inf, 0.0]])
    assert theta[0] > 0.5 > theta[1]
    assert theta[2:].tolist() == [0.5, 0.5]


def test_a_large_scan_learned_in_parts_gives_similar_occupancy(monkeypatch):
    whole = TestMeanField().built(wall_scan(2))
    monkeypatch.setattr("gmmtorch.experiments.baselines.hilbert_features.CHUNK_VALUES", 1500)
    parts = TestMeanField().built(wall_scan(2))
    theta = [made.occupancy(lattice(2)) for made in (whole, parts)]
    assert not torch.equal(*theta)
    assert float((theta[0] - theta[1]).abs().max()) < 0.1


def test_full_covariance_rejects_too_many_hinges(monkeypatch):
    monkeypatch.setattr("gmmtorch.experiments.baselines.hilbert_map._MAX_FULL", 10)
    with pytest.raises(MemoryLimitError, match="mean_field"):
        full_map().insert(wall_scan(2))


def test_damaged_files_of_a_full_covariance_are_refused(tmp_path):
    made = BayesianHilbertMap(5.0, spacing=0.5, covariance="full")
    made.insert(open_scan(2))
    damage = {"means": [lambda v: v * math.inf], "factor": [lambda v: -v - 1]}
    check_damaged_files_are_refused(made, tmp_path, damage, [])
