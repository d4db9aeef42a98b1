"""Owen's T against SciPy; probabilities of polygons against samples, closed forms and quadrature."""

from __future__ import annotations

import itertools
import math

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given
from scipy import integrate, special
from torch import Tensor

from gmmtorch.occupancy.forms.cone import (
    approximate_erf,
    approximate_probability,
    owens_t,
    polygon_probability,
)


def random_polygons(n: int, n_corners: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Starts and ends (n_corners, 2, n) of the edges of polygons inscribed in circles, counter-clockwise."""
    angle = torch.rand(n_corners, n, generator=generator).double().mul(2 * math.pi).sort(0).values
    center = torch.randn(2, n, generator=generator).double()
    radius = 3 * torch.rand(n, generator=generator).double()
    corners = center + radius * torch.stack([angle.cos(), angle.sin()], 1)
    return corners, corners.roll(-1, 0)


def contained(points: Tensor, starts: Tensor, ends: Tensor) -> Tensor:
    """Which points (N, 2) lie to the left of all edges (E, 2): (N,)."""
    step = ends - starts
    offset = points[:, None] - starts
    return (step[:, 0] * offset[..., 1] - step[:, 1] * offset[..., 0] > 0).all(1)


def square(low: float, high: float) -> tuple[torch.Tensor, torch.Tensor]:
    corners = torch.tensor([[low, low], [high, low], [high, high], [low, high]], dtype=torch.float64)
    return corners[..., None], corners.roll(-1, 0)[..., None]


def test_owens_t_equals_scipy():
    h = torch.cat([torch.zeros(1), torch.logspace(-5, 1.7, 150)]).double()
    a = torch.cat([torch.zeros(1), torch.logspace(-5, 12, 250)]).double()
    h, a = torch.cat([-h, h])[:, None], torch.cat([-a, a])
    expected = torch.as_tensor(special.owens_t(h.numpy(), a.numpy()))
    assert (owens_t(h, a) - expected).abs().max() < 1e-14


def test_owens_t_has_its_limits_at_infinite_arguments():
    infinity = torch.tensor(math.inf, dtype=torch.float64)
    h = torch.tensor([0.0, 0.5, 2.0, math.inf], dtype=torch.float64)
    torch.testing.assert_close(owens_t(h, infinity), 0.25 * torch.special.erfc(h / math.sqrt(2)))
    torch.testing.assert_close(owens_t(h, -infinity), -0.25 * torch.special.erfc(h / math.sqrt(2)))
    assert owens_t(infinity, h).abs().max() == 0


def test_owens_t_is_accurate_in_float32(generator):
    h, a = torch.randn(2, 1000, generator=generator) * 3
    assert owens_t(h, a).dtype == torch.float32
    assert (owens_t(h, a) - owens_t(h.double(), a.double())).abs().max() < 1e-6


@given(st.floats(-6, 6), st.floats(-6, 6))
def test_the_derivative_of_owens_t_is_its_integrand(h, a):
    a_grad = torch.tensor(a, dtype=torch.float64, requires_grad=True)
    owens_t(torch.tensor(h, dtype=torch.float64), a_grad).backward()
    expected = math.exp(-0.5 * h * h * (1 + a * a)) / (1 + a * a) / (2 * math.pi)
    assert float(a_grad.grad) == pytest.approx(expected, abs=1e-10)


def test_the_probability_of_a_square_is_that_of_an_interval_squared():
    for low, high in ((-1.0, 1.0), (0.0, 2.0), (0.0, 40.0), (1.5, 1.5001), (-30.0, 1e9)):
        interval = 0.5 * (math.erf(high / math.sqrt(2)) - math.erf(low / math.sqrt(2)))
        assert float(polygon_probability(*square(low, high))) == pytest.approx(interval**2, abs=1e-12)


def test_polygon_probability_equals_the_share_of_samples(generator):
    starts, ends = random_polygons(3, 4, generator)
    points = torch.randn(1_000_000, 2, generator=generator)
    shares = [
        contained(points, starts[..., i].float(), ends[..., i].float()).double().mean() for i in range(3)
    ]
    found = polygon_probability(starts, ends)
    assert float(found.max()) > 0.1
    assert (found - torch.stack(shares)).abs().max() < 4 * 0.5 / math.sqrt(1_000_000)


@given(st.integers(0, 2**31), st.floats(0, 6.3))
def test_polygon_probability_is_invariant_under_rotation_and_division(seed, angle):
    starts, ends = random_polygons(4, 6, torch.Generator().manual_seed(seed))
    cosine, sine = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[cosine, -sine], [sine, cosine]], dtype=torch.float64)
    whole = polygon_probability(starts, ends)
    turned = polygon_probability(*(torch.einsum("ij,ejp->eip", turn, part) for part in (starts, ends)))
    assert (turned - whole).abs().max() < 1e-13
    corner = starts[:1]
    first = polygon_probability(torch.cat([starts[:3], starts[3:4]]), torch.cat([ends[:3], corner]))
    second = polygon_probability(torch.cat([corner, starts[3:]]), torch.cat([starts[3:4], ends[3:]]))
    assert (first + second - whole).abs().max() < 1e-13


def test_edges_of_zero_length_or_through_the_mean_add_zero():
    starts, ends = square(0.0, 2.0)
    whole = polygon_probability(starts, ends)
    nothing = starts[:2]
    padded = polygon_probability(torch.cat([starts, nothing]), torch.cat([ends, nothing]))
    assert torch.equal(padded, whole)


# -- the approximation of the thesis ------------------------------------------------------------------


def test_the_approximate_error_function_has_an_error_below_0_014():
    x = torch.linspace(-6, 6, 20001, dtype=torch.float64)
    worst = float((approximate_erf(x) - torch.erf(x)).abs().max())
    assert 0.0135 < worst < 0.0145
    torch.testing.assert_close(approximate_erf(-x), -approximate_erf(x))


@pytest.mark.parametrize(
    "corners",
    [
        [(-1.0, -0.5), (1.5, -0.2), (0.3, 1.2)],
        [(-1.0, 0.5), (1.5, 0.7), (0.3, 2.2)],
        [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)],  # edges along both axes
        [(-1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)],
    ],
)
def test_the_closed_form_equals_the_integral_of_the_approximation(corners):
    """P = ∬ φ(x) ½ d/dy ê(y/√2) dx dy over the polygon, edge by edge with adaptive quadrature."""
    total = 0.0
    for (x1, y1), (x2, y2) in itertools.pairwise([*corners, corners[0]]):
        if x1 == x2:
            continue
        m = (y2 - y1) / (x2 - x1)

        def integrand(x, m=m, x1=x1, y1=y1):
            y = torch.tensor(y1 + m * (x - x1), dtype=torch.float64)
            return math.exp(-0.5 * x * x) * float(approximate_erf(y / math.sqrt(2)))

        kink = [x1 - y1 / m] if m and min(x1, x2) < x1 - y1 / m < max(x1, x2) else None
        total -= integrate.quad(integrand, x1, x2, points=kink)[0] / math.sqrt(8 * math.pi)
    starts = torch.tensor(corners, dtype=torch.float64)[..., None]
    found = float(approximate_probability(starts, starts.roll(-1, 0)))
    assert found == pytest.approx(total, abs=1e-10)


def test_the_approximation_has_an_error_up_to_0_01_on_random_polygons(generator):
    starts, ends = random_polygons(3000, 6, generator)
    error = approximate_probability(starts, ends) - polygon_probability(starts, ends)
    assert 0.008 < float(error.abs().max()) < 0.015


@given(st.integers(0, 2**31), st.floats(-12, 12))
def test_steep_edges_and_far_corners_keep_the_error_bound(seed, exponent):
    starts, ends = random_polygons(4, 5, torch.Generator().manual_seed(seed))
    stretch = torch.tensor([10.0**-exponent, 10.0**exponent], dtype=torch.float64)[:, None]
    near = approximate_probability(starts * stretch, ends * stretch)
    exact = polygon_probability(starts * stretch, ends * stretch)
    assert (near - exact).abs().max() < 0.015
