"""WindowMotions: a map follows the corrected poses of its scans, window by window."""

from __future__ import annotations

import math

import pytest
import torch
from exploration.replays import content
from torch import Tensor

from gmmtorch.datasets import load
from gmmtorch.mapping.codec.quantization import quantized
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import IncrementalRule
from gmmtorch.mapping.map_builder import MapBuilder, WindowMotions

N_SCANS, WINDOW = 16, 4


def motion(x: float, y: float, yaw: float) -> Tensor:
    cos, sin = math.cos(yaw), math.sin(yaw)
    return torch.tensor([[cos, -sin, x], [sin, cos, y], [0, 0, 1]], dtype=torch.float64)


def built(n: int = N_SCANS, name: str = "synthetic_building_2d", **options: object) -> MapBuilder:
    made = MapBuilder(load(name, n_scans=n), GaussianMap(IncrementalRule(window=WINDOW, **options)))
    for _ in made.insert_all():
        pass
    return made


def bent(poses: Tensor) -> Tensor:
    """The poses of a trajectory without a drift of its heading and position."""
    dim = poses.shape[1] - 1
    steps = torch.eye(dim + 1, dtype=torch.float64).repeat(len(poses), 1, 1)
    for number, step in enumerate(steps):
        planar = motion(0.02 * number, -0.01 * number, 0.004 * number)
        step[:2, :2], step[:2, dim] = planar[:2, :2], planar[:2, 2]
    return steps @ poses


def windows_of(made: MapBuilder) -> Tensor:
    return made.windows.as_inserted(made.map)[1]


@pytest.mark.parametrize("name", ["synthetic_building_2d", "synthetic_building"])
def test_components_and_origins_move_with_the_middle_scan_of_their_window(name):
    made = built(name=name)
    before, poses = made.map._final(), made.poses
    windows = windows_of(made)
    assert sorted(windows.unique().tolist()) == list(range(N_SCANS // WINDOW))
    corrected = bent(poses)
    assert made.correct(corrected, 0) is not None
    after = made.map._final()
    assert torch.equal(made.poses, corrected)
    assert torch.equal(after.ids, before.ids)
    for window in range(N_SCANS // WINDOW):
        middle = window * WINDOW + WINDOW // 2
        step = corrected[middle] @ torch.linalg.inv(poses[middle])
        rows = windows == window
        expected = before.transformed(step, rows)
        assert torch.allclose(after.means[rows], expected.means[rows], atol=1e-9)
        assert torch.allclose(after.covariances[rows], expected.covariances[rows], atol=1e-12)
        seen = [c.origins[c.seen_from[rows[c.seen_by]]] for c in (after, expected)]
        assert torch.allclose(*seen, atol=1e-9)


def test_the_map_is_known_where_it_was_learned_after_several_corrections():
    made = built()
    before = content(made.map.components())
    for _ in range(3):
        made.correct(bent(made.poses), 0)
    components, _ = made.windows.as_inserted(made.map)
    assert content(quantized(components)) == before


def test_small_corrections_wait_until_they_add_up():
    made = built()
    before = content(made.map.components())
    small = motion(0.015, 0.0, 0.0)
    assert made.correct(small @ made.poses, 0) is None
    assert content(made.map.components()) == before
    assert made.windows.moved == []
    assert made.correct(small @ made.poses, 0) is not None
    assert made.windows.moved == list(range(N_SCANS // WINDOW))
    assert all(torch.allclose(one, small @ small, atol=1e-12) for one in made.windows.motions)


def test_only_windows_whose_scans_are_all_corrected_move():
    made = built()
    moved = motion(1.0, 0.0, 0.0)
    motion_at = made.correct(moved @ made.poses[6:], 6)
    assert made.windows.moved == [2, 3]
    assert motion_at is not None
    found = motion_at(torch.cat([made.poses[:6, :2, 2], (made.poses[8:, :2, 2] - torch.tensor([1.0, 0.0]))]))
    assert torch.allclose(found[:6], torch.eye(3).double().expand(6, 3, 3))
    assert torch.allclose(found[6:], moved.expand(8, 3, 3), atol=1e-12)


def test_an_unfinished_window_is_learned_and_moves():
    made = built(N_SCANS - 2)
    assert made.map.n_pending == 2
    made.correct(motion(0.5, 0.0, 0.0) @ made.poses, 0)
    assert made.map.n_pending == 0
    assert len(made.windows.motions) == N_SCANS // WINDOW
    assert torch.unique(windows_of(made)).tolist() == list(range(N_SCANS // WINDOW))


def test_a_merged_component_moves_with_the_window_that_saw_most_of_it():
    made = built(n_components=25)
    made.correct(bent(made.poses), 0)
    now = made.map._final()
    windows = windows_of(made)
    scans = made.windows.motions[0].new_tensor(made.windows._windows)
    origins = torch.stack(made.windows.motions)[made.windows._windows] @ torch.stack(made.windows._poses)
    several = 0
    for row in range(len(now)):
        seen = now.seen_by == row
        near = torch.cdist(now.origins[now.seen_from[seen]], origins[:, :2, 2]).min(1)
        assert float(near.values.max()) < 1e-9  # each origin moved with the scan that was there
        assert int(windows[row]) == int(scans[near.indices[now.seen_count[seen].argmax()]])
        several += len(scans[near.indices].unique()) > 1
    assert several > 0


def test_components_that_no_scan_has_seen_stay():
    windows = WindowMotions()
    stranger = Components.given([[5.0, 5.0]], [torch.eye(2)], [10.0], [[9.0, 9.0]], None, 0)
    made = GaussianMap.of(stranger)
    assert windows.as_inserted(made)[1].tolist() == [-1]
    windows.add(motion(0, 0, 0))
    windows.end()
    assert windows.correct(made, motion(1, 0, 0)[None]) is not None
    assert torch.equal(made.means, stranger.means)


def test_a_checkpoint_continues_with_the_moved_windows(tmp_path):
    made = built(N_SCANS - 2)
    made.correct(bent(made.poses), 0)
    made.save(tmp_path / "checkpoint", {})
    again = MapBuilder(load("synthetic_building_2d"), GaussianMap(IncrementalRule(window=WINDOW)))
    again.load(tmp_path / "checkpoint", {})
    assert all(torch.equal(*pair) for pair in zip(again.windows.motions, made.windows.motions, strict=True))
    assert torch.equal(again.poses, made.poses)
    first, second = (one.windows.as_inserted(one.map) for one in (made, again))
    assert content(first[0]) == content(second[0])
    assert torch.equal(first[1], second[1])
    later = again.insert_all()
    next(later), next(later)
    assert len(again.windows.motions) == len(made.windows.motions)
    assert again.correct(motion(1, 0, 0) @ again.poses[-2:], len(made.poses)) is not None
    assert again.windows.moved == [*made.windows.moved, len(made.windows.motions)]


def test_damaged_windows_are_refused():
    made = built(WINDOW)
    state = made.windows.state()
    with pytest.raises(ValueError, match="disagree"):
        WindowMotions.restored({**state, "windows": state["windows"][:-1]})
    with pytest.raises(ValueError, match="disagree"):
        WindowMotions.restored({**state, "windows": state["windows"] + 5})
