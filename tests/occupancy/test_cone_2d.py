"""(3.3) against quadrature in the geometry it assumes and the exact form at long range; its error."""

from __future__ import annotations

import math

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given
from occupancy.cone_cases import one_cone
from scipy import integrate

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.studies.angular_reference import angular_evidence
from gmmtorch.occupancy.cones import Cones
from gmmtorch.occupancy.forms.cone.cone_evidence import cone_evidence, share_beyond_2d

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


@given(
    p=st.sampled_from([0.0, 1e-9, 0.1, 3.0, 500.0]),
    deviations=st.sampled_from([(1e-4, 1e-4), (1e-3, 1.0), (1000.0, 2000.0), (0.3, 0.1)]),
    size=st.sampled_from([1e-3, 0.1, 10.0, 1000.0]),
    place=st.sampled_from([0.0, 0.3, 1.0, 1.2, -1.0]),
    origin=st.sampled_from([0.0, 5e5]),
    corner=st.sampled_from([0.0, 0.5, 1.0, -7.0]),
)
def test_shares_are_finite_and_in_0_1(p, deviations, size, place, origin, corner):
    covariance = [[deviations[0] ** 2, 0.0], [0.0, deviations[1] ** 2]]
    cones = one_cone((origin + p, -origin), covariance, (origin, -origin))
    low = torch.tensor([[origin + place * p, -origin]], dtype=torch.float64) - corner * size
    hits, misses = cone_evidence(cones, low, low + size)
    for part in (hits, misses):
        assert 0 <= float(part) <= 1 + 1e-9


@pytest.mark.parametrize("bad", [math.nan, math.inf, -5.0])
def test_invalid_boxes_are_refused(bad):
    with pytest.raises(InvalidArgumentError, match="is no box"):
        cone_evidence(one_cone((5.0, 0.0), ROUND), *boxes((1.0, 0.0, bad, 1.0)))
