"""(3.3) against quadrature in the geometry it assumes and the exact form at long range; its error."""

from __future__ import annotations

import itertools
import math

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given
from occupancy.cone_cases import one_cone
from scipy import integrate, special
from scipy.spatial import ConvexHull
from torch import Tensor

from gmmtorch.experiments.studies.angular_reference import angular_evidence
from gmmtorch.occupancy import Cones, cone_evidence
from gmmtorch.occupancy.forms.cone import (
    approximate_erf,
    approximate_probability,
    facing,
    image,
    outline,
    owens_t,
    polygon_probability,
    share_beyond_2d,
)

ROUND = [[1.0, 0.0], [0.0, 1.0]]


def boxes(*corners: tuple[float, float, float, float]) -> tuple[torch.Tensor, torch.Tensor]:
    rows = torch.tensor(corners, dtype=torch.float64)
    return rows[:, :2], rows[:, 2:]


def share(p: float, corners: list[tuple[float, float]], inside: bool = False) -> float:
    cell = torch.tensor(corners, dtype=torch.float64)[..., None]
    mean = torch.tensor([[p], [0.0]], dtype=torch.float64)
    return float(share_beyond_2d(cell, mean, torch.tensor([inside]), 8.0))


def wedge_share(p: float, nearest: float, first: float, last: float) -> float:
    """Rays between two angles that end farther than `nearest`, by quadrature."""

    def density(angle: float) -> float:
        b = p * math.cos(angle)
        radial = math.exp(-0.5 * (nearest - b) ** 2)
        radial += b * math.sqrt(math.pi / 2) * math.erfc((nearest - b) / math.sqrt(2))
        return math.exp(-0.5 * (p * math.sin(angle)) ** 2) * radial / (2 * math.pi)

    points = [x for x in (-1 / p, 0.0, 1 / p) if first < x < last]
    return integrate.quad(density, first, last, points=points or None, limit=200)[0]


@pytest.mark.parametrize(("p", "worst"), [(2.0, 0.134), (5.0, 0.051), (50.0, 0.0050)])
def test_the_error_of_equation_3_3_falls_with_distance(p, worst):
    """The largest error over cells that begin at r' and are seen from θ₁ to θ₂."""
    angles = [k * 0.5 / p for k in range(-7, 8) if abs(k * 0.5 / p) <= math.pi / 2] + [math.pi / 2]
    errors = []
    for nearest in (p - 0.5, p - 0.2, p - 0.1, p, p + 0.3):
        for first in angles:
            for last in angles:
                if first < last:
                    estimate = 0.25 * math.erfc((nearest - p) / math.sqrt(2))
                    sines = (p * math.sin(last), p * math.sin(first))
                    estimate *= math.erf(sines[0] / math.sqrt(2)) - math.erf(sines[1] / math.sqrt(2))
                    errors.append(abs(estimate - wedge_share(p, nearest, first, last)))
    assert 0.9 * worst < max(errors) < 1.01 * worst


def test_cell_angles_and_nearest_points_equal_brute_force():
    p, cell = 4.0, [(2.0, 0.5), (3.0, 0.5), (3.0, 1.5), (2.0, 1.5)]
    first, last = math.atan2(0.5, 3.0), math.atan2(1.5, 2.0)
    nearest = math.hypot(2.0, 0.5)
    expected = 0.25 * math.erfc((nearest - p) / math.sqrt(2))
    expected *= math.erf(p * math.sin(last) / math.sqrt(2)) - math.erf(p * math.sin(first) / math.sqrt(2))
    assert share(p, cell) == pytest.approx(expected, rel=1e-12)
    # The nearest point lies on an edge, not at a corner.
    ahead = [(2.0, -1.0), (3.0, -1.0), (3.0, 1.0), (2.0, 1.0)]
    expected = 0.25 * math.erfc((2.0 - p) / math.sqrt(2)) * 2 * math.erf(p / math.sqrt(5) / math.sqrt(2))
    assert share(p, ahead) == pytest.approx(expected, rel=1e-12)


