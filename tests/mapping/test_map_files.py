"""Files of a GaussianMap: restored settings and components, and hostile files."""

from __future__ import annotations

import base64
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from invalid_values import each_value
from mapping.map_cases import FINE, assert_same_components, built, drive, open_drive
from mapping.random_components import random_components
from occupancy.protocol_contract import lattice, wall_scan
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.files import pack_tensors, read_tensors
from gmmtorch.mapping import Components, GaussianMap, IncrementalRule, QueryOptions, WindowedRule
from gmmtorch.mapping.codec import component_batch as storage
from gmmtorch.mapping.codec.quantization import numbered
from gmmtorch.mapping.components import UNNUMBERED
from gmmtorch.occupancy.calibrator import Calibration
from gmmtorch.scan import Scan

# -- saved and loaded ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dim", "codec", "learning"),
    [
        (2, "quantized", WindowedRule(noise=0.02, max_origins=3, window=2)),
        (3, "float", WindowedRule()),
        (3, "quantized", replace(FINE, mean_origins=None, max_cost=0.01)),
        (2, "float", replace(FINE, window=8, max_bytes=5000, n_components=20)),
    ],
    ids=["windowed", "windowed, plain", "incremental", "under budgets"],
)
@pytest.mark.parametrize("prior", [None, 0.5])
def test_settings_and_components_are_restored(dim, codec, learning, prior, tmp_path):
    options = {"prior": prior, "random_state": 4, "sampling": "stratified", "cutoff": 4.0}
    made = built(open_drive(3, dim), learning, codec=codec, robot=2, method="flux", **options)
    made.save(tmp_path / "m.safetensors")
    loaded = GaussianMap.load(tmp_path / "m.safetensors")
    for name in ("learning", "resolution", "method", "codec", "query_options", "robot"):
        assert getattr(loaded, name) == getattr(made, name), name
    assert_same_components(loaded.components(), made.components())
    assert loaded.nbytes == made.nbytes
    loaded.save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == (tmp_path / "m.safetensors").read_bytes()


def test_a_learned_calibration_is_restored_and_costs_at_most_64_bytes(tmp_path):
    scans = drive(8, 2)
    made, counts = (built(scans, FINE, prior=prior) for prior in (None, 1.0))
    known = made.query_options.calibration
    assert known.n_predicted > 0
    assert 0 < made.nbytes - counts.nbytes <= 64
    made.save(tmp_path / "m.safetensors")
    loaded = GaussianMap.load(tmp_path / "m.safetensors")
    assert loaded.query_options.calibration == known
    assert torch.equal(loaded.occupancy(lattice(2), 0.1), made.occupancy(lattice(2), 0.1))


def test_a_file_of_version_1_0_with_a_hit_length_is_calibrated_by_its_ranges(tmp_path, packed):
    tensors, facts = packed
    facts = {key: value for key, value in facts.items() if key not in ("calibration", "prior")}
    loaded = load_parts(tmp_path, tensors, {**facts, "hit_length": 1.0})
    assert (loaded.query_options.prior, loaded.query_options.calibration) == (None, None)
    parts = loaded.components()
    expected = GaussianMap.of(parts, cutoff=loaded.query_options.cutoff).occupancy(lattice(2), 0.2)
    assert torch.equal(loaded.occupancy(lattice(2), 0.2), expected)


@pytest.mark.parametrize(
    "text", [5, "", "AAAA", "!" * 35, "~" * 35, base64.b85encode(np.full(14, np.nan, "<f2")).decode()]
)
def test_a_damaged_calibration_is_refused(tmp_path, packed, text):
    with pytest.raises(DataError, match=r"m\.safetensors.*calibration"):
        load_parts(tmp_path, packed[0], {**packed[1], "calibration": text})


def test_only_settings_that_differ_from_the_defaults_are_written(tmp_path):
    made = built([wall_scan(2)], FINE, n_samples=1_000_000)
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
        "prior": None,  # the window is not full: nothing is predicted yet
    }
    assert GaussianMap.load(tmp_path / "m.safetensors").query_options == made.query_options


def test_a_file_without_cutoff_and_prior_has_the_format_defaults(tmp_path, packed):
    tensors, facts = packed
    facts = {key: value for key, value in facts.items() if key not in ("cutoff", "prior", "calibration")}
    options = load_parts(tmp_path, tensors, facts).query_options
    assert (options.cutoff, options.prior) == (5.0, 1.0)


@settings(max_examples=30)
@given(
    dim=st.sampled_from([2, 3]),
    k=st.integers(0, 30),
    n_known=st.integers(0, 30),
    seed=st.integers(0, 1000),
    codec=st.sampled_from(["quantized", "float"]),
)
def test_file_size_equals_the_length_of_the_written_file(dim, k, n_known, seed, codec):
    components = random_components(dim, k=k, seed=seed)
    components.ids[n_known:, 1] = UNNUMBERED
    options = QueryOptions(calibration=Calibration.prior(5.0))
    rule, map_settings = IncrementalRule(), storage.MapSettings(0.1, "point", codec, 3, options)
    size = storage.file_size(components, rule, map_settings, next_number=40)
    written = storage.map_bytes(numbered(components, 3, 40)[0], rule, map_settings, 40)
    assert size == len(written) + 48  # room for settings that change


# -- hostile files ---------------------------------------------------------------------------------------


