"""MapBuilder: progress, skipped scans, and checkpoints."""

from __future__ import annotations

import math
from collections.abc import Collection

import pytest
import torch
from exploration.replays import content
from mapping.map_cases import (
    FINE,
    assert_close_components,
    assert_same_components,
    built,
    drive,
    given_parts,
    moved_parts,
    names,
    open_drive,
    sightings,
    some_motion,
)
from occupancy.protocol_contract import dims, lattice, quarter_turn, shifted, wall_scan
from torch import Tensor

from gmmtorch import Components, GaussianMap, IncrementalRule, Scan, WindowedRule
from gmmtorch.datasets import Dataset, Ranges, load
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.files import pack_tensors, read_tensors
from gmmtorch.mapping import MapBuilder, WindowMotions, quantized

RUN = {"seed": 0}
N = 11
OFFICE = load("synthetic_building_2d", n_scans=N)
SCANS = list(OFFICE)


class Damaged(Dataset):
    """The scans of an office; `bad` cannot be read, `empty` have no beam, the data set skips `damaged`."""

    def __init__(self, bad: set[int], empty: Collection[int] = (), damaged: Collection[int] = ()) -> None:
        super().__init__("damaged", Ranges())
        self._bad, self._empty, self._damaged = bad, empty, damaged

    def _known_pose(self, index: int) -> torch.Tensor | None:
        return OFFICE.pose(index)

    def _count(self) -> int:
        return N

    def _read(self, index: int) -> Scan:
        if index in self._bad:
            raise DataError("broken scan")
        scan = SCANS[index]
        if index in self._damaged:
            self._skip("damaged inside", index)
            return Scan(scan.points[:0], scan.origin)
        return Scan(scan.points[:0], scan.origin) if index in self._empty else scan


def builder(dataset: Dataset | None = None) -> MapBuilder:
    return MapBuilder(dataset or Damaged(set()), GaussianMap(IncrementalRule(window=4)))


def finished(one: MapBuilder) -> bytes:
    for _ in one.insert_all():
        pass
    one.finish()
    return one.map._file()


def test_the_builder_inserts_its_scans_and_counts_them():
    one = builder()
    progress = list(one.insert_all())
    one.finish()
    plain = GaussianMap(IncrementalRule(window=4))
    for scan in SCANS:
        plain.insert(scan)
    assert one.map._file() == plain._file()
    origins = torch.stack([scan.origin for scan in SCANS]).double()
    assert torch.equal(one.poses, torch.stack([OFFICE.pose(i) for i in range(N)]))
    assert torch.equal(one.times, torch.arange(N).double())
    last = progress[-1]
    assert [p.n_read for p in progress] == list(range(1, N + 1))
    assert (last.n_total, last.n_skipped) == (N, 0)
    assert last.n_points == sum(len(scan.points) for scan in SCANS)
    assert last.metres == pytest.approx(float((origins[1:] - origins[:-1]).norm(dim=1).sum()))
    assert one.record.history[-1]["nbytes"] == plain.nbytes
    assert one.record.history[-1]["n_components"] == plain.n_components
    assert all(row["memory_bytes"] > 1e6 for row in one.record.history)
    rows = [row["nbytes"] for row in one.record.history]
    assert {now.nbytes for now in progress} == {0, *rows[:-1]}


def test_progress_learns_no_unfinished_window(monkeypatch):
    """A preview of the window for each scan would cost more than the map itself."""
    previews: list[int] = []
    learned = GaussianMap.unrounded

    def counted(self):
        previews.append(self.n_pending)
        return learned(self)

    monkeypatch.setattr(GaussianMap, "unrounded", counted)
    one = builder()
    shown = [now.n_components for now in one.insert_all()]
    assert shown[-1] > 0
    assert set(previews) <= {0, 4}  # none, or a complete window


