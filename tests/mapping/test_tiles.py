"""Tiled maps: the answers of the whole map, files that do not depend on the order, and hostile files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.map_cases import FINE, open_drive
from mapping.random_components import random_components

from gmmtorch.errors import DataError, InvalidArgumentError, MemoryLimitError, MissingDataError, OutputError
from gmmtorch.files import pack_tensors, read_tensors
from gmmtorch.mapping import tiles
from gmmtorch.mapping.codec.component_batch import MapSettings
from gmmtorch.mapping.codec.quantization import quantized
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.query_options import QueryOptions
from gmmtorch.mapping.tile_index import INDEX
from gmmtorch.mapping.tiles import TiledMap, canonical, merge, tile_files
from gmmtorch.occupancy.calibrator import Calibration
from gmmtorch.scan import Scan

SIDE = 10.0
KNOWN = Calibration.prior(8.0)
SETTINGS = MapSettings(0.3, "point", "quantized", 0, QueryOptions(n_samples=200_000, calibration=KNOWN))


def recording(dim: int, seed: int, k: int = 60, codec: str = "quantized") -> Components:
    """Components of 3 by 3 tiles, some of them seen from other tiles."""
    made = random_components(dim, k, seed, center=3.0, extent=25.0, deviations=(0.05, 0.6))
    return made if codec == "float" else quantized(made)


def written(folder: Path, components: Components, set_to: MapSettings = SETTINGS) -> TiledMap:
    folder.mkdir(parents=True)
    for name, data in tile_files(components, set_to, SIDE).items():
        (folder / name).write_bytes(data)
    return TiledMap(folder)


def whole(parts: list[Components], set_to: MapSettings = SETTINGS) -> GaussianMap:
    return GaussianMap.of(
        Components.concatenate(parts), resolution=set_to.resolution, codec=set_to.codec, **vars(set_to.query)
    )


def moved(components: Components, x: float) -> Components:
    """The components and origins moved along x (m)."""
    shift = torch.eye(components.dim)[0].double() * x
    return replace(components, means=components.means + shift, origins=components.origins + shift)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# -- answers -------------------------------------------------------------------------------------------


ERRORS = {"point": 1e-9, "flux": 1e-6, "cone": 0.05}
"""Of θ: of sums; of adaptive quadrature; and of tails of the thesis's cone form, which gives evidence also
outside the hull of a cone, where it depends on the index whether the cone is asked."""


def test_the_calibrations_of_the_parts_are_merged_by_what_they_have_predicted(tmp_path, generator):
    far = Calibration.prior(20.0)._replace(n_predicted=300)
    near = Calibration.prior(5.0)._replace(n_predicted=100)
    known = [replace(SETTINGS, query=replace(SETTINGS.query, calibration=c)) for c in (near, far)]
    parts = [recording(3, seed) for seed in range(2)]
    each = [written(tmp_path / str(i), c, known[i]) for i, c in enumerate(parts)]
    tiled, other = merge(tmp_path / "all", each), merge(tmp_path / "other", each[::-1])
    merged = tiled.query_options.calibration
    assert merged == other.query_options.calibration == Calibration.merged([far, near])
    assert merged.length == pytest.approx(2.5**0.25 * 10**0.75, rel=1e-3)
    assert merged.n_predicted == pytest.approx(400, rel=1e-2)
    set_to = replace(SETTINGS, query=replace(SETTINGS.query, calibration=merged))
    points = 3 + 40 * (torch.rand(100, 3, generator=generator, dtype=torch.float64) - 0.5)
    expected = whole(parts, set_to).occupancy(points)
    torch.testing.assert_close(tiled.occupancy(points), expected, rtol=0, atol=1e-9)
    torch.testing.assert_close(tiled.open().occupancy(points), expected, rtol=0, atol=1e-9)


def test_tiles_without_a_calibration_have_that_of_the_sensor_model(tmp_path, generator):
    set_to = replace(SETTINGS, query=replace(SETTINGS.query, calibration=None))
    parts = recording(2, 0)
    tiled = written(tmp_path / "a", parts, set_to)
    points = 3 + 40 * (torch.rand(100, 2, generator=generator, dtype=torch.float64) - 0.5)
    expected = GaussianMap.of(parts, resolution=0.3).occupancy(points)
    torch.testing.assert_close(tiled.occupancy(points), expected, rtol=0, atol=1e-6)
    assert tiled.query_options.calibration.n_predicted == 0


@pytest.mark.parametrize(
    ("method", "cutoff"), [("point", None), ("point", 4.0), ("flux", None), ("cone", 4.0)]
)
@pytest.mark.parametrize("dim", [2, 3])
def test_answers_are_those_of_the_whole_map(dim, method, cutoff, tmp_path, generator):
    set_to = replace(SETTINGS, query=replace(SETTINGS.query, cutoff=cutoff))
    parts = [recording(dim, seed, 60 if method == "point" else 15) for seed in range(3)]
    tiled = merge(tmp_path / "all", [written(tmp_path / str(i), c, set_to) for i, c in enumerate(parts)])
    expected = whole(parts, set_to)
    points = 3 + 40 * (torch.rand(400, dim, generator=generator, dtype=torch.float64) - 0.5)
    points[:40] = expected.means[:40]
    points[40:47] = expected.origins[:7]
    points = points if method == "point" else points[:120]
    for resolution in (0.05, 0.3, 2.0):
        answer = expected.occupancy(points, resolution, method)
        found = tiled.occupancy(points, resolution, method)
        torch.testing.assert_close(found, answer, rtol=0, atol=ERRORS[method])
        assert float((found - answer).abs().mean()) < 1e-3
    assert float((answer - 0.5).abs().max()) > 0.2
    assert tiled.n_components == expected.n_components


def test_a_query_opens_only_the_tiles_that_give_evidence(tmp_path, generator):
    near, far = recording(2, 0), moved(recording(2, 1), 500.0)
    tiled = merge(tmp_path / "all", [written(tmp_path / "a", near), written(tmp_path / "b", far)])
    n_near = len(TiledMap(tmp_path / "a").index)
    points = 3 + 60 * (torch.rand(300, 2, generator=generator, dtype=torch.float64) - 0.5)
    answer = tiled.occupancy(points)
    assert 0 < tiled.n_read <= n_near < len(tiled.index)
    torch.testing.assert_close(answer, whole([near]).occupancy(points), rtol=0, atol=1e-9)
    before = tiled.n_read
    tiled.occupancy(points)
    assert tiled.n_read == before  # they are still open
    one = TiledMap(tmp_path / "all", memory=1)
    torch.testing.assert_close(one.occupancy(points), answer)
    assert len(one._open) == 1
    assert float(tiled.occupancy(torch.tensor([[1e5, 0.0], [torch.inf, 0.0]])).sub(0.5).abs().max()) == 0


def test_an_opened_box_answers_as_the_whole_map(tmp_path, generator):
    parts = [moved(recording(3, seed), 60.0 * seed) for seed in range(2)]
    tiled = merge(tmp_path / "all", [written(tmp_path / str(i), c) for i, c in enumerate(parts)])
    low, high = torch.tensor([-7.0, -7.0, 0.0]), torch.tensor([-5.0, -4.0, 3.0])
    region = tiled.open(low, high)
    assert 0 < region.n_components < tiled.n_components
    points = low + (high - low) * torch.rand(300, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(region.occupancy(points), whole(parts).occupancy(points), rtol=0, atol=1e-9)
    everything = tiled.open()
    assert everything.n_components == tiled.n_components
    assert len(torch.unique(everything.ids, dim=0)) == tiled.n_components
    assert everything.query_options.cutoff == tiled.query_options.cutoff


def test_monte_carlo_draws_the_rays_of_each_tile(tmp_path):
    parts = [recording(2, 0)]
    tiled = written(tmp_path / "a", parts[0])
    points = parts[0].means
    error = tiled.occupancy(points, 0.3, "monte_carlo") - whole(parts).occupancy(points, 0.3, "monte_carlo")
    assert float(error.abs().mean()) < 0.05


def test_the_cutoff_is_that_of_the_whole_map(tmp_path):
    few, many = recording(2, 0), recording(2, 1)
    few = quantized(replace(few, support=few.support / 1e4, seen_count=few.seen_count / 1e4))
    many = quantized(replace(many, support=many.support * 1e4, seen_count=many.seen_count * 1e4))
    for name, parts in {"few": [few, few, many], "many": [few, many, many]}.items():
        tiles = [written(tmp_path / f"{name}{i}", part) for i, part in enumerate(parts)]
        tiled = merge(tmp_path / name, tiles)
        assert tiled.query_options.cutoff == whole(parts)._answers().cutoff
        assert tiled.query_options.cutoff == (5.0 if name == "few" else 3.0)


# -- merging -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[TiledMap]:
    """Four recordings; two of them are equal."""
    folder = tmp_path_factory.mktemp("recordings")
    return [written(folder / str(i), recording(3, seed, 25)) for i, seed in enumerate([0, 1, 2, 2])]


@pytest.mark.parametrize("tile_bytes", [None, 700])
def test_merging_is_commutative(tile_bytes, recordings, tmp_path):
    merge(tmp_path / "sorted", recordings, tile_bytes)
    expected = contents(tmp_path / "sorted")

    @given(order=st.permutations(recordings))
    @settings(max_examples=6)
    def any_order(order: list[TiledMap]) -> None:
        merge(tmp_path / "mixed", order, tile_bytes)
        assert contents(tmp_path / "mixed") == expected

    any_order()


@pytest.mark.parametrize("codec", ["quantized", "float"])
def test_merging_is_associative_and_keeps_every_component(codec, tmp_path):
    set_to = replace(SETTINGS, codec=codec)
    parts = [written(tmp_path / str(i), recording(3, i, codec=codec), set_to) for i in range(3)]
    left = merge(tmp_path / "left", [merge(tmp_path / "ab", parts[:2]), parts[2]])
    right = merge(tmp_path / "right", [parts[0], merge(tmp_path / "bc", parts[1:])])
    at_once = merge(tmp_path / "all", parts)
    assert contents(left.folder) == contents(right.folder) == contents(at_once.folder)
    together = canonical(Components.concatenate([recording(3, i, codec=codec) for i in range(3)]))
    for name, value in canonical(at_once.open().components()).tensors().items():
        torch.testing.assert_close(value, getattr(together, name), rtol=1e-14, atol=0, msg=name)


@given(seed=st.integers(0, 99), dim=st.sampled_from([2, 3]))
@settings(max_examples=20)
def test_the_canonical_order_depends_on_values_alone(seed, dim):
    generator = torch.Generator().manual_seed(seed)
    made = random_components(dim, 30, seed)
    made = Components.concatenate([made, made.selected(torch.arange(5))])
    # The same places, seen from other origins: only the viewpoints differ.
    elsewhere = replace(made.selected(torch.arange(9)), origins=made.origins + 0.5)
    made = Components.concatenate([made, elsewhere])
    shuffled = made.rearranged(torch.randperm(len(made), generator=generator))
    turn = torch.randperm(len(made.origins), generator=generator)
    mixed = torch.randperm(len(made.seen_by), generator=generator)
    shuffled = replace(
        shuffled,
        origins=shuffled.origins[turn.argsort()],
        seen_by=shuffled.seen_by[mixed],
        seen_from=turn[shuffled.seen_from][mixed],
        seen_count=shuffled.seen_count[mixed],
    )
    one, other = canonical(made), canonical(shuffled)
    for name, value in one.tensors().items():
        assert torch.equal(value, getattr(other, name)), name


def test_a_budget_limits_every_tile(tmp_path):
    parts = [written(tmp_path / str(i), recording(3, i)) for i in range(3)]
    tiled = merge(tmp_path / "all", parts, 700)
    assert int(tiled.index.n_bytes.max()) <= 700
    assert 0 < tiled.n_components < 180
    support = sum(float(recording(3, i).support.sum()) for i in range(3))
    assert float(tiled.open().support.sum()) == pytest.approx(support, rel=0.1)  # counts are rounded


def test_a_new_merge_removes_the_tiles_of_the_old_one(tmp_path):
    first, second = written(tmp_path / "a", recording(2, 0)), written(tmp_path / "b", recording(2, 1, 3))
    merge(tmp_path / "all", [first])
    tiled = merge(tmp_path / "all", [second])
    assert len(contents(tmp_path / "all")) == len(tiled.index) + 1 == len(second.index) + 1


def test_maps_of_different_kinds_are_not_merged(tmp_path):
    first = written(tmp_path / "a", recording(2, 0))
    for name, other in {
        "dim": written(tmp_path / "b", recording(3, 0)),
        "settings": written(tmp_path / "c", recording(2, 0), replace(SETTINGS, resolution=0.2)),
    }.items():
        with pytest.raises(InvalidArgumentError, match=f"has {name}="):
            merge(tmp_path / "all", [first, other])
    with pytest.raises(InvalidArgumentError, match="parts is empty"):
        merge(tmp_path / "all", [])
    with pytest.raises(InvalidArgumentError, match="tile=0"):
        tile_files(recording(2, 0), SETTINGS, 0)


def test_a_map_without_components_has_no_tiles(tmp_path):
    tiled = written(tmp_path / "a", Components.empty(3))
    assert (len(tiled.index), tiled.n_components) == (0, 0)
    assert torch.equal(torch.as_tensor(tiled.occupancy(torch.zeros(4, 3))), torch.full((4,), 0.5).double())
    assert tiled.open().n_components == 0


# -- a map that grows ----------------------------------------------------------------------------------

RULE = replace(FINE, window=3, mean_origins=None)


def street(n: int, dim: int) -> list[Scan]:
    """Scans of rooms, each 15 m after the one before."""
    found = []
    for number, scan in enumerate(open_drive(3, dim) * -(-n // 3)):
        shift = torch.eye(dim, dtype=torch.float64)[0] * (number // 3 * 15.0)
        found.append(Scan(scan.points + shift, scan.origin + shift, scan.no_return + shift))
    return found[:n]


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
    monkeypatch.setattr(tiles, "_RECENT", 40)
    scans = street(14, dim)
    built, tiled, asked = GaussianMap(RULE, codec=codec), None, around(scans)
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
    monkeypatch.setattr(tiles, "_RECENT", 40)
    scans, write = street(15, 2), tiles.write_bytes
    asked = around(scans)
    for stop in range(1, 40):
        folder, n_written = tmp_path / str(stop), 0

        def full(path: Path, data: bytes, stop: int = stop) -> None:
            nonlocal n_written
            n_written += 1
            if n_written == stop:
                raise OutputError(f"{path} cannot be written: No space left on device")
            write(path, data)

        monkeypatch.setattr(tiles, "write_bytes", full)
        if stop == 1:
            with pytest.raises(OutputError):
                grown(folder, scans)
            continue
        made = TiledMap.create(folder, GaussianMap(RULE), 2, SIDE) if stop > 2 else None
        if made is None:
            continue
        n_final, before = 0, None
        try:
            for scan in scans:
                before = TiledMap(folder).occupancy(asked)
                n_final = made.n_components
                made.insert(scan)
        except OutputError:
            monkeypatch.setattr(tiles, "write_bytes", write)
            opened = TiledMap(folder)
            assert opened.n_components == n_final
            assert torch.equal(opened.occupancy(asked), before)
            made.finish()  # the disk has room again: nothing is lost
            assert TiledMap(folder).n_components == made.n_components > n_final
            opened_again = TiledMap(folder)
            torch.testing.assert_close(
                opened_again.occupancy(asked), made.occupancy(asked), rtol=0, atol=1e-9
            )
            opened_again.insert(scans[-1])
            opened_again.finish()
            assert opened_again.n_components > made.n_components
        else:
            break
    assert stop > 12


def test_a_damaged_tile_is_named_and_the_rest_answers(tmp_path, monkeypatch):
    monkeypatch.setattr(tiles, "_RECENT", 10)
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
    monkeypatch.setattr(tiles, "_RECENT", n_recent)
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
    monkeypatch.setattr(tiles, "_RECENT", 40)
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
    known = {INDEX, tiles._recent_name(made._crc32), *map(made._name, range(len(made.index)))}
    assert {*contents(made.folder)} == known | {*others}


def test_a_second_process_cannot_overwrite_a_map(tmp_path, monkeypatch):
    monkeypatch.setattr(tiles, "_RECENT", 40)
    scans = street(9, 2)
    one = grown(tmp_path / "map", scans[:3])
    two = TiledMap(one.folder)
    for scan in scans[3:6]:
        one.insert(scan)
    before = contents(one.folder)
    with pytest.raises(OutputError, match="Open it again"):
        two.add(recording(2, 0))
    assert contents(one.folder) == before
    for scan in scans[6:]:
        one.insert(scan)
    assert TiledMap(one.folder).n_components == one.n_components


def test_tiles_are_not_too_small_for_their_numbers(tmp_path):
    with pytest.raises(InvalidArgumentError, match="side"):
        TiledMap.create(tmp_path / "map", GaussianMap(), 2, side=1e-9)
    with pytest.raises(InvalidArgumentError, match="tile"):
        tile_files(recording(2, 0), SETTINGS, side=1e-9)


@pytest.mark.parametrize("n_recent", [20, 10_000])
def test_a_map_of_added_components_answers_the_same_once_reopened(n_recent, tmp_path, monkeypatch):
    monkeypatch.setattr(tiles, "_RECENT", n_recent)
    parts = [random_components(2, 60, 3, center=3.0, extent=extent) for extent in (10.0, 60.0, 90.0)]
    made = TiledMap.create(tmp_path / "1", GaussianMap(), 2, SIDE)
    other = TiledMap.create(tmp_path / "2", GaussianMap(), 2, SIDE)
    for part in parts:
        made.add(part)
        TiledMap(other.folder).add(part)
        assert contents(made.folder) == contents(other.folder)
    assert made._rule == TiledMap(other.folder)._rule


def test_the_first_unfinished_window_decides_the_cutoff(tmp_path):
    sparse = street(1, 2)[0]
    scan = Scan(sparse.points.repeat(100, 1), sparse.origin)  # components with many points
    built, made = GaussianMap(RULE), TiledMap.create(tmp_path / "map", GaussianMap(RULE), 2, SIDE)
    opened = TiledMap(made.folder)
    for one in (built, made, opened):
        one.insert(scan)
    expected = built.occupancy(around([scan]))
    assert built._answers().cutoff == 3
    assert torch.equal(made.occupancy(around([scan])), expected)
    assert torch.equal(opened.occupancy(around([scan])), expected)


# -- damaged and hostile files -------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return written(tmp_path / "map", recording(2, 0)).folder


def test_a_missing_or_foreign_tile_is_named(folder, tmp_path):
    tile = next(folder.glob("tile_*"))
    other = written(tmp_path / "other", recording(2, 1)).folder / tile.name
    tile.write_bytes(other.read_bytes())
    points = torch.zeros(1, 2)
    with pytest.raises(DataError, match=rf"{tile.name} is not the file that index"):
        TiledMap(folder).open()
    tile.unlink()
    with pytest.raises(MissingDataError, match=rf"{tile.name} is missing.*merge the recordings again"):
        TiledMap(folder).open()
    (folder / INDEX).unlink()
    with pytest.raises(MissingDataError, match=r"index\.safetensors does not exist"):
        TiledMap(folder).occupancy(points)


@given(data=st.data())
@settings(max_examples=40)
def test_a_changed_index_is_refused(data, tmp_path_factory):
    folder = written(tmp_path_factory.mktemp("hostile") / "map", recording(2, 0, 9)).folder
    whole_file = (folder / INDEX).read_bytes()
    place = data.draw(st.integers(0, len(whole_file) - 1))
    changed = bytearray(whole_file)
    changed[place] ^= 1 << data.draw(st.integers(0, 7))
    for content in (bytes(changed), whole_file[:place]):
        (folder / INDEX).write_bytes(content)
        with pytest.raises(DataError, match=r"index\.safetensors"):
            TiledMap(folder)


HOSTILE = {
    "a tile twice": ("tiles", lambda x: x[:1].expand_as(x)),
    "far tiles": ("tiles", lambda x: x + (1 << 50)),
    "another shape": ("tiles", lambda x: x[:, :1]),
    "another length": ("n_bytes", lambda x: x[:-1]),
    "NaN": ("low", lambda x: x * torch.nan),
    "swapped corners": ("low", lambda x: x + 1e4),
    "far corners": ("high", lambda x: x + 1e30),
    "negative distance": ("distance", lambda x: -x - 1),
    "negative counts": ("n_components", lambda x: -x - 1),
    "huge files": ("n_bytes", lambda x: x + (1 << 60)),
    "no checksum": ("crc32", lambda x: x - (1 << 40)),
    "other types": ("crc32", lambda x: x.double()),
}


def rewritten(folder: Path, name: str, change: object, **facts: object) -> None:
    """Writes the index with one column or fact changed, and a checksum that fits."""
    tensors, stored = read_tensors(folder / INDEX, "gmmtorch.tiles", 1)
    if name:
        tensors[name] = change(tensors[name])  # type: ignore[operator]
    (folder / INDEX).write_bytes(pack_tensors(tensors, "gmmtorch.tiles", 1, **{**stored, **facts}))


@pytest.mark.parametrize("case", HOSTILE)
def test_impossible_columns_are_refused(case, folder):
    rewritten(folder, *HOSTILE[case])
    with pytest.raises(DataError, match=r"index\.safetensors"):
        TiledMap(folder)


@pytest.mark.parametrize(
    "fact",
    [{"side": 0}, {"side": "x"}, {"method": "guess"}, {"prior": -1}, {"resolution": None}, {"codec": 1}],
)
def test_impossible_settings_are_refused(fact, folder):
    rewritten(folder, "", None, **fact)
    with pytest.raises(DataError, match=r"index\.safetensors"):
        TiledMap(folder)


def test_a_wrong_number_of_components_is_refused(folder):
    rewritten(folder, "n_components", lambda x: x + 1)
    with pytest.raises(DataError, match="has other components"):
        TiledMap(folder).open()


def test_a_map_that_does_not_fit_into_memory_names_the_remedy(folder):
    tiled = TiledMap(folder)
    tiled.query_options = replace(tiled.query_options, memory_limit=1000)
    with pytest.raises(MemoryLimitError, match="give the bounds of a smaller box"):
        tiled.open()
    with pytest.raises(InvalidArgumentError, match="low="):
        tiled.open([0.0])
    assert "tiles of 10 m" in repr(tiled)
