"""Odometry.close_loops: a sensor that comes back corrects its poses, and one wrong closure does not."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from localization.looping_robot import ANGLES, BACK, DriftingOdometry, lap

from gmmtorch.localization import Odometry, loop_closure
from gmmtorch.pose import Pose

N_SCANS = 56


def points(message: dict[str, Any]) -> torch.Tensor:
    angles = torch.from_numpy(ANGLES)
    return torch.from_numpy(message["ranges"]).double()[:, None] * torch.stack(
        [angles.cos(), angles.sin()], 1
    )


@pytest.fixture(scope="module")
def driven() -> tuple[DriftingOdometry, list[int], torch.Tensor]:
    """Odometry after a lap, the scans that corrected it, and its poses before the first correction."""
    messages, true = lap(N_SCANS)
    odometry, corrected, before = DriftingOdometry(true), [], torch.empty(0)
    for number, message in enumerate(messages):
        odometry.add(points(message))
        poses = odometry.poses
        if odometry.close_loops():
            before = before if corrected else poses
            corrected.append(number)
    return odometry, corrected, before


def test_poses_are_near_the_truth_once_the_sensor_is_back(driven):
    odometry, corrected, before = driven
    true = odometry._true
    assert BACK <= corrected[0] < N_SCANS - 3
    assert float((before - true[: len(before)])[:, :2, 2].norm(dim=1).max()) > 0.7
    off = (odometry.poses - true)[:, :2, 2].norm(dim=1)
    assert float(off.max()) < 0.1
    assert torch.equal(odometry.poses[0], torch.eye(3).double())
    assert torch.equal(odometry.keyframes[-1].pose.matrix, odometry.poses[odometry._frames[-1]])
    assert torch.allclose(odometry.trajectory().poses[:, :2, 2], odometry.poses[:, :2, 2], atol=0.05)
    chain = odometry.trajectory(loops=False).poses
    assert torch.allclose(chain[: len(before)], before, atol=1e-5)


@pytest.mark.parametrize(
    ("shifts", "counts"), [((2.0, -2.0, 0.0), [0, 0, 0]), ((2.0, 0.5, 0.5), [0, 0, 2])], ids=["none", "two"]
)
def test_a_closure_counts_only_if_the_next_one_agrees(driven, monkeypatch, shifts, counts):
    odometry, _, _ = driven
    left = list(shifts)  # of the new keyframe along x, by each closure

    def closure(poses: Pose, places: Any, old: int, new: int, *_: Any) -> loop_closure._Closure:
        moved = Pose.from_yaw(0.0, [left.pop(0), 0.0]) @ poses[new]
        motion = poses[old].inverse() @ moved
        return loop_closure._Closure(old, new, motion, torch.eye(3).double() * 1e4)

    monkeypatch.setattr(loop_closure, "_closure", closure)
    closer, chain, found = loop_closure.LoopCloser(0.5, odometry.rule), odometry._all_edges(), []
    for row, count in zip((48, 51, 54), counts, strict=True):
        poses = closer.corrected(odometry.keyframes[: row + 1], chain.at(torch.arange(row)))
        assert len(closer.closures) == count
        assert (poses is not None) == (count > 0)
        found.append(poses)
    if counts[-1]:
        assert float((found[-1].translation[-1] - odometry.keyframes[54].pose.translation)[0]) > 0.2


def test_scans_that_are_no_keyframes_are_not_searched_for():
    odometry = Odometry()
    assert not odometry.close_loops()
    messages, _ = lap(2)
    for message in (messages[0], messages[0]):
        odometry.add(points(message))
        assert not odometry.close_loops()
    assert len(odometry.keyframes) == 1
