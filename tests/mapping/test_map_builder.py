"""MapBuilder: progress, skipped scans, and checkpoints."""

from __future__ import annotations

from collections.abc import Collection

import pytest
import torch

from gmmtorch.datasets import Dataset, Ranges, load
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import IncrementalRule
from gmmtorch.mapping.map_builder import MapBuilder
from gmmtorch.scan import Scan

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


def built(one: MapBuilder) -> bytes:
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
    learned = GaussianMap._with_pending

    def counted(self):
        previews.append(self.n_pending)
        return learned(self)

    monkeypatch.setattr(GaussianMap, "_with_pending", counted)
    one = builder()
    shown = [now.n_components for now in one.insert_all()]
    assert shown[-1] > 0
    assert set(previews) <= {0, 4}  # none, or a complete window


@pytest.mark.parametrize("stop", [1, 6])
def test_a_resumed_build_gives_the_same_bytes(stop, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    first_whole = builder()
    expected = built(first_whole)
    first = builder()
    for now in first.insert_all():
        if now.n_read == stop:
            break
    first.save(path, RUN)
    second = builder()
    second.load(path, RUN)
    assert second.progress() == first.progress()
    assert built(second) == expected
    assert torch.equal(second.poses, first_whole.poses)


def test_unreadable_and_empty_scans_are_skipped_and_counted():
    one = builder(Damaged({0, 5}, {7}, {8, 9}))
    data = built(one)
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
        built(builder(Damaged(set(range(N)))))


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
