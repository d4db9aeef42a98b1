"""Mass of Gaussians in boxes against scipy's multivariate normal and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from occupancy.cone_cases import normal, random_covariances, uniform
from scipy.stats import multivariate_normal, norm

from gmmtorch.linalg import safe_cholesky
from gmmtorch.occupancy.cones import Cones, WhitenedCones
from gmmtorch.occupancy.forms.quadrature import box_mass, normal_mass


def mass(mean, covariance, low, high, **options):
    """Mass (P,) of Gaussians in boxes, all (P, D)."""
    nowhere, ones = torch.zeros_like(mean), torch.ones(len(mean))
    white = WhitenedCones.of(Cones(mean, covariance, nowhere, ones, ones < 0))
    return box_mass(white, low.T, high.T, **options)


@given(start=st.floats(-9, 9), span=st.floats(1e-12, 20), single=st.booleans())
def test_normal_mass_is_accurate_in_the_tails(start, span, single):
    dtype = torch.float32 if single else torch.float64
    a, s = torch.tensor([start], dtype=dtype), torch.tensor([span], dtype=dtype)
    # relative to the rounding of the end points
    middle = abs(float(a)) + float(s)
    lower, upper = (
        (float(a), float(a) + float(s)) if start + span / 2 < 0 else (-float(a) - float(s), -float(a))
    )
    expected = norm.cdf(upper) - norm.cdf(lower)
    if span < 1e-3:
        expected = span * norm.pdf(0.5 * (lower + upper))
    tolerance = (1e-4 if single else 1e-6) * (1 + middle)
    assert float(normal_mass(a, s)) == pytest.approx(expected, rel=tolerance, abs=1e-30)


def test_normal_mass_of_an_infinite_span_is_the_tail():
    start = torch.tensor([-40.0, -3.0, 0.0, 2.0, 40.0], dtype=torch.float64, requires_grad=True)
    tail = normal_mass(start, torch.full_like(start, math.inf))
    np.testing.assert_allclose(tail.detach(), norm.sf(start.detach()), rtol=1e-12)
    (slope,) = torch.autograd.grad(tail.sum(), start)
    np.testing.assert_allclose(slope, -norm.pdf(start.detach()), rtol=1e-12, atol=1e-300)


@pytest.mark.parametrize("dim", [2, 3])
def test_box_mass_equals_scipy(dim):
    generator = torch.Generator().manual_seed(dim)
    deviations = 10 ** uniform(generator, 20, dim, low=-2, high=0)
    covariance, mean = random_covariances(generator, deviations), normal(generator, 20, dim)
    center = mean + (safe_cholesky(covariance) @ normal(generator, 20, dim, 1)).squeeze(-1)
    low, high = center - uniform(generator, 20, dim, high=0.5), center + uniform(generator, 20, dim, high=0.5)
    parts = zip(mean, covariance, low, high, strict=True)
    exact = torch.tensor(
        [multivariate_normal(m, c, abseps=1e-6).cdf(b, lower_limit=a) for m, c, a, b in parts]
    )
    assert float(exact.median()) > 0.01
    for dtype in (torch.float64, torch.float32):
        error = (mass(mean, covariance, low, high, dtype=dtype) - exact).abs()
        assert float(error.max()) < 1e-4
        assert float(error.median()) < 1e-5
    assert (
        float((mass(mean, covariance, low, high, tolerance=1e-8) - exact).abs().max()) < 3e-5
    )  # scipy's own error


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("ratio", [1e-6, 1.0, 1e6])
def test_box_mass_is_exact_from_1e_6_to_1e6_component_sizes(dim, ratio):
    """Along the axes of a component its mass is a product."""
    deviations = torch.tensor([[0.001, 0.2, 2.0][:dim]], dtype=torch.float64)
    mean = torch.full((1, dim), 0.3, dtype=torch.float64)
    low = mean - 0.4 * ratio * deviations
    high = mean + 0.9 * ratio * deviations
    expected = (norm.cdf(0.9 * ratio) - norm.cdf(-0.4 * ratio)) ** dim
    got = float(mass(mean, torch.diag_embed(deviations**2), low, high))
    assert got == pytest.approx(expected, rel=1e-3, abs=1e-30)


def test_masses_of_a_partition_sum_to_one_and_are_not_negative():
    generator = torch.Generator().manual_seed(0)
    covariance = random_covariances(generator, torch.tensor([[0.002, 0.3, 0.4]], dtype=torch.float64))
    steps = torch.arange(-12, 12).double() * 0.2
    low = torch.cartesian_prod(steps, steps, steps)
    n = len(low)
    parts = mass(torch.zeros(n, 3).double(), covariance.expand(n, 3, 3), low, low + 0.2)
    assert float(parts.min()) == 0  # beyond five deviations exactly
    assert float(parts.sum()) == pytest.approx(1, abs=5e-4)
    assert float((parts > 0).double().mean()) < 0.3


def test_gradients_of_box_mass_equal_finite_differences():
    generator = torch.Generator().manual_seed(4)
    factor = safe_cholesky(random_covariances(generator, torch.tensor([[0.1, 0.2, 0.4]]).double()))
    mean, low = normal(generator, 1, 3), torch.zeros(1, 3, dtype=torch.float64)
    mean = 0.1 * mean
    inputs = [x.clone().requires_grad_() for x in (mean, factor, low, low + 0.3)]
    assert torch.autograd.gradcheck(
        lambda m, f, a, b: mass(m, f @ f.mT, a, b, tolerance=1e-3), inputs, atol=1e-5
    )
