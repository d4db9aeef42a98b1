"""Octree files of other programs: answers against OctoMap's own, and files that are refused before OctoMap
reads them."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from gmmtorch.errors import DataError, MissingDataError
from gmmtorch.experiments.baselines.octomap_map import OctoMapMap
from gmmtorch.experiments.baselines.octree_files import parsed_octree
from gmmtorch.scan import Scan

pyoctomap = pytest.importorskip("pyoctomap")


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
