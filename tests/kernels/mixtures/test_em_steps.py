"""The fused steps of EM against their twins; test_em compares the E-step with a loop over points."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kernels.twins import by_both

from gmmtorch.errors import NumericalError
from gmmtorch.kernels import fused_kmeans, is_kmeans_fused, kernels
from gmmtorch.kernels.mixtures import em_steps
from gmmtorch.mixture.em.exact import Parameters, maximization, natural_parameters, quadratic_features


def mixture(k: int, dim: int, kind: str) -> Parameters:
    generator = torch.Generator().manual_seed(k + dim)
    means = 4 * torch.rand(k, dim, generator=generator, dtype=torch.float64)
    roots = 0.2 * torch.randn(k, dim, dim, generator=generator, dtype=torch.float64)
    covariances = roots @ roots.mT + 1e-5 * torch.eye(dim)
    weights = torch.rand(k, generator=generator, dtype=torch.float64)
    if kind == "equal":  # every component is likeliest
        means, covariances, weights = (
            means[:1].expand(k, -1),
            covariances[:1].expand(k, -1, -1),
            weights * 0 + 1,
        )
    if kind == "flat":  # a millimetre thick along an axis: products lose nine digits
        covariances = torch.eye(dim).double().repeat(k, 1, 1)
        covariances[:, 0, 0] = 1e-6
    if kind == "empty":
        weights[1::2] = 0.0
    return Parameters(weights / weights.sum(), means, covariances)


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize(("n", "k"), [(1, 1), (7, 3), (8, 4), (101, 30), (400, 5)])
@pytest.mark.parametrize("kind", ["any", "equal", "flat", "empty"])
def test_fused_statistics_equal_the_twin(dim, n, k, kind):
    generator = torch.Generator().manual_seed(n)
    features = quadratic_features(4 * torch.rand(n, dim, generator=generator, dtype=torch.float64))
    weight = 3 * torch.rand(n, generator=generator, dtype=torch.float64)
    natural = natural_parameters(mixture(k, dim, kind))
    found = by_both(lambda: em_steps.expectation(features, weight, natural, torch.float64))
    scale = float(found[0][0].abs().max()) * (1e4 if kind == "flat" else 1)
    torch.testing.assert_close(found[1][0], found[0][0], rtol=0, atol=1e-12 * scale + 1e-300)
    torch.testing.assert_close(found[1][1], found[0][1], rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("kind", ["any", "empty"])
def test_fused_most_likely_component_is_that_of_the_twin(kind):
    features = quadratic_features(4 * torch.rand(203, 3, dtype=torch.float64))
    natural = natural_parameters(mixture(41, 3, kind))
    with kernels("torch"):
        expected = em_steps.most_likely(features, natural)
    with kernels("fused"):
        assert em_steps.most_likely(features, natural).tolist() == expected.tolist()
        assert em_steps.most_likely(features[:0], natural).tolist() == []


def test_the_first_of_equal_components_is_the_most_likely():
    features = quadratic_features(torch.rand(20, 3, dtype=torch.float64))
    natural = natural_parameters(mixture(41, 3, "equal"))
    with kernels("fused"):
        assert set(em_steps.most_likely(features, natural).tolist()) == {0}


@pytest.mark.cpu_only
def test_threads_share_the_rows():
    features = quadratic_features(4 * torch.rand(1000, 3, dtype=torch.float64))
    natural, before = natural_parameters(mixture(20, 3, "any")), torch.get_num_threads()
    found = []
    with kernels("fused"):
        for n_threads in (1, 2):
            torch.set_num_threads(n_threads)
            try:
                found.append(em_steps.expectation(features, torch.ones(1000).double(), natural))
            finally:
                torch.set_num_threads(before)
    torch.testing.assert_close(found[0], found[1], rtol=1e-12, atol=1e-12)


def test_gradients_come_from_the_twin():
    features = quadratic_features(torch.rand(20, 2, dtype=torch.float64))
    natural = natural_parameters(mixture(3, 2, "any")).requires_grad_()
    with kernels("auto"):
        assert not em_steps._is_e_step_fused(features, natural)


def test_rows_in_spatial_order_are_the_same_rows(generator):
    features = quadratic_features(torch.rand(3000, 3, generator=generator, dtype=torch.float64))
    weight = torch.rand(3000, generator=generator, dtype=torch.float64)
    with kernels("fused"):
        ordered, weights = em_steps.in_spatial_order(features, weight)
        same = em_steps.in_spatial_order(torch.ones_like(features), weight)
    rows = torch.cat([features, weight[:, None]], 1)
    moved = torch.cat([ordered, weights[:, None]], 1)
    assert sorted(rows.tolist()) == sorted(moved.tolist())
    step = (ordered[1:, 1:4] - ordered[:-1, 1:4]).norm(dim=1).mean()
    assert float(step) < 0.3 * float((features[1:, 1:4] - features[:-1, 1:4]).norm(dim=1).mean())
    assert torch.equal(same[1], weight)
    with kernels("torch"):
        assert em_steps.in_spatial_order(features, weight)[0] is features


K = 40


def sums(dim: int, seed: int, thickness: float) -> torch.Tensor:
    """Statistics of K flat clouds; some are empty, and some have one point."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(K, 30, dim, generator=generator, dtype=torch.float64)
    points[:, :, 0] = points[:, :, -1] * 0.3 + thickness * points[:, :, 0]
    weight = 10 * torch.rand(K, 30, generator=generator, dtype=torch.float64)
    weight[::7] = 0.0
    weight[1::7, 1:] = 0.0
    features = quadratic_features(points.flatten(0, 1)).view(K, 30, -1)
    return (features * weight[..., None]).sum(1)


