"""Sensor models against hand computation, simulated sensors, and general properties."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mixture.fit_contract import move, rigid_motion
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mixture.estimators.sensor_model import (
    DepthCameraModel,
    LaserModel,
    LidarModel,
    SensorModel,
    estimate_normals,
    measured_sensor,
)
from gmmtorch.simulation import depth_camera, laser_2d, simulate_scan, spinning_lidar

MODELS: list[tuple[SensorModel, int]] = [(DepthCameraModel(), 3), (LidarModel(), 3), (LaserModel(), 2)]
models = pytest.mark.parametrize(("model", "dim"), MODELS, ids=["camera", "lidar", "laser"])


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


# -- noise ------------------------------------------------------------------------------------------------


def test_camera_noise_by_hand():
    camera = DepthCameraModel(axial=(0.001, 0.002, 0.003), lateral=0.5, pixel_angle=0.01)
    (found,) = camera.noise_covariances(vector(5, 1, 1)[None], vector(3, 1, 1))
    # z = 2 m: σ = 1 + 4 + 12 mm along x, half a pixel of 2 cm across.
    torch.testing.assert_close(found, torch.diag(vector(0.017, 0.01, 0.01) ** 2))


def test_default_camera_noise_equals_the_published_kinect_model():
    """Nguyen et al.: σ_z = 1.2 mm + 1.9 mm (z − 0.4)², and within a factor of two Khoshelham's 1.4 mm z²."""
    z = torch.linspace(0.4, 5, 20, dtype=torch.float64)
    along, _, _ = DepthCameraModel().deviations(z)
    torch.testing.assert_close(along, 0.0012 + 0.0019 * (z - 0.4) ** 2)
    far = z > 1
    assert (along[far] / (1.425e-3 * z[far] ** 2) < 2).all()
    assert (along[far] / (1.425e-3 * z[far] ** 2) > 0.5).all()


def test_lidar_noise_by_hand():
    lidar = LidarModel(noise=0.01, proportional_noise=0.001, divergence=0.004)
    normal = vector(0, math.sin(1.0), math.cos(1.0))[None]
    (found,) = lidar.noise_covariances(vector(0, 0, 10)[None], vector(0, 0, 0), normal)
    along = math.hypot(0.02, 0.01 * math.tan(1.0))
    torch.testing.assert_close(found, torch.diag(vector(0.01, 0.01, along) ** 2))


def test_laser_noise_by_hand():
    laser = LaserModel(noise=0.02, divergence=0.008)
    origin, points = vector(1, 1), torch.stack([vector(1, 6), vector(4, 5)])
    found = laser.noise_covariances(points, origin)
    along, across = 0.02**2, 0.01**2  # both at 5 m
    torch.testing.assert_close(found[0], torch.diag(vector(across, along)))
    beam = vector(0.6, 0.8)
    expected = across * torch.eye(2).double() + (along - across) * torch.outer(beam, beam)
    torch.testing.assert_close(found[1], expected)


@models
def test_noise_along_the_beam_grows_with_incidence_up_to_a_limit(model, dim):
    angles = torch.linspace(0, math.pi / 2, 40, dtype=torch.float64)
    normals = torch.zeros(40, dim, dtype=torch.float64)
    normals[:, 0], normals[:, 1] = -angles.cos(), angles.sin()
    points = torch.zeros(40, dim, dtype=torch.float64)
    points[:, 0] = 6
    origin = torch.zeros(dim, dtype=torch.float64)
    found = model.noise_covariances(points, origin, normals)
    along = found[:, 0, 0]
    assert (along.diff() >= 0).all()
    assert along[0] < along[20] < along[-1]
    capped = angles > math.radians(80)
    assert along[capped].max() == along[capped].min()
    _, across, footprint = model.deviations(vector(6))
    head_on = model.noise_covariances(points[:1], origin)[0]
    torch.testing.assert_close(found[0], head_on)
    expected = head_on[0, 0] + footprint[0] ** 2 * math.tan(math.radians(80)) ** 2
    torch.testing.assert_close(along[-1], expected)
    torch.testing.assert_close(found[:, 1, 1], (across**2).expand(40))
    flipped = model.noise_covariances(points, origin, -normals)
    assert torch.equal(flipped, found)


@models
@given(seed=st.integers(0, 1000), scale=st.sampled_from([0.0, 1e-4, 1.0, 1e3]))
def test_covariances_are_positive_definite_and_rotate_with_the_world(model, dim, seed, scale):
    rng = np.random.default_rng(seed)
    points = torch.from_numpy(rng.normal(size=(12, dim)) * scale)
    origin = torch.from_numpy(rng.normal(size=dim) * 0.1)
    points[0] = origin
    normals = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(12, dim))), dim=1)
    found = model.noise_covariances(points, origin, normals)
    assert found.shape == (12, dim, dim)
    torch.testing.assert_close(found, found.mT)
    assert (torch.linalg.cholesky_ex(found)[1] == 0).all()
    motion = torch.from_numpy(rigid_motion(dim, seed))
    turn = motion[:dim, :dim]
    moved = model.noise_covariances(move(motion, points), move(motion, origin), normals @ turn.T)
    torch.testing.assert_close(moved[1:], turn @ found[1:] @ turn.T, rtol=1e-6, atol=1e-12)


