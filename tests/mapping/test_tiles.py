"""Tiled maps: the answers of the whole map, files that do not depend on the order, and hostile files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.map_cases import assert_same_components
from mapping.random_components import random_components

from gmmtorch import Components, GaussianMap
from gmmtorch.errors import DataError, InvalidArgumentError, MemoryLimitError, MissingDataError
from gmmtorch.files import pack_tensors, read_tensors
from gmmtorch.mapping import INDEX, QueryOptions, TiledMap, merge, quantized, tile_files
from gmmtorch.mapping.codec.component_batch import MapSettings
from gmmtorch.mapping.tiles.tile_files import canonical
from gmmtorch.occupancy.calibrator import Calibration

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
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name != ".lock"}


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
    assert_same_components(one, other)


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
