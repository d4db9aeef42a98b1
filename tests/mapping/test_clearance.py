"""Clearance and collision probability against closed forms, samples and search; and those of bodies."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mapping.random_components import normal_components
from scipy import optimize, stats
from scipy.spatial.transform import Rotation

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping import Body, Components, GaussianMap, collision_probability, expected_returns
from gmmtorch.mapping.surfaces import clearance

dims = pytest.mark.parametrize("dim", [2, 3])


def one(covariance: list[float], weight: float = 1.0) -> tuple[torch.Tensor, ...]:
    """A component at the origin, axis-aligned."""
    variances = torch.tensor([covariance], dtype=torch.float64)
    return torch.zeros_like(variances), torch.diag_embed(variances), torch.tensor([weight]).double()


def brute_distance(point: np.ndarray, mean: np.ndarray, covariance: np.ndarray, q: float) -> float:
    """Distance to the surface of an ellipsoid by search over directions from its centre."""
    root = q * np.linalg.cholesky(covariance)

    def gap(u: np.ndarray) -> float:
        return float(np.linalg.norm(mean + root @ (u / np.linalg.norm(u)) - point))

    rng = np.random.default_rng(0)
    starts = sorted(rng.normal(size=(300, len(mean))), key=gap)[:3]
    return min(float(optimize.minimize(gap, start, options={"gtol": 1e-9}).fun) for start in starts)


@pytest.mark.slow
@dims
def test_clearance_is_the_distance_to_the_nearest_ellipsoid(dim):
    c = normal_components(6, dim, seed=1, spread=1.0)
    points = torch.randn(6, dim, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    points = torch.cat([points, c.means[:3] + 0.1 * points[:3]])
    found = clearance(c, points, deviations=1.5)
    signs = set()
    for point, distance in zip(points, found.tolist(), strict=True):
        each = []
        for mean, covariance in zip(c.means, c.covariances, strict=True):
            offset = point - mean
            inside = float(offset @ torch.linalg.solve(covariance, offset)) < 1.5**2
            gap = brute_distance(point.numpy(), mean.numpy(), covariance.numpy(), 1.5)
            each.append(-gap if inside else gap)
        assert distance == pytest.approx(min(each), abs=1e-6)
        signs.add(distance < 0)
    assert signs == {True, False}


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        ([0.0, 0.0], -1.0),  # the centre: the short axis away
        ([0.5, 0.0], -math.hypot(8 / 15 - 0.5, math.sqrt(1 - (8 / 15) ** 2 / 16))),
        ([4.0, 0.0], 0.0),
        ([5.0, 0.0], 1.0),
        ([0.0, -3.0], 2.0),
    ],
)
def test_clearance_on_the_axes_of_an_ellipse_equals_its_closed_form(point, expected):
    # Semi-axes 4 and 1; the nearest surface point to (x, 0) within the evolute is at 16 x / 15.
    found = clearance(one([4.0, 0.25]), torch.tensor([point]).double())
    assert float(found) == pytest.approx(expected, abs=1e-9)


def test_gradients_of_clearance_point_away_from_the_surface():
    points = torch.tensor([[3.0, 0.4, -1.0], [0.1, 0.02, 0.3]], dtype=torch.float64, requires_grad=True)
    mixture = one([1.0, 0.04, 0.25])
    assert torch.autograd.gradcheck(lambda x: clearance(mixture, x), points, atol=1e-5)
    (slope,) = torch.autograd.grad(clearance(mixture, points).sum(), points)
    torch.testing.assert_close(slope.norm(dim=1), torch.ones(2, dtype=torch.float64))


@pytest.mark.parametrize("sigma", [0.02, 0.3, 5.0])
@pytest.mark.parametrize("radius", [0.1, 0.5, 2.0])
@dims
def test_ball_mass_of_a_round_component_is_noncentral_chi_square(dim, radius, sigma):
    points = torch.zeros(9, dim, dtype=torch.float64)
    offset = torch.linspace(0, radius + 5 * sigma, 9, dtype=torch.float64)
    points[:, 0] = offset
    found = expected_returns(one([sigma**2] * dim, 7.0), points, radius)
    expected = 7 * stats.ncx2.cdf((radius / sigma) ** 2, dim, (offset.numpy() / sigma) ** 2 + 1e-300)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-5, atol=1e-9)


@given(
    st.integers(0, 10**6),
    st.sampled_from([2, 3]),
    st.lists(st.floats(-2.0, 0.5), min_size=3, max_size=3),
    st.floats(0.05, 1.5),
)
def test_ball_mass_equals_the_share_of_samples(seed, dim, log_deviations, radius):
    generator = torch.Generator().manual_seed(seed)
    turn = torch.linalg.qr(torch.randn(dim, dim, generator=generator, dtype=torch.float64))[0]
    factor = turn * 10 ** torch.tensor(log_deviations[:dim], dtype=torch.float64)
    drawn = torch.randn(40_000, dim, generator=generator, dtype=torch.float64) @ factor.T
    point = drawn[:1] + 0.5 * radius * torch.randn(1, dim, generator=generator, dtype=torch.float64)
    mixture = (torch.zeros(1, dim).double(), (factor @ factor.T)[None], torch.ones(1).double())
    share = float(((drawn - point).norm(dim=1) <= radius).double().mean())
    found = float(expected_returns(mixture, point, radius)[0])
    assert abs(found - share) <= 5 * math.sqrt(max(found, 1e-4) / 40_000)


def test_ball_mass_of_thin_sheets_equals_a_finer_quadrature():
    sigma = np.array([0.003, 0.4, 0.7])
    center = np.array([0.28, 0.1, -0.2])
    mixture = one((sigma**2).tolist())
    found = float(expected_returns(mixture, torch.from_numpy(-center)[None], 0.3)[0])
    # Discs of the ball across the thin axis, each by a fine polar rule.
    x = np.linspace(0.25, 0.3, 2001)
    rho = np.sqrt(np.maximum(0.09 - x**2, 0))
    t, w = np.polynomial.legendre.leggauss(40)
    share, angle = (t + 1) / 2, np.pi * (t + 1)
    radius = rho[:, None, None] * share[:, None]
    density = stats.norm.pdf(radius * np.cos(angle), center[1], sigma[1])
    density *= stats.norm.pdf(radius * np.sin(angle), center[2], sigma[2])
    disc = (density * radius * w).sum(2) @ w * rho / 2 * np.pi
    expected = np.trapezoid(disc * stats.norm.pdf(x, center[0], sigma[0]), x)
    assert found == pytest.approx(expected, rel=1e-5)


@dims
def test_collision_probability_ignores_no_return_components(dim):
    c = normal_components(8, dim, seed=4, spread=0.7, empty=0.3)
    points = torch.randn(30, dim, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    expected = torch.zeros(30, dtype=torch.float64)
    for k in range(len(c)):
        if not bool(c.max_range[k]):
            part = c.means[k : k + 1], c.covariances[k : k + 1], c.support[k : k + 1]
            expected += expected_returns(part, points, 0.2)
    torch.testing.assert_close(expected_returns(c, points, 0.2), expected)
    torch.testing.assert_close(collision_probability(c, points, 0.2), 1 - torch.exp(-expected))
    assert bool(c.max_range.any())


@dims
def test_an_empty_map_has_infinite_clearance(dim):
    points = torch.zeros(2, dim, dtype=torch.float64)
    for nothing in (Components.empty(dim), GaussianMap()):
        assert clearance(nothing, points).tolist() == [math.inf] * 2
        assert collision_probability(nothing, points, 0.3).tolist() == [0.0] * 2


def test_components_below_the_least_density_are_no_obstacles():
    means, covariances, _ = one([4.0, 4.0, 4.0])
    peak = 1 / math.sqrt((2 * math.pi * 4.0) ** 3)
    stray = means, covariances, torch.tensor([3.0]).double()
    at = torch.zeros(1, 3, dtype=torch.float64)
    assert float(clearance(stray, at, least_density=2.9 * peak)) == pytest.approx(-4.0)
    assert float(clearance(stray, at, least_density=3.1 * peak)) == math.inf


def test_infinite_queries_are_clear_and_empty_queries_give_empty_results():
    c = normal_components(4, 3, seed=0)
    far = torch.tensor([[math.inf, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    assert float(clearance(c, far)[0]) == math.inf
    assert float(collision_probability(c, far, 0.3)[0]) == 0
    torch.testing.assert_close(clearance(c, far)[1:], clearance(c, far[1:]))
    for answer in (clearance(c, torch.zeros(0, 3)), expected_returns(c, torch.zeros(0, 3), 0.3)):
        assert answer.shape == (0,)


@pytest.mark.parametrize(
    "ask",
    [
        lambda c: clearance(c, torch.full((1, 3), torch.nan)),
        lambda c: clearance(c, torch.zeros(1, 2)),
        lambda c: clearance(c, torch.zeros(1, 3), deviations=0.0),
        lambda c: expected_returns(c, torch.zeros(1, 3), 0.0),
        lambda c: expected_returns(c, torch.zeros(1, 3), math.nan),
        lambda c: clearance("map", torch.zeros(1, 3)),
        lambda c: clearance(("a", "b", "c"), torch.zeros(1, 3)),
        lambda c: clearance((c.means, c.covariances, -c.support), torch.zeros(1, 3)),
        lambda c: clearance((c.means * math.nan, c.covariances, c.support), torch.zeros(1, 3)),
    ],
)
def test_invalid_queries_are_refused(ask):
    with pytest.raises(InvalidArgumentError):
        ask(normal_components(3, 3, seed=0))


# -- bodies -----------------------------------------------------------------------------------------


def poses(seed: int, n: int, dim: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    found = torch.eye(dim + 1, dtype=torch.float64).repeat(n, 1, 1)
    found[:, :dim, dim] = 4 * torch.rand(n, dim, generator=generator, dtype=torch.float64)
    turns = Rotation.random(n, rng=seed).as_matrix() if dim == 3 else None
    angles = torch.rand(n, generator=generator, dtype=torch.float64) * 6.28
    flat = torch.stack([angles.cos(), -angles.sin(), angles.sin(), angles.cos()], 1).view(n, 2, 2)
    found[:, :dim, :dim] = flat if turns is None else torch.from_numpy(turns)
    return found


def body(dim: int) -> Body:
    return Body(torch.eye(dim, dtype=torch.float64)[:2] * 0.5, [0.3, 0.1])


@dims
@given(st.integers(0, 50))
def test_clearance_of_a_body_is_that_of_its_nearest_ball(dim, seed):
    c, path, shape = normal_components(6, dim, seed), poses(seed, 5, dim), body(dim)
    found = shape.clearance(c, path)
    for pose, value in zip(path, found, strict=True):
        gaps = [
            float(clearance(c, (pose[:dim, :dim] @ centre + pose[:dim, dim])[None])) - float(radius)
            for centre, radius in zip(shape.centres, shape.radii, strict=True)
        ]
        assert float(value) == pytest.approx(min(gaps), abs=1e-9)


@dims
def test_collision_probability_of_apart_balls_is_that_of_independent_balls(dim):
    c, path, shape = normal_components(6, dim, 1), poses(1, 5, dim), body(dim)
    found = shape.collision_probability(c, path)
    clear = torch.ones(5, dtype=torch.float64)
    for centre, radius in zip(shape.centres, shape.radii, strict=True):
        places = path[:, :dim, :dim] @ centre + path[:, :dim, dim]
        clear *= 1 - collision_probability(c, places, float(radius))
    torch.testing.assert_close(found, 1 - clear)


def test_a_body_in_an_empty_map_and_on_an_empty_path():
    nothing, shape = Components.empty(3), body(3)
    assert shape.clearance(nothing, poses(0, 2, 3)).tolist() == [torch.inf] * 2
    assert shape.collision_probability(nothing, poses(0, 2, 3)).tolist() == [0.0] * 2
    assert shape.clearance(nothing, torch.zeros(0, 4, 4)).shape == (0,)
    assert shape.collision_probability(nothing, torch.zeros(0, 4, 4)).shape == (0,)


@pytest.mark.parametrize(
    ("centres", "radii", "words"),
    [
        (torch.zeros(0, 3), torch.zeros(0), r"centres has shape \(0, 3\)"),
        (torch.zeros(2, 4), [1.0, 1.0], r"centres has shape \(2, 4\)"),
        (torch.zeros(2, 3), [1.0], r"radii has shape \(1,\)"),
        (torch.zeros(1, 3), [0.0], "above zero"),
        (torch.full((1, 3), torch.nan), [1.0], "finite"),
    ],
)
def test_invalid_bodies_are_refused(centres, radii, words):
    with pytest.raises(InvalidArgumentError, match=words):
        Body(centres, radii)


def test_poses_of_another_dimension_are_refused():
    with pytest.raises(InvalidArgumentError, match=r"poses has shape \(1, 3, 3\); expected \(S, 4, 4\)"):
        body(3).clearance(Components.empty(3), torch.eye(3)[None])
