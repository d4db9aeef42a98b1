"""Tests of gmmtorch.occupancy.forms.point: enumeration of all maps, simulated scans of a wall, bad rays."""

import itertools

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from occupancy.cone_cases import random_cones

from gmmtorch.errors import InvalidArgumentError, MemoryLimitError
from gmmtorch.occupancy.cones import Cones
from gmmtorch.occupancy.evidence import occupancy_probability
from gmmtorch.occupancy.forms.point import PointForm, expected_range, first_hit, hit_probability


@given(st.lists(st.floats(0, 1), min_size=1, max_size=8))
def test_first_hit_equals_enumeration_of_all_maps(occupancy):
    """Every map of the cells, weighted by its probability, says where the beam ends."""
    ends, none = [0.0] * len(occupancy), 0.0
    for cells in itertools.product([False, True], repeat=len(occupancy)):
        weight = 1.0
        for full, o in zip(cells, occupancy, strict=True):
            weight *= o if full else 1 - o
        if any(cells):
            ends[cells.index(True)] += weight
        else:
            none += weight
    probability, no_hit = first_hit(torch.tensor(occupancy, dtype=torch.float64))
    assert probability.tolist() == pytest.approx(ends, abs=1e-12)
    assert float(no_hit) == pytest.approx(none, abs=1e-12)


def wall(dim: int, distance: float, noise: float, counts: float = 5e5) -> Cones:
    """A wall across the first axis seen from two metres around the origin, tiled by components."""
    axis = torch.arange(-8, 9, dtype=torch.float64) * 0.5
    aside = torch.cartesian_prod(*[axis] * (dim - 1)).view(-1, dim - 1)
    n = aside.shape[0]
    deviations = torch.tensor([noise] + [0.5] * (dim - 1), dtype=torch.float64)
    return Cones(
        torch.cat([torch.full((n, 1), distance, dtype=torch.float64), aside], 1),
        torch.diag(deviations**2).repeat(n, 1, 1),
        torch.zeros(n, dim, dtype=torch.float64),
        torch.full((n,), counts, dtype=torch.float64),
        torch.zeros(n, dtype=torch.bool),
    )


def fan(dim: int, n: int = 9) -> torch.Tensor:
    angle = torch.linspace(-0.4, 0.4, n, dtype=torch.float64)
    rest = [torch.full_like(angle, 0.1)] * (dim - 2)
    return torch.stack([angle.cos(), angle.sin(), *rest], 1)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("distance", [2.0, 3.3])
def test_beams_end_where_a_simulated_scan_does(dim, distance):
    """Against a thousand noisy scans of the wall: where they end, on average and cell by cell."""
    noise, h = 0.02, 0.1
    directions = fan(dim)
    true = distance * directions.norm(dim=1) / directions[:, 0]
    generator = torch.Generator().manual_seed(0)
    scans = true + noise * torch.randn(1000, len(true), generator=generator, dtype=torch.float64)
    origins = torch.zeros_like(directions)
    hits = hit_probability(wall(dim, distance, noise), origins, directions, 5.0, h)
    found = expected_range(wall(dim, distance, noise), origins, directions, 5.0, h)
    assert float((found.mean - scans.mean(0)).abs().max()) < h
    assert float(hits.no_hit.max()) < 0.02
    near = (hits.depth - true[:, None]).abs() < 1.5 * h + 2 * noise
    measured = ((hits.depth[:, None, None] - scans).abs() < h / 2).double().mean(1)  # (S, R)
    assert float(measured.sum(0).min()) > 0.99
    assert float((hits.probability * near).sum(1).min()) > 0.9
    assert float((measured.T * near).sum(1).min()) > 0.99


def test_a_beam_does_not_end_before_the_wall():
    found = expected_range(wall(3, 3.0, 0.02), torch.zeros(9, 3), fan(3), 2.5, 0.1)
    assert float(found.no_hit.min()) > 0.98
    assert float((found.mean - 2.5).abs().max()) < 0.03