@pytest.mark.parametrize("stop", [1, 6])
def test_a_resumed_build_gives_the_same_bytes(stop, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    first_whole = builder()
    expected = finished(first_whole)
    first = builder()
    for now in first.insert_all():
        if now.n_read == stop:
            break
    first.save(path, RUN)
    second = builder()
    second.load(path, RUN)
    assert second.progress() == first.progress()
    assert finished(second) == expected
    assert torch.equal(second.poses, first_whole.poses)


def test_unreadable_and_empty_scans_are_skipped_and_counted():
    one = builder(Damaged({0, 5}, {7}, {8, 9}))
    data = finished(one)
    empty = "a scan has neither returns nor free beams"
    assert one.skipped == {"broken scan": 2, empty: 1, "damaged inside": 2}
    assert one.progress().n_skipped == 5
    assert one.record.indices == [i for i in range(N) if i not in (0, 5, 7, 8, 9)]
    plain = GaussianMap(IncrementalRule(window=4))
    for index in one.record.indices:
        plain.insert(SCANS[index])
    assert data == plain._file()


def test_a_data_set_without_a_usable_scan_is_an_error_with_the_reason():
    with pytest.raises(DataError, match="no scan of 11 can be used: broken scan"):
        finished(builder(Damaged(set(range(N)))))


def test_a_checkpoint_of_another_run_or_a_damaged_one_is_refused(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    first = builder()
    next(iter(first.insert_all()))
    first.save(path, RUN)
    with pytest.raises(InvalidArgumentError, match="seed=0, this run has seed=1"):
        builder().load(path, {"seed": 1})
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(DataError):
        builder().load(path, RUN)


def test_a_checkpoint_with_poses_of_another_shape_is_refused(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    first = builder()
    next(iter(first.insert_all()))
    first.save(path, RUN)
    tensors, facts = read_tensors(path, "gmmtorch.map_builder", 1)
    poses = tensors[facts["tree"]["poses"]["$tensor"]]
    for shape in ((len(poses), -1), (-1,), (1, *poses.shape)):
        tensors[facts["tree"]["poses"]["$tensor"]] = poses.reshape(shape)
        path.write_bytes(pack_tensors(tensors, "gmmtorch.map_builder", 1, **facts))
        with pytest.raises(DataError, match="delete it to start again"):
            builder().load(path, RUN)


# -- WindowMotions: a map follows the corrected poses of its scans, window by window ---------------------


N_SCANS, WINDOW = 16, 4


def motion(x: float, y: float, yaw: float) -> Tensor:
    cos, sin = math.cos(yaw), math.sin(yaw)
    return torch.tensor([[cos, -sin, x], [sin, cos, y], [0, 0, 1]], dtype=torch.float64)


def built_in_windows(n: int = N_SCANS, name: str = "synthetic_building_2d", **options: object) -> MapBuilder:
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
    made = built_in_windows(name=name)
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
    made = built_in_windows()
    before = content(made.map.components())
    for _ in range(3):
        made.correct(bent(made.poses), 0)
    components, _ = made.windows.as_inserted(made.map)
    assert content(quantized(components)) == before


def test_small_corrections_wait_until_they_add_up():
    made = built_in_windows()
    before = content(made.map.components())
    small = motion(0.015, 0.0, 0.0)
    assert made.correct(small @ made.poses, 0) is None
    assert content(made.map.components()) == before
    assert made.windows.moved == []
    assert made.correct(small @ made.poses, 0) is not None
    assert made.windows.moved == list(range(N_SCANS // WINDOW))
    assert all(torch.allclose(one, small @ small, atol=1e-12) for one in made.windows.motions)


def test_only_windows_whose_scans_are_all_corrected_move():
    made = built_in_windows()
    moved = motion(1.0, 0.0, 0.0)
    motion_at = made.correct(moved @ made.poses[6:], 6)
    assert made.windows.moved == [2, 3]
    assert motion_at is not None
    found = motion_at(torch.cat([made.poses[:6, :2, 2], (made.poses[8:, :2, 2] - torch.tensor([1.0, 0.0]))]))
    assert torch.allclose(found[:6], torch.eye(3).double().expand(6, 3, 3))
    assert torch.allclose(found[6:], moved.expand(8, 3, 3), atol=1e-12)


def test_an_unfinished_window_is_learned_and_moves():
    made = built_in_windows(N_SCANS - 2)
    assert made.map.n_pending == 2
    made.correct(motion(0.5, 0.0, 0.0) @ made.poses, 0)
    assert made.map.n_pending == 0
    assert len(made.windows.motions) == N_SCANS // WINDOW
    assert torch.unique(windows_of(made)).tolist() == list(range(N_SCANS // WINDOW))


def test_a_merged_component_moves_with_the_window_that_saw_most_of_it():
    made = built_in_windows(n_components=25)
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
    made = built_in_windows(N_SCANS - 2)
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
    made = built_in_windows(WINDOW)
    state = made.windows.state()
    with pytest.raises(ValueError, match="disagree"):
        WindowMotions.restored({**state, "windows": state["windows"][:-1]})
    with pytest.raises(ValueError, match="disagree"):
        WindowMotions.restored({**state, "windows": state["windows"] + 5})


# -- GaussianMap.transform -----------------------------------------------------------------------------


@dims
def test_transform_equals_a_map_of_moved_components_and_origins(dim):
    parts, matrix = given_parts(dim), some_motion(dim)
    made = GaussianMap.from_components(**parts)
    made.transform(matrix)
    expected = GaussianMap.from_components(**moved_parts(parts, matrix))
    assert_close_components(made.components(), expected.components())
    torch.testing.assert_close(made.occupancy(lattice(dim)), expected.occupancy(lattice(dim)))


@dims
def test_transform_of_some_ids_leaves_other_components_unchanged(dim):
    parts, matrix = given_parts(dim), some_motion(dim)
    chosen = torch.tensor([False, True, False, True])
    made = GaussianMap.from_components(**parts)
    made.transform(matrix, ids=made.ids[chosen])
    there = moved_parts(parts, matrix)
    both = {
        name: torch.where(chosen.reshape(-1, *[1] * (value.ndim - 1)), there[name], value)
        for name, value in parts.items()
    }
    assert_close_components(made.components(), GaussianMap.from_components(**both).components())
    for name in ("means", "covariances"):
        assert torch.equal(getattr(made, name)[~chosen], parts[name][~chosen])


def test_an_origin_shared_by_moved_and_unmoved_components_is_split():
    parts = given_parts(k=2)
    shared = torch.zeros(2, 2, dtype=torch.float64)
    made = GaussianMap.from_components(parts["means"], parts["covariances"], parts["support"], shared)
    made.transform(shifted(2, (1.0, 2.0)), ids=[[0, 1]])
    assert [list(seen) for seen in sightings(made.components())] == [[(0.0, 0.0)], [(1.0, 2.0)]]


@pytest.mark.parametrize("ids", [[], [[5, 0]], [[0, 99]]])
def test_transform_of_unknown_ids_moves_nothing(ids):
    made = GaussianMap.from_components(**given_parts())
    before = made.means.clone()
    made.transform(quarter_turn(2), ids=ids)
    assert torch.equal(made.means, before)


def correction(dim: int) -> Tensor:
    """A turn by 3° about the vertical and a step of 20 cm."""
    matrix = shifted(dim, (0.2, -0.1, 0.05))
    c, s = math.cos(math.radians(3)), math.sin(math.radians(3))
    matrix[:2, :2] = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    return matrix


@dims
def test_a_pose_correction_equals_learning_from_the_corrected_scans(dim):
    rule = WindowedRule(window=1, dtype="float64")
    scans, matrix = [drive(1, dim)[0], *open_drive(3, dim)[1:]], correction(dim)
    made = built([], rule, prior=1.0)
    of_window = []
    for scan in scans:
        known = names(made.ids) if made.dim else set()
        made.insert(scan)
        of_window.append(sorted(names(made.ids) - known))
    wrong = made.occupancy(lattice(dim))
    made.transform(matrix, ids=of_window[1])
    expected = built([scans[0], scans[1].transformed(matrix), scans[2]], rule, prior=1.0)
    # New ids follow the position, which the rotation changes: components are matched by their means.
    ours, theirs = made.components(), expected.components()
    distance, nearest = torch.cdist(theirs.means, ours.means).min(1)
    assert sorted(nearest.tolist()) == list(range(len(ours)))
    assert float(distance.max()) < 1e-6
    assert_close_components(ours.rearranged(nearest), theirs, 1e-6)
    right = expected.occupancy(lattice(dim))
    torch.testing.assert_close(made.occupancy(lattice(dim)), right, rtol=0, atol=1e-5)
    assert float((wrong - right).abs().max()) > 0.1


@pytest.mark.parametrize("learning", [WindowedRule(window=20), FINE])
def test_transform_closes_the_pending_window_and_learning_continues(learning):
    made = built(drive(3), learning)
    ids = made.components().ids
    made.transform(shifted(2, (0.0, 1.0)))
    assert torch.equal(made.ids, ids)
    made.insert(wall_scan(2))
    assert names(made.components().ids) > names(ids)


@pytest.mark.parametrize(
    "matrix",
    [
        torch.eye(4),
        torch.eye(2),
        torch.diag(torch.tensor([2.0, 1.0, 1.0])),
        torch.diag(torch.tensor([1.0, -1.0, 1.0])),
        torch.full((3, 3), math.nan),
        torch.tensor([[1.0, 0.0, math.nan], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.5, 0.0, 1.0]]),
    ],
    ids=["3D", "2x2", "scaled", "mirror", "nan", "nan translation", "perspective"],
)
def test_a_matrix_that_is_no_rigid_motion_is_refused(matrix):
    made = GaussianMap.from_components(**given_parts())
    before = made.means.clone()
    with pytest.raises(InvalidArgumentError, match="transform"):
        made.transform(matrix)
    assert torch.equal(made.means, before)


@pytest.mark.parametrize(
    ("matrix", "ids"), [(torch.eye(3), [[0, 1, 2]]), (2 * torch.eye(3), None)], ids=["ids", "matrix"]
)
def test_a_refused_transform_keeps_the_pending_window(matrix, ids):
    scans = drive(3)
    made = built(scans[:2], window=3)
    with pytest.raises(InvalidArgumentError, match=r"ids has shape|transform"):
        made.transform(matrix, ids=ids)
    made.insert(scans[2])
    assert_same_components(made.components(), built(scans, window=3).components())
