"""OctoMap behind the protocol: its update rule computed separately, and files that are read or refused."""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from occupancy.protocol_contract import RESOLUTION, OccupancyMapContract, lattice, open_scan, wall_scan

from gmmtorch import OccupancyGrid, Scan
from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError
from gmmtorch.experiments.baselines.octomap_map import OctoMapMap, parsed_octree

pyoctomap = pytest.importorskip("pyoctomap")


class TestOctoMapMap(OccupancyMapContract):
    thins_scans = True

    def make(self) -> OctoMapMap:
        return OctoMapMap(RESOLUTION)


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


def tree_of(n_points: int = 40, resolution: float = 0.1):
    """An octree with hits in the unit cube and misses on the way, pruned."""
    draw = np.random.default_rng(0)
    tree = pyoctomap.OcTree(resolution)
    tree.insertPointCloud(draw.random((n_points, 3)), np.array([0.5, 0.5, 0.5]))
    return tree


def file_of(tree, path: Path) -> Path:
    path.write_bytes(tree.writeBinary() if path.suffix == ".bt" else tree.write())
    return path


def header(size: object = 1, resolution: object = 0.1, kind: str = "OcTree", binary: bool = False) -> bytes:
    first = "# Octomap OcTree binary file" if binary else "# Octomap OcTree file"
    return f"{first}\n# a comment\n#\nid {kind}\nsize {size}\nres {resolution}\ndata\n".encode()


@pytest.mark.parametrize("suffix", [".ot", ".bt"])
def test_an_imported_tree_answers_as_octomap_does(tmp_path, suffix):
    tree = tree_of()
    found = OctoMapMap.from_octree(file_of(tree, tmp_path / f"a{suffix}"))
    points = np.random.default_rng(1).random((500, 3)) * 1.4 - 0.2
    nodes = [tree.search(point) for point in points]
    if suffix == ".ot":
        expected = [0.5 if node is None else node.getOccupancy() for node in nodes]
    else:
        expected = [
            0.5 if node is None else found.clamp_high if tree.isNodeOccupied(node) else found.clamp_low
            for node in nodes
        ]
    assert set(np.round(expected, 6)) > {0.5}
    np.testing.assert_allclose(found.occupancy(points), expected, atol=1e-6)
    assert (found.resolution, found.dim) == (pytest.approx(0.1), 3)


def test_an_imported_tree_learns_and_is_saved(tmp_path):
    made = OctoMapMap.from_octree(file_of(tree_of(), tmp_path / "a.bt"))
    made.insert(Scan([[3.05, 0.05, 0.05]], [0.05, 0.05, 0.05]))
    made.save(tmp_path / "b.ot")
    points = [[3.05, 0.05, 0.05], [2.05, 0.05, 0.05], [9.0, 0.0, 0.0]]
    assert made.occupancy(points)[0] > 0.5 > made.occupancy(points)[1]
    np.testing.assert_array_equal(
        OctoMapMap.load(tmp_path / "b.ot").occupancy(points), made.occupancy(points)
    )


@pytest.mark.parametrize("suffix", [".ot", ".bt"])
def test_an_empty_tree_is_unknown_everywhere(tmp_path, suffix):
    found = OctoMapMap.from_octree(file_of(pyoctomap.OcTree(0.1), tmp_path / f"a{suffix}"))
    assert found.occupancy([[0.0, 0.0, 0.0]]).tolist() == [0.5]


@pytest.mark.parametrize("suffix", [".ot", ".bt"])
def test_a_tree_that_is_cut_off_or_too_long_is_refused(tmp_path, suffix):
    path = file_of(tree_of(3), tmp_path / f"a{suffix}")
    whole = path.read_bytes()
    for length in [*range(0, len(whole), 7), len(whole) - 1]:
        path.write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"a\.[ob]t"):
            parsed_octree(path.read_bytes(), path)
    for more in (b"\0", bytes(10)):
        path.write_bytes(whole + more)
        with pytest.raises(DataError, match=r"a\.[ob]t"):
            parsed_octree(path.read_bytes(), path)


DEEP = struct.pack("<fB", 0.0, 1)
DEEP_BINARY = struct.pack("<H", 3)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"hello", "does not begin as OctoMap"),
        (header(kind="ColorOcTree") + DEEP, "ColorOcTree"),
        (header(size="many") + DEEP, "header is damaged"),
        (header(resolution=-1) + DEEP, "header is damaged"),
        (header(resolution="nan") + DEEP, "header is damaged"),
        (header()[:-6], "header is damaged"),
        (header(size=1 << 40) + DEEP, "at most 33,554,432"),
        (header(size=2) + struct.pack("<fB", 0.0, 0), "announces 2 nodes, but has 1"),
        (header(size=0) + struct.pack("<fB", 0.0, 0), "announces 0 nodes, but has 1"),
        (header(size=0, binary=True) + DEEP_BINARY + bytes(2), "announces 0 nodes, but has 2"),
        (header(size=1), "announces 1 nodes, but has 0"),
        (header(size=1) + struct.pack("<fB", float("nan"), 0), "finite probability"),
        (header(size=18) + DEEP * 17 + struct.pack("<fB", 0.0, 0), "deeper than 16"),
        (header(size=18, binary=True) + DEEP_BINARY * 17, "deeper than 16"),
        (header(size=200_000, binary=True) + DEEP_BINARY * 200_000, "deeper than 16"),
        (header(size=2, binary=True) + DEEP_BINARY, "ends before its tree"),
        (header(size=1, binary=True) + bytes(4), "after its tree"),
    ],
)
def test_other_and_hostile_files_are_refused(tmp_path, content, words):
    path = tmp_path / "a.ot"
    path.write_bytes(content)
    with pytest.raises(DataError, match=words):
        OctoMapMap.from_octree(path)


def test_the_deepest_tree_is_read(tmp_path):
    leaf = struct.pack("<fB", 2.0, 0)
    assert parsed_octree(header(size=17) + DEEP * 16 + leaf, "a.ot")[0].size() == 17


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(MissingDataError, match=r"none\.bt"):
        OctoMapMap.from_octree(tmp_path / "none.bt")
