"""The fused M-step, its extrapolation, and natural parameters against their twins."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kernels.mixtures.test_e_step import mixture

from gmmtorch.errors import NumericalError
from gmmtorch.kernels import kernels
from gmmtorch.mixture.em.exact import Parameters, maximization, natural_parameters, quadratic_features
from gmmtorch.mixture.em.truncated import Momentum, centered_parameters

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


@given(
    dim=st.sampled_from([1, 2, 3]),
    seed=st.integers(0, 10_000),
    thickness=st.sampled_from([1.0, 1e-3]),
    far=st.sampled_from([0.0, 30.0]),
)
def test_steps_with_momentum_are_those_of_the_twin(dim, seed, thickness, far):
    found = {}
    for choice in ("torch", "fused"):
        parameters, momentum = mixture(K, dim, "any"), Momentum(1e-6)
        parameters = parameters._replace(means=parameters.means + far)
        with kernels(choice):
            for step in range(4):
                parameters = momentum.step(sums(dim, seed + step // 2, thickness), parameters)
            found[choice] = [*parameters, *momentum.undo()]
    for fused, twin in zip(found["fused"], found["torch"], strict=True):
        torch.testing.assert_close(fused, twin, rtol=1e-11, atol=1e-11)


@given(dim=st.sampled_from([1, 2, 3]), seed=st.integers(0, 10_000), is_first=st.booleans())
def test_the_m_step_is_that_of_the_twin(dim, seed, is_first):
    previous = None if is_first else mixture(K, dim, "any")
    with kernels("torch"):
        twin = maximization(sums(dim, seed, 1e-3), 1e-6, previous)
    with kernels("fused"):
        fused = maximization(sums(dim, seed, 1e-3), 1e-6, previous)
    for one, other in zip(fused, twin, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("kind", ["any", "equal", "flat", "empty"])
def test_natural_parameters_are_those_of_the_twin(dim, kind):
    parameters = mixture(K, dim, kind)
    for function in (natural_parameters, centered_parameters):
        with kernels("torch"):
            twin = function(parameters)
        with kernels("fused"):
            fused = function(parameters)
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
