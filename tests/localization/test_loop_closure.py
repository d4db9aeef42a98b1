"""Pose graphs against a dense solution and a planted false closure; loops of a robot that comes back."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from localization.looping_robot import ANGLES, BACK, DriftingOdometry, lap
from scipy.optimize import least_squares

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.localization import Odometry, loop_closure
from gmmtorch.localization.local_map import Keyframe, nowhere
from gmmtorch.localization.loop_closure import ANYWHERE, Doubts, _Closure, _edges, _put_together, _Revision
from gmmtorch.localization.pose_graph import Edges, _moved, _normal_equations, optimised, residuals
from gmmtorch.pose import Pose

FREE = {2: 3, 3: 6}


def motion(dim: int, *step: float) -> Pose:
    return Pose.from_turn(torch.tensor(step[dim:]).double(), torch.tensor(step[:dim]).double())


def chain(steps: list[Pose]) -> Pose:
    poses = [Pose.identity(steps[0].dim)]
    for step in steps:
        poses.append(poses[-1] @ step)
    return Pose.stack(poses)


def edges_of(rows: list[tuple[int, int, Pose]], deviation: float = 0.1, n_closures: int = 0) -> Edges:
    source, target, motions = zip(*rows, strict=True)
    free = FREE[motions[0].dim]
    is_closure = torch.arange(len(rows)) >= len(rows) - n_closures
    information = torch.eye(free).double().repeat(len(rows), 1, 1) / deviation**2
    return Edges(torch.tensor(source), torch.tensor(target), Pose.stack(motions), information, is_closure)


def noisy_graph(dim: int, n: int = 8) -> tuple[Pose, Edges]:
    draw = torch.Generator().manual_seed(dim)
    free = FREE[dim]
    turn = torch.zeros(n, free).double()
    turn[:, 0], turn[:, -1] = 1.0, 2 * math.pi / n
    true = chain([motion(dim, *row) for row in turn.tolist()])[:n]
    pairs = [(i, i + 1) for i in range(n - 1)] + [(0, n - 1), (1, n - 2)]
    noise = 0.03 * torch.randn(len(pairs), free, generator=draw).double()
    measured = _moved(Pose.stack([true[i].inverse() @ true[j] for i, j in pairs]), noise)
    rows = [(i, j, measured[row]) for row, (i, j) in enumerate(pairs)]
    return chain([measured[row] for row in range(n - 1)]), edges_of(rows)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_optimum_is_that_of_a_dense_solver(dim):
    start, edges = noisy_graph(dim)
    found = optimised(start, edges)

    def error(x: np.ndarray) -> np.ndarray:
        steps = torch.from_numpy(x).view(len(start) - 1, -1)
        poses = Pose.cat([start[:1], _moved(start[1:], steps)])
        return (residuals(poses, edges) / 0.1).flatten().numpy()

    dense = least_squares(error, np.zeros((len(start) - 1) * FREE[dim]), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    cost = 0.5 * float((residuals(found.poses, edges) / 0.1).square().sum())
    # The Jacobian of Gauss–Newton is exact only where the error is zero, so its end is not quite the optimum.
    assert cost == pytest.approx(dense.cost, rel=1e-2)
    steps = torch.from_numpy(dense.x).view(len(start) - 1, -1)
    assert torch.allclose(found.poses[1:].matrix, _moved(start[1:], steps).matrix, atol=3e-3)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_steps_use_the_derivatives_of_the_errors(dim):
    """Also far from the optimum, where guesses are turned by up to 3 rad."""
    draw = torch.Generator().manual_seed(0)
    n, free = 6, dim * (dim + 1) // 2
    turns = torch.randn(n, free - dim, generator=draw).double()
    turns *= 3 * torch.rand(n, 1, generator=draw).double() / turns.norm(dim=1, keepdim=True)
    poses = Pose.from_turn(turns, torch.randn(n, dim, generator=draw).double() * 10)
    edges = edges_of([(i, i + 1, Pose.identity(dim)) for i in range(n - 1)], 0.1)

    def cost(steps: torch.Tensor) -> torch.Tensor:
        moved = Pose.cat([poses[:1], _moved(poses[1:], steps)])
        return residuals(moved, edges).square().sum() / 0.1**2 / 2

    steps = torch.zeros(n - 1, free, dtype=torch.float64, requires_grad=True)
    expected = torch.autograd.grad(cost(steps), steps)[0]
    _, gradient = _normal_equations(poses, edges, torch.ones(n - 1).double())
    torch.testing.assert_close(torch.from_numpy(gradient).view(n - 1, free), expected)


def test_guesses_far_off_do_not_throw_the_poses_away():
    """Half of a ring is turned and shifted by a wide edge, as where the sensor was lost."""
    n = 40
    yaw = torch.arange(n).double() * (2 * math.pi / n)
    true = Pose.from_yaw(yaw, 5 * torch.stack([yaw.cos(), yaw.sin()], 1))
    pairs = [*((i, i + 1) for i in range(n - 1)), (0, n - 1), (1, n - 2), (2, n - 3)]
    edges = edges_of([(i, j, true[i].inverse() @ true[j]) for i, j in pairs], 0.01, 3)
    edges.information[n // 2] = 1e-4 * torch.eye(3).double()
    for turn in (-2.5, -1.0, 1.0, 3.0):
        moved = Pose.from_yaw([turn], [80.0, -60.0]) @ true[n // 2 + 1 :]
        found = optimised(Pose.cat([true[: n // 2 + 1], moved]), edges)
        assert found.converged
        torch.testing.assert_close(found.poses.matrix, true.matrix, atol=1e-5, rtol=0)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_false_closure_does_not_tear_the_trajectory(dim):
    start, edges = noisy_graph(dim, 12)
    ends = zip(edges.source.tolist(), edges.target.tolist(), strict=True)
    rows = [(i, j, edges.motions[row]) for row, (i, j) in enumerate(ends)]
    honest = optimised(start, edges_of(rows, 0.03, 2))
    false = (2, 8, motion(dim, *[5.0] * dim, *[0.5] * (FREE[dim] - dim)))
    fooled = optimised(start, edges_of([*rows, false], 0.03, 3))
    assert fooled.weights[-1] < 0.01
    assert (fooled.weights[-3:-1] > 0.2).all()
    assert torch.allclose(fooled.poses.matrix, honest.poses.matrix, atol=1e-2)


def test_one_pose_is_its_own_optimum():
    none = torch.zeros(0, dtype=torch.int64)
    empty = Edges(none, none, Pose.identity(2, 0), torch.zeros(0, 3, 3).double(), none.bool())
    found = optimised(Pose.identity(2, 1), empty)
    assert found.converged
    assert found.covariances.abs().max() == 0


def test_edges_must_connect_all_poses():
    start, edges = noisy_graph(2)
    apart = edges.at(torch.arange(3))
    with pytest.raises(InvalidArgumentError, match="do not connect pose 4"):
        optimised(start, apart)
    with pytest.raises(InvalidArgumentError, match="name pose"):
        optimised(start[:3], edges)


# -- loop closer -------------------------------------------------------------------------------------


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


@pytest.mark.parametrize(("right", "wrong"), [(2, 0), (1, 0), (2, 1), (1, 1)])
def test_two_closures_that_agree_move_a_map_that_began_after_the_sensor_was_lost(right, wrong):
    true = Pose.from_yaw(0.2 * torch.arange(8).double(), 2.0 * torch.arange(16).double().view(8, 2))
    off = Pose.from_yaw(torch.tensor(math.radians(97)).double(), torch.tensor([13.0, -6.0]).double())
    guess = Pose.cat([true[:4], off @ true[4:]])  # the sensor was lost between poses 3 and 4
    source, target = torch.arange(7), torch.arange(1, 8)
    sure = torch.linalg.inv(nowhere(2, 0.02, 0.005))
    information = sure.repeat(7, 1, 1)
    information[3] = torch.linalg.inv(nowhere(2, *ANYWHERE))
    edges = Edges(source, target, guess[source].inverse() @ guess[target], information, source < 0)
    found = [
        _Closure(one, other, true[one].inverse() @ true[other], sure)
        for one, other in [(1, 6), (2, 5)][:right]
    ]
    found += [_Closure(0, 7, Pose.from_yaw(3.0, torch.tensor([1.0, 2.0]).double()), sure)][:wrong]
    edges = edges.joined(_edges(found))
    best = optimised(_put_together(guess, found, torch.tensor([4])), edges)
    odometry = Odometry()
    odometry._poses, odometry._frames = [guess[row] for row in range(8)], list(range(8))
    odometry._parts = [0, 4]
    used = edges.is_closure & (best.weights > 0.5)
    is_joined = right == 2
    assert odometry._is_apart(edges.at(used)).tolist() == [False] * 4 + [not is_joined] * 4
    if is_joined:
        assert float((best.poses.translation - true.translation).norm(dim=1).max()) < 0.01


# -- doubtful motions and poses ------------------------------------------------------------------------


WRONG = Pose.from_yaw(2.5, torch.tensor([3.0, -2.0]).double())


def revision_of(
    poses: Pose, scans: list[torch.Tensor], lost: dict[int, torch.Tensor] | None = None
) -> _Revision:
    """Scans that are keyframes unless they are lost, at poses whose motions the edges repeat."""
    source = torch.arange(len(scans) - 1)
    sure = torch.linalg.inv(nowhere(2, 0.02, 0.005)).repeat(len(source), 1, 1)
    edges = Edges(source, source + 1, poses[:-1].inverse() @ poses[1:], sure, source < 0)
    order = torch.randperm(len(scans[0]), generator=torch.Generator().manual_seed(0))
    places = [(i, Keyframe(scan[order], poses[i])) for i, scan in enumerate(scans) if i not in (lost or {})]
    parts = torch.ones(len(places), dtype=torch.int64)
    return _Revision(poses, edges, places, parts, lost or {}, 8.0, 0.5, Odometry().rule)


def errors(revision: _Revision, true: Pose) -> torch.Tensor:
    poses = optimised(revision.poses, revision.edges, with_covariances=False).poses
    return (true.inverse() @ poses).matrix.sub(torch.eye(3)).abs().amax((1, 2))


@pytest.fixture(scope="module")
def lap_of_20() -> tuple[list[torch.Tensor], Pose]:
    messages, true = lap(20)
    return [points(message) for message in messages], Pose.from_matrix(true)


def test_a_wrong_motion_is_found_by_several_scans_together(lap_of_20):
    scans, true = lap_of_20
    wrong = Pose.cat([true[:12], true[11] @ WRONG @ true[11].inverse() @ true[12:]])
    revision = revision_of(wrong, scans)
    assert float(errors(revision, true).max()) > 1
    revision.examine([12])
    assert float(errors(revision, true).max()) < 0.05
    right = revision_of(true, scans)
    right.examine([12])
    assert not right.closures  # a right motion stays as it is


def test_a_motion_along_a_corridor_without_ends_is_not_replaced():
    along = torch.linspace(-30, 30, 400).double()
    scan = torch.stack([along, torch.where(torch.arange(400) % 2 == 0, 1.0, -1.0).double()], 1)
    at = Pose.from_yaw(
        torch.zeros(10).double(), torch.arange(10).double()[:, None] * torch.tensor([1.0, 0.0])
    )
    revision = revision_of(at, [scan] * 10)
    revision.examine([5])
    assert not revision.closures
    assert torch.equal(revision.poses.matrix, at.matrix)


def test_a_lost_scan_and_a_wrong_pose_are_found_between_their_neighbours(lap_of_20):
    scans, true = lap_of_20
    shifted = [true[i] @ WRONG if i in (6, 13) else true[i] for i in range(20)]
    revision = revision_of(Pose.stack(shifted), scans, {6: scans[6]})
    assert revision.place(Doubts([], [12], {6: scans[6]})) == {6, 13}
    assert float(errors(revision, true).max()) < 0.05
