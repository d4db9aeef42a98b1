"""Point files in chunks: every format against the written points, bounded reads, and damaged files."""

from __future__ import annotations

import importlib.util
import struct
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
import torch
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.datasets import PointChunks, in_memory, merge_surveys, open_points, survey
from gmmtorch.datasets.point_files.point_chunks import row_uniform
from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError

N = 23
POINTS = np.random.default_rng(0).normal(size=(N, 3)).astype(np.float32)
POINTS[4] = np.nan
POINTS[9, 1] = np.inf
VALID = np.delete(POINTS, [4, 9], 0).astype(np.float64)

needs_laspy = pytest.mark.skipif(
    importlib.util.find_spec("laspy") is None or importlib.util.find_spec("lazrs") is None,
    reason="laspy and lazrs are not installed",
)


def pcd(points: np.ndarray, kind: str) -> bytes:
    """float32 fields x, y, z after a label of one byte, with three bytes of padding between y and z."""
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS label x y _ z\nSIZE 1 4 4 1 4\nTYPE U F F U F\nCOUNT 1 1 1 3 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA {kind}\n"
    ).encode()
    if kind == "ascii":
        return header + "".join(f"7 {x!r} {y!r} 0 0 0 {z!r}\n" for x, y, z in points.tolist()).encode()
    return header + b"".join(struct.pack("<Bff3xf", 7, *p) for p in points)