def test_cells_behind_the_sensor_get_no_evidence_and_wide_cells_are_clipped():
    behind = [(-2.0, -1.0), (-1.0, -1.0), (-1.0, 1.0), (-2.0, 1.0)]
    assert share(3.0, behind) == 0
    beside = [(-2.0, 0.5), (0.0, 0.5), (0.0, 1.5), (-2.0, 1.5)]  # up to 90° exactly
    assert share(3.0, beside) == pytest.approx(0, abs=1e-12)
    around = [(-5.0, -5.0), (1.0, -5.0), (1.0, 5.0), (-5.0, 5.0)]
    everything = 0.5 * math.erfc(-3.0 / math.sqrt(2)) * math.erf(3.0 / math.sqrt(2))
    assert share(3.0, around, inside=True) == pytest.approx(everything, rel=1e-12)


def test_cone_form_equals_the_exact_form_at_long_range():
    cones = one_cone((30.0, 10.0), [[0.3, 0.1], [0.1, 0.2]])
    low = torch.cartesian_prod(torch.arange(24.0, 36.0, 0.7), torch.arange(7.0, 13.0, 0.7)).double()
    high = low + 0.7
    hits, misses = cone_evidence(cones, low, high)
    rows = Cones(*(part.expand(len(low), *part.shape[1:]) for part in cones))
    true_hits, true_misses = angular_evidence(rows, low, high)
    assert float(true_hits.max()) > 0.2
    assert (hits - true_hits).abs().max() < 1e-4
    assert (misses - true_misses).abs().max() < 0.06  # cells as wide as the component; of (3.3), not of this
    far = one_cone((3000.0, 1000.0), [[0.3, 0.1], [0.1, 0.2]])
    near = torch.tensor([[2999.9, 999.9]], dtype=torch.float64)
    found = cone_evidence(far, near - 1e-3, near)[1]
    assert found == pytest.approx(float(angular_evidence(far, near - 1e-3, near)[1]), rel=0.01)


def test_evidence_sums_only_the_given_pairs():
    first = one_cone((5.0, 0.0), ROUND)
    both = Cones(*(torch.cat([part, part]) for part in first))
    low, high = boxes((2.0, -0.5, 3.0, 0.5), (3.0, -0.5, 4.0, 0.5))
    whole = cone_evidence(both, low, high)
    index = torch.tensor([0]), torch.tensor([1])
    hits, misses = cone_evidence(both, low, high, pairs=[index])
    torch.testing.assert_close(misses, torch.tensor([0.5, 0.0], dtype=torch.float64) * whole[1])
    torch.testing.assert_close(hits, torch.tensor([0.5, 0.0], dtype=torch.float64) * whole[0])


def test_evidence_is_exactly_zero_outside_the_cone():
    cones = one_cone((10.0, 0.0), ROUND)
    tangent = 5 / math.sqrt(100 - 25)
    x = 8.0
    low, high = boxes(
        (x, x * tangent + 0.5, x + 0.4, x * tangent + 0.9),  # beside
        (x, x * tangent - 0.5, x + 0.4, x * tangent - 0.1),
        (15.1, -0.5, 16.0, 0.5),  # beyond
        (-3.0, -0.5, -2.0, 0.5),  # behind
    )
    hits, misses = cone_evidence(cones, low, high)
    assert misses.tolist()[0] == misses.tolist()[2] == misses.tolist()[3] == 0
    assert misses[1] > 0
    assert hits[[0, 2, 3]].abs().max() == 0


# -- 3D ------------------------------------------------------------------------------------------------


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None]


def turned_cone(mean, deviations, angles=(0.0, 0.0), origin=(0.0, 0.0, 0.0), max_range=False) -> Cones:
    """A component turned about z, then about y."""
    (c, s), (d, t) = ((math.cos(a), math.sin(a)) for a in angles)
    about_z = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    about_y = torch.tensor([[d, 0, t], [0, 1, 0], [-t, 0, d]], dtype=torch.float64)
    turn = about_y @ about_z
    covariance = turn @ torch.diag(torch.tensor(deviations, dtype=torch.float64) ** 2) @ turn.T
    covariance = 0.5 * (covariance + covariance.T)
    place = [torch.tensor([x], dtype=torch.float64) for x in (mean, origin)]
    return Cones(place[0], covariance[None], place[1], torch.ones(1).double(), torch.tensor([max_range]))