@pytest.mark.parametrize("dim", [2, 3])
def test_hit_probability_and_expected_range_agree(dim):
    cones = random_cones(dim, 30, 0)
    generator = torch.Generator().manual_seed(0)
    origins = 6 * torch.rand(40, dim, generator=generator, dtype=torch.float64)
    directions = torch.randn(40, dim, generator=generator, dtype=torch.float64)
    hits = hit_probability(cones, origins, directions, 3.05, 0.1)
    assert hits.probability.shape == (40, 31)
    total = hits.probability.sum(1) + hits.no_hit
    torch.testing.assert_close(total, torch.ones_like(total))
    found = expected_range(PointForm(cones, 0.1), origins, 7 * directions, 3.05, 0.1)
    mean = (hits.probability * hits.depth.clamp_max(3.05)).sum(1) + 3.05 * hits.no_hit
    torch.testing.assert_close(found.mean, mean)
    torch.testing.assert_close(found.no_hit, hits.no_hit)


def test_occupancy_along_a_beam_is_that_of_the_point_form():
    cones = random_cones(3, 20, 1)
    origin, direction = torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[0.0, 3.0, 4.0]])
    hits = hit_probability(cones, origin, direction, 1.0, 0.25, prior=0.5)
    assert hits.depth.tolist() == [0.125, 0.375, 0.625, 0.875]
    points = origin.double() + hits.depth[:, None] * direction.double() / 5
    o = occupancy_probability(*PointForm(cones, 0.25)(points), 0.5)
    expected, none = first_hit(o)
    torch.testing.assert_close(hits.probability[0], expected)
    torch.testing.assert_close(hits.no_hit[0], none)


def test_unobserved_space_stops_a_beam_with_probability_half_per_cell():
    hits = hit_probability(random_cones(2, 1, 0), torch.full((1, 2), 1e6), torch.ones(1, 2), 0.4, 0.1)
    assert hits.probability[0].tolist() == pytest.approx([1 / 2, 1 / 4, 1 / 8, 1 / 16])
    assert float(hits.no_hit) == pytest.approx(1 / 16)


def test_expected_range_has_gradients():
    cones = wall(2, 2.0, 0.05, counts=100.0)
    form = PointForm(cones, 0.2)
    origins = torch.tensor([[0.1, 0.2], [0.3, -0.1]], dtype=torch.float64, requires_grad=True)
    directions = torch.tensor([[1.0, 0.1], [1.0, -0.3]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda o, d: expected_range(form, o, d, 3.0, 0.2).mean, (origins, directions), atol=1e-4, rtol=1e-3
    )


def test_no_rays_give_empty_results():
    none = torch.zeros(0, 3)
    hits = hit_probability(random_cones(3, 2, 0), none, none, 1.0, 0.1)
    assert hits.probability.shape == (0, 10)
    assert expected_range(random_cones(3, 2, 0), none, none, 1.0, 0.1).mean.shape == (0,)


def test_invalid_rays_are_refused():
    cones, one = random_cones(3, 2, 0), torch.ones(1, 3)
    for origins, directions in ((one, 0 * one), (one / 0, one), (one, one * float("nan")), (one, one[:, :2])):
        with pytest.raises(InvalidArgumentError, match=r"direction|origin"):
            expected_range(cones, origins, directions, 1.0, 0.1)
    for max_range in (0, -1, float("inf"), float("nan")):
        with pytest.raises(InvalidArgumentError, match="max_range"):
            hit_probability(cones, one, one, max_range, 0.1)
    with pytest.raises(InvalidArgumentError, match="resolution"):
        hit_probability(PointForm(cones, 0.2), one, one, 1.0, 0.1)
    with pytest.raises(MemoryLimitError, match="resolution"):
        expected_range(cones, one, one, 1e7, 0.001)
    with pytest.raises(MemoryLimitError, match="fewer rays"):
        hit_probability(cones, one.expand(100_000, 3), one.expand(100_000, 3), 1e3, 0.05)