def parts_of(folder: Path, codec: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    path = folder / "m.safetensors"
    built(open_drive(3), FINE, n_samples=500, codec=codec).save(path)
    return read_tensors(path, storage.FILE_KIND, storage.FILE_VERSION)


@pytest.fixture(scope="module")
def exact(tmp_path_factory) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and settings of a valid file with the float codec."""
    return parts_of(tmp_path_factory.mktemp("exact"), "float")


@pytest.fixture(scope="module")
def packed(tmp_path_factory) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and settings of a valid file with the quantized codec."""
    return parts_of(tmp_path_factory.mktemp("packed"), "quantized")


def load_parts(folder: Path, tensors: dict[str, Tensor], facts: dict[str, Any]) -> GaussianMap:
    path = folder / "m.safetensors"
    path.write_bytes(pack_tensors(tensors, storage.FILE_KIND, storage.FILE_VERSION, **facts))
    return GaussianMap.load(path)


@pytest.mark.slow
@pytest.mark.parametrize(("codec", "mask"), [("quantized", 0x01), ("float", 0x80)])
def test_a_file_with_any_damaged_byte_is_refused_or_valid(tmp_path, codec, mask):
    """Damage of the batch, which has a checksum, is always refused."""
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
def test_a_file_with_invalid_tensors_is_refused(tmp_path, exact, damage):
    tensors, facts = exact
    with pytest.raises(DataError, match=r"m\.safetensors"):
        load_parts(tmp_path, {**tensors, **damage(tensors)}, facts)


def test_a_file_that_lacks_a_tensor_is_refused(tmp_path, exact, packed):
    for tensors, facts in (exact, packed):
        assert load_parts(tmp_path, tensors, facts).n_components > 0
        for name in tensors:
            with pytest.raises(DataError, match=r"m\.safetensors"):
                load_parts(tmp_path, {k: v for k, v in tensors.items() if k != name}, facts)


def test_load_refuses_other_kinds_and_versions(tmp_path, packed):
    tensors, facts = packed
    path = tmp_path / "m.safetensors"
    kind = storage.FILE_KIND
    for other, version in (("gmmtorch.occupancy_grid", 2), (kind, 1), (kind, 3), (kind, "2")):
        path.write_bytes(pack_tensors(tensors, other, version, **facts))
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


DAMAGED_FACTS = {
    "n_samples": [-5, 10**30],
    "sampling": ["magic", []],
    "resolution": [0, "x", None, 10**400],
    "prior": ["x", -1, 10**400],
    "cutoff": ["x", 0, 10**400],
    "calibration": ["x", 3],
    "random_state": [None, 2**80],
    "method": ["magic", ["point"]],
    "codec": ["zip", {}],
    "robot": ["x", 2**70, None],
    "n_numbered": [None, "12", -1, 1e30, []],
    "unheard_of": [1],
    "learning": [None, [], "incremental", {}, {"kind": "magic"}, {"kind": []}],
}
DAMAGED_RULES = {
    "noise": [-1, "x"],
    "window": [0, "x"],
    "max_origins": [1.5],
    "unheard_of": [1],
    "novelty": [{"unheard_of": 1}, 3],
}
DAMAGED_FACTS["learning"] += [
    {"kind": kind, name: value}
    for kind in ("windowed", "incremental")
    for name, value in each_value(DAMAGED_RULES)
]
DAMAGED_FACTS["learning"] += [
    {"kind": "windowed", "window": None},
    {"kind": "incremental", "max_bytes": 0},
    {"kind": "incremental", "n_components": "x"},
    {"kind": "incremental", "max_cost": "x"},
    {"kind": "incremental", "novelty": {"distance": -1}},
]


@pytest.mark.parametrize(("name", "value"), each_value(DAMAGED_FACTS), ids=str)
def test_a_file_whose_settings_are_damaged_is_refused(tmp_path, packed, name, value):
    tensors, facts = packed
    with pytest.raises(DataError, match=r"m\.safetensors"):
        load_parts(tmp_path, tensors, {**facts, name: value})


def test_attributes_of_other_components_are_refused(tmp_path, packed):
    """The block of three components beside a batch of none, each with a sound checksum."""
    points = torch.rand(200, 3)
    coloured = GaussianMap()
    coloured.insert(Scan(points, torch.zeros(3), attributes={"colour": torch.rand(200, 3)}))
    coloured.finish()
    coloured.save(tmp_path / "c.safetensors")
    tensors, facts = read_tensors(tmp_path / "c.safetensors", storage.FILE_KIND, storage.FILE_VERSION)
    none = torch.frombuffer(bytearray(storage.encode(Components.empty(3))), dtype=torch.uint8)
    with pytest.raises(DataError, match=r"m\.safetensors"):
        load_parts(tmp_path, {**tensors, "components": none}, facts)


def test_a_cutoff_beyond_the_whole_numbers_of_a_tensor_is_a_number(tmp_path, packed):
    tensors, facts = packed
    found = load_parts(tmp_path, tensors, {**facts, "cutoff": 2**64})
    assert found.query_options.cutoff == 2.0**64
    assert found.occupancy(lattice(found.dim), 0.2).isfinite().all()


def test_a_file_that_lacks_a_setting_is_refused(tmp_path, packed):
    tensors, facts = packed
    for name in ("n_numbered", "learning"):
        with pytest.raises(DataError, match=name):
            load_parts(tmp_path, tensors, {k: v for k, v in facts.items() if k != name})


@settings(max_examples=60)
@given(
    name=st.sampled_from(["means", "covariances", "support", "origins", "seen_count"]),
    place=st.integers(0, 10**6),
    value=st.floats() | st.sampled_from([1e30, -1e30, 1e-40, 1e12, 1e300]),
)
def test_any_tensor_value_is_refused_or_gives_probabilities(tmp_path, exact, name, place, value):
    tensors, facts = exact
    changed = tensors[name].clone()
    changed.view(-1)[place % changed.numel()] = value
    try:
        theta = load_parts(tmp_path, {**tensors, name: changed}, facts).occupancy(lattice(2)[::5])
    except GmmTorchError:
        return
    assert 0 <= float(theta.min()) <= float(theta.max()) <= 1