def of_each(cones: Cones, n: int) -> Cones:
    return Cones(*(part.expand(n, *part.shape[1:]) for part in cones))


# -- silhouettes ----------------------------------------------------------------------------------


@given(st.integers(0, 2**31), st.tuples(*[st.sampled_from([-1, 0, 1])] * 3))
def test_the_outline_is_the_convex_hull_of_the_projected_corners(seed, region):
    """From each of the 26 regions around a box, counter-clockwise as seen along the axis of depth."""
    g = torch.Generator().manual_seed(seed)
    side = 0.2 + torch.rand(3, generator=g).double()
    share = torch.rand(3, generator=g).double() * 0.8 + 0.1
    eye = torch.tensor(region) * (side * (0.6 + share)) + (torch.tensor(region) == 0) * side * (share - 0.5)
    low, high = -0.5 * side - eye, 0.5 * side - eye
    corners, inside = outline(low[:, None], high[:, None])
    assert bool(inside) == (region == (0, 0, 0))
    if inside:
        return
    toward = (0.5 * (low + high)) / (0.5 * (low + high)).norm()
    turn = facing(toward[:, None])[..., 0]
    edges = image((turn @ corners.squeeze(2).T).T[..., None])
    everything = torch.cartesian_prod(*torch.stack([low, high], 1)) @ turn.T
    if float(everything[:, 2].min()) < 1e-3:
        return  # beside the eye: clipped, see below
    hull = ConvexHull((everything[:, :2] / everything[:, 2:]).numpy())
    starts, ends = (part.squeeze(2).numpy() for part in edges)
    area = 0.5 * np.sum(starts[:, 0] * ends[:, 1] - starts[:, 1] * ends[:, 0])
    assert area == pytest.approx(hull.volume, rel=1e-9)
    assert np.linalg.norm(ends - starts, axis=1).sum() == pytest.approx(hull.area, rel=1e-9)


def test_corners_behind_the_viewpoint_are_clipped():
    """The image of a floor below the viewpoint, clipped at the horizon, against samples."""
    corners, _ = outline(column(-5.0, -5.0, -2.0), column(5.0, 5.0, -1.0))
    ahead = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=torch.float64)  # y, z, depth x
    starts, ends = image((corners.squeeze(2) @ ahead.T)[..., None])
    # Right below the horizon line z/x = −1/5, and as wide as −5 … 5 at x = 0: half a plane but a trapezium.
    share = polygon_probability(starts, ends)
    samples = torch.randn(400_000, 2, generator=torch.Generator().manual_seed(0)).double()
    y, z = samples[:, 0], samples[:, 1]
    x = -1 / z.clamp(max=-1e-9)  # where the ray reaches the floor
    seen = (z < 0) & (x < 5) & ((y * x).abs() < 5)
    assert float(share) == pytest.approx(float(seen.double().mean()), abs=3e-3)


# -- evidence -------------------------------------------------------------------------------------


def test_a_thin_wall_far_away_has_the_exact_evidence(generator):
    """Cells that end before a wall seen at an angle, where the approximation holds."""
    cones = turned_cone((8.0, 3.0, 1.0), (0.02, 0.5, 0.35), angles=(0.5, 0.3))
    spread = torch.tensor([0.5, 0.5, 0.4]) * torch.randn(30, 3, generator=generator).double()
    low = 0.6 * cones.means + 0.6 * spread
    truth = angular_evidence(of_each(cones, len(low)), low, low + 0.3, tolerance=1e-6)
    errors = {}
    for exact in (True, False):
        hits, misses = cone_evidence(cones, low, low + 0.3, exact=exact)
        assert (hits - truth[0]).abs().max() < 1e-4
        errors[exact] = float((misses - truth[1]).abs().max())
    assert float(truth[1].max()) > 0.1
    assert errors[True] < 1e-3 < errors[False] < 0.01


def test_evidence_is_zero_behind_the_sensor_beyond_the_wall_and_beside_the_cone():
    cones = turned_cone((5.0, 0.0, 0.0), (0.05, 0.5, 0.5))
    tangent = 5 * 0.5 / 5.0
    low = torch.tensor(
        [
            [-1.5, -0.1, -0.1],  # behind
            [5.3, -0.1, -0.1],  # beyond
            [3.0, 3.3 * tangent + 0.1, -0.1],  # beside
            [3.0, 3.3 * tangent - 0.4, -0.1],  # inside
        ],
        dtype=torch.float64,
    )
    for exact in (True, False):
        hits, misses = cone_evidence(cones, low, low + 0.3, exact=exact)
        assert hits[:3].abs().max() == misses[:3].abs().max() == 0
        assert misses[3] > 0


