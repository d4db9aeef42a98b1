"""The scans of a recording in a map: a covered sensor, damaged scans, and clocks that jump."""

from __future__ import annotations

import pytest
import torch

import gmmtorch as gt
from gmmtorch.errors import DataError
from gmmtorch.localization import Tracker
from gmmtorch.localization.tracker import clock_faults, locate_scans

COVERED, DAMAGED = range(5, 15), 18


class Recording:
    """The flat building, seen by a sensor that is covered for ten scans; one scan is damaged."""

    def __init__(self) -> None:
        self.scans = gt.datasets.load("synthetic_building_2d", n_scans=150)
        self.times = torch.arange(24) / 10

    def __len__(self) -> int:
        return 24

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
