"""Pruning: its formulas by hand, and spurious components in simulated scans."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from mixture.fit_contract import move, rigid_motion
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mixture import DeconvolvedGaussianMixture, GaussianMixture, prune
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.em.partition import FlatnessRule, partition
from gmmtorch.mixture.estimators.sensor_model import DepthCameraModel, LaserModel, LidarModel, SensorModel
from gmmtorch.mixture.pruning import expected_density, support_density
from gmmtorch.simulation import RangeSensor, depth_camera, laser_2d, simulate_scan, spinning_lidar


def tensor(*rows: object) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)


# -- formulas ---------------------------------------------------------------------------------------------


def test_support_density_by_hand():
    covariances = torch.diag(tensor(0.04, 1e-6, 0.09))[None]
    assert float(support_density(tensor(100.0), covariances)) == pytest.approx(100 / (4 * math.pi * 0.06))
    covariances = torch.diag(tensor(1e-6, 0.09))[None]
    assert float(support_density(tensor(60.0), covariances)) == pytest.approx(60 / 1.2)


@pytest.mark.parametrize("dim", [2, 3])
def test_evenly_covered_surface_has_about_its_point_density(dim):
    points = torch.rand(200_000, dim, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points[:, 0] = 0
    found = float(support_density(tensor(200_000.0), torch.cov(points.T)[None]))
    assert found == pytest.approx(200_000 / {2: 1.155, 3: 1.047}[dim], rel=0.01)


def test_expected_density_by_hand():
    laser = LaserModel(angular_step=0.01)
    means, covariances = tensor([4.0, 3.0]), torch.diag(tensor(1e-4, 1.0))[None]  # normal along x
    found = expected_density(means, covariances, laser, tensor(0.0, 0.0))
    assert float(found[0]) == pytest.approx(0.8 / (0.01 * math.sqrt(25 + 1.0001)))
    several = tensor([0.0, 3.0], [2.0, 3.0], [12.0, 3.0])  # at 4, 2 and 8 m
    expected = 1 / (0.01 * math.sqrt(4 + 1.0001))
    assert float(expected_density(means, covariances, laser, several)) == pytest.approx(expected)


def test_expected_density_with_counts_by_hand():
    laser = LaserModel(angular_step=0.01)
    means, covariances = tensor([4.0, 3.0]), torch.diag(tensor(1e-12, 1e-8))[None]
    origins = tensor([0.0, 3.0], [2.0, 3.0], [12.0, 3.0])
    views = tensor(25.0, 50.0, 12.5)
    for counts, expected in ((views * 3, 87.5), (tensor(0.0, 0.0, 7.0), 12.5), (tensor(2.0, 4.0, 0.0), 75)):
        found = expected_density(means, covariances, laser, origins, counts[None])
        assert float(found) == pytest.approx(expected)


def test_the_density_of_a_large_component_is_that_of_its_mean_area_per_beam(generator):
    camera = DepthCameraModel(pixel_angle=0.01, max_incidence=0.0)
    means, covariances = tensor([0.0, 0.0, 1.0]), torch.diag(tensor(0.5, 2.0, 1e-6))[None]
    draws = torch.randn(200_000, 3, generator=generator, dtype=torch.float64)
    points = means + draws @ covariances[0].sqrt()
    area = camera.point_density(points.norm(dim=1)).reciprocal().mean()
    found = expected_density(means, covariances, camera, torch.zeros(3).double())
    assert float(found) == pytest.approx(float(1 / area), rel=0.02)


def test_prune_by_support():
    mixture = Parameters(tensor(0.5, 0.3, 0.2), tensor([0.0], [1.0], [2.0]), torch.ones(3, 1, 1).double())
    left, kept = prune(mixture, 100, min_support=25)
    assert kept.tolist() == [True, True, False]
    torch.testing.assert_close(left.weights, tensor(0.625, 0.375))
    assert torch.equal(left.means, tensor([0.0], [1.0]))
    assert torch.equal(mixture.weights, tensor(0.5, 0.3, 0.2))
    assert prune(mixture, 100)[1].all()


# -- phantoms -----------------------------------------------------------------------------------------------


class Step:
    """Walls across x at 3 m and at 6 m; the nearer one only for y > 0."""

    def distances(self, origin: Tensor, directions: Tensor) -> Tensor:
        near = (3 - origin[0]) / directions[:, 0]
        near = torch.where((near > 0) & (origin[1] + near * directions[:, 1] > 0), near, torch.inf)
        far = (6 - origin[0]) / directions[:, 0]
        return torch.minimum(near, torch.where(far > 0, far, torch.inf))


SENSORS: dict[str, tuple[RangeSensor, SensorModel]] = {
    "camera": (
        depth_camera(160, 120, range_noise=0.01),
        DepthCameraModel(pixel_angle=math.tan(math.radians(37.5)) / 80),
    ),
    "lidar": (
        spinning_lidar(64, 720, max_range=20.0),
        LidarModel(azimuth_step=2 * math.pi / 720, elevation_step=math.radians(56) / 63),
    ),
    "laser": (laser_2d(7200), LaserModel(angular_step=math.pi / 7200)),
}
SHARE = 0.25


def scene(kind: str) -> tuple[Parameters, int, Tensor]:
    """A mixture of a scan's two walls plus two spurious components at the end; its points; the origin.

    The spurious components take a hundredth of the points within 1.5 m of the edge, and of all points.
    """
    sensor = SENSORS[kind][0]
    dim = sensor.directions.shape[1]
    generator = torch.Generator().manual_seed(0)
    pose = torch.eye(dim + 1, dtype=torch.float64)
    pose[1, dim] = -0.3
    scan = simulate_scan(sensor, pose, Step(), generator)
    points = scan.points[(scan.points[:, 1].abs() < 3) & (scan.points[:, 0] < 7)]
    draw = torch.rand(len(points), generator=generator)
    labels, n = partition(points, torch.ones(len(points)).double(), FlatnessRule(0.05, 0.3, 12, 12))
    edge = points[:, 1].abs() < 1.5
    owner = torch.where((draw < 0.01) & edge, n, torch.where(draw > 0.99, n + 1, labels))
    parts = [points[owner == k] for k in range(n + 2)]
    parts = [part for part in parts if len(part) > dim]
    return (
        Parameters(
            tensor(*(len(part) for part in parts)) / sum(map(len, parts)),
            torch.stack([part.mean(0) for part in parts]),
            torch.stack([torch.cov(part.T, correction=0) + 1e-6 * torch.eye(dim) for part in parts]),
        ),
        sum(map(len, parts)),
        scan.origin,
    )


@pytest.mark.parametrize("kind", SENSORS)
def test_prune_removes_spurious_components_and_keeps_walls(kind):
    mixture, n_points, origin = scene(kind)
    spurious_x = mixture.means[-2:, 0]
    assert ((spurious_x > 3.3) & (spurious_x < 5.7)).all()  # in free space
    left, kept = prune(mixture, n_points, min_density_share=SHARE, sensor=SENSORS[kind][1], origins=origin)
    assert kept[-2:].tolist() == [False, False]
    assert kept[:-2].double().mean() >= 0.95
    large = mixture.weights * n_points > 30
    assert kept[:-2][large[:-2]].all()
    assert (torch.minimum((left.means[:, 0] - 3).abs(), (left.means[:, 0] - 6).abs()) < 0.1).all()
    assert float(left.weights.sum()) == pytest.approx(1)
    torch.testing.assert_close(left.means, mixture.means[kept])


@pytest.mark.parametrize("kind", SENSORS)
def test_expected_density_does_not_depend_on_the_frame(kind):
    mixture, _, origin = scene(kind)
    motion = torch.from_numpy(rigid_motion(len(origin)))
    motion[:-1, -1] *= 3000
    turn, model = motion[:-1, :-1], SENSORS[kind][1]
    before = expected_density(mixture.means, mixture.covariances, model, origin)
    moved = move(motion, mixture.means), turn @ mixture.covariances @ turn.T
    after = expected_density(*moved, model, move(motion, origin))
    torch.testing.assert_close(after, before, rtol=1e-5, atol=0)


# -- estimators and arguments -----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
@pytest.mark.parametrize(
    "estimator",
    [
        GaussianMixture(4, tol=1e-4, means_init=np.array([[0.0, 0], [1, 1], [2, 2], [3, 0]])),
        DeconvolvedGaussianMixture(4, tol=1e-4, thickness=2.0),
    ],
)
def test_prune_returns_the_type_of_the_estimator(kind, estimator):
    rng = np.random.default_rng(0)
    sizes = [100, 80, 60, 8]
    centers = np.array([[0.0, 0], [9, 0], [0, 9], [9, 9]])
    points = np.concatenate([c + rng.normal(size=(n, 2)) for c, n in zip(centers, sizes, strict=True)])
    fitted = type(estimator)(**{**estimator.get_params(), "random_state": 0, "max_iter": 200})
    fitted.fit(kind(points))
    left, kept = prune(fitted, len(points), min_support=20)
    expected = fitted.weights * len(points) >= 20
    assert torch.equal(kept, expected)
    assert type(left) is type(fitted)
    assert type(left.means_) is type(fitted.means_)
    assert left.n_components == int(kept.sum()) == 3
    assert (left.tol, left.lower_bounds_, left.converged_) == (1e-4, fitted.lower_bounds_, fitted.converged_)
    assert len(fitted.weights_) == 4
    left.fit(kind(points))
    assert len(left.weights_) == 3


def two() -> Parameters:
    return Parameters(tensor(0.5, 0.5), tensor([1.0, 0.0], [0.0, 1.0]), torch.eye(2).double().expand(2, 2, 2))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"min_support": -1}, "^min_support=-1"),
        ({"min_support": math.nan}, "^min_support=nan"),
        ({"min_density_share": -0.1}, r"^min_density_share=-0\.1"),
        ({"n_points": 0}, "^n_points=0"),
        ({"min_support": 51}, "^min_support=51.*all 2 components.*support is 50 "),
        ({"min_density_share": 0.1}, "sensor and origins"),
        ({"min_density_share": 0.1, "sensor": LaserModel()}, "sensor and origins"),
        (
            {"min_density_share": 1e6, "sensor": LaserModel(), "origins": torch.zeros(2)},
            "all 2 components.*share of the expected density",
        ),
        (
            {"min_density_share": 0.1, "sensor": LaserModel(), "origins": torch.zeros(3)},
            r"^origins has shape \(3,\)",
        ),
        (
            {
                "min_density_share": 0.1,
                "sensor": LaserModel(),
                "origins": torch.zeros(4, 2),
                "counts": torch.ones(4, 2),
            },
            r"^counts has shape \(4, 2\); expected \(2, 4\)",
        ),
    ],
)
def test_invalid_arguments_are_named(options, said):
    with pytest.raises(InvalidArgumentError, match=said):
        prune(two(), **{"n_points": 100, **options})


def test_min_density_share_needs_2d_or_3d():
    flat = Parameters(tensor(1.0), tensor([0.0]), torch.ones(1, 1, 1).double())
    with pytest.raises(InvalidArgumentError, match="D = 1"):
        prune(flat, 10, min_density_share=0.1, sensor=LaserModel(), origins=torch.zeros(1))


def test_unfitted_mixture_is_rejected():
    with pytest.raises(ValueError, match="not fitted"):
        prune(GaussianMixture(2), 10, min_support=1)