@given(dim=st.sampled_from([1, 2, 3]), seed=st.integers(0, 10_000), is_first=st.booleans())
def test_the_m_step_is_that_of_the_twin(dim, seed, is_first):
    previous = None if is_first else mixture(K, dim, "any")
    twin, fused = by_both(lambda: maximization(sums(dim, seed, 1e-3), 1e-6, previous))
    for one, other in zip(fused, twin, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("kind", ["any", "equal", "flat", "empty"])
def test_natural_parameters_are_those_of_the_twin(dim, kind):
    twin, fused = by_both(lambda: natural_parameters(mixture(K, dim, kind)))
    scale = twin.abs().amax(1, keepdim=True).clamp(1.0, 1e20)
    assert float(((fused - twin).abs() / scale).max()) < 1e-10


def test_a_covariance_that_is_not_positive_is_repaired_or_named_as_by_the_twin():
    parameters = mixture(3, 2, "any")
    parameters.covariances[1] = torch.ones(2, 2)  # singular: jitter helps
    with kernels("fused"):
        fused = natural_parameters(parameters)
    with kernels("torch"):
        assert torch.equal(fused, natural_parameters(parameters))
    parameters.covariances[1] = -torch.eye(2)
    with kernels("fused"), pytest.raises(NumericalError, match=r"covariances\[1\] is not positive definite"):
        natural_parameters(parameters)
    bad = Parameters(parameters.weights, parameters.means, torch.full((3, 2, 2), torch.nan).double())
    with kernels("fused"), pytest.raises(NumericalError, match="NaN"):
        natural_parameters(bad)


# -- k-means --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "k", "dim"), [(1, 1, 1), (7, 3, 2), (65, 5, 3), (400, 9, 21), (300, 300, 2)])
def test_nearest_centers_are_those_of_brute_force(n, k, dim):
    generator = torch.Generator().manual_seed(n)
    points = torch.randn(n, dim, generator=generator, dtype=torch.float64)
    weight = torch.rand(n, generator=generator, dtype=torch.float64)
    centers = torch.randn(2, k, dim, generator=generator, dtype=torch.float64)
    squared = (points[None, :, None] - centers[:, None]).square().sum(3)
    nearest, distance, sums = em_steps.nearest_centers(points, weight, centers)
    found = [(nearest, distance)]
    if is_kmeans_fused(points, weight):
        found.append(fused_kmeans(points, weight, centers, 0, 0.0))
    for own, least in found:
        torch.testing.assert_close(least, squared.amin(2), rtol=1e-10, atol=1e-12)
        assert torch.equal(own, squared.argmin(2))
    one_hot = torch.nn.functional.one_hot(nearest, k).double() * weight[:, None]
    torch.testing.assert_close(sums[..., 0], one_hot.sum(1), rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(sums[..., 1:], one_hot.mT @ points, rtol=1e-11, atol=1e-13)
