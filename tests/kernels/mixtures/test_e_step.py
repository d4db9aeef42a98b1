"""The fused E-step against its twin, which test_em compares with a loop over points."""

from __future__ import annotations

import pytest
import torch

from gmmtorch.kernels import kernels
from gmmtorch.kernels.mixtures import e_step
from gmmtorch.mixture.em.exact import Parameters, natural_parameters, quadratic_features


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
    natural, found = natural_parameters(mixture(k, dim, kind)), []
    for choice in ("torch", "fused"):
        with kernels(choice):
            found.append(e_step.expectation(features, weight, natural, torch.float64))
    scale = float(found[0][0].abs().max()) * (1e4 if kind == "flat" else 1)
    torch.testing.assert_close(found[1][0], found[0][0], rtol=0, atol=1e-12 * scale + 1e-300)
    torch.testing.assert_close(found[1][1], found[0][1], rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("kind", ["any", "empty"])
def test_fused_most_likely_component_is_that_of_the_twin(kind):
    features = quadratic_features(4 * torch.rand(203, 3, dtype=torch.float64))
    natural = natural_parameters(mixture(41, 3, kind))
    with kernels("torch"):
        expected = e_step.most_likely(features, natural)
    with kernels("fused"):
        assert e_step.most_likely(features, natural).tolist() == expected.tolist()
        assert e_step.most_likely(features[:0], natural).tolist() == []


def test_the_first_of_equal_components_is_the_most_likely():
    features = quadratic_features(torch.rand(20, 3, dtype=torch.float64))
    with kernels("fused"):
        assert set(e_step.most_likely(features, natural_parameters(mixture(41, 3, "equal"))).tolist()) == {0}


@pytest.mark.cpu_only
def test_threads_share_the_rows():
    features = quadratic_features(4 * torch.rand(1000, 3, dtype=torch.float64))
    natural, before = natural_parameters(mixture(20, 3, "any")), torch.get_num_threads()
    found = []
    with kernels("fused"):
        for n_threads in (1, 2):
            torch.set_num_threads(n_threads)
            try:
                found.append(e_step.expectation(features, torch.ones(1000).double(), natural))
            finally:
                torch.set_num_threads(before)
    torch.testing.assert_close(found[0], found[1], rtol=1e-12, atol=1e-12)


def test_gradients_come_from_the_twin():
    features = quadratic_features(torch.rand(20, 2, dtype=torch.float64))
    natural = natural_parameters(mixture(3, 2, "any")).requires_grad_()
    with kernels("auto"):
        assert not e_step._is_fused(features, natural)


def test_rows_in_spatial_order_are_the_same_rows():
    generator = torch.Generator().manual_seed(0)
    features = quadratic_features(torch.rand(3000, 3, generator=generator, dtype=torch.float64))
    weight = torch.rand(3000, generator=generator, dtype=torch.float64)
    with kernels("fused"):
        ordered, weights = e_step.in_spatial_order(features, weight)
        same = e_step.in_spatial_order(torch.ones_like(features), weight)
    rows = torch.cat([features, weight[:, None]], 1)
    moved = torch.cat([ordered, weights[:, None]], 1)
    assert sorted(rows.tolist()) == sorted(moved.tolist())
    step = (ordered[1:, 1:4] - ordered[:-1, 1:4]).norm(dim=1).mean()
    assert float(step) < 0.3 * float((features[1:, 1:4] - features[:-1, 1:4]).norm(dim=1).mean())
    assert torch.equal(same[1], weight)
    with kernels("torch"):
        assert e_step.in_spatial_order(features, weight)[0] is features
