"""Cone form in 3D: silhouettes against convex hulls, and evidence against samples and exact flux."""

from __future__ import annotations

import math

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given
from scipy.spatial import ConvexHull

from gmmtorch.experiments.studies.angular_reference import angular_evidence
from gmmtorch.occupancy.cones import Cones
from gmmtorch.occupancy.forms.cone.cone_evidence import cone_evidence
from gmmtorch.occupancy.forms.cone.polygons import polygon_probability
from gmmtorch.occupancy.forms.cone.projection import Planes
from gmmtorch.occupancy.forms.cone.silhouette import facing, image, meets_disc, outline


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None]


def one_cone(mean, deviations, angles=(0.0, 0.0), origin=(0.0, 0.0, 0.0), max_range=False) -> Cones:
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


def test_polygons_meet_a_disc_by_their_edges_or_around_it():
    low, high = column(1.0, -1.0, 4.0), column(2.0, 1.0, 5.0)
    edges = image(outline(low, high)[0])
    nearest = 1.0 / 5.0
    radius = torch.tensor([nearest * 0.99], dtype=torch.float64)
    assert not meets_disc(*edges, radius)
    assert meets_disc(*edges, radius * 1.02)
    assert meets_disc(*image(outline(column(-1.0, -1.0, 4.0), high)[0]), radius * 1e-6)


@given(st.integers(0, 2**31))
def test_facing_rotates_the_third_axis_to_the_direction(seed):
    direction = torch.randn(3, 5, generator=torch.Generator().manual_seed(seed)).double()
    direction = direction / direction.norm(dim=0)
    turn = facing(direction).permute(2, 0, 1)
    torch.testing.assert_close(turn @ turn.transpose(1, 2), torch.eye(3).double().expand(5, 3, 3))
    torch.testing.assert_close(torch.linalg.det(turn), torch.ones(5).double())
    torch.testing.assert_close(turn[:, 2].T, direction)


# -- evidence -------------------------------------------------------------------------------------


def test_a_thin_wall_far_away_has_the_exact_evidence(generator):
    """Cells that end before a wall seen at an angle, where the approximation holds."""
    cones = one_cone((8.0, 3.0, 1.0), (0.02, 0.5, 0.35), angles=(0.5, 0.3))
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


def test_a_small_far_perpendicular_wall_equals_samples(generator):
    cones = one_cone((0.0, 0.0, 100.0), (0.5, 0.4, 0.001))
    low = torch.tensor([[-0.3, -0.2, 90.0], [0.1, 0.1, 50.0]], dtype=torch.float64)
    _, misses = cone_evidence(cones, low, low + 0.4, exact=True)
    ends = cones.means + torch.randn(1_000_000, 3, generator=generator).double() * torch.tensor(
        [0.5, 0.4, 0.001]
    )
    for found, corner in zip(misses, low, strict=True):
        first, second = corner / ends, (corner + 0.4) / ends
        enter, leave = torch.minimum(first, second).amax(1), torch.maximum(first, second).amin(1)
        assert float(found) == pytest.approx(float((enter < leave).double().mean()), abs=2e-3)


def test_the_plane_contains_the_long_axes_and_its_normal_points_away():
    planes = Planes.of(one_cone((-4.0, 1.0, 0.5), (0.01, 0.5, 0.3)))
    assert float(planes.mean[2]) == pytest.approx(4.0)
    torch.testing.assert_close(planes.deviation.squeeze(1), torch.tensor([0.5, 0.3, 0.01]).double())
    assert torch.linalg.det(planes.frame[..., 0]) == pytest.approx(1.0)


def test_evidence_is_zero_behind_the_sensor_beyond_the_wall_and_beside_the_cone():
    cones = one_cone((5.0, 0.0, 0.0), (0.05, 0.5, 0.5))
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
    cones = one_cone((3.0, 0.4, 0.2), (0.02, 0.3, 0.3))
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
    cones = one_cone((3.0, 0.0, 0.0), (0.5, 0.5, 0.01))
    low = torch.tensor([[1.0, -0.2, -0.2], [1.0, -0.2, 0.5], [-2.0, -0.2, -0.2]], dtype=torch.float64)
    for exact in (True, False):
        _, misses = cone_evidence(cones, low, low + 0.4, exact=exact)
        assert bool(((misses >= 0) & (misses <= 1)).all())
        assert misses[1] == misses[2] == 0


@given(
    distance=st.sampled_from([0.0, 1e-9, 0.1, 3.0, 500.0]),
    deviations=st.sampled_from([(1e-4,) * 3, (1e-3, 1.0, 0.5), (1000.0, 2000.0, 3000.0), (0.01, 0.01, 2.0)]),
    size=st.sampled_from([1e-3, 0.1, 10.0, 1000.0]),
    place=st.sampled_from([0.0, 0.3, 1.0, 1.2, -1.0]),
    origin=st.sampled_from([0.0, 5e5]),
    corner=st.sampled_from([0.0, 0.5, 1.0, -7.0]),
    exact=st.booleans(),
)
def test_shares_are_finite_and_in_0_1(distance, deviations, size, place, origin, corner, exact):
    where = (origin + distance, -origin + 0.3 * distance, origin)
    cones = one_cone(where, deviations, (0.4, 0.7), origin=(origin, -origin, origin))
    low = cones.origins + place * (cones.means - cones.origins) - corner * size
    for part in cone_evidence(cones, low, low + size, exact=exact):
        assert 0 <= float(part) <= 1 + 1e-9
