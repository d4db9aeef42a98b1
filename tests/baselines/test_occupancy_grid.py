"""OccupancyGrid: the map contract, dense evidence, log-odds by formula, and damaged files."""

from __future__ import annotations

import math
from typing import ClassVar

import pytest
import torch
from baselines.tensor_file_contract import TensorFileContract
from occupancy.protocol_contract import RESOLUTION, lattice, open_scan, wall_scan

from gmmtorch.occupancy import Evidence, LogOdds, OccupancyGrid, VoxelGrid


class GridContract(TensorFileContract):
    """Counts are additive, so the order of scans and the chunk size do not matter."""

    damage: ClassVar = {
        "hits": [
            *(lambda v, x=x: v.double() * 0 + x for x in (math.nan, math.inf, -1.0)),
            lambda v: v.repeat(2),
        ],
        "misses": [lambda v: v.double() * math.nan, lambda v: -v.short() - 1, lambda v: v[:, None]],
        "observed": [lambda v: v[:, :-1], lambda v: v.repeat(2, 1)],
        "keys": [torch.zeros_like, lambda v: v.int()],
        "anchor": [lambda v: v.new_zeros(3)],
    }
    damaged_settings: ClassVar = [
        *({"resolution": value} for value in (0, "wide", None)),
        *({"prior": value} for value in (-1.0, "much", None)),
        *({"log_odds": value} for value in ({"hit": "x"}, {"unheard": 1}, 3, {"hit": None})),
    ]

    @pytest.mark.parametrize("dim", [2, 3])
    def test_the_order_of_the_scans_does_not_matter(self, dim):
        scans = [wall_scan(dim), open_scan(dim), wall_scan(dim, 1, (1.3, -0.7, 0.3))]
        one, other = self.built(*scans), self.built(*reversed(scans))
        assert torch.equal(self.ask(one, lattice(dim)), self.ask(other, lattice(dim)))
        assert one.nbytes == other.nbytes

    def test_the_chunk_size_does_not_matter(self, monkeypatch):
        scans = [wall_scan(2, seed) for seed in range(6)]
        whole = self.ask(self.built(*scans), lattice(2))
        monkeypatch.setattr("gmmtorch.occupancy.occupancy_grid._CHUNK_RAYS", 300)
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
