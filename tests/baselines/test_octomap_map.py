"""OctoMap behind the protocol: the map contract, and its update rule computed separately."""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path

import pytest
import torch
from occupancy.protocol_contract import RESOLUTION, OccupancyMapContract, lattice, open_scan, wall_scan

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.experiments.baselines.octomap_map import OctoMapMap
from gmmtorch.occupancy.occupancy_grid import OccupancyGrid
from gmmtorch.scan import Scan

pyoctomap = pytest.importorskip("pyoctomap")


class TestOctoMapMap(OccupancyMapContract):
    thins_scans = True

    def make(self) -> OctoMapMap:
        return OctoMapMap(RESOLUTION)


class TestOctoMapMapByRay(OccupancyMapContract):
    def make(self) -> OctoMapMap:
        return OctoMapMap(RESOLUTION, by_ray=True)


def log_odds(p: float) -> float:
    return math.log(p / (1 - p))


def one_scan_probability(hits: torch.Tensor, misses: torch.Tensor) -> torch.Tensor:
    """OctoMap's sensor model for one scan: one hit for a cell with hits, otherwise one miss."""
    value = torch.where(hits > 0, log_odds(0.7), log_odds(0.4))
    return torch.where(hits + misses > 0, torch.sigmoid(value), 0.5)


@pytest.mark.parametrize("dim", [2, 3])
def test_one_scan_updates_each_cell_once(dim):
    scan = wall_scan(dim)
    both = Scan(scan.points, scan.origin, open_scan(dim).no_return + torch.tensor([0.0, 0.5, 0.0])[:dim])
    for given in (scan, open_scan(dim), both):
        counts = OccupancyGrid(RESOLUTION)
        counts.insert(given)
        ends = given.ends()[0]
        query = torch.cat([lattice(dim), ends, (ends + given.origin) / 2])
        hits, misses = counts.evidence().at_points(query)
        made = OctoMapMap(RESOLUTION)
        made.insert(given)
        expected = one_scan_probability(hits, misses).double()
        wrong = (made.occupancy(query) - expected).abs() > 1e-6
        # OctoMap traverses in float32, so a ray that touches a corner can enter another cell.
        assert float(wrong.double().mean()) < 0.01
        assert len(expected.unique()) >= 2


def test_by_ray_updates_a_cell_once_per_beam():
    end, origin = torch.tensor([[1.0625, 0.1875, 0.0625]]).double(), torch.tensor([0.31, 0.19, 0.06]).double()
    scan = Scan(end.repeat(3, 1), origin)
    once, by_ray = OctoMapMap(RESOLUTION), OctoMapMap(RESOLUTION, by_ray=True)
    once.insert(scan)
    by_ray.insert(scan)
    between = (end + origin) / 2
    for point, p in ((end, 0.7), (between, 0.4)):
        assert float(once.occupancy(point)[0]) == pytest.approx(p, abs=1e-6)
        expected = 1 / (1 + math.exp(-3 * log_odds(p)))
        assert float(by_ray.occupancy(point)[0]) == pytest.approx(expected, abs=1e-6)


def test_octomap_clamps_probabilities():
    made = OctoMapMap(RESOLUTION)
    for _ in range(30):
        made.insert(wall_scan(3))
    theta = made.occupancy(lattice(3))
    assert float(theta.max()) == pytest.approx(0.971, abs=1e-6)
    assert float(theta.min()) == pytest.approx(0.1192, abs=1e-6)


def test_beams_beyond_max_range_add_misses_only():
    made = OctoMapMap(RESOLUTION, max_range=1.5)
    made.insert(wall_scan(3))
    made.insert(open_scan(3))
    assert float(made.occupancy(lattice(3)).max()) == 0.5
    assert made.occupancy([[1.2, 0.19, 0.44], [2.5, 0.19, 0.44]]).tolist()[1] == 0.5
    assert made.occupancy([[1.2, 0.19, 0.44]])[0] < 0.5


# -- files -----------------------------------------------------------------------------------------------


def test_octomap_reads_the_file(tmp_path: Path):
    made = OctoMapMap(RESOLUTION)
    made.insert(wall_scan(3))
    made.save(tmp_path / "map.ot")
    tree = pyoctomap.OcTree(0.1).read(str(tmp_path / "map.ot"))
    assert tree.getResolution() == RESOLUTION
    shift = (wall_scan(3).origin / RESOLUTION).floor() * RESOLUTION  # the octree's centre
    nodes = [tree.search(x) for x in (lattice(3) - shift).numpy()]
    theta = [0.5 if node is None else node.getOccupancy() for node in nodes]
    assert made.occupancy(lattice(3)).tolist() == theta


def test_octomap_file_stores_the_settings_exactly(tmp_path: Path):
    made = OctoMapMap(0.123456789, hit=0.8, miss=0.3, clamp_low=0.05, clamp_high=0.99, max_range=7.0)
    made.insert(wall_scan(3))
    made.save(tmp_path / "map.ot")
    loaded = OctoMapMap.load(tmp_path / "map.ot")
    for each in (made, loaded):
        each.insert(wall_scan(3, 1))
    assert torch.equal(loaded.occupancy(lattice(3)), made.occupancy(lattice(3)))
    assert loaded.resolution == made.resolution
    assert len(made.occupancy(lattice(3)).unique()) == 3


def test_octomap_load_rejects_files_of_other_programs(tmp_path: Path):
    (tmp_path / "map.ot").write_bytes(pyoctomap.OcTree(0.1).write())
    with pytest.raises(DataError, match=r"map\.ot"):
        OctoMapMap.load(tmp_path / "map.ot")


def test_octomap_load_rejects_a_tree_that_would_end_the_process(tmp_path: Path):
    """OctoMap recurses as deep as a file says; a checksum does not show that its writer was honest."""
    made = OctoMapMap(RESOLUTION)
    made.insert(wall_scan(3))
    made.save(tmp_path / "map.ot")
    head, mark, rest = (tmp_path / "map.ot").read_bytes().partition(b"# gmmtorch.octomap_map 1 ")
    facts = rest[8:].partition(b"\n")[0]
    size = b"\nid OcTree\nsize 200000\nres 0.125\ndata\n"
    tail = facts + size + struct.pack("<fB", 0.0, 1) * 200_000
    (tmp_path / "map.ot").write_bytes(head + mark + b"%08x" % zlib.crc32(head + mark + tail) + tail)
    with pytest.raises(DataError, match="deeper than 16"):
        OctoMapMap.load(tmp_path / "map.ot")


# -- bad input -------------------------------------------------------------------------------------------


def test_a_beam_that_leaves_the_octree_is_rejected_without_a_change():
    made = OctoMapMap(0.01)
    made.insert(Scan(torch.tensor([[1.0, 0, 0]]), torch.zeros(3)))
    size = made.nbytes
    with pytest.raises(InvalidArgumentError, match="coarser"):
        made.insert(Scan(torch.tensor([[400.0, 0, 0]]), torch.zeros(3)))
    assert made.nbytes == size
