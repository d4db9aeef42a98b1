"""Tests of gmmtorch.occupancy.forms.radial: closed forms against quadrature."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import multivariate_normal

from gmmtorch.occupancy.cones import whitening
from gmmtorch.occupancy.forms.radial import flux_density, tail_moment


def component(dim: int, seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A mean, a covariance with deviations from 2 cm to 0.5 m, and a sensor some metres away."""
    generator = torch.Generator().manual_seed(seed)
    axes = torch.linalg.qr(torch.randn(dim, dim, generator=generator, dtype=torch.float64))[0]
    deviations = 0.02 * 25 ** torch.rand(dim, generator=generator, dtype=torch.float64)
    mean = torch.randn(dim, generator=generator, dtype=torch.float64)
    return (
        mean,
        (axes * deviations**2) @ axes.T,
        2 * torch.randn(dim, generator=generator, dtype=torch.float64),
    )


def density_of(mean, covariance, place, sensor) -> float:
    inverse, log_norm = whitening(covariance[None])
    return float(flux_density(inverse[0] @ (place - sensor), inverse[0] @ (place - mean), log_norm[0]))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("share", [0.2, 0.8, 1.0, 1.05])
@pytest.mark.parametrize("seed", range(5))
def test_flux_is_the_integral_along_the_ray(dim, share, seed):
    mean, covariance, sensor = component(dim, seed)
    generator = torch.Generator().manual_seed(seed)
    aside = (
        0.1 * torch.randn(dim, generator=generator, dtype=torch.float64) @ torch.linalg.cholesky(covariance).T
    )
    place = sensor + share * (mean + aside - sensor)
    normal = multivariate_normal(mean.numpy(), covariance.numpy())
    expected, error = quad(
        lambda t: t ** (dim - 1) * normal.pdf((sensor + t * (place - sensor)).numpy()),
        1,
        1 + 20 / share,
        points=[1 / share],
        limit=500,
        epsabs=0,
        epsrel=1e-10,
    )
    assert density_of(mean, covariance, place, sensor) == pytest.approx(expected, rel=1e-8, abs=10 * error)


@pytest.mark.parametrize("dim", [2, 3])
@given(along=st.floats(-30, 5), depth=st.floats(-4, 100))
def test_the_moment_is_the_integral_of_a_power_and_a_gaussian(dim, along, depth):
    # From the sensor on only: a ≥ −b.
    along = max(along, -depth)
    value = tail_moment(*torch.tensor([along, depth], dtype=torch.float64), dim)
    begin = max(along, -12.0)
    expected, _ = quad(
        lambda w: (w + depth) ** (dim - 1) * math.exp(-0.5 * w * w), begin, max(begin, 0) + 12, epsrel=1e-11
    )
    largest = (abs(depth) + 1) ** (dim - 1) * math.exp(-0.5 * max(along, 0) ** 2)
    assert float(value) == pytest.approx(expected, rel=1e-9, abs=1e-12 * largest)


def test_float32_agrees_where_positions_would_cancel():
    """5 mm thick at 10 m: whitened positions are in the thousands, differences are not."""
    covariance = torch.diag(torch.tensor([0.005, 0.3, 0.3], dtype=torch.float64) ** 2)
    inverse, log_norm = whitening(covariance[None])
    offset = torch.tensor([0.001, 0.2, -0.1], dtype=torch.float64)
    ray = torch.tensor([10.0, 1.0, 0.5], dtype=torch.float64)
    white = inverse[0] @ ray, inverse[0] @ offset, log_norm[0]
    assert float(flux_density(*(x.float() for x in white))) == pytest.approx(
        float(flux_density(*white)), rel=1e-5
    )
