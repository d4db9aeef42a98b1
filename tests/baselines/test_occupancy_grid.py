"""OccupancyGrid: the map contract, dense evidence, log-odds by formula, and damaged files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from occupancy.protocol_contract import RESOLUTION, OccupancyMapContract, lattice, open_scan, wall_scan
from torch import Tensor

from gmmtorch.baselines.occupancy_grid import LogOdds, OccupancyGrid
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.files import pack_tensors
from gmmtorch.occupancy.evidence import Evidence
from gmmtorch.occupancy.grid import VoxelGrid


class GridContract(OccupancyMapContract):
    """Counts are additive, so the order of scans and the chunk size do not matter."""

    @pytest.mark.parametrize("dim", [2, 3])
    def test_the_order_of_the_scans_does_not_matter(self, dim):
        scans = [wall_scan(dim), open_scan(dim), wall_scan(dim, 1, (1.3, -0.7, 0.3))]
        one, other = self.built(*scans), self.built(*reversed(scans))
        assert torch.equal(self.ask(one, lattice(dim)), self.ask(other, lattice(dim)))
        assert one.nbytes == other.nbytes

    def test_the_chunk_size_does_not_matter(self, monkeypatch):
        scans = [wall_scan(2, seed) for seed in range(6)]
        whole = self.ask(self.built(*scans), lattice(2))
        monkeypatch.setattr("gmmtorch.baselines.occupancy_grid._CHUNK_RAYS", 300)
        assert torch.equal(self.ask(self.built(*scans), lattice(2)), whole)


class TestOccupancyGridByCounts(GridContract):
    def make(self) -> OccupancyGrid:
        return OccupancyGrid(RESOLUTION)

    @pytest.mark.parametrize("dim", [2, 3])
    def test_occupancy_equals_that_of_dense_evidence(self, dim):
        scans = [wall_scan(dim), open_scan(dim), wall_scan(dim, 1, (1.314453125, -0.685546875, 0.298828125))]
        dense = Evidence.empty(VoxelGrid.covering([-2.0] * dim, [6.0] * dim, RESOLUTION))
        for scan in scans:
            ends, is_hit = scan.ends()
            dense.add_rays(scan.origin.expand(len(ends), -1), ends, None, is_hit)
        assert torch.equal(self.ask(self.built(*scans), lattice(dim)), dense.lookup(lattice(dim)))


class TestOccupancyGridByLogOdds(GridContract):
    def make(self) -> OccupancyGrid:
        return OccupancyGrid(RESOLUTION, log_odds=LogOdds())

    def test_each_beam_adds_its_update_to_the_log_odds(self):
        made, counts = self.built(wall_scan(2)), OccupancyGrid(RESOLUTION)
        counts.insert(wall_scan(2))
        hits, misses = counts.evidence().at_points(lattice(2))
        odds = (0.9 / 0.1) ** hits * (0.4 / 0.6) ** misses
        torch.testing.assert_close(self.ask(made, lattice(2)), odds / (1 + odds), rtol=1e-9, atol=1e-15)


# -- invalid input ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("resolution", [0, -0.1, math.nan, math.inf])
def test_occupancy_grid_rejects_an_invalid_resolution(resolution):
    with pytest.raises(InvalidArgumentError, match="resolution"):
        OccupancyGrid(resolution)


@pytest.mark.parametrize("prior", [-1.0, math.nan, math.inf])
def test_occupancy_grid_rejects_an_invalid_prior(prior):
    with pytest.raises(InvalidArgumentError, match="prior"):
        OccupancyGrid(0.1, prior=prior)


@pytest.mark.parametrize("rule", [{"hit": math.nan}, {"miss": math.inf}])
def test_log_odds_rejects_values_that_are_not_finite(rule):
    with pytest.raises(InvalidArgumentError, match=next(iter(rule))):
        OccupancyGrid(0.1, log_odds=LogOdds(**rule))


def valid_file() -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Content of a file: one block of 16² cells at the origin; one cell has two hits and one miss."""
    observed = torch.zeros(1, 32, dtype=torch.uint8)
    observed[0, 0] = 0b1000_0000
    tensors = {
        "anchor": torch.zeros(2, dtype=torch.int64),
        "keys": torch.tensor([(1 << 30) * ((1 << 31) + 1)]),
        "observed": observed,
        "hits": torch.tensor([2], dtype=torch.uint8),
        "misses": torch.tensor([1], dtype=torch.uint8),
    }
    return tensors, {"resolution": 0.5, "dim": 2, "prior": 1.0}


def load_file(folder: Path, tensors: dict[str, Tensor], facts: dict[str, Any]) -> OccupancyGrid:
    path = folder / "grid.safetensors"
    path.write_bytes(pack_tensors(tensors, "gmmtorch.occupancy_grid", 1, **facts))
    return OccupancyGrid.load(path)


@pytest.mark.parametrize(
    "change",
    [
        {"hits": torch.tensor([math.nan])},
        {"hits": torch.tensor([math.inf])},
        {"hits": torch.tensor([-1.0])},
        {"hits": torch.tensor([2, 2], dtype=torch.uint8)},
        {"misses": torch.tensor([math.nan], dtype=torch.float64)},
        {"misses": torch.tensor([-1], dtype=torch.int16)},
        {"misses": torch.tensor([[1]], dtype=torch.uint8)},
        {"observed": torch.zeros(1, 31, dtype=torch.uint8)},
        {"observed": torch.zeros(2, 32, dtype=torch.uint8)},
        {"keys": torch.tensor([5, 5])},
        {"keys": torch.tensor([5], dtype=torch.int32)},
        {"anchor": torch.zeros(3, dtype=torch.int64)},
    ],
    ids=lambda c: next(iter(c)),
)
def test_occupancy_grid_load_rejects_damaged_tensors(tmp_path, change):
    tensors, facts = valid_file()
    with pytest.raises(DataError, match=r"grid\.safetensors"):
        load_file(tmp_path, {**tensors, **change}, facts)


@pytest.mark.parametrize("name", ["anchor", "keys", "observed", "hits", "misses"])
def test_occupancy_grid_load_rejects_missing_tensors(tmp_path, name):
    tensors, facts = valid_file()
    tensors.pop(name)
    with pytest.raises(DataError, match=r"grid\.safetensors"):
        load_file(tmp_path, tensors, facts)


@pytest.mark.parametrize(
    "change",
    [
        {"resolution": 0},
        {"resolution": "wide"},
        {"resolution": None},
        {"dim": 4},
        {"dim": [2]},
        {"prior": -1.0},
        {"prior": "much"},
        {"prior": None},
        {"log_odds": {"hit": "x"}},
        {"log_odds": {"unheard": 1}},
        {"log_odds": 3},
        {"log_odds": {"hit": None}},
    ],
    ids=str,
)
def test_occupancy_grid_load_rejects_damaged_settings(tmp_path, change):
    tensors, facts = valid_file()
    with pytest.raises(DataError, match=r"grid\.safetensors"):
        load_file(tmp_path, tensors, {**facts, **change})
