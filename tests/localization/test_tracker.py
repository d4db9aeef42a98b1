"""Localisation of scans in a map: one after the other, and of all scans of a data set."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import gmmtorch as gt
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.localization import Tracker, clock_faults, locate_scans
from gmmtorch.pose import Pose, generators


def in_sensor_frame(scan: gt.Scan, pose: Tensor) -> Tensor:
    return scan.transformed(torch.linalg.inv(pose)).points


def moved(pose: Tensor, distance: float, angle: float, seed: int = 0) -> Tensor:
    """A pose that is off by metres and radians in a random direction."""
    dim, generator = len(pose) - 1, torch.Generator().manual_seed(seed)
    shift = torch.randn(dim, generator=generator).double()
    turn = torch.randn(dim * (dim - 1) // 2, generator=generator).double()
    off = pose.clone()
    off[:dim, dim] += distance * shift / shift.norm()
    axis = torch.einsum("k,kij->ij", turn / turn.norm(), generators(dim))
    off[:dim, :dim] = torch.linalg.matrix_exp(angle * axis) @ pose[:dim, :dim]
    return off


def errors(pose: Tensor, truth: Tensor) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    dim = len(pose) - 1
    turn = pose[:dim, :dim].T @ truth[:dim, :dim] - torch.eye(dim)
    angle = math.degrees(float(torch.linalg.matrix_norm(turn)) / math.sqrt(2))
    return float((pose[:dim, dim] - truth[:dim, dim]).norm()), angle


def held_out(name: str, n_scans: int) -> tuple[gt.datasets.Dataset, gt.GaussianMap]:
    """Scans with their poses, and a map of all but every fifth."""
    scans, m = gt.datasets.load(name, n_scans=n_scans), gt.GaussianMap()
    for number, scan in enumerate(scans):
        if number % 5:
            m.insert(scan)
    return scans, m


@pytest.fixture(scope="module")
def building():
    return held_out("synthetic_building_2d", 240)


def test_held_out_scans_are_found_from_half_a_metre_and_ten_degrees(building):
    scans, m = building
    for number in range(0, len(scans), 30):
        truth = scans.pose(number)
        tracker = Tracker(m, moved(truth, 0.5, math.radians(10), number))
        found = tracker.locate(in_sensor_frame(scans[number], truth))
        distance, angle = errors(found.pose, truth)
        assert found.found, (number, found.doubts)
        assert distance < 0.1, number
        assert angle < 1, number


def test_a_sequence_is_tracked_by_rough_odometry_past_a_covered_sensor(building):
    scans, m = building
    tracker = Tracker(m, scans.pose(0))
    for number in range(16):
        truth = scans.pose(number)
        motion = torch.linalg.solve(scans.pose(max(number - 1, 0)), truth)
        points = in_sensor_frame(scans[number], truth)
        is_covered = number in (6, 7)
        found = tracker.locate(points[:0] if is_covered else points, moved(motion, 0.1, 0.05, number))
        assert found.found != is_covered, (number, found.doubts)
        if not is_covered:
            assert errors(found.pose, truth)[0] < 0.1, number


def test_scans_without_a_pose_are_found_right_or_not_at_all(building):
    scans, m = building
    tracker, n_found = Tracker(m), 0
    for number in range(0, len(scans), 20):
        truth = scans.pose(number)
        tracker.restart()
        found = tracker.locate(in_sensor_frame(scans[number], truth))
        n_found += found.found
        assert not found.found or errors(found.pose, truth)[0] < 0.1, number
    assert n_found >= 11  # of 12


def test_a_tilted_or_turned_sensor_in_space_is_found_without_a_pose():
    """Held-out scans, with the sensor upright, tilted, on its side and upside down."""
    scans, m = held_out("synthetic_building", 30)
    tracker = Tracker(m)
    turns = torch.tensor([[0.0, 0, 0], [0.4, 0.2, 0], [0, math.pi / 2, 1], [math.pi, 0, 0]]).double()
    for number, turn in zip((5, 10, 15, 20), turns, strict=True):
        truth = scans.pose(number) @ Pose.from_turn(turn).matrix
        tracker.restart()
        found = tracker.locate(in_sensor_frame(scans[number], truth))
        distance, angle = errors(found.pose, truth)
        assert found.found, (number, found.doubts)
        assert distance < 0.1, number
        assert angle < 1, number


def test_a_scan_of_another_place_is_not_found(building):
    _, m = building
    angle = torch.linspace(0, 2 * math.pi, 300).double()
    star = (2 + torch.sin(7 * angle))[:, None] * torch.stack([angle.cos(), angle.sin()], 1)
    found = Tracker(m, torch.eye(3)).locate(star)
    assert not found.found
    assert "another place" in " ".join(found.doubts)


def test_points_in_free_space_and_too_few_points_are_doubts(building, monkeypatch):
    scans, m = building
    truth = scans.pose(7)
    points = in_sensor_frame(scans[7], truth)
    few = Tracker(m, truth).locate(points[:9])
    assert "only 9 points" in " ".join(few.doubts)
    monkeypatch.setattr(gt.GaussianMap, "occupancy", lambda _, asked, *__: torch.zeros(len(asked)))
    (doubt,) = Tracker(m, truth).locate(points).doubts
    assert doubt.startswith("100% of the points lie where the map saw free space, and 0% of the beams")
    monkeypatch.setattr(gt.GaussianMap, "occupancy", lambda _, asked, *__: torch.ones(len(asked)))
    (doubt,) = Tracker(m, truth).locate(points).doubts
    assert doubt.endswith("0% of the points lie where the map saw free space, and 100% of the beams pass "
                          "through its surfaces")  # fmt: skip


def test_a_corridor_leaves_its_direction_open():
    along = torch.linspace(-15, 15, 61).double()
    means = torch.cat([torch.stack([along, torch.full_like(along, side)], 1) for side in (-1.0, 1.0)])
    shape = torch.diag(torch.tensor([0.1, 1e-4]).double()).repeat(len(means), 1, 1)
    beam = torch.linspace(-4, 4, 200).double()
    points = torch.cat([torch.stack([beam, torch.full_like(beam, side)], 1) for side in (-1.0, 1.0)])
    found = Tracker((means, shape, torch.ones(len(means))), torch.eye(3)).locate(points)
    assert not found.found
    assert "direction open" in " ".join(found.doubts)
    deviation = found.covariance.diagonal().sqrt()
    assert float(deviation[0]) > 0.3
    assert float(deviation[1]) < 0.1


def test_far_from_the_origin_the_pose_is_the_same(building):
    scans, m = building
    there = torch.eye(3).double()
    there[:2, 2] = torch.tensor([500e3, -300e3])
    points, truth = in_sensor_frame(scans[5], scans.pose(5)), scans.pose(5)
    means, covariances, weights = (
        getattr(m.components(), name) for name in ("means", "covariances", "support")
    )
    near = Tracker((means, covariances, weights), moved(truth, 0.3, 0.1)).locate(points)
    far = Tracker((means + there[:2, 2], covariances, weights), there @ moved(truth, 0.3, 0.1)).locate(points)
    torch.testing.assert_close(far.pose, there @ near.pose, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pose": torch.ones(3, 3)}, "pose"),
        ({"distance": -1}, "distance"),
        ({"angle": 4}, "angle"),
        ({"n_points": 0}, "n_points"),
        ({"least_explained": 2}, "least_explained"),
    ],
)
def test_bad_arguments_are_named(building, change, message):
    with pytest.raises(InvalidArgumentError, match=message):
        Tracker(building[1], **{"pose": torch.eye(3), **change})


def test_bad_scans_and_maps_are_named(building):
    tracker = Tracker(building[1], torch.eye(3))
    with pytest.raises(InvalidArgumentError, match="points has shape"):
        tracker.locate(torch.zeros(4, 3))
    with pytest.raises(InvalidArgumentError, match="not finite"):
        tracker.locate(torch.tensor([[math.nan, 0.0]]))
    with pytest.raises(InvalidArgumentError, match="motion"):
        tracker.locate(torch.zeros(4, 2), torch.ones(3, 3))
    with pytest.raises(InvalidArgumentError, match="no surface"):
        Tracker(gt.GaussianMap())
    parts = torch.zeros(1, 2), torch.eye(2)[None], torch.ones(1)
    with pytest.raises(InvalidArgumentError, match="does not state from where"):
        Tracker(parts)


# -- scan locations ----------------------------------------------------------------------------------


COVERED, DAMAGED = range(5, 15), 18


class Recording:
    """The flat building, seen by a sensor that is covered for ten scans; one scan is damaged."""

    def __init__(self) -> None:
        self.scans = gt.datasets.load("synthetic_building_2d", n_scans=150)
        self.times = torch.arange(24) / 10

    def __len__(self) -> int:
        return 24

    def check_one_sensor(self, what):
        self.scans.check_one_sensor(what)

    def pose(self, index):
        return self.scans.pose(index)

    def __getitem__(self, index):
        scan = self.scans[index]
        if index == DAMAGED:
            raise DataError("scan 18 is damaged")
        if index not in COVERED:
            return scan
        ahead = scan.points - scan.origin  # the cover is 5 cm in front of the sensor
        return gt.Scan(scan.origin + 0.05 * ahead / ahead.norm(dim=1, keepdim=True), scan.origin)


@pytest.fixture(scope="module")
def mapped() -> tuple[Recording, gt.GaussianMap]:
    recording, m = Recording(), gt.GaussianMap()
    for scan in recording.scans:
        m.insert(scan)
    return recording, m


@pytest.mark.parametrize("use_motion", [False, True])
def test_a_covered_sensor_and_a_damaged_scan_are_said_and_passed(mapped, use_motion):
    recording, m = mapped
    tracker = Tracker(m, recording.pose(0))
    located = list(locate_scans(recording, tracker, use_motion))
    lost = {scan.number for scan in located if not scan.location.found}
    assert lost >= {*COVERED, DAMAGED}
    assert len(lost) <= len(COVERED) + 3  # without odometry the next scan may be missed
    for scan in located:
        truth = recording.pose(scan.number)
        if scan.location.found:
            assert float((scan.location.pose - truth)[:2, 2].norm()) < 0.1, scan.number
        elif scan.number in COVERED:
            assert "0.2 m" in scan.location.doubts[0]
    assert located[DAMAGED].location.doubts == ("scan 18 is damaged",)
    assert located[3].time == pytest.approx(0.3)


def test_clocks_that_go_back_or_jump_are_named_with_their_scan():
    times = torch.tensor([0.0, 0.1, 0.2, 0.3, 0.15, 0.25, 0.35, 7.0, 7.1]).double()
    found = clock_faults(times)
    assert [scan for scan, _ in found] == [4, 7]
    assert "goes back by 0.15 s" in found[0][1]
    assert "6.65 s after the scan before it, usually 0.1 s" in found[1][1]
    assert clock_faults(torch.arange(9) / 10) == clock_faults(torch.zeros(1)) == []


@pytest.mark.slow
@pytest.mark.real_data
def test_scans_metres_apart_in_a_hall_are_found_right_or_not_at_all(real_data):
    """In this map two poses that are metres wrong explain 90 and 92 % of scans 29 and 30."""
    scans = gt.datasets.load("scan_folder", path=real_data / "hall")
    m = gt.GaussianMap(gt.IncrementalRule(max_bytes=16000))
    for scan in scans:
        m.insert(scan)
    tracker, n_found = Tracker(m, scans.pose(25)), 0
    for number in range(25, 33):
        truth = scans.pose(number)
        location = tracker.locate((scans[number].points - truth[:3, 3]) @ truth[:3, :3])
        n_found += location.found
        assert not location.found or float((location.pose - truth)[:3, 3].norm()) < 0.2
    assert n_found >= 5
