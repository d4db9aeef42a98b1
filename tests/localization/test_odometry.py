"""Odometry in simulated worlds whose poses are known, and on bad input."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from gmmtorch.datasets import load
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.localization import Odometry, absolute_trajectory_error, with_odometry
from gmmtorch.localization.alignment import align
from gmmtorch.localization.local_map import Keyframe, LocalMap
from gmmtorch.localization.odometry import _RULE, _bridged
from gmmtorch.localization.pose_search import Expectation
from gmmtorch.pose import Pose

N_2D, N_3D = 14, 6


def sensor_scans(name: str, n: int) -> tuple[list[Tensor], Tensor]:
    """Points of the first scans in the frame of the sensor, and the true poses."""
    scans = load(name)
    poses = torch.stack([scans.pose(i) for i in range(n)])
    return [scans[i].transformed(torch.linalg.inv(pose)).points for i, pose in enumerate(poses)], poses


def keyframe(points: Tensor) -> Keyframe:
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    return Keyframe(points[order], Pose.identity(points.shape[1]))


@pytest.mark.parametrize(("name", "n"), [("synthetic_building_2d", N_2D), ("synthetic_building", N_3D)])
def test_poses_of_a_simulated_building_are_found_from_its_scans(name, n):
    scans, true = sensor_scans(name, n)
    odometry = Odometry()
    for points in scans:
        odometry.add(points)
    found = odometry.trajectory()
    assert found.found.all()
    errors = absolute_trajectory_error(found.poses, true, align="first")
    assert float(errors.distances.max()) < 0.05
    assert math.degrees(float(errors.angles.max())) < 0.5
    assert (torch.linalg.eigvalsh(found.covariances[1:]) > 0).all()


def test_covered_scans_and_nan_rows_leave_the_track():
    scans, true = sensor_scans("synthetic_building_2d", 8)
    odometry = Odometry()
    for number, points in enumerate(scans):
        if number == 4:
            location = odometry.add(points[:0])
            assert not location.found
            assert "too few points" in location.doubts[0]
        else:
            odometry.add(torch.cat([points, torch.full((3, 2), torch.nan)]))
    found = odometry.trajectory()
    assert found.found.tolist() == [number != 4 for number in range(8)]
    errors = absolute_trajectory_error(found.poses, true, align="first").distances
    assert float(errors[-1]) < 0.05
    assert float(found.covariances[4, 0, 0]) > 100 * float(found.covariances[5, 0, 0])


def test_a_corridor_leaves_the_direction_along_it_open():
    draw = torch.Generator().manual_seed(0)
    odometry = Odometry()
    for _ in range(3):
        along, noise = 16 * torch.rand(400, generator=draw) - 8, 0.01 * torch.randn(400, generator=draw)
        side = torch.ones(400)
        side[200:] = -1
        location = odometry.add(torch.stack([along, side + noise], 1))
    spread = odometry.trajectory().covariances[-1].diagonal().sqrt()
    assert float(location.covariance[0, 0]) > 100 * float(location.covariance[1, 1])
    assert float(spread[0]) > 5 * float(spread[1])


def test_a_sensor_that_is_covered_for_ten_seconds_is_found_again():
    scans, true = sensor_scans("synthetic_building_2d", 8)
    odometry = Odometry()
    stamp = 0.0
    for number, points in enumerate(scans):
        if number == 4:
            for covered in range(10):
                odometry.add(points[:0], stamp := stamp + (1.0 if covered != 5 else 1e6))  # the clock jumps
        location = odometry.add(points, stamp := stamp + 1.0)
        assert location.found
    found = odometry.trajectory()
    seen = [*range(4), *range(14, 18)]
    assert found.found.nonzero().squeeze(1).tolist() == seen
    errors = absolute_trajectory_error(found.poses[seen], true, align="first").distances
    assert float(errors.max()) < 0.05
    assert float(found.covariances[8, 0, 0]) > 1.0  # m²: no scan confirms the guess
    assert "too few points" in found.doubts[8]
    assert found.doubts[14] == ""


def test_a_sensor_that_is_carried_away_is_lost_and_the_map_is_kept():
    scans, true = sensor_scans("synthetic_building_2d", 6)
    odometry = Odometry()
    for points in scans[:4]:
        odometry.add(points)
    before = [frame.points for frame in odometry.keyframes]
    draw = torch.Generator().manual_seed(0)
    for number in range(8):  # a moving crowd
        location = odometry.add(3 * torch.rand(200, 2, generator=draw).double() - 1.5)
        assert number > 3 or (not location.found and location.probability < 0.7)
        if number < 3:
            assert len(odometry.keyframes) == len(before)
    back = odometry.trajectory()
    assert back.found.tolist() == [True] * 4 + [False] * 8
    errors = absolute_trajectory_error(back.poses[:4], true[:4], align="first").distances
    assert float(errors.max()) < 0.05


def test_a_lost_scan_lies_on_the_way_between_those_that_were_found():
    poses = Pose.from_yaw(0.1 * torch.arange(7), torch.arange(14).view(7, 2).double().square())
    found = torch.tensor([True, True, False, False, True, True, False])
    bridged = _bridged(poses, found).matrix
    assert torch.allclose(bridged[2:4], poses[[1, 1]].towards(poses[[4, 4]], torch.tensor([1, 2]) / 3).matrix)
    assert torch.equal(bridged[[0, 1, 4, 5, 6]], poses[[0, 1, 4, 5, 6]].matrix)


def test_a_lost_scan_is_searched_for_again_when_the_next_one_is_found(monkeypatch):
    scans, true = sensor_scans("synthetic_building_2d", 8)
    locate, n_calls = LocalMap.locate, 0

    def missed(local, scan, expected, wide=False):
        nonlocal n_calls
        n_calls += 1
        location = locate(local, scan, expected, wide)
        return (
            replace(location, pose=expected.poses[0].matrix, doubts=("missed",)) if n_calls == 4 else location
        )

    monkeypatch.setattr(LocalMap, "locate", missed)
    odometry = Odometry()
    assert [odometry.add(points).found for points in scans] == [number != 4 for number in range(8)]
    back = odometry.trajectory()
    assert back.found.all()
    errors = absolute_trajectory_error(back.poses, true, align="first").distances
    assert float(errors.max()) < 0.05


def test_a_room_with_equal_sides_leaves_the_heading_in_doubt():
    side = torch.linspace(-3, 3, 120).double()
    wall = torch.full_like(side, 3.0)
    room = torch.cat([torch.stack(w, 1) for w in ((side, wall), (side, -wall), (wall, side), (-wall, side))])
    frame = keyframe(room)
    local = LocalMap([frame], 0.5, _RULE)
    between = Pose.from_yaw([0.8], [0.0, 0.0])
    location = local.locate(frame, Expectation(between, 0.3, 0.2, 0.95))
    assert "another pose explains the scan as well" in location.doubts
    heading = math.atan2(location.pose[1, 0], location.pose[0, 0])
    assert heading == pytest.approx(math.pi / 2, abs=0.02)  # 45° lies between; 0.8 rad is nearer to this one


def wall(draw: torch.Generator, n: int, reach: float, period: float) -> Tensor:
    """Points (N, 3) of a wall 3 m ahead, with a pillar every `period` metres."""
    x, height = torch.rand(2, n, generator=draw).double()
    x, height = reach * (2 * x - 1), 2 * height - 1
    is_pillar = (x / period - (x / period).round()).abs() < 0.15
    return torch.stack([x, 3 - 0.2 * is_pillar, height], 1) + 0.01 * torch.randn(n, 3, generator=draw)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_first_search_in_3d_reaches_past_the_nearest_maximum(seed):
    # One pillar is missing, which the pose 1 m to the side explains almost as well.
    draw = torch.Generator().manual_seed(seed)
    before, after = wall(draw, 4000, 8, 1), wall(draw, 1000, 3, 1)
    before, after = (points[(points[:, 0].abs() > 0.2) | (points[:, 1] > 2.9)] for points in (before, after))
    local = LocalMap([keyframe(before)], 0.5, _RULE)
    predicted = Pose.from_yaw([0.0], [0.75, 0.0, 0.0])
    location = local.locate(keyframe(after), Expectation(predicted, 0.3, 0.2, 0.95))
    assert location.found
    assert float(location.pose[:3, 3].norm()) < 0.05


def wall_and_post(draw: torch.Generator, n: int, reach: float, dim: int) -> Tensor:
    """Points (N, D) of a wall 3 m ahead, and of a post 1 m before it with 5 % of them."""
    sides = torch.tensor([reach, 0.01, 1][:dim])
    points = torch.tensor([0.0, 3, 0][:dim]) + sides * (2 * torch.rand(n, dim, generator=draw) - 1)
    points[: n // 20, :2] = torch.tensor([0.0, 2]) + 0.05 * torch.rand(n // 20, 2, generator=draw)
    return points.double()


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("shift", [-0.4, 0.4])
def test_a_pose_that_slid_along_a_wall_returns_to_where_its_post_is(dim, shift):
    # At the last blur the post is out of reach, and along the wall the score is flat.
    draw = torch.Generator().manual_seed(0)
    local = LocalMap([keyframe(wall_and_post(draw, 2000, 6, dim))], 0.5, _RULE)
    scan = keyframe(wall_and_post(draw, 600, 3, dim))
    start = Pose.from_yaw([0.0], [shift, 0.0, 0.0][:dim])
    expected = Expectation(Pose.identity(dim, 1), 0.3, 0.2, 0.95)
    climbed = align(scan.points, local._targets[-1], start.shifted(-local._center), 15).motions
    assert float(climbed.orthonormal().shifted(local._center).translation.norm()) > 0.3
    location = local._climbed(scan, expected, start, local._targets[-1:]).location
    assert location.found
    assert float(location.pose[:dim, dim].norm()) < 0.05


def test_a_small_gain_of_evidence_does_not_move_a_pose_from_the_largest_score():
    # Along the wall, the counts of points that agree with free space give places nearby 2 nats more.
    draw = torch.Generator().manual_seed(0)
    local = LocalMap([keyframe(wall_and_post(draw, 2000, 6, 3))], 0.5, _RULE)
    scan = keyframe(wall_and_post(draw, 600, 3, 3))
    start = Pose.identity(3, 1)
    climbed = align(scan.points, local._targets[-1], start.shifted(-local._center), 15).motions
    location = local._climbed(scan, Expectation(start, 0.3, 0.2, 0.95), start, local._targets[-1:]).location
    assert torch.equal(location.pose, climbed.orthonormal().shifted(local._center)[0].matrix)


@pytest.mark.parametrize("seed", [0, 2])
def test_a_box_that_moved_along_equal_pillars_is_not_believed(seed):
    # Along a wall with a pillar every 2 m, a box of 2 % of the points moves by 2 m. People hide the wall, so
    # that the search is wide.
    draw = torch.Generator().manual_seed(seed)
    before, after = wall(draw, 3000, 8, 2)[:, :2], wall(draw, 1000, 5, 2)[:, :2]
    for points, place in ((before, 1), (after, -1)):
        points[(points[:, 0] - place).abs() < 0.1, 1] -= 0.3
    after[:300, 1] = 3 - 0.3 * torch.rand(300, generator=draw)
    local = LocalMap([keyframe(before)], 0.5, _RULE)
    expected = Expectation(Pose.identity(2, 1), 0.3, 0.2, 0.95)
    location = local.locate(keyframe(after), expected)
    assert float(location.pose[:2, 2].norm()) < 0.05 or not location.found


def test_a_motion_beyond_the_bounds_is_not_found():
    scans, _ = sensor_scans("synthetic_building_2d", 2)
    free, bound = Odometry(), Odometry(max_step=0.05, max_turn=0.01)
    for points in scans:
        found, refused = free.add(points), bound.add(points)
    assert found.found
    assert not refused.found
    assert "max_step" in "".join(refused.doubts)


# -- scans, clocks and wheels that are wrong in usual ways -------------------------------------------------


def largest_error(odometry: Odometry, true: Tensor) -> float:
    """The largest distance (m) of the poses from the true ones (N, 3, 3), with the first one there."""
    return float(absolute_trajectory_error(odometry.poses, true, align="first").distances.max())


def test_a_sensor_upside_down_sees_the_mirrored_world():
    scans, true = sensor_scans("synthetic_building_2d", 6)
    mirror = torch.diag(torch.tensor([1.0, -1.0])).double()
    odometry = Odometry()
    assert all(odometry.add(points.double() @ mirror).found for points in scans)
    flip = torch.block_diag(mirror, torch.ones(1, 1).double())
    assert largest_error(odometry, flip @ (true[0].inverse() @ true) @ flip) < 0.05


def test_clocks_that_stand_still_or_jump_do_not_mislead():
    scans, true = sensor_scans("synthetic_building_2d", 6)
    odometry = Odometry()
    stamps = [0.0, 0.0, 1.0, 1e9, math.nan, -5.0]
    assert all(odometry.add(*pair).found for pair in zip(scans, stamps, strict=True))
    assert largest_error(odometry, true) < 0.05


def test_repeated_scans_do_not_move():
    scans, _ = sensor_scans("synthetic_building_2d", 1)
    odometry = Odometry()
    assert all(odometry.add(scans[0]).found for _ in range(6))
    assert len(odometry.keyframes) == 1
    assert float(odometry.poses[:, :2, 2].norm(dim=1).max()) < 0.01


def test_wheels_that_slip_by_a_third_are_corrected():
    scans, true = sensor_scans("synthetic_building_2d", 6)
    odometry = Odometry()
    odometry.add(scans[0])
    for number in range(1, 6):
        motion = true[number - 1].inverse() @ true[number]
        motion[:2, 2] *= 0.7
        assert odometry.add(scans[number], motion=motion).found
    assert largest_error(odometry, true) < 0.05


# -- recordings ------------------------------------------------------------------------------------------


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("log", "first", "last"),
    [("intel", 0, 2), ("intel", 54, 60), ("intel", 884, 895), ("hall", 20, 24)],
    ids=["a wall grows behind the sensor", "a corridor", "a corridor with doors", "a turn by 135 degrees"],
)
def test_steps_that_mislead_the_points_are_found_with_free_space(real_data, log, first, last):
    planar = real_data / f"laser2d/{log}.log.gz"
    scans = load("carmen", planar) if planar.is_file() else load("scan_folder", real_data / log)
    true = torch.stack([scans.pose(i) for i in range(first, last + 1)])
    odometry = Odometry()
    for number, pose in enumerate(true, first):
        location = odometry.add(scans[number].transformed(torch.linalg.inv(pose)).points)
        assert location.found
        errors = absolute_trajectory_error(location.pose[None], (true[:1].inverse() @ pose), align="none")
        assert float(errors.distances[0]) < 0.2


@pytest.mark.slow
@pytest.mark.real_data
def test_the_poses_of_a_narrow_lidar_stay_right_along_a_wall(real_data):
    # Its field of view is a cone of 70°: with ten keyframes the error is 2 m.
    scans = load("scan_folder", real_data / "courtyard")
    true = torch.stack([scans.pose(number) for number in range(64)])
    odometry = Odometry()
    for number, pose in enumerate(true):
        odometry.add(scans[number].transformed(torch.linalg.inv(pose)).points)
    found = odometry.trajectory(loops=False)
    assert absolute_trajectory_error(found.poses, true).rmse < 0.15


@pytest.mark.parametrize(("spread", "expected"), [(0.3, 80), (10.0, 10)])
def test_a_narrow_field_of_view_keeps_more_keyframes(spread, expected):
    points = torch.tensor([5.0, 0.0, 0.0]) + torch.tensor([0.5, 5 * spread, 5 * spread]) * torch.randn(
        500, 3, generator=torch.Generator().manual_seed(0)
    )
    odometry = Odometry()
    odometry.add(points)
    assert odometry.n_keyframes == expected
    given = Odometry(n_keyframes=7)
    given.add(points)
    assert given.n_keyframes == 7


def test_one_scan_has_the_first_pose():
    odometry = Odometry()
    location = odometry.add(torch.rand(100, 3))
    assert location.found
    found = odometry.trajectory()
    assert torch.equal(found.poses, torch.eye(4).double()[None])
    assert found.covariances.abs().max() == 0


def test_scans_with_too_few_points_have_a_trajectory_that_is_not_found():
    odometry = Odometry()
    for _ in range(3):
        odometry.add(torch.rand(2, 3))
    assert odometry.trajectory().found.tolist() == [True, False, False]


def test_a_clock_that_jumps_does_not_scale_the_motion():
    odometry = Odometry()
    ratios = [odometry._clock(stamp) for stamp in (0.0, 1.0, 3.0, 2.0, 3.0, math.nan, 5.0, 1e9, None)]
    assert ratios == [1.0, 1.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]


def test_bad_arguments_are_named():
    with pytest.raises(InvalidArgumentError, match="no scan was added"):
        Odometry().trajectory()
    odometry = Odometry()
    with pytest.raises(InvalidArgumentError, match="points has shape"):
        odometry.add(torch.zeros(5, 4))
    odometry.add(torch.rand(50, 2))
    with pytest.raises(InvalidArgumentError, match=r"expected \(N, 2\)"):
        odometry.add(torch.rand(50, 3))
    with pytest.raises(InvalidArgumentError, match="motion"):
        odometry.add(torch.rand(50, 2), motion=2 * torch.eye(3))
    with pytest.raises(InvalidArgumentError, match="odometry='icp'"):
        with_odometry(load("synthetic_building_2d", n_scans=2), "icp")
    with pytest.raises(InvalidArgumentError, match="motion='wheels'"):
        with_odometry(load("synthetic_building_2d", n_scans=2), motion="wheels")
    with pytest.raises(InvalidArgumentError, match="use odometry=mixture"):
        with_odometry(load("synthetic_building_2d", n_scans=2), "kiss_icp", motion="dataset")
    with pytest.raises(InvalidArgumentError, match="max_turn"):
        Odometry(max_turn=4.0)


def test_a_recording_gets_the_estimated_poses_and_keeps_its_points():
    few = load("synthetic_building_2d", n_scans=3)
    posed, trajectory = with_odometry(few)
    assert len(posed) == len(trajectory.poses) == 3
    for index in range(3):
        moved = posed.pose(index) @ torch.linalg.inv(few.pose(index))
        assert torch.allclose(posed[index].points, few[index].transformed(moved).points, atol=1e-9)
        assert torch.equal(posed.own_pose(index), few.pose(index))


def test_the_motion_of_the_data_set_predicts_the_poses(monkeypatch):
    few = load("synthetic_building_2d", n_scans=3)
    true = [few.pose(index) for index in range(3)]
    motions: list[Tensor | None] = []
    add = Odometry.add
    monkeypatch.setattr(
        Odometry,
        "add",
        lambda self, points, stamp, motion, _: (motions.append(motion), add(self, points, stamp, motion)),
    )
    with_odometry(few, motion="dataset")
    assert motions[0] is None
    for index in (1, 2):
        assert torch.allclose(true[index - 1] @ motions[index], true[index])
    motions.clear()
    with_odometry(few)
    assert motions == [None, None, None]


def test_kiss_icp_gives_poses_of_the_same_scans():
    pytest.importorskip("kiss_icp")
    few = load("synthetic_building", n_scans=2)
    posed, trajectory = with_odometry(few, "kiss_icp")
    assert trajectory.poses.shape == (2, 4, 4)
    assert torch.allclose(trajectory.poses[0], torch.eye(4).double(), atol=1e-6)
    assert trajectory.covariances.isnan().all()
    assert len(posed) == 2


def test_a_folder_without_poses_is_read_in_the_frame_of_the_sensor(tmp_path):
    (tmp_path / "scans").mkdir()
    header = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\n"
    header += "POINTS 2\nDATA ascii\n"
    (tmp_path / "scans" / "0.pcd").write_text(header + "1 2 3\n4 5 6\n")
    with pytest.raises(DataError, match=r"odometry=auto"):
        load("scan_folder", tmp_path)
    scan = load("scan_folder", tmp_path, poses="standing")[0]
    assert scan.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert scan.origin.tolist() == [0, 0, 0]