@models
def test_each_point_may_have_its_own_origin(model, dim):
    rng = np.random.default_rng(0)
    points, origins = torch.from_numpy(rng.normal(size=(2, 9, dim)))
    each = torch.cat([model.noise_covariances(points[i : i + 1], origins[i]) for i in range(9)])
    torch.testing.assert_close(model.noise_covariances(points, origins), each)
    far = vector(5e5, 4e6, 100)[:dim]
    torch.testing.assert_close(
        model.noise_covariances(points + far, origins + far), each, rtol=1e-6, atol=1e-10
    )


# -- density ----------------------------------------------------------------------------------------------


def test_point_density_by_hand():
    camera = DepthCameraModel(pixel_angle=0.002)
    assert float(camera.point_density(vector(2.5), 0.5)) == pytest.approx(0.5 / 0.005**2)
    lidar = LidarModel(azimuth_step=0.004, elevation_step=0.02)
    assert float(lidar.point_density(vector(5.0))) == pytest.approx(1 / (25 * 8e-5))
    laser = LaserModel(angular_step=0.01)
    assert float(laser.point_density(vector(4.0), -0.25)) == pytest.approx(0.25 / 0.04)
    edge_on = float(laser.point_density(vector(4.0), 0.0))
    assert edge_on == pytest.approx(math.cos(math.radians(80)) / 0.04)


# -- normals ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_normals_of_a_noisy_plane(dim):
    rng = np.random.default_rng(0)
    turn = torch.from_numpy(rigid_motion(dim)[:dim, :dim])
    flat = torch.from_numpy(rng.uniform(-1, 1, size=(3000, dim)))
    flat[:, 0] = torch.from_numpy(rng.normal(size=3000) * 3e-4)
    points = flat @ turn.T + torch.tensor([5e5, 4e6, 0.0])[:dim].double()
    normals = estimate_normals(points, 20)
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(3000).double())
    assert ((normals @ turn[:, 0]).abs() > 0.99).double().mean() > 0.95


@pytest.mark.parametrize("dim", [2, 3])
def test_normals_of_degenerate_clouds_are_unit_vectors(dim):
    line = torch.arange(5.0)[:, None] * torch.ones(dim)
    for points in (torch.zeros(1, dim), torch.ones(7, dim), line, torch.zeros(2, dim)):
        normals = estimate_normals(points)
        torch.testing.assert_close(normals.norm(dim=1), torch.ones(len(points)).double())
    across = estimate_normals(line) @ torch.ones(dim).double()
    torch.testing.assert_close(across, torch.zeros(5).double())


# -- arguments --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: DepthCameraModel(axial=(0.0, 0.0, 0.0)), "axial"),
        (lambda: DepthCameraModel(axial=(0.001, -0.01, 0.001)), "axial"),
        (lambda: DepthCameraModel(axial=(0.001, 0.0, -0.001)), "axial"),
        (lambda: DepthCameraModel(axial=(0.001, -0.0021, 0.001)), "axial"),  # below zero near 1 m
        (lambda: DepthCameraModel(axial=(math.nan, 0.0, 0.0)), "axial"),
        (lambda: DepthCameraModel(lateral=0.0), "lateral"),
        (lambda: DepthCameraModel(pixel_angle=-1.0), "pixel_angle"),
        (lambda: LidarModel(noise=0.0), "noise"),
        (lambda: LidarModel(proportional_noise=-0.1), "proportional_noise"),
        (lambda: LidarModel(elevation_step=math.inf), "elevation_step"),
        (lambda: LaserModel(divergence=math.nan), "divergence"),
        (lambda: LaserModel(angular_step=0.0), "angular_step"),
        (lambda: LaserModel(max_incidence=math.pi / 2), "max_incidence"),
        (lambda: estimate_normals(torch.zeros(3, 2), 0), "n_neighbors"),
    ],
)
def test_invalid_arguments_are_named(make, name):
    with pytest.raises(InvalidArgumentError, match=f"^{name}="):
        make()


# -- spacing of beams -------------------------------------------------------------------------------------


class Sphere:
    """A sphere of 5 m around the origin of the beams."""

    def distances(self, origin: Tensor, directions: Tensor) -> Tensor:
        return torch.full_like(directions[:, 0], 5.0)


@pytest.mark.parametrize(
    ("sensor", "density", "tolerance"),
    [
        (laser_2d(720), 720 / math.pi / 5, 0.01),
        (spinning_lidar(32, 360, max_range=20.0), None, 0.1),
        (depth_camera(120, 90), None, 0.4),  # pixels are denser off the axis
    ],
    ids=["laser", "lidar", "camera"],
)
def test_measured_sensor_has_the_density_of_the_scan(sensor, density, tolerance):
    dim = sensor.directions.shape[1]
    scan = simulate_scan(sensor, torch.eye(dim + 1).double(), Sphere(), torch.Generator().manual_seed(0))
    if density is None:  # points within a cap around the middle of the field of view
        axis = scan.points.mean(0) if sensor.max_range == math.inf else vector(1.0, 0.0, 0.0)
        axis = axis / axis.norm()
        near = (scan.points @ axis / 5).clamp(-1, 1).acos() < 0.15
        density = float(near.sum()) / (2 * math.pi * 25 * (1 - math.cos(0.15)))
    found = measured_sensor(scan.points + 3.0, scan.origin + 3.0)
    assert float(found.point_density(5.0)) == pytest.approx(density, rel=tolerance)


@pytest.mark.parametrize("dim", [2, 3])
def test_measured_sensor_of_too_few_directions_has_the_default_spacing(dim):
    default = LaserModel() if dim == 2 else LidarModel()
    for points in (torch.zeros(0, dim), torch.ones(1, dim), torch.ones(5, dim)):
        assert measured_sensor(points, torch.zeros(dim)) == default
