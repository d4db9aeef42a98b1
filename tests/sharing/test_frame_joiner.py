"""FrameJoiner: a robot finds its frame in a teammate's map of the same place, and in no other map."""

from __future__ import annotations

import math

import pytest
import torch
from sharing.replica_histories import exchange

import gmmtorch as gt
from gmmtorch.localization import Tracker
from gmmtorch.team.sharing import FrameJoiner, Replica

N_SCANS = 60


def motion(x: float, y: float, yaw: float) -> torch.Tensor:
    cos, sin = math.cos(yaw), math.sin(yaw)
    return torch.tensor([[cos, -sin, x], [sin, cos, y], [0, 0, 1]], dtype=torch.float64)


def robot_with(number: int, scans: list[gt.Scan], window: int = 20) -> Replica:
    """A robot that has mapped scans in a frame of its own."""
    replica = Replica(number, incarnation=number, own_frame=True)
    m = gt.GaussianMap(window=window, robot=number)
    for scan in scans:
        m.insert(scan)
    replica.add(m)
    return replica


def joiner_of(replica: Replica, scans: list[gt.Scan], heard: list[bytes]) -> FrameJoiner:
    """It remembers the scans; then its robot has received the datagrams."""
    joiner = FrameJoiner(replica)
    for scan in scans:
        joiner.add(scan)
    for datagram in heard:
        replica.receive(datagram)
    return joiner


@pytest.fixture(scope="module")
def scans() -> list[gt.Scan]:
    return list(gt.datasets.load("synthetic_building_2d", n_scans=N_SCANS))


@pytest.fixture(scope="module")
def first_part(scans) -> list[bytes]:
    """The datagrams of robot 0, which has mapped two thirds of the building."""
    return robot_with(0, scans[: 2 * N_SCANS // 3]).datagrams()


def test_remembered_scans_follow_corrected_poses(scans, first_part):
    truth, drift = motion(30.0, -7.0, 2.0), motion(4.0, -2.0, 0.5)
    theirs = [scan.transformed(truth) for scan in scans[N_SCANS // 2 :]]
    one = robot_with(1, theirs)
    joiner = joiner_of(one, [scan.transformed(drift) for scan in theirs], first_part)
    joiner.correct(lambda origins: torch.linalg.inv(drift).expand(len(origins), 3, 3))
    assert any(joiner.search() for _ in range(20))
    back = one.placement.transform @ truth
    assert torch.allclose(back, torch.eye(3).double(), atol=0.05)


def test_two_parts_of_a_building_are_laid_over_each_other(scans, first_part):
    truth = motion(30.0, -7.0, 2.0)  # robot 1's frame ← the building's
    theirs = [scan.transformed(truth) for scan in scans[N_SCANS // 2 :]]
    one, watcher = robot_with(1, theirs), Replica(0, incarnation=5, own_frame=True)
    joiner = joiner_of(one, theirs, [])
    assert not joiner.search()  # nothing to join yet
    for datagram in first_part:
        one.receive(datagram)
    one.datagrams()
    joined = [joiner.search() for _ in range(20) if one.other_frames]
    assert joined.count(True) == 1
    assert joiner.n_located >= 2  # never by one scan alone
    assert one.placement.root == 0
    back = one.placement.transform @ truth
    ends = torch.cat([scans[N_SCANS // 2].points, scans[-1].points])
    off = (ends @ back[:2, :2].T + back[:2, 2] - ends).norm(dim=1)
    assert float(off.max()) < 0.05
    sent = one.datagrams()
    assert sum(map(len, sent)) < 200  # the frame and a supersession: no component is sent again
    exchange([one, watcher])
    assert len(watcher.components(0)) == len(one.components())


def test_a_frame_is_estimated_again_when_the_maps_have_grown(scans, first_part):
    truth = motion(30.0, -7.0, 2.0)  # robot 1's frame ← the building's
    theirs = [scan.transformed(truth) for scan in scans[N_SCANS // 2 :]]
    one = robot_with(1, theirs[:14])
    joiner = joiner_of(one, theirs[:14], first_part)
    assert any(joiner.search() for _ in range(20))
    assert not joiner.search()  # nothing is new
    one.join(0, torch.linalg.inv(truth @ motion(0.1, 0.0, math.radians(0.5))))
    grown = gt.GaussianMap(robot=1, window=20)
    for scan in theirs:
        grown.insert(scan)
    one.add(grown)
    assert joiner.search()
    ends = torch.cat([scan.points for scan in scans])
    back = one.placement.transform @ truth
    off = (ends @ back[:2, :2].T + back[:2, 2] - ends).norm(dim=1)
    assert float(off.max()) < 0.05
    assert not joiner.search()


def test_a_map_of_another_building_is_not_joined(first_part):
    other = list(gt.datasets.load("synthetic_building_2d", n_scans=16, seed=5))
    one = robot_with(1, other)
    joiner = joiner_of(one, other, first_part)
    n_places = len(joiner._places)
    assert not any(joiner.search() for _ in range(n_places))
    assert joiner.n_searches == n_places >= 8
    assert not joiner.search()  # no place is left: the next search waits for news
    assert joiner.n_searches == n_places
    assert one.other_frames == [0]


def test_estimates_that_disagree_join_nothing(scans, first_part, monkeypatch):
    """Two wrong locations in succession, as two corridors that look the same would give."""
    one = robot_with(1, scans[:10])
    joiner = joiner_of(one, scans[: N_SCANS // 2], first_part)
    true, shifts = Tracker.locate, iter(range(100))

    def wrong(tracker, points):
        location = true(tracker, points)
        location.pose[0, 2] += next(shifts)  # metres, another one each time
        return location

    monkeypatch.setattr(Tracker, "locate", wrong)
    for _ in range(6):
        assert not joiner.search()
    assert joiner.n_located >= 3


def test_the_number_of_places_is_bounded(scans):
    joiner = FrameJoiner(Replica(1, own_frame=True), spacing=0.01, most_places=8)
    for scan in scans[:60]:
        joiner.add(scan)
    assert len(joiner._places) <= 8
    assert len(joiner._waiting) <= 8
