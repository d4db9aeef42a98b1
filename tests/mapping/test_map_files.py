"""Files of a GaussianMap: what comes back, and hostile ones. Their batches: see test_codec, test_storage."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.map_cases import FINE, assert_same_components, built, names, open_drive
from mapping.random_components import random_components
from occupancy.protocol_contract import dims, lattice, wall_scan
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError, MissingDataError
from gmmtorch.files import pack_tensors, read_tensors
from gmmtorch.mapping.codec import map_file as storage
from gmmtorch.mapping.codec.component_batch import numbered
from gmmtorch.mapping.components import UNNUMBERED
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import IncrementalRule, WindowedRule
from gmmtorch.mapping.query_options import QueryOptions

codecs = pytest.mark.parametrize("codec", ["quantized", "float"])


# -- what comes back -------------------------------------------------------------------------------------


@dims
@codecs
@pytest.mark.parametrize(
    "learning",
    [
        WindowedRule(noise=0.02, max_origins=3, window=2),
        WindowedRule(),
        replace(FINE, mean_origins=None, max_cost=0.01),
        replace(FINE, window=8, max_bytes=5000, n_components=20),
    ],
    ids=["windowed", "windowed, plain", "incremental", "under budgets"],
)
def test_settings_and_components_come_back(dim, codec, learning, tmp_path):
    options = {"prior": 0.5, "random_state": 4, "sampling": "stratified", "cutoff": 4.0, "hit_length": 0.1}
    made = built(open_drive(5, dim), learning, codec=codec, robot=2, method="flux", **options)
    made.save(tmp_path / "m.safetensors")
    loaded = GaussianMap.load(tmp_path / "m.safetensors")
    for name in ("learning", "resolution", "method", "codec", "query_options", "robot"):
        assert getattr(loaded, name) == getattr(made, name), name
    assert_same_components(loaded.components(), made.components())
    assert loaded.nbytes == made.nbytes
    loaded.save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == (tmp_path / "m.safetensors").read_bytes()


def test_settings_are_written_where_they_are_not_the_defaults(tmp_path):
    made = built([wall_scan(2)], FINE, n_samples=1_000_000, compiled=True)
    made.save(tmp_path / "m.safetensors")
    facts = read_tensors(tmp_path / "m.safetensors", storage.FILE_KIND, storage.FILE_VERSION)[1]
    assert facts.pop("n_numbered") == made.n_components
    assert facts == {
        "learning": {"kind": "incremental", "noise": 0.01, "length": 0.1, "cell": 0.05, "window": 2},
        "resolution": made.resolution,
        "method": "point",
        "codec": "float",
        "robot": 0,
        "cutoff": None,
        "hit_length": 1.0,
    }
    assert GaussianMap.load(tmp_path / "m.safetensors").query_options == GaussianMap().query_options


def test_a_file_without_cutoff_and_hit_length_has_those_of_the_format(tmp_path, packed):
    tensors, facts = packed
    facts = {key: value for key, value in facts.items() if key not in ("cutoff", "hit_length")}
    options = load_parts(tmp_path, tensors, facts).query_options
    assert (options.cutoff, options.hit_length) == (5.0, None)


@codecs
def test_ids_stay_unique_when_a_loaded_map_goes_on(codec, tmp_path):
    built(open_drive(3), window=2, codec=codec).save(tmp_path / "m.safetensors")
    loaded = GaussianMap.load(tmp_path / "m.safetensors")
    before = names(loaded.ids)
    loaded.insert(wall_scan(2))
    assert names(loaded.components().ids) > before


@settings(max_examples=30)
@given(
    dim=st.sampled_from([2, 3]),
    k=st.integers(0, 30),
    n_known=st.integers(0, 30),
    seed=st.integers(0, 1000),
    codec=st.sampled_from(["quantized", "float"]),
)
def test_file_size_is_the_length_of_the_file_of_the_numbered_components(dim, k, n_known, seed, codec):
    components = random_components(dim, k=k, seed=seed)
    components.ids[n_known:, 1] = UNNUMBERED
    rule, map_settings = IncrementalRule(), storage.MapSettings(0.1, "point", codec, 3, QueryOptions())
    size = storage.FileSize(rule, map_settings, next_number=40)(components)
    written = storage.to_bytes(numbered(components, 3, 40), rule, map_settings, 40)
    assert size == len(written) + 48  # room for settings that change


# -- hostile files ---------------------------------------------------------------------------------------


def parts_of(folder: Path, codec: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    path = folder / "m.safetensors"
    built(open_drive(3), FINE, n_samples=500, codec=codec).save(path)
    return read_tensors(path, storage.FILE_KIND, storage.FILE_VERSION)


@pytest.fixture(scope="module")
def exact(tmp_path_factory) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and settings of a sound file of every number as it is."""
    return parts_of(tmp_path_factory.mktemp("exact"), "float")