def test_all_rays_leave_the_voxel_of_the_sensor_origin():
    cones = turned_cone((3.0, 0.4, 0.2), (0.02, 0.3, 0.3))
    low = torch.full((1, 3), -0.1, dtype=torch.float64)
    assert float(cone_evidence(cones, low, low + 0.25)[1]) == pytest.approx(1.0)
    corners = torch.cartesian_prod(*[torch.tensor([-0.25, 0.0], dtype=torch.float64)] * 3)
    _, misses = cone_evidence(
        cones, corners, corners + 0.25, exact=True
    )  # they share the corner at the sensor
    truth = angular_evidence(of_each(cones, 8), corners, corners + 0.25, tolerance=1e-6)[1]
    assert float(misses.sum()) == pytest.approx(1.0, abs=1e-4)
    assert (misses - truth).abs().max() < 2e-3


def test_a_plane_through_the_sensor_origin_gives_valid_shares():
    """The image of a floor that contains the sensor is a line that hides no cell above or below."""
    cones = turned_cone((3.0, 0.0, 0.0), (0.5, 0.5, 0.01))
    low = torch.tensor([[1.0, -0.2, -0.2], [1.0, -0.2, 0.5], [-2.0, -0.2, -0.2]], dtype=torch.float64)
    for exact in (True, False):
        _, misses = cone_evidence(cones, low, low + 0.4, exact=exact)
        assert bool(((misses >= 0) & (misses <= 1)).all())
        assert misses[1] == misses[2] == 0


@given(
    dim=st.sampled_from([2, 3]),
    distance=st.sampled_from([0.0, 1e-9, 0.1, 3.0, 500.0]),
    deviations=st.sampled_from([(1e-4,) * 3, (1e-3, 1.0, 0.5), (1000.0, 2000.0, 3000.0), (0.3, 0.1, 2.0)]),
    size=st.sampled_from([1e-3, 0.1, 10.0, 1000.0]),
    place=st.sampled_from([0.0, 0.3, 1.0, 1.2, -1.0]),
    origin=st.sampled_from([0.0, 5e5]),
    corner=st.sampled_from([0.0, 0.5, 1.0, -7.0]),
    exact=st.booleans(),
)
def test_shares_are_finite_and_in_0_1(dim, distance, deviations, size, place, origin, corner, exact):
    where = (origin + distance, -origin + 0.3 * distance, origin)
    cones = turned_cone(where, deviations, (0.4, 0.7), origin=(origin, -origin, origin))
    if dim == 2:
        cones = one_cone(where[:2], [d * d for d in deviations[:2]], (origin, -origin))
    low = cones.origins + place * (cones.means - cones.origins) - corner * size
    for part in cone_evidence(cones, low, low + size, exact=exact):
        assert 0 <= float(part) <= 1 + 1e-9


# -- Owen's T and polygons ----------------------------------------------------------------------------


def random_polygons(n: int, n_corners: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Starts and ends (n_corners, 2, n) of the edges of polygons inscribed in circles, counter-clockwise."""
    angle = torch.rand(n_corners, n, generator=generator).double().mul(2 * math.pi).sort(0).values
    center = torch.randn(2, n, generator=generator).double()
    radius = 3 * torch.rand(n, generator=generator).double()
    corners = center + radius * torch.stack([angle.cos(), angle.sin()], 1)
    return corners, corners.roll(-1, 0)


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


def test_the_probability_of_a_square_is_that_of_an_interval_squared():
    for low, high in ((-1.0, 1.0), (0.0, 2.0), (0.0, 40.0), (1.5, 1.5001), (-30.0, 1e9)):
        interval = 0.5 * (math.erf(high / math.sqrt(2)) - math.erf(low / math.sqrt(2)))
        assert float(polygon_probability(*square(low, high))) == pytest.approx(interval**2, abs=1e-12)


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
