"""Monte Carlo form against the integrals that it estimates."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from occupancy.cone_cases import joined, one_cone
from scipy.stats import chi2, multivariate_normal

from gmmtorch.errors import InvalidArgumentError, NumericalError
from gmmtorch.occupancy import Cones, Evidence, VoxelGrid, sample_rays
from gmmtorch.occupancy.forms.monte_carlo import SAMPLINGS, allocate_samples

MEAN_2D, COVARIANCE_2D = np.array([3.1, 1.3]), np.array([[0.12, 0.05], [0.05, 0.09]])
SENSOR_2D = np.array([0.37, 0.21])


def component(count: float = 50.0) -> Cones:
    return one_cone(MEAN_2D, COVARIANCE_2D, SENSOR_2D, count)


def three_cones() -> Cones:
    shapes = [(0.2, 0.01, 0.1), (0.05, 0.05, 0.05), (0.01, 0.3, 0.2)]
    parts = zip([(3.0, 0, 1), (0, 4.0, 1), (-3.0, -1, 0)], shapes, (70.0, 20.0, 10.0), strict=True)
    each = [one_cone(mean, shape, (0, 0, 0.5), count) for mean, shape, count in parts]
    return joined(*each)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def evidence_of(grid: VoxelGrid, what: Cones, n: int, seed: int = 0, sampling: str = "sobol") -> Evidence:
    evidence = Evidence.empty(grid)
    evidence.add_rays(*sample_rays(what, n, seeded(seed), sampling))
    return evidence


def box_probability(grid: VoxelGrid, mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """∫ of the density over each cell, by scipy."""
    low = grid.centers().numpy() - grid.resolution / 2
    normal = multivariate_normal(mean, covariance)
    return np.array([normal.cdf(a + grid.resolution, lower_limit=a) for a in low]).reshape(grid.shape)


def missed_share(grid: VoxelGrid, mean: np.ndarray, covariance: np.ndarray, sensor: np.ndarray) -> np.ndarray:
    """Share of the rays that leave each cell, by quadrature over the angle and the range beyond the exit."""
    n_angles, n_ranges, far = 3000, 600, 6.0
    toward = math.atan2(*(mean - sensor)[::-1])
    width = 2.2 / n_angles  # 1.1 rad either side: the component subtends far less
    angles = toward - 1.1 + (np.arange(n_angles) + 0.5) * width
    ranges = (np.arange(n_ranges) + 0.5) * far / n_ranges
    direction = np.stack([np.cos(angles), np.sin(angles)], 1)
    points = sensor + ranges[None, :, None] * direction[:, None]
    density = multivariate_normal(mean, covariance).pdf(points) * ranges * (far / n_ranges)
    beyond = np.zeros((n_angles, n_ranges + 1))  # share per radian that ends beyond the edge of each interval
    beyond[:, :-1] = np.cumsum(density[:, ::-1], 1)[:, ::-1]
    share = []
    for center in grid.centers().numpy():
        corners = center + grid.resolution / 2 * np.array([[-1.0], [1.0]]) - sensor
        t = corners[:, None, :] / direction  # (2, angles, axes)
        enter, leave = t.min(0).max(1).clip(0), t.max(0).min(1).clip(0, far)
        place = leave / far * n_ranges
        low = np.minimum(place.astype(int), n_ranges - 1)
        rows = np.arange(n_angles)
        value = beyond[rows, low] + (place - low) * (beyond[rows, low + 1] - beyond[rows, low])
        share.append((value * (leave > enter)).sum() * width)
    return np.array(share).reshape(grid.shape)


# -- the integrals -------------------------------------------------------------------------------------


def test_hits_equal_the_mass_of_the_density():
    turned = ((0.2, 0.08, 0), (0.08, 0.1, 0.02), (0, 0.02, 0.15))
    for grid, what in (
        (VoxelGrid((1.5, 0.0), 0.25, (12, 12)), component()),
        (VoxelGrid((1.0, -0.75, -0.75), 0.5, (4, 4, 4)), one_cone((2.0, 0.3, 0.1), turned, count=20.0)),
    ):
        count = float(what.counts)
        expected = count * box_probability(grid, what.means[0].numpy(), what.covariances[0].numpy())
        found = evidence_of(grid, what, 1 << 17).hits.numpy()
        np.testing.assert_allclose(found, expected, atol=count * 5e-4)
        assert expected.max() > 0.04 * count


def test_misses_equal_the_share_of_rays_that_leave_a_cell():
    grid = VoxelGrid((0.0, 0.0), 0.4, (9, 6))  # contains the sensor, the component, and cells beyond it
    one = missed_share(grid, MEAN_2D, COVARIANCE_2D, SENSOR_2D)
    found = evidence_of(grid, component(), 1 << 17).misses.numpy()
    assert found[0, 0] == pytest.approx(50, abs=1e-9)  # every ray leaves the cell of the sensor
    np.testing.assert_allclose(found, 50 * one, atol=50 * 2e-3)
    second = np.array([1.1, 2.3])
    both = joined(component(30.0), one_cone(MEAN_2D, COVARIANCE_2D, second, 20.0))
    expected = 30 * one + 20 * missed_share(grid, MEAN_2D, COVARIANCE_2D, second)
    np.testing.assert_allclose(evidence_of(grid, both, 1 << 17).misses.numpy(), expected, atol=50 * 3e-3)


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_all_kinds_of_sampling_have_the_same_expectation(sampling):
    grid = VoxelGrid((1.5, 0.0), 0.5, (6, 6))
    expected = 50 * box_probability(grid, MEAN_2D, COVARIANCE_2D)
    mean = sum(evidence_of(grid, component(), 4000, seed, sampling).hits.numpy() for seed in range(10)) / 10
    np.testing.assert_allclose(mean, expected, atol=50 * 5 * 0.5 / math.sqrt(40_000))  # five standard errors


def test_sobol_samples_have_less_variance_than_independent_ones():
    grid = VoxelGrid((1.5, 0.0), 0.25, (12, 12))
    expected = 50 * box_probability(grid, MEAN_2D, COVARIANCE_2D)

    def error(sampling: str) -> float:
        found = [evidence_of(grid, component(), 2048, seed, sampling).hits.numpy() for seed in range(8)]
        return float(np.sqrt(np.mean([(f - expected) ** 2 for f in found])))

    assert error("sobol") < 0.6 * error("plain")


def test_stratified_samples_have_less_variance_than_plain_ones():
    def first_count(sampling: str, seed: int) -> float:
        rays = sample_rays(three_cones(), 500, seeded(seed), sampling)
        return float(rays.weights[rays.ends[:, 0] > 1.5].sum())

    def spread(sampling: str) -> float:
        return float(np.std([first_count(sampling, seed) for seed in range(12)]))

    assert spread("stratified") < 0.1 * spread("plain")


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_ends_follow_the_components_distribution(sampling):
    rays = sample_rays(component(), 20_000, seeded(), sampling)
    offset = rays.ends.numpy() - MEAN_2D
    squared = np.einsum("ni,ij,nj->n", offset, np.linalg.inv(COVARIANCE_2D), offset)
    for quantile in (0.1, 0.5, 0.9, 0.99):
        share = (squared < chi2(2).ppf(quantile)).mean()
        assert share == pytest.approx(quantile, abs=5 * math.sqrt(quantile * (1 - quantile) / 20_000))
    assert bool(torch.isfinite(rays.ends).all())


# -- bookkeeping ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("sampling", SAMPLINGS)
@pytest.mark.parametrize("n", [1, 10, 1000])
def test_weights_sum_to_the_counts(sampling, n):
    assert float(sample_rays(three_cones(), n, seeded(), sampling).weights.sum()) == pytest.approx(100)


@pytest.mark.parametrize("sampling", ["sobol", "stratified"])
def test_weights_of_each_cone_sum_to_its_count(sampling):
    what = three_cones()
    rays = sample_rays(
        what._replace(origins=torch.diag(torch.tensor([1.0, 2.0, 3.0])).double()), 333, seeded(), sampling
    )
    for cone in range(3):
        own = rays.origins[:, cone] != 0
        assert float(rays.weights[own].sum()) == pytest.approx(float(what.counts[cone]))


def test_samples_are_proportional_to_counts_and_at_least_one():
    counts = torch.tensor([1000.0, 1.0, 0.0, 1e-6, 500.0])
    assert allocate_samples(counts, 15).tolist() == [10, 1, 0, 1, 5]
    assert allocate_samples(counts, 1).tolist() == [1, 1, 0, 1, 1]
    assert allocate_samples(torch.zeros(3), 10).tolist() == [0, 0, 0]
    assert allocate_samples(torch.empty(0), 10).tolist() == []


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_rays_start_at_the_sensor_origin_and_depend_on_the_seed(sampling):
    first, again = (sample_rays(three_cones(), 64, seeded(4), sampling) for _ in range(2))
    other = sample_rays(three_cones(), 64, seeded(5), sampling)
    assert torch.equal(first.ends, again.ends)
    assert not torch.equal(first.ends, other.ends)
    assert first.origins.unique(dim=0).tolist() == [[0.0, 0.0, 0.5]]


@pytest.mark.parametrize("covariance", [[[1.0, 1.0], [1.0, 1.0]], [[1.0, 0.0], [0.0, 0.0]]])
def test_a_flat_component_is_sampled_along_its_line(covariance):
    rays = sample_rays(one_cone((2.0, 3.0), covariance), 500, seeded())
    offset = rays.ends - torch.tensor([2.0, 3.0]).double()
    normal = torch.linalg.eigh(torch.tensor(covariance).double()).eigenvectors[:, 0]
    assert float((offset @ normal).abs().max()) < 1e-4
    assert float(offset.norm(dim=1).max()) > 1


@pytest.mark.parametrize("covariance", [[[1.0, 0.0], [0.0, -1.0]], [[math.nan, 0.0], [0.0, 1.0]]])
def test_invalid_covariances_are_refused(covariance):
    with pytest.raises(NumericalError, match=r"covariances\[0\]"):
        sample_rays(one_cone((2.0, 3.0), covariance), 5, seeded())


def test_invalid_arguments_are_refused():
    with pytest.raises(InvalidArgumentError, match="n_samples=0"):
        sample_rays(component(), 0, seeded())
    with pytest.raises(InvalidArgumentError, match="sampling='halton'"):
        sample_rays(component(), 10, seeded(), "halton")