@pytest.fixture(scope="module")
def packed(tmp_path_factory) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Those of a quantised one."""
    return parts_of(tmp_path_factory.mktemp("packed"), "quantized")


def load_parts(folder: Path, tensors: dict[str, Tensor], facts: dict[str, Any]) -> GaussianMap:
    path = folder / "m.safetensors"
    path.write_bytes(pack_tensors(tensors, storage.FILE_KIND, storage.FILE_VERSION, **facts))
    return GaussianMap.load(path)


def test_the_parts_that_the_hostile_files_start_from_are_sound(tmp_path, exact, packed):
    for parts in (exact, packed):
        assert load_parts(tmp_path, *parts).n_components > 0


@pytest.mark.slow
@pytest.mark.parametrize("mask", [0x01, 0x80])
@codecs
def test_every_byte_may_be_damaged(tmp_path, codec, mask):
    """Refused, or a map with answers; of the batch, which has a checksum, always refused."""
    path = tmp_path / "m.safetensors"
    made = built(open_drive(1), IncrementalRule(n_components=3, length=0.5), codec=codec, n_samples=500)
    made.save(path)
    data = path.read_bytes()
    header = 8 + int.from_bytes(data[:8], "little")
    refused = []
    for place in range(len(data)):
        path.write_bytes(data[:place] + bytes([data[place] ^ mask]) + data[place + 1 :])
        try:
            theta = GaussianMap.load(path).occupancy(lattice(2)[::20])
            assert 0 <= float(theta.min()) <= float(theta.max()) <= 1
        except GmmTorchError:
            refused.append(place)
    assert len(refused) > header / 2
    if codec == "quantized":
        assert set(range(header, len(data))) <= set(refused)


DAMAGE = {
    "means, one dimension": lambda t: {"means": t["means"].flatten()},
    "means, four dimensions": lambda t: {"means": t["means"].repeat(1, 2)},
    "means, a number": lambda t: {"means": torch.tensor(1.0, dtype=torch.float64)},
    "means, NaN": lambda t: {"means": t["means"] * math.nan},
    "means, single": lambda t: {"means": t["means"].float()},
    "covariances, indefinite": lambda t: {"covariances": -t["covariances"]},
    "covariances, askew": lambda t: {"covariances": t["covariances"] + torch.eye(2).roll(1, 0).triu()},
    "covariances, infinite": lambda t: {"covariances": t["covariances"] * math.inf},
    "covariances, fewer": lambda t: {"covariances": t["covariances"][1:]},
    "support, negative": lambda t: {"support": -t["support"]},
    "support, fewer": lambda t: {"support": t["support"][1:]},
    "max_range, floats": lambda t: {"max_range": t["max_range"].double()},
    "max_range, fewer": lambda t: {"max_range": t["max_range"][1:]},
    "ids, wrong shape": lambda t: {"ids": t["ids"][:, :1]},
    "ids, floats": lambda t: {"ids": t["ids"].double()},
    "origins, other dimension": lambda t: {"origins": torch.zeros(9, 3, dtype=torch.float64)},
    "origins, none": lambda t: {"origins": t["origins"][:0]},
    "seen_by, beyond the table": lambda t: {"seen_by": t["seen_by"] + 10_000},
    "seen_by, negative": lambda t: {"seen_by": -1 - t["seen_by"]},
    "seen_from, beyond the table": lambda t: {"seen_from": t["seen_from"] + 100},
    "seen_from, negative": lambda t: {"seen_from": -1 - t["seen_from"]},
    "seen_from, fewer": lambda t: {"seen_from": t["seen_from"][1:]},
    "seen_count, negative": lambda t: {"seen_count": -t["seen_count"]},
    "seen_count, NaN": lambda t: {"seen_count": t["seen_count"] * math.nan},
    "seen_count, whole": lambda t: {"seen_count": t["seen_count"].long()},
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE.keys())
def test_a_file_whose_numbers_are_no_map_is_refused(tmp_path, exact, damage):
    tensors, facts = exact
    with pytest.raises(DataError, match=r"m\.safetensors"):
        load_parts(tmp_path, {**tensors, **damage(tensors)}, facts)


@pytest.mark.parametrize(
    "name",
    [
        "means",
        "covariances",
        "support",
        "max_range",
        "ids",
        "origins",
        "seen_by",
        "seen_from",
        "seen_count",
        "components",
    ],
)
def test_a_file_that_lacks_a_tensor_is_refused(tmp_path, exact, packed, name):
    tensors, facts = packed if name == "components" else exact
    with pytest.raises(DataError, match=r"m\.safetensors"):
        load_parts(tmp_path, {k: v for k, v in tensors.items() if k != name}, facts)


@pytest.mark.parametrize(
    ("kind", "version"),
    [
        ("gmmtorch.occupancy_grid", 2),
        (storage.FILE_KIND, 1),
        (storage.FILE_KIND, 3),
        (storage.FILE_KIND, "2"),
    ],
)
def test_load_refuses_other_kinds_and_versions(tmp_path, packed, kind, version):
    tensors, facts = packed
    path = tmp_path / "m.safetensors"
    path.write_bytes(pack_tensors(tensors, kind, version, **facts))
    with pytest.raises(DataError, match=r"m\.safetensors"):
        GaussianMap.load(path)


@pytest.mark.parametrize(
    "batch",
    [torch.zeros(5), torch.zeros(5, 5).byte(), torch.zeros(0).byte(), torch.zeros(50).byte()],
    ids=["floats", "matrix", "no bytes", "zeros"],
)
def test_load_refuses_files_without_a_batch(tmp_path, packed, batch):
    with pytest.raises(DataError, match=r"m\.safetensors"):
        load_parts(tmp_path, {"components": batch}, packed[1])


def test_load_names_a_missing_file(tmp_path):
    with pytest.raises(MissingDataError, match="nowhere"):
        GaussianMap.load(tmp_path / "nowhere.safetensors")


@pytest.mark.parametrize(
    "change",
    [
        {"n_samples": -5},
        {"n_samples": 10**30},
        {"sampling": "magic"},
        {"sampling": []},
        {"resolution": 0},
        {"resolution": "x"},
        {"resolution": None},
        {"prior": "x"},
        {"prior": -1},
        {"cutoff": "x"},
        {"cutoff": 0},
        {"hit_length": "x"},
        {"random_state": None},
        {"random_state": 2**80},
        {"method": "magic"},
        {"method": ["point"]},
        {"codec": "zip"},
        {"codec": {}},
        {"robot": "x"},
        {"robot": 2**70},
        {"robot": None},
        {"n_numbered": None},
        {"n_numbered": "12"},
        {"n_numbered": -1},
        {"n_numbered": 1e30},
        {"n_numbered": []},
        {"unheard_of": 1},
        {"learning": None},
        {"learning": []},
        {"learning": "incremental"},
        {"learning": {}},
        {"learning": {"kind": "magic"}},
        {"learning": {"kind": []}},
        *(
            {"learning": {"kind": kind, **damage}}
            for kind in ("windowed", "incremental")
            for damage in (
                {"noise": -1},
                {"noise": "x"},
                {"window": 0},
                {"window": "x"},
                {"max_origins": 1.5},
                {"unheard_of": 1},
                {"novelty": {"unheard_of": 1}},
                {"novelty": 3},
            )
        ),
        {"learning": {"kind": "windowed", "window": None}},
        {"learning": {"kind": "incremental", "max_bytes": 0}},
        {"learning": {"kind": "incremental", "n_components": "x"}},
        {"learning": {"kind": "incremental", "max_cost": "x"}},
        {"learning": {"kind": "incremental", "novelty": {"distance": -1}}},
    ],
    ids=str,
)
def test_a_file_whose_settings_are_damaged_is_refused(tmp_path, packed, change):
    tensors, facts = packed
    with pytest.raises(DataError, match=r"m\.safetensors"):
        load_parts(tmp_path, tensors, {**facts, **change})


@pytest.mark.parametrize("name", ["n_numbered", "learning"])
def test_a_file_that_lacks_a_setting_is_refused(tmp_path, packed, name):
    tensors, facts = packed
    with pytest.raises(DataError, match=name):
        load_parts(tmp_path, tensors, {k: v for k, v in facts.items() if k != name})


@settings(max_examples=100)
@given(
    name=st.sampled_from(["means", "covariances", "support", "origins", "seen_count"]),
    place=st.integers(0, 10**6),
    value=st.floats() | st.sampled_from([1e30, -1e30, 1e-40, 1e12, 1e300]),
)
def test_any_number_in_a_file_is_refused_or_answered_with(tmp_path, exact, name, place, value):
    tensors, facts = exact
    changed = tensors[name].clone()
    changed.view(-1)[place % changed.numel()] = value
    try:
        theta = load_parts(tmp_path, {**tensors, name: changed}, facts).occupancy(lattice(2)[::5])
    except GmmTorchError:
        return
    assert 0 <= float(theta.min()) <= float(theta.max()) <= 1