def ply(points: np.ndarray, form: str) -> bytes:
    """Doubles z, x, y after a colour; an element of two integers before the vertices and faces after them."""
    header = (
        f"ply\nformat {form} 1.0\ncomment made here\nelement camera 2\nproperty short id\n"
        f"element vertex {len(points)}\nproperty uchar red\nproperty double z\nproperty float64 x\n"
        "property double y\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    if form == "ascii":
        rows = "".join(f"255 {z!r} {x!r} {y!r}\n" for x, y, z in points.tolist())
        return header + f"1\n2\n{rows}3 0 1 2\n".encode()
    order = ">" if form == "binary_big_endian" else "<"
    rows = b"".join(struct.pack(f"{order}Bddd", 255, z, x, y) for x, y, z in points.tolist())
    return header + struct.pack(f"{order}hh", 1, 2) + rows + struct.pack(f"{order}Biii", 3, 0, 1, 2)


def written(folder: Path, name: str) -> Path:
    """Writes POINTS in the format given by the file name."""
    path = folder / name
    form = path.stem
    if name.endswith(".npy"):
        np.save(path, np.asfortranarray(POINTS) if form == "fortran" else POINTS)
    elif name.endswith(".pcd"):
        path.write_bytes(pcd(POINTS, form))
    elif name.endswith(".ply"):
        path.write_bytes(ply(POINTS, form))
    else:
        import laspy

        cloud = laspy.create(point_format=3, file_version="1.2")
        cloud.header.scales, cloud.header.offsets = [1e-9] * 3, [0.0] * 3
        cloud.x, cloud.y, cloud.z = VALID.T  # LAS stores integers (here nanometres), so no NaN
        cloud.write(path)
    return path


TEXT = ["ascii.pcd", "ascii.ply"]
RECORDS = ["binary.pcd", "binary_little_endian.ply", "binary_big_endian.ply"]
FILES = [
    *["c.npy", "fortran.npy"],
    *RECORDS,
    *TEXT,
    *[pytest.param(name, marks=needs_laspy) for name in ("a.las", "a.laz")],
]


def read_all(source: PointChunks) -> tuple[np.ndarray, np.ndarray, int]:
    chunks = list(source)
    points = torch.cat([chunk.points for chunk in chunks])
    assert points.dtype == torch.float64
    assert all(chunk.points.shape[0] <= source.chunk_points for chunk in chunks)
    rows = torch.cat([chunk.rows for chunk in chunks])
    return points.numpy(), rows.numpy(), sum(chunk.n_dropped for chunk in chunks)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("chunk_points", [1, 5, 1000])
def test_every_format_returns_the_valid_points_in_order(tmp_path, name, chunk_points):
    source = open_points(written(tmp_path, name), chunk_points=chunk_points)
    for _ in range(2):  # a source can be read repeatedly
        points, rows, n_dropped = read_all(source)
        np.testing.assert_allclose(points, VALID, rtol=0, atol=1e-9 if name.startswith("a.") else 0)
        if not name.startswith("a."):
            assert n_dropped == 2
            assert rows.tolist() == [i for i in range(N) if i not in (4, 9)]
    assert source.dim == 3
    assert source.name == Path(name).stem


@pytest.mark.parametrize("name", FILES)
def test_shards_are_contiguous_and_cover_all_rows(tmp_path, name):
    source = open_points(written(tmp_path, name), chunk_points=4)
    shards = [source.shard(i, 3) for i in range(3)]
    assert sum(shard.n_rows for shard in shards) == source.n_rows
    assert max(shard.n_rows for shard in shards) - min(shard.n_rows for shard in shards) <= 1
    for got, expected in zip(
        zip(*[read_all(shard)[:2] for shard in shards], strict=True), read_all(source)[:2], strict=True
    ):
        np.testing.assert_array_equal(np.concatenate(got), expected)


@needs_laspy
@given(cut=st.integers(0, 1 << 16), name=st.sampled_from(["c.npy", "a.las", "a.laz"]))
def test_a_file_cut_at_any_byte_is_an_error(tmp_path, cut, name):
    path = written(tmp_path, name)
    data = path.read_bytes()
    path.write_bytes(data[: cut % len(data)])
    with pytest.raises(DataError, match=str(path)):
        list(open_points(path))


@pytest.mark.parametrize("suffix", [".npy", ".pcd", ".ply", pytest.param(".las", marks=needs_laspy)])
@pytest.mark.parametrize("data", [b"", b"\x89PNG\r\n\x1a\n" + bytes(300), b"x y z\n1 2 3\n"])
def test_open_points_rejects_other_content(tmp_path, suffix, data):
    path = tmp_path / f"foreign{suffix}"
    path.write_bytes(data)
    with pytest.raises(DataError, match=str(path)):
        list(open_points(path))


def chunk_table(data: bytes) -> int:
    """The byte at which the table of chunks of a LAZ file begins."""
    return int(struct.unpack_from("<q", data, struct.unpack_from("<I", data, 96)[0])[0])


@needs_laspy
@pytest.mark.parametrize(
    ("names", "place", "content", "message"),
    [
        ("las laz", 103, b"\xff", "variable-length records"),
        ("las laz", 96, b"\xff\xff\xff\x7f", "byte 2147483647"),
        ("las laz", 105, b"\x01\x00", "[Pp]oint"),
        ("las laz", 25, b"\x09", r"1\.9"),
        ("las laz", 131, struct.pack("<d", 0.0), "scales"),
        ("las laz", 139, struct.pack("<d", float("nan")), "scales"),
        ("las laz", 155, struct.pack("<d", float("inf")), "offsets"),
        ("las", 107, b"\xff" * 4, "4294967295 points"),
        ("laz", lambda data: chunk_table(data) + 4, b"\0\0\0\x80", "2147483648 chunks"),
        ("laz", lambda data: data.index(b"laszip encoded") + 64, b"\0\0\0\x80", "2,147,483,648 points"),
    ],
)
def test_a_las_header_is_checked_before_anything_is_allocated(tmp_path, names, place, content, message):
    for name in names.split():
        path = written(tmp_path, f"a.{name}")
        data = bytearray(path.read_bytes())
        at = place if isinstance(place, int) else place(data)
        data[at : at + len(content)] = content
        path.write_bytes(data)
        with pytest.raises(DataError, match=message):
            open_points(path)


@needs_laspy
def test_every_damaged_byte_of_the_chunk_table_of_a_laz_file_is_survived(tmp_path):
    """The table is compressed. A wrong length of a chunk made the decompressor panic or run out of memory."""
    path = written(tmp_path, "a.laz")
    data = path.read_bytes()
    refused = 0
    for place in range(chunk_table(data), len(data)):
        for byte in (0, 127, 255):
            path.write_bytes(data[:place] + bytes([byte]) + data[place + 1 :])
            try:
                list(open_points(path))
            except DataError:
                refused += 1
    assert refused > 10


@pytest.mark.parametrize("header", ["{'descr': '<f8', 'shape': (2, 3), ", "((((((", "{}"])
def test_open_points_rejects_an_npy_header_that_cannot_be_parsed(tmp_path, header):
    path = tmp_path / "a.npy"
    text = header.ljust(117).encode() + b"\n"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + bytes(48))
    with pytest.raises(DataError, match="cannot be read as a NumPy array"):
        open_points(path)


def test_open_points_rejects_an_archive_of_arrays(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.zeros((2, 3)))
    (tmp_path / "a.npz").rename(tmp_path / "a.npy")
    with pytest.raises(DataError, match="zip archive"):
        open_points(tmp_path / "a.npy")


@pytest.mark.parametrize(
    "array",
    [
        np.zeros(3),
        np.zeros((2, 0)),
        np.zeros((2, 3), complex),
        np.zeros((2, 2, 2)),
        np.array([["a", "b"]]),
        np.array([{"a": 1}], dtype=object),
    ],
    ids=["one axis", "no column", "complex", "three axes", "text", "pickled"],
)
def test_open_points_rejects_arrays_of_other_shapes_and_types(tmp_path, array):
    path = tmp_path / "odd.npy"
    np.save(path, array)
    with pytest.raises(DataError, match="odd"):
        open_points(path)


def test_masked_and_sparse_arrays_are_errors_that_name_the_remedy():
    with pytest.raises(InvalidArgumentError, match=r"^points is a masked array"):
        in_memory(np.ma.masked_less(np.ones((3, 2)), 2.0))
    with pytest.raises(InvalidArgumentError, match=r"^points is sparse, a csr_array; give points.toarray"):
        in_memory(scipy.sparse.csr_array(np.ones((3, 2))))


