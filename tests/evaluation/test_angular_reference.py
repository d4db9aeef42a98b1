"""The angular reference against sampled rays, nested quadrature, closed forms and smaller tolerances."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from scipy import integrate

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.studies.angular_reference import angular_evidence
from gmmtorch.experiments.studies.approximation_error import Scene, cast_rays, random_scene
from gmmtorch.occupancy.cones import Cones


def exact(scene: Scene, tolerance: float = 1e-7) -> tuple[torch.Tensor, torch.Tensor]:
    n = len(scene.low)
    cones = Cones(*(part.expand(n, *part.shape[1:]) for part in scene.cone))
    return angular_evidence(cones, scene.low, scene.high, tolerance)


def a_scene(dim: int, deviations: float, distance: float, low: list[list[float]], size: float) -> Scene:
    mean, covariance = torch.zeros(1, dim).double(), torch.eye(dim).double()[None] * deviations**2
    mean[0, 0] = distance
    cone = Cones(mean, covariance, torch.zeros(1, dim).double(), torch.ones(1), torch.zeros(1).bool())
    corners = torch.tensor(low, dtype=torch.float64)
    return Scene(cone, corners, corners + size)


@pytest.mark.parametrize("dim", [2, 3])
def test_reference_matches_sampled_rays_within_their_noise(dim, generator):
    n, scores = 100_000, []
    for _ in range(10 if dim == 2 else 4):
        scene = random_scene(dim, 4, generator)
        for true, found in zip(exact(scene), cast_rays(scene, n, generator), strict=True):
            noise = (true * (1 - true) / n).clamp_min(1e-9).sqrt()
            scores.append((found - true) / noise)
    scores = torch.cat(scores)
    assert float(scores.abs().max()) < 4.5
    assert float(scores.square().mean()) < 2


def test_reference_matches_nested_scipy_quadrature():
    """Misses of a square in 2D: ∫ dθ ∫ r N dr, both by SciPy, in Cartesian coordinates of the sensor."""
    scene = a_scene(2, 0.7, 2.0, [[0.8, -0.4]], 0.6)

    def density(r: float, angle: float) -> float:
        x, y = r * math.cos(angle) - 2.0, r * math.sin(angle)
        return r * math.exp(-0.5 * (x * x + y * y) / 0.49) / (2 * math.pi * 0.49)

    def leave(angle: float) -> float:
        up = (0.2 if angle > 0 else -0.4) / math.sin(angle) if angle else math.inf
        return min(1.4 / math.cos(angle), up)

    ends = math.atan2(-0.4, 0.8), math.atan2(-0.4, 1.4), 0.0, math.atan2(0.2, 1.4), math.atan2(0.2, 0.8)
    misses = sum(
        integrate.dblquad(density, a, b, leave, 9.0, epsabs=1e-10)[0] for a, b in itertools.pairwise(ends)
    )
    hits = integrate.dblquad(lambda y, x: density_xy(x, y), 0.8, 1.4, -0.4, 0.2)[0]
    found = exact(scene)
    assert float(found[1]) == pytest.approx(misses, abs=1e-7)
    assert float(found[0]) == pytest.approx(hits, abs=1e-7)


def density_xy(x: float, y: float) -> float:
    return math.exp(-0.5 * ((x - 2.0) ** 2 + y * y) / 0.49) / (2 * math.pi * 0.49)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(("deviation", "distance"), [(0.3, 2.0), (1.0, 0.4), (0.02, 3.0)])
def test_hits_and_misses_in_the_sensor_cell_sum_to_one(dim, deviation, distance):
    hits, misses = exact(a_scene(dim, deviation, distance, [[-0.5] * dim], 1.0))
    assert float(hits + misses) == pytest.approx(1, abs=1e-6)


def test_hits_of_an_aligned_component_match_the_error_function():
    scene = a_scene(3, 0.5, 2.0, [[1.5, -0.3, 0.1]], 0.8)

    def interval(low: float, high: float) -> float:
        return 0.5 * (math.erf(high / 0.5 / math.sqrt(2)) - math.erf(low / 0.5 / math.sqrt(2)))

    expected = interval(-0.5, 0.3) * interval(-0.3, 0.5) * interval(0.1, 0.9)
    assert float(exact(scene)[0]) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("dim", "n_scenes"), [(2, 40), (3, 4)])
def test_a_smaller_tolerance_gives_the_same_evidence(dim, n_scenes, generator):
    for _ in range(n_scenes):
        scene = random_scene(dim, 4, generator)
        for once, twice in zip(exact(scene, 1e-8), exact(scene, 1e-10), strict=True):
            assert (once - twice).abs().max() < 1e-6


def test_different_numbers_of_boxes_and_cones_raise():
    scene = a_scene(2, 0.5, 2.0, [[1.0, 0.0], [2.0, 0.0]], 0.5)
    with pytest.raises(InvalidArgumentError, match="low has 2 and high 2 boxes for 1 cones"):
        angular_evidence(scene.cone, scene.low, scene.high)
