"""Points of PCD and PLY files: against libraries that others keep, and after any one corruption."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import plyfile
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scan_files import kitti, scan_folder

from gmmtorch.datasets import load
from gmmtorch.datasets.base import number_rows
from gmmtorch.datasets.point_files.point_chunks import open_points, read_cloud
from gmmtorch.errors import DataError

NOT_FINITE = [
    *["nan", "-nan", "NaN", "NAN", "inf", "-inf", "+Infinity", "-INF", "1e999"],
    *["1.#QNAN", "-1.#IND", "1.#INF", "-1.#INF", "1.#SNAN", "1.#QNAN0", "-1.#IND00", "1.#INF00e+000"],
    *["1.#J", "1.#R", "1.#IO", "1.$", "nan(ind)", "-nan(snan)", "nan(0x8000000000000)", "NaNQ"],
]
NO_NUMBERS = [
    *["1,5", "1.234,5", "1,#QNAN", "0x10", "0x1p3", "word", "1_0", "1.5.2", "--1", "1e", "1d5", "1.5f"],
    *["1.#", "nano", "infin", "#", "1;5", '"1"', "None", "True", "1\0", "１"],
]
TYPES = {"f4": "float", "f8": "double", "i4": "int", "i2": "short", "u1": "uchar"}
EXTRA = {"red": "u1", "ring": "i2", "intensity": "f4"}


@dataclass(frozen=True)
class Cloud:
    """A point file: fields (name → NumPy type), values (N, F) and form.

    before, after: records of other elements of a PLY file. lists: those after have lists.
    """

    kind: str
    form: str
    fields: dict[str, str]
    values: np.ndarray
    before: int = 0
    after: int = 0
    lists: bool = False

    @property
    def points(self) -> np.ndarray:
        return self.values[:, [list(self.fields).index(axis) for axis in "xyz"]]

    @property
    def order(self) -> str:
        return ">" if self.form == "binary_big_endian" else "<"

    def header(self) -> str:
        n = len(self.values)
        if self.kind == "pcd":
            codes = self.fields.values()
            rows = {
                "VERSION": "0.7",
                "FIELDS": " ".join(self.fields),
                "SIZE": " ".join(code[1] for code in codes),
                "TYPE": " ".join(code[0].upper() for code in codes),
                "COUNT": " ".join("1" for _ in codes),
            }
            end = f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA {self.form}\n"
            return "".join(f"{key} {value}\n" for key, value in rows.items()) + end
        properties = "".join(f"property {TYPES[code]} {name}\n" for name, code in self.fields.items())
        last = "property list uchar int vertex_indices\n" if self.lists else "property float weight\n"
        return (
            f"ply\nformat {self.form} 1.0\ncomment by a test\n"
            f"element camera {self.before}\nproperty short id\nelement vertex {n}\n{properties}"
            f"element face {self.after}\n{last}end_header\n"
        )

    def texts(self) -> list[list[str]]:
        """The words of each line."""
        rows = [[f"{value:g}" for value in row] for row in self.values]
        if self.kind == "pcd":
            return rows
        face = ["3", "0", "1", "2"] if self.lists else ["7"]
        return [*([["4"]] * self.before), *rows, *([face] * self.after)]

    def data(self) -> bytes:
        if self.form == "ascii":
            return "".join(" ".join(words) + "\n" for words in self.texts()).encode()
        record = np.dtype([(name, self.order + code) for name, code in self.fields.items()])
        rows = np.array([tuple(row) for row in self.values.tolist()], record).tobytes()
        if self.kind == "pcd":
            return rows
        face = (
            struct.pack(f"{self.order}Biii", 3, 0, 1, 2) if self.lists else struct.pack(f"{self.order}f", 7)
        )
        return struct.pack(f"{self.order}h", 4) * self.before + rows + face * self.after

    def write(self, folder: Path) -> Path:
        path = folder / f"a.{self.kind}"
        path.write_bytes(self.header().encode() + self.data())
        return path


@st.composite
def clouds(draw: st.DrawFn, forms: Sequence[tuple[str, str]]) -> Cloud:
    """Files of at least one point, whose numbers every type of a coordinate represents."""
    kind, form = draw(st.sampled_from(forms))
    extra = draw(st.lists(st.sampled_from(list(EXTRA)), unique=True))
    names = draw(st.permutations([*"xyz", *extra]))
    fields = {name: EXTRA.get(name) or draw(st.sampled_from(["f4", "f8", "i4"])) for name in names}
    n = draw(st.integers(1, 12))
    values = draw(st.lists(st.integers(0, 250), min_size=n * len(names), max_size=n * len(names)))
    other = {} if kind == "pcd" else {"before": draw(st.integers(0, 2)), "after": draw(st.integers(0, 2))}
    lists = kind == "ply" and draw(st.booleans())
    return Cloud(kind, form, fields, np.array(values, float).reshape(n, -1), **other, lists=lists)


TEXT = [("pcd", "ascii"), ("ply", "ascii")]
BINARY = [("pcd", "binary"), ("ply", "binary_little_endian"), ("ply", "binary_big_endian")]


def read(path: Path) -> tuple[np.ndarray, int]:
    """The valid points and the number of those dropped, which do not depend on the size of the chunks."""
    found = []
    for chunk_points in (2, 1000):
        chunks = list(open_points(path, chunk_points=chunk_points))
        points = np.concatenate([np.empty((0, 3)), *(chunk.points.numpy() for chunk in chunks)])
        found.append((points, sum(chunk.n_dropped for chunk in chunks)))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    assert found[0][1] == found[1][1]
    np.testing.assert_array_equal(finite(read_cloud(path).numpy()), found[0][0])
    return found[0]


def finite(points: np.ndarray) -> np.ndarray:
    return points[np.isfinite(points).all(1)]


def read_elsewhere(path: Path) -> np.ndarray:
    """The points as plyfile reads them; those of a PCD file, record by record."""
    if path.suffix == ".ply":
        vertex = plyfile.PlyData.read(str(path))["vertex"]
        return np.stack([np.asarray(vertex[axis], float) for axis in "xyz"], 1)
    head, _, data = path.read_bytes().partition(b"DATA ")
    rows = [line.split() for line in head.decode("latin1").split("\n") if line and line[0] != "#"]
    header = {words[0]: words[1:] for words in rows if words}
    form, _, data = data.partition(b"\n")
    codes = [
        {"F4": "f", "F8": "d"}.get(kind + size)
        or {"1": "bB", "2": "hH", "4": "iI", "8": "qQ"}[size]["IU".index(kind)]
        for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)
    ]
    record = struct.Struct("<" + "".join(codes))
    n, columns = int(header["POINTS"][0]), [header["FIELDS"].index(axis) for axis in "xyz"]
    if form.strip() == b"ascii":
        table = [[float(word) for word in line.split()] for line in data.decode().split("\n")[:n]]
    else:
        table = [record.unpack_from(data, i * record.size) for i in range(n)]
    return np.array([[row[column] for column in columns] for row in table], float).reshape(n, 3)


# -- valid files ----------------------------------------------------------------------------------


@given(cloud=clouds([*TEXT, *BINARY]))
def test_points_are_those_that_were_written_and_that_others_read(tmp_path, cloud):
    path = cloud.write(tmp_path)
    points, n_dropped = read(path)
    np.testing.assert_array_equal(points, cloud.points)
    np.testing.assert_array_equal(points, finite(read_elsewhere(path)))
    assert n_dropped == 0


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_lists_before_and_in_the_points_are_read(tmp_path, form):
    """plyfile writes lists of different lengths, which only reading them can pass over."""
    faces = np.array([([0, 1, 2],), ([0, 1],), ([],), ([2, 1, 0],)], dtype=[("indices", "O")])
    points = np.array(
        [([4, 5], 1.5, 7, 3.0, [1.0]), ([], 2.5, 8, 4.0, []), ([9], -2.5, 9, 5.0, [2.0, 3.0])],
        dtype=[("near", "O"), ("z", "f8"), ("x", "i4"), ("y", "f4"), ("weights", "O")],
    )
    kinds = {"len_types": {"near": "u1", "weights": "u2"}, "val_types": {"near": "i4", "weights": "f8"}}
    if form == "binary_big_endian":  # plyfile swaps no bytes of records with lists
        points, kinds = np.array([tuple(row) for row in points[["z", "x", "y"]]], "f8, i4, f4"), {}
        points.dtype.names = ("z", "x", "y")
    elements = [
        plyfile.PlyElement.describe(faces, "face", len_types={"indices": "u1"}, val_types={"indices": "i4"}),
        plyfile.PlyElement.describe(points, "vertex", **kinds),
    ]
    order = ">" if "big" in form else "<"
    path = tmp_path / "lists.ply"
    plyfile.PlyData(elements, text=form == "ascii", byte_order=order).write(str(path))
    assert read(path)[0].tolist() == [[7, 3, 1.5], [8, 4, 2.5], [9, 5, -2.5]]
    plyfile.PlyData(elements[::-1], text=form == "ascii", byte_order=order).write(str(path))
    assert read(path)[0].tolist() == [[7, 3, 1.5], [8, 4, 2.5], [9, 5, -2.5]]
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(DataError, match="lists"):
        read(path)


def compressed(
    rows: np.ndarray, packed: bytes, header: str = "FIELDS x y z\nSIZE 4 4 8\nTYPE F F F\n"
) -> bytes:
    n = len(rows)
    head = f"VERSION 0.7\n{header}WIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA binary_compressed\n".encode()
    return head + struct.pack("<II", len(packed), n * 16) + packed


def test_compressed_pcd_files_repeat_earlier_bytes(tmp_path):
    """A literal, a repetition that overlaps itself, and a long one; the fields one after the other."""
    points = np.repeat([[1.0, -2.0, 0.5]], 40, 0)
    data = b"".join(
        [points[:, 0].astype("<f4").tobytes(), points[:, 1].astype("<f4").tobytes(), points[:, 2].tobytes()]
    )
    pieces = []
    for start, period, length in ((0, 4, 160), (160, 4, 160), (320, 8, 320)):
        pieces.append(bytes([period - 1]) + data[start : start + period])
        left = length - period
        while left:
            taken = min(left, 264) if min(left, 264) >= 9 else left
            pieces.append(
                bytes([(7 << 5), taken - 9, period - 1])
                if taken >= 9
                else bytes([(taken - 2) << 5, period - 1])
            )
            left -= taken
    path = tmp_path / "a.pcd"
    packed = b"".join(pieces)
    path.write_bytes(compressed(points, packed))
    np.testing.assert_array_equal(read(path)[0], points)
    path.write_bytes(compressed(points, packed) + bytes(100))
    np.testing.assert_array_equal(read(path)[0], points)
    path.write_bytes(compressed(points[:0], b""))
    assert len(read(path)[0]) == 0
    for wrong in (packed[:-1], packed + b"\0\0", b"\x20\x09" + packed[2:], packed[:5] + b"\0\0" + packed[5:]):
        path.write_bytes(compressed(points, wrong))
        with pytest.raises(DataError, match="compressed"):
            read(path)


@given(rows=st.lists(st.tuples(*[st.sampled_from([0.0, 1.5, np.nan, np.pi, 1e30])] * 3), max_size=200))
def test_compressed_pcd_files_are_read_as_open3d_writes_them(tmp_path, rows):
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    points = np.array(rows, np.float32).reshape(-1, 3)
    if not len(points):
        return
    path = tmp_path / "a.pcd"
    cloud = open3d.t.geometry.PointCloud(points)
    open3d.t.io.write_point_cloud(str(path), cloud, write_ascii=False, compressed=True)
    np.testing.assert_array_equal(read(path)[0], finite(points.astype(float)))


def test_an_organised_pcd_file_with_padding_of_zeros_is_read(tmp_path):
    cloud = Cloud("pcd", "binary", {"x": "f4", "y": "f4", "z": "f4"}, np.arange(18.0).reshape(6, 3))
    cloud.values[2] = np.nan
    path = cloud.write(tmp_path)
    data = path.read_bytes().replace(b"WIDTH 6\nHEIGHT 1", b"WIDTH 3\nHEIGHT 2")
    path.write_bytes(data + bytes(4000))  # PCL has filled pages
    points, n_dropped = read(path)
    np.testing.assert_array_equal(points, np.delete(cloud.values, 2, 0))
    assert n_dropped == 1
    path.write_bytes(data.replace(b"HEIGHT 2", b"HEIGHT 3"))
    with pytest.raises(DataError, match="WIDTH times HEIGHT"):
        read(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("TYPE F F F", "TYPE F F O", "damaged header"),
        ("TYPE F F F", "TYPE F F C", "damaged header"),
        ("SIZE 4 4 8", "SIZE 4 4 3", "damaged header"),
        ("SIZE 4 4 8", "SIZE 4 4", "damaged header"),
        ("SIZE 4 4 8", "SIZE 4 4 99999999", "damaged header"),
        ("FIELDS x y z", "FIELDS x w z", "no field y"),
        ("FIELDS x y z", "FIELDS x y z x", "several fields x"),
        ("POINTS 1", "POINTS 1_0", "damaged header"),
        ("DATA binary", "DATA zipped", "known are ascii"),
    ],
)
def test_a_pcd_header_is_checked(tmp_path, old, new, message):
    cloud = Cloud("pcd", "binary", {"x": "f4", "y": "f4", "z": "f8"}, np.ones((1, 3)))
    path = cloud.write(tmp_path)
    path.write_bytes(path.read_bytes().replace(old.encode(), new.encode()))
    with pytest.raises(DataError, match=message):
        read(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("property float z", "property float  x", "damaged header"),
        ("property float z", "property float w", "no field z"),
        ("property float z", "property half z", "damaged header"),
        ("property float z", "propertz float z", "damaged header"),
        ("element face", "element vertex", "damaged header"),
        ("vertex 1", "vertex 1_0", "damaged header"),
        ("vertex 1", "vertex -1", "damaged header"),
        ("vertex 1", f"vertex {10**30}", "truncated"),
        ("element vertex", "element point", "number of points"),
        ("binary_little", "binary_middle", "known are ascii"),
    ],
)
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_a_ply_header_is_checked(tmp_path, form, old, new, message):
    cloud = Cloud("ply", form, {"x": "f4", "y": "f4", "z": "f4"}, np.ones((1, 3)))
    path = cloud.write(tmp_path)
    data = path.read_bytes()
    path.write_bytes(data.replace(old.encode(), new.encode()))
    if old.encode() in data:
        with pytest.raises(DataError, match=message):
            read(path)


# -- words ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("word", NOT_FINITE)
def test_every_spelling_of_a_number_that_is_not_finite_is_read(word):
    assert not np.isfinite(number_rows([f"1 {word} 3"], 3, "a, row")[0, 1])
    assert number_rows([f"1 {word} 3"], None, "a, row")[0, ::2].tolist() == [1, 3]


@pytest.mark.parametrize("word", NO_NUMBERS)
def test_a_word_that_is_no_number_is_an_error_that_names_it(word):
    shown = repr(word.strip())[1:-1].replace("\\", "\\\\")
    with pytest.raises(DataError) as error:
        number_rows(["1 2 3", "1 nan 1.#IND", f"4 {word} 6"], 3, "a.pcd, row", first=11)
    assert str(error.value).startswith("a.pcd, row 13: ")
    assert repr(word) in str(error.value) or shown in str(error.value)


@pytest.mark.parametrize("line", ["1 2", "1 2 3 4", "1  3"])
def test_a_line_of_another_width_is_an_error(line):
    with pytest.raises(DataError, match=r"^a, row 2 has \d numbers instead of 3"):
        number_rows(["1 2 3", line], 3, "a, row")


@pytest.mark.parametrize("kind", ["pcd", "ply"])
def test_scan_folders_drop_points_that_are_not_finite_and_refuse_decimal_commas(tmp_path, kind):
    cloud = Cloud(kind, "ascii", {"x": "f4", "y": "f4", "z": "f4"}, np.arange(1.0, 10).reshape(3, 3))
    text = cloud.header() + "1 2 3\n4 -inf 6\n7 8 9\n"
    (tmp_path / "right").mkdir()
    folder = scan_folder(tmp_path / "right", {f"0.{kind}": text.encode()}, kitti(np.eye(3), [0.0, 0.0, 0.0]))
    scans = load("scan_folder", folder)
    assert scans[0].points.tolist() == [[1, 2, 3], [7, 8, 9]]
    assert scans.skipped == {"points dropped: their coordinates are not finite": 1}
    (folder / "scans" / f"0.{kind}").write_text(text.replace("-inf", "nan"))
    scans = load("scan_folder", folder)
    assert scans[0].points.tolist() == [[1, 2, 3], [7, 8, 9]]
    assert len(scans.skipped) == (kind == "ply")  # NaN in a PCD file is a beam without return
    (folder / "scans" / f"0.{kind}").write_text(text.replace("7 8", "7,5 8"))
    with pytest.raises(
        DataError, match=rf"0\.{kind}, row 3: '7,5' is not a number; write decimals with a point"
    ):
        load("scan_folder", folder)[0]


# -- corruptions ----------------------------------------------------------------------------------


@given(cloud=clouds(TEXT), draw=st.data())
def test_a_changed_word_drops_its_point_or_is_an_error(tmp_path, cloud, draw):
    words = cloud.texts()
    lines = cloud.header().encode(), words
    row = draw.draw(st.integers(0, len(cloud.values) - 1))
    column = draw.draw(st.integers(0, len(cloud.fields) - 1))
    word = draw.draw(st.sampled_from([*NOT_FINITE, *NO_NUMBERS, "", "1 2"]))
    words[row + cloud.before] = [*words[row + cloud.before]]
    words[row + cloud.before][column] = word
    path = tmp_path / f"a.{cloud.kind}"
    path.write_bytes(lines[0] + "".join(" ".join(line) + "\n" for line in words).encode())
    is_lost = list(cloud.fields)[column] in "xyz"
    if word in NOT_FINITE:
        points, n_dropped = read(path)
        np.testing.assert_array_equal(points, np.delete(cloud.points, row, 0) if is_lost else cloud.points)
        assert n_dropped == is_lost
    else:
        with pytest.raises(DataError, match=rf"a\.{cloud.kind}.*row {row + 1}\b"):
            read(path)


@given(cloud=clouds([*TEXT, *BINARY]), draw=st.data())
def test_a_truncated_file_is_an_error(tmp_path, cloud, draw):
    path = cloud.write(tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[: draw.draw(st.integers(0, len(data) - 1))])
    with pytest.raises(DataError, match=rf"a\.{cloud.kind}"):
        read(path)


@given(cloud=clouds([*TEXT, *BINARY]), draw=st.data())
def test_a_file_with_more_data_is_an_error(tmp_path, cloud, draw):
    path = cloud.write(tmp_path)
    path.write_bytes(path.read_bytes() + (b"7 7\n" if cloud.form == "ascii" else b"\1\2"))
    with pytest.raises(DataError, match=rf"a\.{cloud.kind}"):
        read(path)


@given(cloud=clouds([*TEXT, *BINARY]), byte=st.integers(0, 255), draw=st.data())
def test_a_changed_byte_of_the_header_never_gives_other_points(tmp_path, cloud, byte, draw):
    """The changed header may announce other types; then an independent reader reads the same points."""
    path = cloud.write(tmp_path)
    data = bytearray(path.read_bytes())
    data[draw.draw(st.integers(0, len(cloud.header()) - 1))] = byte
    path.write_bytes(data)
    try:
        points, n_dropped = read(path)
    except DataError:
        return
    if not np.array_equal(points, cloud.points):
        np.testing.assert_array_equal(points, finite(read_elsewhere(path)))
    assert len(points) + n_dropped == len(cloud.values)


@given(byte=st.integers(0, 255), draw=st.data())
def test_a_changed_byte_of_an_npy_header_never_gives_other_points(tmp_path, byte, draw):
    points = np.arange(24, dtype=np.float32).reshape(8, 3)
    path = tmp_path / "a.npy"
    np.save(path, points)
    data = bytearray(path.read_bytes())
    data[draw.draw(st.integers(0, 127))] = byte
    path.write_bytes(data)
    try:
        found = read_cloud(path).numpy()
    except DataError:
        return
    np.testing.assert_array_equal(found, np.load(path).astype(float))
    assert found.size == points.size
