"""DepthCamera against the geometry of rays, boxes and spheres, and against its noise model."""

from __future__ import annotations

import math
import pickle

import pytest
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.simulation import DepthCamera, MeshWorld, box, depth_camera

LOW, HIGH = torch.tensor([0.0, 0, 0]).double(), torch.tensor([9.0, 7, 4]).double()
ROOM = MeshWorld(box((0, 0, 0), (9, 7, 4)))
NO_TEAMMATES = torch.zeros(0, 3, dtype=torch.float64)
EXACT = DepthCamera(40, 30, noise=0.0, dropout=0.0)


def pose(x: float, y: float, z: float, yaw: float = 0.0) -> Tensor:
    return torch.tensor([x, y, z, yaw], dtype=torch.float64)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def world_directions(camera: DepthCamera, yaw: float) -> Tensor:
    """Directions (N, 3) in the world frame, rotated by complex multiplication."""
    d = camera.directions
    turned = torch.complex(d[:, 0], d[:, 1]) * complex(math.cos(yaw), math.sin(yaw))
    return torch.stack([turned.real, turned.imag, d[:, 2]], 1)


def to_walls(origin: Tensor, directions: Tensor) -> Tensor:
    """Distances (N,) in metres from a point in the room to its walls, by slabs."""
    return torch.where(directions > 0, (HIGH - origin) / directions, (LOW - origin) / directions).amin(1)


def test_pixels_are_evenly_spaced_and_fill_the_field_of_view():
    camera = DepthCamera(8, 6, horizontal_fov=1.4, vertical_fov=0.9)
    plane = (camera.directions / camera.directions[:, :1]).view(6, 8, 3)
    left, up = plane[..., 1], plane[..., 2]
    torch.testing.assert_close(left[2, :-1] - left[2, 1:], torch.full((7,), math.tan(0.7) / 4).double())
    torch.testing.assert_close(up[:-1, 3] - up[1:, 3], torch.full((5,), math.tan(0.45) / 3).double())
    assert float(left[0, 0] + math.tan(0.7) / 8) == pytest.approx(math.tan(0.7))
    assert float(up[0, 0] + math.tan(0.45) / 6) == pytest.approx(math.tan(0.45))
    assert float(camera.directions.norm(dim=1).sub(1).abs().max()) < 1e-15


def test_square_pixels_have_the_directions_of_depth_camera():
    angle = 2 * math.atan(math.tan(0.6) * 64 / 80)
    camera = DepthCamera(80, 64, horizontal_fov=1.2, vertical_fov=angle)
    torch.testing.assert_close(camera.directions, depth_camera(80, 64, field_of_view=1.2).directions)


@pytest.mark.parametrize("yaw", [0.0, 0.4, 2.0, -3.0, 40.0])
def test_ends_without_noise_lie_on_the_walls(yaw):
    where = pose(3.0, 2.5, 1.7, yaw)
    frame = EXACT.sense(ROOM, where, NO_TEAMMATES, 0.3, seeded())
    directions = world_directions(EXACT, yaw)
    distance = to_walls(where[:3], directions)
    assert torch.equal(frame.pixel, torch.arange(40 * 30))
    assert torch.equal(frame.is_hit, distance < 6.0)
    expected = where[:3] + directions * distance.clamp_max(6.0)[:, None]
    assert float((frame.ends - expected).abs().max()) < 1e-5
    beyond = (frame.ends[~frame.is_hit] - where[:3]).norm(dim=1)
    assert bool(((beyond - 6.0).abs() < 1e-12).all())


@pytest.mark.parametrize("depth", [1.0, 3.5])
def test_depth_noise_grows_with_the_square_of_depth(depth):
    camera = DepthCamera(160, 120, noise=0.004, dropout=0.0, max_range=8.0)
    wall = MeshWorld(box((depth, -50, -50), (depth + 1, 50, 50)))
    frame = camera.sense(wall, pose(0, 0, 0), NO_TEAMMATES, 0.3, seeded(1))
    error = (camera.image(frame) - depth).flatten()
    # The noise depends on depth only: it is equal at the corners and in the middle of the image.
    outer = camera.directions[:, 0] < 0.75
    for part in (error[outer], error[~outer]):
        n = len(part)
        assert n > 1000
        assert abs(float(part.mean())) < 4.5 * 0.004 * depth**2 / math.sqrt(n)
        assert abs(float(part.std()) / (0.004 * depth**2) - 1) < 4.5 / math.sqrt(2 * n)
    across = torch.linalg.cross(frame.ends, world_directions(camera, 0.0))
    assert float(across.norm(dim=1).max()) < 1e-9  # the error is along the beam


