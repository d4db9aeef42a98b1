"""Tiled maps that grow: the answers of a map in memory, whenever they are stopped or reopened."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from mapping.map_cases import FINE, rooms
from mapping.random_components import random_components
from mapping.test_tiles import SETTINGS, SIDE, contents, moved, recording, written

from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError, OutputError
from gmmtorch.files import pack_tensors, read_tensors
from gmmtorch.mapping import INDEX, Components, GaussianMap, TiledMap, merge, tile_files
from gmmtorch.mapping.tiles import tiled_map
from gmmtorch.scan import Scan

RULE = replace(FINE, window=3, mean_origins=None)


street = partial(rooms, apart=15.0)


def around(scans: list[Scan]) -> torch.Tensor:
    ends = torch.cat([scan.points[::7] for scan in scans])
    return torch.cat([ends, ends + 0.3, torch.full_like(ends[:1], torch.inf), ends[:1] + 1e6])


def grown(folder: Path, scans: list[Scan], **options: object) -> TiledMap:
    made = TiledMap.create(folder, GaussianMap(RULE, **options), scans[0].dim, SIDE, memory=100_000)
    for scan in scans:
        made.insert(scan)
    return made


@pytest.mark.parametrize("codec", ["quantized", "float"])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_map_that_grows_in_tiles_answers_as_one_in_memory(dim, codec, tmp_path, monkeypatch):
    monkeypatch.setattr(tiled_map, "_RECENT", 40)
    scans = street(14, dim)
    built, asked = GaussianMap(RULE, codec=codec), around(scans)
    tiled = TiledMap.create(tmp_path / "map", GaussianMap(RULE, codec=codec), dim, SIDE, memory=100_000)
    for number, scan in enumerate(scans):
        built.insert(scan)
        tiled.insert(scan)
        if number % 4 == 0:
            assert torch.isfinite(tiled.occupancy(asked)).all()
    assert len(tiled.index) > 2
    assert tiled.n_pending == 2
    assert (tiled.occupancy(asked) != 0.5).any()
    tiled.finish()
    built.finish()
    assert tiled.n_components == built.n_components
    # Calibrations differ, because the tiled one predicts with its recent components only.
    whole = built.snapshot(calibration=tiled.query_options.calibration, cutoff=tiled.query_options.cutoff)
    expected = whole.occupancy(asked)
    torch.testing.assert_close(tiled.occupancy(asked), expected, rtol=0, atol=1e-9)
    opened = TiledMap(tmp_path / "map", memory=1)
    torch.testing.assert_close(opened.occupancy(asked), expected, rtol=0, atol=1e-9)
    torch.testing.assert_close(opened.open().occupancy(asked), expected, rtol=0, atol=1e-9)
    assert len(opened._open) == 1
    more = moved(recording(dim, 0), 200.0)
    opened.add(more)
    assert TiledMap(tmp_path / "map").n_components == tiled.n_components + len(more)
    found = TiledMap(tmp_path / "map").occupancy(torch.cat([asked, more.means]))
    torch.testing.assert_close(found[: len(asked)], expected, rtol=0, atol=1e-9)
    assert (found[len(asked) :] != 0.5).any()


def test_a_map_that_is_stopped_at_any_write_opens_with_all_finished_windows(tmp_path, monkeypatch):
    monkeypatch.setattr(tiled_map, "_RECENT", 40)
    scans, write = street(15, 2), tiled_map.write_bytes
    asked, left = around(scans), 0

    def full(path: Path, data: bytes) -> None:
        nonlocal left
        left -= 1
        if left < 0:  # the disk takes half of a file
            half = path.with_name(f".{path.stem}.0123456789abcdef{path.suffix}")
            half.parent.mkdir(exist_ok=True)
            half.write_bytes(data[: len(data) // 2])
            raise OutputError(f"{path} cannot be written: No space left on device")
        write(path, data)

    for n_written in range(40):
        folder, left = tmp_path / str(n_written), n_written
        monkeypatch.setattr(tiled_map, "write_bytes", full)
        if n_written < 2:  # the first file of recent components, and the index
            with pytest.raises(OutputError):
                TiledMap.create(folder, GaussianMap(RULE), 2, SIDE)
            continue
        made, n_final, before = TiledMap.create(folder, GaussianMap(RULE), 2, SIDE), 0, None
        try:
            for scan in scans:
                if made.n_pending == 2:  # the next scan is written
                    n_final, before = made.n_components, TiledMap(folder).occupancy(asked)
                made.insert(scan)
        except OutputError:
            monkeypatch.setattr(tiled_map, "write_bytes", write)
            opened = TiledMap(folder)
            assert opened.n_components == n_final
            assert torch.equal(opened.occupancy(asked), before)
            made.finish()  # the disk has room again: nothing is lost
            again = TiledMap(folder)
            assert again.n_components == made.n_components > n_final
            torch.testing.assert_close(again.occupancy(asked), made.occupancy(asked), rtol=0, atol=1e-9)
            again.insert(scans[-1])
            again.finish()
            assert again.n_components > made.n_components
        else:
            break
    assert n_written > 11


def test_a_damaged_tile_is_named_and_the_rest_answers(tmp_path, monkeypatch):
    monkeypatch.setattr(tiled_map, "_RECENT", 10)
    scans = street(30, 2)
    folder = grown(tmp_path / "map", scans).folder
    expected = TiledMap(folder).occupancy(around(scans[-3:])[:-2])
    first = TiledMap(folder)
    tile = folder / first._name(first.near(*[scans[0].origin] * 2)[0])
    tile.write_bytes(tile.read_bytes()[:-1])
    damaged = TiledMap(folder)
    with pytest.raises(DataError, match=tile.name):
        damaged.occupancy(scans[0].origin[None])
    assert torch.equal(damaged.occupancy(around(scans[-3:])[:-2]), expected)
    tile.unlink()
    with pytest.raises(MissingDataError, match=tile.name):
        damaged.occupancy(scans[0].origin[None])
    recent = next(folder.glob("recent_*"))
    recent.write_bytes(recent.read_bytes()[:-1])
    with pytest.raises(DataError, match=recent.name):
        TiledMap(folder)
    recent.unlink()
    with pytest.raises(MissingDataError, match=recent.name):
        TiledMap(folder)


def test_recent_components_of_another_dimension_are_refused(tmp_path):
    flat, solid = (TiledMap.create(tmp_path / str(dim), GaussianMap(), dim) for dim in (2, 3))
    (recent,) = flat.folder.glob("recent_*")
    tensors, facts = read_tensors(solid.folder / INDEX, "gmmtorch.tiles", 2)
    facts["recent"] = flat._crc32
    (solid.folder / INDEX).write_bytes(pack_tensors(tensors, "gmmtorch.tiles", 2, **facts))
    (solid.folder / recent.name).write_bytes(recent.read_bytes())
    with pytest.raises(DataError, match="2D"):
        TiledMap(solid.folder)


def test_maps_that_cannot_grow_in_tiles_say_why(tmp_path):
    for rule in (replace(RULE, n_components=5), replace(RULE, forget="contradiction")):
        with pytest.raises(InvalidArgumentError, match="budget"):
            TiledMap.create(tmp_path / "a", GaussianMap(rule), 2)
    merged = written(tmp_path / "b", recording(2, 0))
    with pytest.raises(InvalidArgumentError, match="do not grow"):
        merged.insert(street(1, 2)[0])
    with pytest.raises(InvalidArgumentError, match="has a map"):
        TiledMap.create(tmp_path / "b", GaussianMap(), 2)


@pytest.mark.parametrize("n_recent", [40, 10_000])
def test_merged_maps_that_grow_have_all_their_components(n_recent, tmp_path, monkeypatch):
    monkeypatch.setattr(tiled_map, "_RECENT", n_recent)
    scans = street(8, 2)
    one, two = grown(tmp_path / "1", scans[:4]), grown(tmp_path / "2", scans[4:])
    parts = [one.open().components(), two.open().components()]
    assert one.n_pending == two.n_pending == 1
    merged = merge(tmp_path / "all", [one, two])
    assert merged.n_components == sum(map(len, parts))
    options = {**vars(merged.query_options), "resolution": merged.resolution}
    expected = GaussianMap.of(Components.concatenate(parts), **options).occupancy(around(scans))
    torch.testing.assert_close(merged.occupancy(around(scans)), expected, rtol=0, atol=1e-9)


def test_a_map_is_not_merged_into_its_own_folder(tmp_path):
    made = grown(tmp_path / "map", street(4, 2))
    before = contents(made.folder)
    with pytest.raises(InvalidArgumentError, match="another folder"):
        merge(tmp_path / "other" / ".." / "map", [made])
    assert contents(made.folder) == before


def test_a_merge_replaces_a_map_that_grows(tmp_path):
    grown(tmp_path / "map", street(4, 2))
    merged = merge(tmp_path / "map", [written(tmp_path / "part", recording(2, 0))])
    assert {*contents(merged.folder)} == {*contents(tmp_path / "part")}


def test_the_next_write_removes_what_an_interrupted_one_left(tmp_path, monkeypatch):
    monkeypatch.setattr(tiled_map, "_RECENT", 40)
    scans = street(9, 2)
    made = grown(tmp_path / "map", scans[:6])
    others = ["notes.safetensors", "tile_map.safetensors", "recent.txt", "index_old.safetensors"]
    ended = ["tile_0_-7_0123abcd", "recent_0123abcd", ".index.0123456789abcdef"]
    ended = [f"{name}.safetensors" for name in [*ended, ".tile_0_0_0123abcd.0123456789abcdef"]]
    for name in [*others, *ended]:
        (made.folder / name).write_bytes(b"")
    TiledMap(made.folder).occupancy(around(scans))
    assert {*ended} <= {*contents(made.folder)}  # reading does not change files
    for scan in scans[6:]:
        made.insert(scan)
    known = {INDEX, tiled_map._recent_name(made._crc32), *map(made._name, range(len(made.index)))}
    assert {*contents(made.folder)} == known | {*others}


def test_a_second_process_cannot_overwrite_a_map(tmp_path, monkeypatch):
    monkeypatch.setattr(tiled_map, "_RECENT", 40)
    scans = street(9, 2)
    one = grown(tmp_path / "map", scans[:3])
    two = TiledMap(one.folder)
    for scan in scans[3:6]:
        one.insert(scan)
    one.finish()
    before = contents(one.folder)
    with pytest.raises(OutputError, match="Open it again"):
        two.add(recording(2, 0))
    assert contents(one.folder) == before
    for scan in scans[6:]:
        one.insert(scan)
    assert TiledMap(one.folder).n_components == one.n_components


def test_a_second_writer_is_refused_until_the_first_ends(tmp_path):
    scans = street(9, 2)
    one = TiledMap.create(tmp_path / "map", GaussianMap(RULE), 2, SIDE)
    one.insert(scans[0])
    two = TiledMap(one.folder)
    for write in (partial(two.insert, scans[1]), partial(two.add, recording(2, 0)), two.finish):
        with pytest.raises(OutputError, match="is being written"):
            write()
    with pytest.raises(OutputError, match="is being written"):
        merge(one.folder, [written(tmp_path / "part", recording(2, 0))])
    one.finish()
    with pytest.raises(OutputError, match="Open it again"):
        two.add(recording(2, 0))
    two = write = None  # the lock is free
    three = TiledMap(one.folder)
    three.insert(scans[2])
    with pytest.raises(OutputError, match="is being written"):
        one.insert(scans[3])
    del three  # its scan is lost, and its lock is free
    one.insert(scans[3])
    one.finish()
    assert TiledMap(one.folder).n_scans == 2


_WRITER = """
import sys
from mapping.test_growing_tiles import RULE, SIDE, GaussianMap, TiledMap, street
made = TiledMap.create(sys.argv[1], GaussianMap(RULE), 2, SIDE)
for scan in street(5, 2):
    made.insert(scan)
