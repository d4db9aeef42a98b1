"""Every map keeps the contract of `occupancy.protocol_contract`; and what is a grid's alone."""

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
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import IncrementalRule, WindowedRule
from gmmtorch.occupancy.evidence import Evidence
from gmmtorch.occupancy.grid import VoxelGrid


class TestGaussianMapOneOrigin(OccupancyMapContract):
    """The thesis's map: one mixture a scan, one origin a component."""

    shift_tolerance = 1e-3
    turn_tolerance = 0.05

    def make(self) -> GaussianMap:
        return GaussianMap(WindowedRule(window=1, max_origins=1), resolution=RESOLUTION, n_samples=20_000)


class TestGaussianMapWindowed(OccupancyMapContract):
    shift_tolerance = 1e-3
    turn_tolerance = 0.05

    def make(self) -> GaussianMap:
        return GaussianMap(WindowedRule(), resolution=RESOLUTION, n_samples=20_000)


class TestGaussianMapIncremental(OccupancyMapContract):
    """The default: merged as it grows."""

    shift_tolerance = 1e-3
    turn_tolerance = 0.05

    def make(self) -> GaussianMap:
        return GaussianMap(resolution=RESOLUTION, n_samples=20_000)


class TestGaussianMapUnderABudget(OccupancyMapContract):
    shift_tolerance = 1e-3
    turn_tolerance = 0.05

    def make(self) -> GaussianMap:
        return GaussianMap(IncrementalRule(window=2, max_bytes=1000), resolution=RESOLUTION)


class GridContract(OccupancyMapContract):
    """Grids answer with counts, so order and portions may not matter at all."""

    @pytest.mark.parametrize("dim", [2, 3])
    def test_the_order_of_the_scans_does_not_matter(self, dim):
        scans = [wall_scan(dim), open_scan(dim), wall_scan(dim, 1, (1.3, -0.7, 0.3))]
        one, other = self.built(*scans), self.built(*reversed(scans))
        assert torch.equal(self.ask(one, lattice(dim)), self.ask(other, lattice(dim)))
        assert one.nbytes == other.nbytes

    def test_many_scans_are_counted_in_portions(self, monkeypatch):
        scans = [wall_scan(2, seed) for seed in range(6)]
        whole = self.ask(self.built(*scans), lattice(2))
        monkeypatch.setattr("gmmtorch.baselines.occupancy_grid._RAYS_AT_ONCE", 300)
        assert torch.equal(self.ask(self.built(*scans), lattice(2)), whole)


class TestOccupancyGridByCounts(GridContract):
    def make(self) -> OccupancyGrid:
        return OccupancyGrid(RESOLUTION)

    @pytest.mark.parametrize("dim", [2, 3])
    def test_its_answers_are_those_of_dense_evidence(self, dim):
        scans = [wall_scan(dim), open_scan(dim), wall_scan(dim, 1, (1.314453125, -0.685546875, 0.298828125))]
        dense = Evidence.empty(VoxelGrid.covering([-2.0] * dim, [6.0] * dim, RESOLUTION))
        for scan in scans:
            ends, is_hit = scan.ends()
            dense.add_rays(scan.origin.expand(len(ends), -1), ends, None, is_hit)
        assert torch.equal(self.ask(self.built(*scans), lattice(dim)), dense.lookup(lattice(dim)))


class TestOccupancyGridByLogOdds(GridContract):
    def make(self) -> OccupancyGrid:
        return OccupancyGrid(RESOLUTION, log_odds=LogOdds())

    def test_every_beam_adds_its_update_to_the_log_odds(self):
        made, counts = self.built(wall_scan(2)), OccupancyGrid(RESOLUTION)
        counts.insert(wall_scan(2))
        hits, misses = counts.evidence().at_points(lattice(2))
        odds = (0.9 / 0.1) ** hits * (0.4 / 0.6) ** misses
        torch.testing.assert_close(self.ask(made, lattice(2)), odds / (1 + odds), rtol=1e-9, atol=1e-15)


# -- a grid's own ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("resolution", [0, -0.1, math.nan, math.inf])
def test_a_grid_refuses_a_resolution_that_is_none(resolution):
    with pytest.raises(InvalidArgumentError, match="resolution"):
        OccupancyGrid(resolution)


@pytest.mark.parametrize("prior", [-1.0, math.nan, math.inf])
def test_a_grid_refuses_a_prior_that_is_no_count_when_it_is_made(prior):
    with pytest.raises(InvalidArgumentError, match="prior"):
        OccupancyGrid(0.1, prior=prior)


@pytest.mark.parametrize("rule", [{"hit": math.nan}, {"miss": math.inf}])
def test_log_odds_that_are_no_numbers_are_refused_when_they_are_given(rule):
    with pytest.raises(InvalidArgumentError, match=next(iter(rule))):
        OccupancyGrid(0.1, log_odds=LogOdds(**rule))


def sound_parts() -> tuple[dict[str, Tensor], dict[str, Any]]:
    """One block of 16² cells at the origin, in which one cell was hit twice and missed once."""
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


def load_parts(folder: Path, tensors: dict[str, Tensor], facts: dict[str, Any]) -> OccupancyGrid:
    path = folder / "grid.safetensors"
    path.write_bytes(pack_tensors(tensors, "gmmtorch.occupancy_grid", 1, **facts))
    return OccupancyGrid.load(path)


def test_the_parts_that_the_hostile_files_start_from_are_sound(tmp_path):
    made = load_parts(tmp_path, *sound_parts())
    query = torch.tensor([[0.25, 0.25], [0.75, 0.25], [-0.25, 0.25]], dtype=torch.float64)
    assert made.occupancy(query).tolist() == [3 / 5, 0.5, 0.5]


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
def test_a_grid_file_whose_numbers_are_damaged_is_refused(tmp_path, change):
    tensors, facts = sound_parts()
    with pytest.raises(DataError, match=r"grid\.safetensors"):
        load_parts(tmp_path, {**tensors, **change}, facts)


@pytest.mark.parametrize("name", ["anchor", "keys", "observed", "hits", "misses"])
def test_a_grid_file_that_lacks_a_tensor_is_refused(tmp_path, name):
    tensors, facts = sound_parts()
    tensors.pop(name)
    with pytest.raises(DataError, match=r"grid\.safetensors"):
        load_parts(tmp_path, tensors, facts)


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
def test_a_grid_file_whose_settings_are_damaged_is_refused(tmp_path, change):
    tensors, facts = sound_parts()
    with pytest.raises(DataError, match=r"grid\.safetensors"):
        load_parts(tmp_path, tensors, {**facts, **change})