def test_readings_beyond_max_range_become_no_return_beams():
    camera = DepthCamera(60, 60, 0.02, 0.02, max_range=5.0, noise=0.01, dropout=0.0)
    wall = MeshWorld(box((4.9, -9, -9), (6, 9, 9)))
    frame = camera.sense(wall, pose(0, 0, 0), NO_TEAMMATES, 0.3, seeded())
    ranges = frame.ends.norm(dim=1)
    assert bool((ranges[frame.is_hit] < 5.0).all())
    torch.testing.assert_close(ranges[~frame.is_hit], torch.full_like(ranges[~frame.is_hit], 5.0))
    share = 0.5 * math.erfc(0.1 / (0.01 * 4.9**2) / math.sqrt(2))
    assert abs(float((~frame.is_hit).double().mean()) - share) < 4.5 * math.sqrt(share * (1 - share) / 3600)


def test_noise_never_moves_a_hit_behind_the_camera():
    close = MeshWorld(box((0.01, -9, -9), (1, 9, 9)))
    frame = DepthCamera(noise=1e4, dropout=0.0).sense(close, pose(0, 0, 0), NO_TEAMMATES, 0.3, seeded())
    assert float((frame.ends @ torch.tensor([1.0, 0, 0]).double()).min()) > 0


def test_pixels_drop_out_in_the_given_share():
    camera = DepthCamera(dropout=0.05)
    frame = camera.sense(ROOM, pose(4, 3, 2), NO_TEAMMATES, 0.3, seeded())
    n = 160 * 120
    assert abs(len(frame.pixel) / n - 0.95) < 4.5 * math.sqrt(0.05 * 0.95 / n)
    assert bool((frame.pixel[1:] > frame.pixel[:-1]).all())
    assert frame.ends.dtype == torch.float64
    assert len(frame.ends) == len(frame.is_hit) == len(frame.pixel)


def test_known_distances_give_the_same_frame():
    camera = DepthCamera(40, 30)
    here, teammate = pose(4, 3, 2), torch.tensor([[4.5, 3.5, 2.0]], dtype=torch.float64)
    one = camera.sense(ROOM, here, teammate, 0.3, seeded())
    other = camera.sense(ROOM, here, teammate, 0.3, seeded(), camera.beams(ROOM, here))
    assert all(torch.equal(a, b) for a, b in zip(vars(one).values(), vars(other).values(), strict=True))


def test_the_number_of_random_draws_does_not_depend_on_the_world():
    camera = DepthCamera(40, 30, dropout=0.2)
    teammates = torch.tensor([[4.5, 3.0, 2.0]], dtype=torch.float64)
    one, other = seeded(3), seeded(3)
    camera.sense(ROOM, pose(4, 3, 2), teammates, 0.3, one)
    camera.sense(MeshWorld(box((50, 0, 0), (51, 1, 1))), pose(0, 0, 0), NO_TEAMMATES, 0.3, other)
    first, second = (camera.sense(ROOM, pose(4, 3, 2), NO_TEAMMATES, 0.3, g) for g in (one, other))
    assert torch.equal(first.ends, second.ends)
    assert torch.equal(first.pixel, second.pixel)