print("waits", flush=True)
sys.stdin.read()
"""


def test_a_killed_writer_leaves_its_finished_windows_and_no_lock(tmp_path):
    paths = [str(Path(__file__).parents[1]), *sys.path]
    command = [sys.executable, "-c", _WRITER, str(tmp_path / "map")]
    process = subprocess.Popen(
        command,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "waits\n"
    opened = TiledMap(tmp_path / "map")
    assert opened.n_scans == 3
    with pytest.raises(OutputError, match="is being written"):
        opened.insert(street(5, 2)[3])
    process.kill()
    process.communicate()
    for scan in street(5, 2)[3:]:
        opened.insert(scan)
    opened.finish()
    whole = grown(tmp_path / "whole", street(5, 2))
    whole.finish()
    assert contents(opened.folder) == contents(whole.folder)


def test_tiles_are_not_too_small_for_their_numbers(tmp_path):
    with pytest.raises(InvalidArgumentError, match="side"):
        TiledMap.create(tmp_path / "map", GaussianMap(), 2, side=1e-9)
    with pytest.raises(InvalidArgumentError, match="tile"):
        tile_files(recording(2, 0), SETTINGS, side=1e-9)


@pytest.mark.parametrize("n_recent", [20, 10_000])
def test_a_map_of_added_components_answers_the_same_once_reopened(n_recent, tmp_path, monkeypatch):
    monkeypatch.setattr(tiled_map, "_RECENT", n_recent)
    parts = [random_components(2, 60, 3, center=3.0, extent=extent) for extent in (10.0, 60.0, 90.0)]
    made = TiledMap.create(tmp_path / "1", GaussianMap(), 2, SIDE)
    other = TiledMap.create(tmp_path / "2", GaussianMap(), 2, SIDE)
    for part in parts:
        made.add(part)
        TiledMap(other.folder).add(part)
        assert contents(made.folder) == contents(other.folder)
    assert made._rule == TiledMap(other.folder)._rule


def test_monte_carlo_draws_the_share_of_each_tile_as_the_map_grows(tmp_path, monkeypatch):
    monkeypatch.setattr(tiled_map, "_RECENT", 10)
    scans = street(12, 2)
    made = TiledMap.create(tmp_path / "map", GaussianMap(RULE, cutoff=4.0, n_samples=20_000), 2, SIDE)
    for scan in scans:
        made.insert(scan)
        made.occupancy(around(scans[:3])[::9], 0.3, "monte_carlo")
    made.finish()
    asked = around(scans)[::9]
    expected = TiledMap(made.folder).occupancy(asked, 0.3, "monte_carlo")
    assert torch.equal(made.occupancy(asked, 0.3, "monte_carlo"), expected)


def test_the_first_unfinished_window_decides_the_cutoff(tmp_path):
    sparse = street(1, 2)[0]
    scan = Scan(sparse.points.repeat(100, 1), sparse.origin)  # components with many points
    built, made = GaussianMap(RULE), TiledMap.create(tmp_path / "map", GaussianMap(RULE), 2, SIDE)
    opened = TiledMap(TiledMap.create(tmp_path / "opened", GaussianMap(RULE), 2, SIDE).folder)
    for one in (built, made, opened):
        one.insert(scan)
    expected = built.occupancy(around([scan]))
    assert built._answers().cutoff == 3
    assert torch.equal(made.occupancy(around([scan])), expected)
    assert torch.equal(opened.occupancy(around([scan])), expected)
