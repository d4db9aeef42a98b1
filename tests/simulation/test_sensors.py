"""Range sensors and their smooth paths; rays against segments."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.simulation import (
    buildings,
    laser_2d,
    poses_2d,
    poses_3d,
    sense,
    simulate_scan,
    smooth_path,
    spinning_lidar,
)
from gmmtorch.simulation.buildings import ray_segments
from gmmtorch.simulation.furniture import circle, prism
from gmmtorch.simulation.sensors import depth_camera


class Shell:
    """A world with a surface at a distance of `radius` metres from every origin."""

    def __init__(self, radius: float) -> None:
        self.radius = radius

    def distances(self, origin: Tensor, directions: Tensor) -> Tensor:
        return torch.full_like(directions[:, 0], self.radius)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def example_pose(dim: int) -> Tensor:
    pose = torch.eye(dim + 1, dtype=torch.float64)
    pose[:dim, dim] = torch.arange(1.0, dim + 1)
    return pose


def test_laser_beams_are_symmetric_and_evenly_spaced():
    directions = laser_2d(n_beams=4, field_of_view=math.pi).directions
    angles = torch.atan2(directions[:, 1], directions[:, 0]).rad2deg()
    torch.testing.assert_close(angles, torch.tensor([-67.5, -22.5, 22.5, 67.5], dtype=torch.float64))


def test_lidar_rings_have_the_given_elevations():
    directions = spinning_lidar(3, 4, (-0.5, 0.5)).directions
    assert directions.shape == (12, 3)
    torch.testing.assert_close(directions[4:8, 2], torch.zeros(4, dtype=torch.float64))
    torch.testing.assert_close(
        directions[:, 2].asin()[::4], torch.tensor([-0.5, 0, 0.5], dtype=torch.float64)
    )
    torch.testing.assert_close(directions[5], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))


def test_camera_pixels_are_row_major_from_the_top_left():
    directions = depth_camera(6, 4, math.radians(90)).directions.view(4, 6, 3)
    assert bool((directions[..., 0] > 0).all())
    assert bool((directions[0, :, 2] > 0).all())
    assert bool((directions[:, 0, 1] > 0).all())
    image = directions / directions[..., :1]
    torch.testing.assert_close(image[0, :, 1], -image[0, :, 1].flip(0))
    assert float(image[0, 0, 1] - image[0, 1, 1]) == pytest.approx(2 / 6)  # square pixels, 90° across
    assert float(image[0, 0, 2] - image[1, 0, 2]) == pytest.approx(2 / 6)


def test_noise_has_the_given_deviation_along_the_beam():
    sensor = spinning_lidar(64, 360, range_noise=0.02)
    pose = example_pose(3)
    ends, no_return = sense(sensor, pose, Shell(4.0), generator())
    assert not bool(no_return.any())
    offset = ends - pose[:3, 3]
    error = offset.norm(dim=1) - 4.0
    n = error.shape[0]
    assert float(error.std()) == pytest.approx(0.02, rel=4 / math.sqrt(2 * n))
    assert abs(float(error.mean())) < 4 * 0.02 / math.sqrt(n)
    across = offset - (offset * sensor.directions).sum(1, keepdim=True) * sensor.directions
    assert float(across.norm(dim=1).max()) < 1e-9


@pytest.mark.parametrize("radius", [12.0, 40.0, math.inf])
def test_surfaces_out_of_range_give_no_return(radius):
    scan = simulate_scan(laser_2d(max_range=12.0), example_pose(2), Shell(radius), generator())
    assert scan.points.shape == (0, 2)
    length = (scan.no_return - scan.origin).norm(dim=1)
    torch.testing.assert_close(length, torch.full((180,), 12.0, dtype=torch.float64))


def test_noise_never_moves_a_hit_beyond_the_range():
    scan = simulate_scan(laser_2d(2000, max_range=12.0), example_pose(2), Shell(11.995), generator())
    assert 0 < len(scan.points) < 2000
    assert scan.n_beams == 2000
    assert bool(((scan.points - scan.origin).norm(dim=1) < 12.0).all())


def test_dropped_beams_are_absent_in_the_given_share():
    sensor = laser_2d(20_000, dropout=0.25)
    scan = simulate_scan(sensor, example_pose(2), Shell(3.0), generator())
    assert len(scan.no_return) == 0
    assert scan.n_beams / 20_000 == pytest.approx(0.75, abs=0.02)
    empty = simulate_scan(sensor, example_pose(2), Shell(math.inf), generator())
    assert empty.n_beams == scan.n_beams


def test_scans_depend_only_on_the_generator():
    first, second, other = (
        sense(laser_2d(dropout=0.1), example_pose(2), Shell(3.0), generator(seed))[0] for seed in (1, 1, 2)
    )
    assert torch.equal(first, second)
    assert first.shape != other.shape or not torch.equal(first, other)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: laser_2d(n_beams=0), "n_beams=0"),
        (lambda: laser_2d(field_of_view=7.0), r"field_of_view=7\.0"),
        (lambda: laser_2d(max_range=0.0), r"max_range=0\.0"),
        (lambda: laser_2d(max_range=math.inf), "max_range=inf"),
        (lambda: laser_2d(range_noise=-0.1), r"range_noise=-0\.1"),
        (lambda: laser_2d(dropout=1.0), r"dropout=1\.0"),
        (lambda: spinning_lidar(n_rings=0), "n_rings=0"),
        (lambda: depth_camera(height=0), "height=0"),
        (lambda: depth_camera(field_of_view=0.0), r"field_of_view=0\.0"),
        (lambda: depth_camera(field_of_view=math.pi), "field_of_view=3.14"),
        (lambda: smooth_path(torch.zeros(1, 2)), "waypoints"),
        (lambda: smooth_path(torch.zeros(4, 3)), "waypoints"),
        (lambda: smooth_path(CORNER, 0.0), r"spacing=0\.0"),
        (lambda: poses_2d(smooth_path(CORNER), 0), "n=0"),
    ],
)
def test_sensors_and_paths_reject_invalid_arguments(make, message):
    with pytest.raises(InvalidArgumentError, match=message):
        make()


# -- trajectories ------------------------------------------------------------------------------------


CORNER = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]])


def test_path_keeps_its_ends_and_spacing():
    path = smooth_path(CORNER, 0.05)
    assert path[0].tolist() == [0.0, 0.0]
    torch.testing.assert_close(path[-1], CORNER[-1].double())
    steps = (path[1:] - path[:-1]).norm(dim=1)
    assert bool(((steps > 0.045) & (steps < 0.0501)).all())


def test_path_rounds_corners_without_overshoot():
    path = smooth_path(CORNER)
    heading = torch.atan2(*(path[1:] - path[:-1]).T.flip(0))
    assert float((heading[1:] - heading[:-1]).abs().max()) < 0.15
    assert bool((path[:, 0] <= 4).all())
    assert bool((path[:, 1] >= 0).all())
    assert float((path - torch.tensor([4.0, 0.0])).norm(dim=1).min()) > 0.5


def test_path_is_straight_along_collinear_waypoints():
    path = smooth_path(torch.tensor([[0.0, 1.0], [3.0, 3.0], [3.0, 4.0], [3.0, 5.0], [7.0, 5.0]]))
    middle = path[(path[:, 1] > 3.55) & (path[:, 1] < 4.45)]
    torch.testing.assert_close(middle[:, 0], torch.full_like(middle[:, 0], 3.0))


def test_poses_2d_face_forward_at_even_spacing():
    poses = poses_2d(smooth_path(CORNER), 30)
    assert poses.shape == (30, 3, 3)
    torch.testing.assert_close(poses[0], torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(
        poses[-1], torch.tensor([[0, -1, 4], [1, 0, 4], [0, 0, 1]], dtype=torch.float64), atol=1e-6, rtol=0
    )
    steps = (poses[1:, :2, 2] - poses[:-1, :2, 2]).norm(dim=1)
    assert float(steps.max() - steps.min()) < 0.02


@pytest.mark.parametrize(("pitch", "swing"), [(0.0, 0.0), (0.2, 0.0), (0.2, 1.0)])
def test_poses_3d_are_rigid_without_roll(pitch, swing):
    poses = poses_3d(smooth_path(CORNER), 20, 1.5, pitch, swing)
    rotation = poses[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64).expand(20, 3, 3))
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(20, dtype=torch.float64))
    assert bool((poses[:, 2, 3] == 1.5).all())
    torch.testing.assert_close(rotation[:, 2, 0], torch.full((20,), -math.sin(pitch), dtype=torch.float64))
    torch.testing.assert_close(rotation[:, 2, 1], torch.zeros(20, dtype=torch.float64))  # no roll


# -- rays against segments ---------------------------------------------------------------------------

DTYPE = torch.float64


def tensor(values) -> Tensor:
    return torch.tensor(values, dtype=DTYPE)


def random(shape: tuple[int, ...], seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=DTYPE)


def solve_all_pairs(origins: Tensor, directions: Tensor, segments: Tensor) -> Tensor:
    """Distances (N,) from a linear system per pair: o + t d = a + s e, 0 ≤ s ≤ 1, t > 0."""
    edges = segments[:, 1] - segments[:, 0]
    columns = torch.stack(torch.broadcast_tensors(-directions[:, None], edges), -1)
    right = origins.expand_as(directions)[:, None] - segments[:, 0]
    t, weight = torch.linalg.solve(columns, right[..., None])[..., 0].unbind(-1)
    return torch.where((weight >= 0) & (weight <= 1) & (t > 0), t, torch.inf).amin(1)


@pytest.mark.parametrize("one_origin", [True, False])
def test_distances_agree_with_a_linear_solver(one_origin):
    segments = random((4, 2, 2), 0)
    origins = random((2,), 1) if one_origin else random((500, 2), 1)
    directions = random((500, 2), 2)
    found, expected = (
        ray_segments(origins, directions, segments),
        solve_all_pairs(origins, directions, segments),
    )
    assert 0.2 < float(torch.isfinite(expected).double().mean()) < 0.999
    torch.testing.assert_close(found, expected)


def test_chunk_sizes_do_not_change_the_distances(monkeypatch):
    segments, directions = random((30, 2, 2), 0), random((200, 2), 1)
    whole = ray_segments(torch.zeros(2), directions, segments)
    monkeypatch.setattr(buildings, "_CHUNK_PAIRS", 64)
    torch.testing.assert_close(ray_segments(torch.zeros(2), directions, segments), whole)


def test_distances_to_a_segment_are_multiples_of_the_direction():
    wall = tensor([[[2.0, -1.0], [2.0, 1.0]]])
    directions = tensor([[1, 0], [-1, 0], [2, 0], [1, 0.5], [1, 0.6], [0, 1]])
    found = ray_segments(tensor([0.0, 0.0]), directions, wall)
    assert found.tolist() == [2.0, math.inf, 1.0, 2.0, math.inf, math.inf]


def test_rays_at_shared_ends_hit():
    ring = circle(1.0, 360)
    segments = torch.stack([ring, ring.roll(-1, 0)], 1)
    distance = ray_segments(tensor([0.1, 0.2]), ring - tensor([0.1, 0.2]), segments)
    torch.testing.assert_close(distance, torch.ones_like(distance))


def test_prism_has_the_exact_volume():
    drum = prism(circle(0.5, 24), 1.0, 3.0)
    volume = float((drum[:, 0] * torch.linalg.cross(drum[:, 1], drum[:, 2])).sum() / 6)
    assert volume == pytest.approx(2.0 * 12 * 0.25 * math.sin(2 * math.pi / 24))


def test_no_segments_give_infinity_and_no_rays_give_nothing():
    assert torch.isinf(ray_segments(torch.zeros(2), torch.ones(3, 2), torch.empty(0, 2, 2))).all()
    assert ray_segments(torch.zeros(2), torch.empty(0, 2), torch.ones(4, 2, 2)).shape == (0,)


@pytest.mark.parametrize(
    ("origins", "directions", "segments", "message"),
    [
        ((3,), (5, 2), (1, 2, 2), "origin has"),
        ((4, 2), (5, 2), (1, 2, 2), "origin has"),
        ((2,), (5, 3), (1, 2, 2), "directions"),
        ((2,), (2,), (1, 2, 2), "directions"),
        ((2,), (5, 2), (1, 3, 2), "segments"),
    ],
)
def test_ray_segments_rejects_shapes_that_do_not_match(origins, directions, segments, message):
    with pytest.raises(InvalidArgumentError, match=message):
        ray_segments(torch.zeros(origins), torch.ones(directions), torch.zeros(segments))
