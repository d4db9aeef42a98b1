"""Progress: the newest state that is sound, whatever has become of the files."""

from __future__ import annotations

import os

import pytest
import torch

from gmmtorch.errors import DataError, OutputError
from gmmtorch.exploration.mission.mission_progress import Progress


def state(n: int) -> dict[str, object]:
    return {"n": n, "none": None, "nested": [{"x": torch.full((2, 3), float(n), dtype=torch.float64)}]}


def saved(folder, *numbers: int, **facts) -> Progress:
    progress = Progress(folder, **facts)
    for number in numbers:
        progress.save(number, state(number))
    return progress


def found(folder, **facts) -> int | None:
    newest = Progress(folder, **facts).newest()
    if newest is None:
        return None
    number, kept = newest
    assert kept["n"] == number
    assert torch.equal(kept["nested"][0]["x"], state(number)["nested"][0]["x"])
    return number


def files(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_newest_is_found_and_two_are_kept(tmp_path):
    assert found(tmp_path / "none") is None
    assert Progress(tmp_path / "none").farthest is None
    progress = saved(tmp_path, 0, 7, 30, 102)
    assert found(tmp_path) == progress.farthest == 102
    assert files(tmp_path) == ["map-00000030.state", "map-00000102.state"]
    saved(tmp_path, 102)  # again
    assert found(tmp_path) == 102


def test_whatever_byte_rots_the_one_before_is_found(tmp_path):
    saved(tmp_path, 10, 20)
    path = tmp_path / "map-00000020.state"
    data = path.read_bytes()
    for at in range(0, len(data), 7):
        path.write_bytes(data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :])
        assert found(tmp_path) == 10
        path.write_bytes(data[:at])
        assert found(tmp_path) == 10
    assert Progress(tmp_path).farthest == 20


def test_a_rotten_one_stays_until_it_is_passed_and_the_sound_one_too(tmp_path):
    saved(tmp_path, 10, 20)
    (tmp_path / "map-00000020.state").write_bytes(b"rotten")
    progress = Progress(tmp_path)
    assert progress.newest()[0] == 10
    progress.save(15, state(15))
    assert found(tmp_path) == 15
    assert Progress(tmp_path).farthest == 20
    progress.save(25, state(25))
    assert files(tmp_path) == ["map-00000015.state", "map-00000025.state"]


def test_nothing_sound_is_nothing(tmp_path, caplog):
    saved(tmp_path, 10)
    (tmp_path / "map-00000010.state").write_bytes(b"")
    assert found(tmp_path) is None
    assert "map-00000010.state" in caplog.text
    progress = Progress(tmp_path)
    progress.newest()
    progress.save(0, state(0))
    assert found(tmp_path) == 0
    assert progress.farthest == 10


def test_another_runs_is_refused_and_left(tmp_path):
    saved(tmp_path, 10, dataset="intel", window=4, part=(0, 2))
    assert found(tmp_path, dataset="intel", window=4, part=(0, 2)) == 10
    for facts in ({"dataset": "aces", "window": 4, "part": (0, 2)}, {"dataset": "intel", "window": 4}, {}):
        with pytest.raises(DataError, match="another folder"):
            found(tmp_path, **facts)
    assert files(tmp_path) == ["map-00000010.state"]


def test_fragments_of_a_life_that_ended_go_and_others_files_stay(tmp_path):
    (tmp_path / ".map-00000010.x1.state").write_bytes(b"half")
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "map-mine.state").write_text("mine")
    saved(tmp_path, 10)
    assert files(tmp_path) == ["map-00000010.state", "map-mine.state", "notes.txt"]


def test_a_write_that_fails_leaves_what_was(tmp_path, monkeypatch):
    progress = saved(tmp_path, 10)

    def fail(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fail)
        with pytest.raises(OutputError, match="No space left"):
            progress.save(20, state(20))
    assert files(tmp_path) == ["map-00000010.state"]
    progress.save(20, state(20))
    assert found(tmp_path) == 20