@pytest.mark.parametrize(
    ("teammate", "is_visible"),
    [
        ((5.0, 3.2, 2.1), True),
        ((4.0, 2.0, 2.0), True),  # at the edge of the image
        ((1.0, 3.0, 2.0), False),  # behind
        ((2.0, 3.0, 3.5), False),  # overhead
        ((8.7, 3.0, 2.0), False),  # beyond the range
    ],
)
def test_beams_that_hit_a_teammate_are_absent(teammate, is_visible):
    where, center, radius = pose(2.0, 3.0, 2.0), torch.tensor(teammate, dtype=torch.float64), 0.35
    frame = EXACT.sense(ROOM, where, center[None], 0.3, seeded())
    blocked = []
    for i, u in enumerate(world_directions(EXACT, 0.0)):
        # Point of the beam, up to the surface or the range, that is nearest to the sphere's centre.
        length = min(6.0, float(to_walls(where[:3], u[None])))
        t = min(max(float(u @ (center - where[:3])), 0.0), length)
        if float((where[:3] + t * u - center).norm()) < radius:
            blocked.append(i)
    absent = sorted(set(range(40 * 30)) - set(frame.pixel.tolist()))
    assert absent == blocked
    assert bool(blocked) == is_visible


def test_a_teammate_behind_a_wall_hides_no_beam_and_one_at_the_camera_hides_all():
    where = pose(8.0, 3.0, 2.0)
    behind = torch.tensor([[9.6, 3.0, 2.0]], dtype=torch.float64)
    assert len(EXACT.sense(ROOM, where, behind, 0.3, seeded()).pixel) == 1200
    touching = torch.tensor([[7.8, 3.1, 2.0]], dtype=torch.float64)
    empty = EXACT.sense(ROOM, where, torch.cat([behind, touching]), 0.3, seeded())
    assert len(empty.pixel) == 0
    assert empty.scan().n_beams == 0


def test_scan_and_image_contain_the_same_beams():
    camera = DepthCamera(40, 30, dropout=0.1)
    where = pose(3.0, 2.5, 1.7, 0.4)
    frame = camera.sense(ROOM, where, NO_TEAMMATES, 0.3, seeded())
    ends, is_hit = frame.scan().ends()
    assert torch.equal(ends[is_hit], frame.ends[frame.is_hit])
    assert torch.equal(ends[~is_hit], frame.ends[~frame.is_hit])
    depth = camera.image(frame)
    assert depth.shape == (30, 40)
    assert int(depth.isnan().sum()) == 1200 - len(frame.pixel)
    assert int(depth.isinf().sum()) == int((~frame.is_hit).sum())
    row, column = frame.pixel // 40, frame.pixel % 40
    left = (19.5 - column.double()) / 20 * math.tan(1.5184 / 2)
    up = (14.5 - row.double()) / 15 * math.tan(1.0123 / 2)
    z = depth[row, column]
    c, s = math.cos(0.4), math.sin(0.4)
    rebuilt = where[:3] + torch.stack([z * (c - s * left), z * (s + c * left), z * up], 1)
    torch.testing.assert_close(rebuilt[frame.is_hit], frame.ends[frame.is_hit])


@pytest.mark.parametrize(
    "bad",
    [
        {"width": 0},
        {"height": -1},
        {"height": 2.5},
        {"horizontal_fov": 0.0},
        {"vertical_fov": math.pi},
        {"vertical_fov": math.nan},
        {"max_range": 0.0},
        {"max_range": math.inf},
        {"noise": -0.1},
        {"dropout": 1.0},
    ],
)
def test_depth_camera_rejects_invalid_attributes(bad):
    (name,) = bad
    with pytest.raises(InvalidArgumentError, match=f"{name}="):
        DepthCamera(**bad)


def test_sense_rejects_poses_and_teammates_that_are_not_finite():
    with pytest.raises(InvalidArgumentError, match="pose="):
        EXACT.sense(ROOM, pose(math.nan, 0, 0), NO_TEAMMATES, 0.3, seeded())
    with pytest.raises(InvalidArgumentError, match="others="):
        EXACT.sense(ROOM, pose(1, 1, 1), NO_TEAMMATES.new_full((1, 3), math.inf), 0.3, seeded())


def test_a_pickled_camera_has_no_tensors_that_it_computed():
    camera = DepthCamera(40, 30)
    before = pickle.dumps(camera)
    camera.beams(ROOM, pose(4.0, 3.0, 1.0))
    assert pickle.dumps(camera) == before
    assert torch.equal(pickle.loads(before).directions, camera.directions)
