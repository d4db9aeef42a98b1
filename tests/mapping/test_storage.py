"""Map files: one batch of components and the settings; files of version 1."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from mapping.random_components import random_components
from torch import Tensor

from gmmtorch.errors import DataError, MissingDataError
from gmmtorch.files import pack_tensors
from gmmtorch.linalg import pack_symmetric
from gmmtorch.mapping.codec import map_file as storage
from gmmtorch.mapping.codec.component_batch import encode, quantized
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import WindowedRule

dims = pytest.mark.parametrize("dim", [2, 3])


def assert_same(one: Components, other: Components) -> None:
    for field in fields(Components):
        assert torch.equal(getattr(one, field.name), getattr(other, field.name)), field.name


@dims
@pytest.mark.parametrize("k", [0, 1, 50])
def test_components_and_settings_come_back(dim, k, tmp_path):
    components, facts = quantized(random_components(dim, k=k)), {"resolution": 0.2, "learning": {"kind": "x"}}
    path = tmp_path / "m.safetensors"
    path.write_bytes(storage.to_bytes(components, facts))
    found, told = storage.from_file(path)
    assert_same(found, components)
    assert told == facts


def test_the_container_is_small():
    components = random_components(3, k=100)
    assert len(storage.to_bytes(components, {})) - len(encode(components)) < 200


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(MissingDataError, match="nowhere"):
        storage.from_file(tmp_path / "nowhere.safetensors")


@pytest.mark.parametrize(
    "tensors",
    [
        {"components": torch.zeros(5)},
        {"components": torch.zeros(5, 5, dtype=torch.uint8)},
        {"components": torch.zeros(0, dtype=torch.uint8)},
        {"components": torch.zeros(50, dtype=torch.uint8)},
        {"other": torch.zeros(50, dtype=torch.uint8)},
    ],
    ids=["floats", "a matrix", "no bytes", "zeros", "another name"],
)
def test_a_file_that_holds_no_batch_is_refused(tmp_path, tensors):
    path = tmp_path / "m.safetensors"
    path.write_bytes(pack_tensors(tensors, storage.FILE_KIND, storage.FILE_VERSION))
    with pytest.raises(DataError, match=r"m\.safetensors"):
        storage.from_file(path)


def test_a_later_version_is_refused_by_name(tmp_path):
    path = tmp_path / "m.safetensors"
    path.write_bytes(pack_tensors({}, storage.FILE_KIND, 3))
    with pytest.raises(DataError, match=r"version 3 .* version 2 or 1"):
        storage.from_file(path)


def version_1(components: Components) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and settings of a file of version 1, of components with one sighting each."""
    frame = components.origins[0].round()
    k = len(components)
    tensors = {
        "frame": frame,
        "means": (components.means - frame).float(),
        "covariances": pack_symmetric(components.covariances).float(),
        "support": components.support.float(),
        "max_range": components.max_range.to(torch.uint8),
        "id_runs": torch.tensor([[0, 0, k]]),
        "origins": (components.origins - frame).float(),
        "sightings": torch.ones(k, dtype=torch.uint8),
        "seen_from": components.seen_from.to(torch.uint8),
        "seen_share": torch.full((k,), 255, dtype=torch.uint8),
    }
    settings = {"window": 4, "learning": {"noise": 0.02}, "resolution": 0.3, "random_state": 3, "robot": 0}
    return tensors, settings


def write_version_1(folder: Path, tensors: dict[str, Tensor], settings: dict[str, Any]) -> Path:
    path = folder / "m.safetensors"
    path.write_bytes(pack_tensors(tensors, storage.FILE_KIND, 1, **settings))
    return path


@dims
def test_files_of_version_1_load(dim, tmp_path):
    # Deviations and places that float32 holds exactly, so that both round to the same.
    components = random_components(dim, max_sightings=1)
    single = {
        name: getattr(components, name).float().double() for name in ("covariances", "support", "seen_count")
    }
    near = {name: (getattr(components, name) * 2**10).round() / 2**10 for name in ("means", "origins")}
    components = replace(components, **single, **near)
    path = write_version_1(tmp_path, *version_1(components))
    assert_same(storage.from_file(path)[0], quantized(components))
    loaded = GaussianMap.load(path)
    assert loaded.n_components == len(components)
    assert loaded.resolution == 0.3
    assert loaded.method == "monte_carlo"
    assert loaded.learning == WindowedRule(noise=0.02, window=4)


DAMAGE = {
    "means, NaN": lambda t: {"means": t["means"] * torch.nan},
    "covariances, indefinite": lambda t: {"covariances": -t["covariances"]},
    "support, fewer": lambda t: {"support": t["support"][1:]},
    "id_runs, huge": lambda t: {"id_runs": t["id_runs"] + torch.tensor([0, 0, 2**62])},
    "sightings, too many": lambda t: {"sightings": t["sightings"] + 1},
    "seen_from, beyond the table": lambda t: {"seen_from": t["seen_from"] + 100},
    "seen_share, none": lambda t: {"seen_share": t["seen_share"] * 0},
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE.keys())
def test_damaged_files_of_version_1_are_refused(tmp_path, damage):
    tensors, settings = version_1(random_components(3, max_sightings=1))
    with pytest.raises(DataError, match=r"m\.safetensors"):
        storage.from_file(write_version_1(tmp_path, {**tensors, **damage(tensors)}, settings))