def test_open_points_rejects_missing_files_and_unknown_suffixes(tmp_path):
    with pytest.raises(MissingDataError, match="does not exist"):
        open_points(tmp_path / "none.npy")
    with pytest.raises(InvalidArgumentError, match=r"\.xyz"):
        open_points(tmp_path / "cloud.xyz")
    (tmp_path / "folder.npy").mkdir()
    with pytest.raises(MissingDataError, match="is not a file"):
        open_points(tmp_path / "folder.npy")


@pytest.mark.parametrize("options", [{"chunk_points": 0}, {"max_range": 0.0}, {"max_range": float("nan")}])
def test_open_points_rejects_invalid_options(tmp_path, options):
    with pytest.raises(InvalidArgumentError, match=next(iter(options))):
        open_points(written(tmp_path, "c.npy"), **options)


def test_points_at_or_beyond_max_range_are_dropped_and_counted():
    points = torch.tensor([[3.0, 4.0], [0.0, 4.9], [6.0, 0.0]], dtype=torch.float64)
    source = PointChunks(in_memory(points).rows, max_range=5.0)
    (chunk,) = source
    assert chunk.points.tolist() == [[0.0, 4.9]]
    assert chunk.n_dropped == 2


# -- surveys --------------------------------------------------------------------------------------


@given(
    n=st.integers(0, 60),
    chunk_points=st.integers(1, 70),
    n_shards=st.integers(1, 5),
    wanted=st.one_of(st.none(), st.integers(1, 70)),
    seed=st.integers(0, 2**32),
)
def test_a_survey_does_not_depend_on_chunks_or_shards(n, chunk_points, n_shards, wanted, seed):
    points = np.random.default_rng(n).normal(size=(n, 2))
    points[::7] = np.nan
    valid = points[np.isfinite(points).all(1)]
    source = in_memory(points, chunk_points=chunk_points)
    whole = survey(in_memory(points), wanted, seed)
    merged = merge_surveys([survey(source.shard(i, n_shards), wanted, seed) for i in range(n_shards)], wanted)
    for found in (whole, merged):
        assert (found.n_points, found.n_dropped) == (len(valid), n - len(valid))
        np.testing.assert_allclose(found.total.numpy(), valid.sum(0), atol=1e-12)
        if len(valid):
            assert found.low.tolist() == valid.min(0).tolist()
            assert found.high.tolist() == valid.max(0).tolist()
        assert found.points.shape[0] == (len(valid) if wanted is None else min(wanted, len(valid)))
    assert torch.equal(whole.sample, merged.sample)
    assert whole.checksum == merged.checksum
    assert {tuple(row) for row in whole.points.tolist()} <= {tuple(row) for row in valid.tolist()}


def test_the_checksum_depends_on_every_coordinate_and_row():
    points = torch.randn(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    before = survey(in_memory(points)).checksum
    swapped = points[torch.arange(50).roll(1)]
    nudged = points.clone()
    nudged[7, 2] = torch.nextafter(nudged[7, 2], torch.tensor(9.0).double())
    turned = points[:, [1, 0, 2]]
    for other in (swapped, nudged, turned, points[:-1]):
        assert survey(in_memory(other)).checksum != before


def test_the_sample_draws_every_point_equally_often():
    points = torch.arange(40.0)[:, None]
    counts = torch.zeros(40)
    for seed in range(600):
        counts[survey(in_memory(points), 10, seed).points[:, 0].long()] += 1
    assert counts.sum() == 6000
    assert (counts - 150).abs().max() < 5 * (600 * 0.25 * 0.75) ** 0.5  # five standard deviations


def test_row_uniform_is_uniform_and_independent_between_seeds():
    rows = torch.arange(100_000)
    first, second = row_uniform(rows, 0), row_uniform(rows, 1)
    assert float(first.min()) >= 0
    assert float(first.max()) < 1
    counts = torch.histc(first, 50, 0, 1)
    assert float(((counts - 2000) ** 2 / 2000).sum()) < 100  # χ² with 49 degrees: 1e-5 beyond
    for other in (second, first.roll(1)):
        assert abs(float(torch.corrcoef(torch.stack([first, other]))[0, 1])) < 0.02


def test_random_subsets_of_disjoint_intervals_partition_the_rows():
    source = in_memory(torch.randn(1000, 2), chunk_points=64)
    rows = [read_all(source.random_subset(low, high, 3))[1] for low, high in ((0, 0.1), (0.1, 1))]
    assert sorted(np.concatenate(rows).tolist()) == list(range(1000))
    assert 60 < len(rows[0]) < 140
    with pytest.raises(InvalidArgumentError, match="already a random subset"):
        source.random_subset(0, 0.5, 1).random_subset(0, 0.5, 1)
