"""PCD and PLY files: their headers, the position of the points in them, and reading them with Open3D."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError
from gmmtorch.optional_packages import load_open3d

AXES = ("x", "y", "z")
_HEADER_BYTES = 1 << 16
_MAX_FIELD, _MAX_FIELDS = 1 << 16, 1 << 10
_PLY_CODES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


class Layout(NamedTuple):
    """The position of the points in a PCD or PLY file of text lines or binary records.

    skip: lines (text) or bytes (binary) before the first point. width: numbers per line, or bytes per record.
    axes: of x, y and z, the column (text), or the dtype and byte offset (binary).
    """

    skip: int
    width: int
    axes: list[Any]


class CloudHeader(NamedTuple):
    """What the header of a PCD or PLY file announces.

    n_points: number of points. is_text: text lines, or binary records. n_bytes: size of the header.
    length: least number of words (text) or bytes (binary) after the header.
    layout: None if the file can only be read as a whole.
    """

    n_points: int
    is_text: bool
    n_bytes: int
    length: int
    layout: Layout | None


def read_cloud(path: Path) -> Tensor:
    """Points (N, 3), float64, of a PCD or PLY file, including rows with NaN.

    Raises `DataError` if the file is unreadable or shorter than its header announces.
    """
    open3d = load_open3d(f"{path} cannot be read")
    header = read_header(path)
    check_length(path, header)
    try:
        with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
            cloud = open3d.t.io.read_point_cloud(str(path))
            points = cloud.point.positions.numpy() if "positions" in cloud.point else np.empty((0, 3))
    except (RuntimeError, KeyError, MemoryError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read as a point cloud: {error}") from error
    if points.shape[0] != header.n_points:
        raise DataError(
            f"{path} announces {header.n_points} points, but {points.shape[0]} could be read; the file is "
            "truncated or not a point cloud. Write it again."
        )
    return torch.from_numpy(points.astype(np.float64))


def read_header(path: Path) -> CloudHeader:
    """The header of a PCD file (suffix .pcd) or a PLY file. Raises `DataError` if it is damaged."""
    try:
        return _pcd_cloud_header(path) if path.suffix.lower() == ".pcd" else _ply_cloud_header(path)
    except (ValueError, KeyError, IndexError, TypeError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path} has a damaged header ({error!r}); write it again.") from error


def check_length(path: Path, header: CloudHeader) -> None:
    """Raises `DataError` if the file is shorter than its header announces.

    Open3D does not check this: it fills the missing points with zeros.
    """
    if header.is_text:
        with path.open("rb") as file:
            file.seek(header.n_bytes)
            found = len(file.read().split())
    else:
        found = path.stat().st_size - header.n_bytes
    if found < header.length:
        unit = "numbers" if header.is_text else "bytes"
        raise DataError(
            f"{path} announces {header.n_points} points, but ends after {found} of {header.length} "
            f"{unit}; it is truncated. Write or fetch it again."
        )


def pcd_header(path: Path) -> dict[str, list[str]]:
    """Header fields of a PCD file, such as {"VIEWPOINT": ["0", "0", "0", "1", "0", "0", "0"]}."""
    return _pcd_fields(_header_lines(path, "DATA")[0])


def _pcd_fields(lines: list[list[str]]) -> dict[str, list[str]]:
    return {words[0]: words[1:] for words in lines if words and not words[0].startswith("#")}


def _pcd_cloud_header(path: Path) -> CloudHeader:
    lines, n_bytes = _header_lines(path, "DATA")
    header = _pcd_fields(lines)
    kind, fields = header["DATA"][0], header["FIELDS"]
    if kind not in ("ascii", "binary", "binary_compressed"):
        raise DataError(f"{path} has DATA {kind}; known are ascii, binary and binary_compressed.")
    if not header.get("POINTS", [""])[0].isdecimal():
        raise DataError(f"{path} does not state its number of points (POINTS); it is damaged.")
    n_points = int(header["POINTS"][0])
    is_text = kind == "ascii"
    counts = [int(count) for count in header.get("COUNT", ["1"] * len(fields))]
    sizes = [int(size) for size in header["SIZE"]]
    if min([*counts, *sizes]) < 1 or max([*counts, *sizes]) > _MAX_FIELD or len(fields) > _MAX_FIELDS:
        raise DataError(f"{path} announces fields of impossible size; its header is damaged. Write it again.")
    if kind == "binary_compressed":
        width = sum(c * s for c, s in zip(counts, sizes, strict=True))
        return CloudHeader(
            n_points, False, n_bytes, _compressed_length(path, n_bytes, n_points * width), None
        )
    codes = [f"<{kind.lower()}{size}" for kind, size in zip(header["TYPE"], sizes, strict=True)]
    widths = counts if is_text else [c * s for c, s in zip(counts, sizes, strict=True)]
    axes = _axes(path, fields, widths, None if is_text else codes)
    layout = Layout(len(lines) if is_text else n_bytes, sum(widths), axes)
    return CloudHeader(n_points, is_text, n_bytes, n_points * layout.width, layout)


def _compressed_length(path: Path, n_bytes: int, n_unpacked: int) -> int:
    """Number of bytes after the header of a compressed PCD file: two lengths and the compressed data.

    Open3D allocates both lengths unchecked. LZF packs at most 264 bytes into three.
    """
    with path.open("rb") as file:
        file.seek(n_bytes)
        lengths = file.read(8)
    packed, unpacked = np.frombuffer(lengths.ljust(8, b"\0"), "<u4").tolist()
    if unpacked != n_unpacked or unpacked > 88 * packed + 264:
        raise DataError(
            f"{path} announces {unpacked} bytes in {packed} compressed ones for points of {n_unpacked} "
            "bytes; it is damaged. Write it again."
        )
    return 8 + packed


class PlyProperty(NamedTuple):
    """A property of a PLY element; `code` is the NumPy type of the value, or of a list's length.

    item: the NumPy type of the entries of a list.
    """

    name: str
    is_list: bool
    code: str
    item: str


class PlyElements(NamedTuple):
    """The elements of a PLY file in the order of the file. n_lines, n_bytes: size of the header."""

    form: str
    counts: dict[str, int]
    properties: dict[str, list[PlyProperty]]
    n_lines: int
    n_bytes: int


def ply_elements(path: Path) -> PlyElements:
    """The elements that the header of a PLY file announces."""
    lines, n_bytes = _header_lines(path, "end_header")
    if lines[0] != ["ply"]:
        raise DataError(f"{path} does not start with 'ply'; it is not a PLY file.")
    form, element = "", ""
    counts: dict[str, int] = {}
    properties: dict[str, list[PlyProperty]] = {}
    for words in lines:
        if words[:1] == ["format"]:
            form = words[1]
        elif words[:1] == ["element"]:
            element = words[1]
            counts[element], properties[element] = int(words[2]), []
        elif words[:1] == ["property"]:
            is_list = words[1] == "list"
            code, item = (words[2], words[3]) if is_list else (words[1], words[1])
            properties[element].append(PlyProperty(words[-1], is_list, _PLY_CODES[code], _PLY_CODES[item]))
    if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise DataError(f"{path} has format {form!r}; known are ascii, and binary of either byte order.")
    return PlyElements(form, counts, properties, len(lines), n_bytes)


def _ply_cloud_header(path: Path) -> CloudHeader:
    """The layout is None if points contain lists, or follow elements that do."""
    form, counts, properties, n_lines, n_bytes = ply_elements(path)
    if "vertex" not in counts:
        raise DataError(f"{path} does not state its number of points (element vertex); it is damaged.")
    if any(count < 0 or (count > 0 and not properties[name]) for name, count in counts.items()):
        raise DataError(f"{path} announces an element without data; its header is damaged. Write it again.")
    is_text = form == "ascii"
    widths = {
        name: [1 if is_text else np.dtype(p.code).itemsize for p in of] for name, of in properties.items()
    }
    length = sum(counts[name] * sum(widths[name]) for name in counts)
    before = list(counts)[: list(counts).index("vertex")]
    layout = None
    if not any(p.is_list for name in [*before, "vertex"] for p in properties[name]):
        order = ">" if form == "binary_big_endian" else "<"
        codes = None if is_text else [order + p.code for p in properties["vertex"]]
        axes = _axes(path, [p.name for p in properties["vertex"]], widths["vertex"], codes)
        skipped = sum(counts[name] * (1 if is_text else sum(widths[name])) for name in before)
        layout = Layout((n_lines if is_text else n_bytes) + skipped, sum(widths["vertex"]), axes)
    return CloudHeader(counts["vertex"], is_text, n_bytes, length, layout)


def _axes(path: Path, fields: list[str], widths: list[int], codes: list[str] | None) -> list[Any]:
    """The columns of x, y and z; with the `codes` of binary fields, their dtypes and byte offsets."""
    missing = [axis for axis in AXES if axis not in fields]
    if missing:
        raise DataError(f"{path} has no field {missing[0]}, only {', '.join(fields)}; it holds no points.")
    starts = [sum(widths[: fields.index(axis)]) for axis in AXES]
    if codes is None:
        return starts
    return [(np.dtype(codes[fields.index(axis)]), start) for axis, start in zip(AXES, starts, strict=True)]


def _header_lines(path: Path, last: str) -> tuple[list[list[str]], int]:
    """The words of each line of a header, up to the line that begins with `last`, and the header's bytes."""
    with path.open("rb") as file:
        *whole, _ = file.read(_HEADER_BYTES).split(b"\n")
    lines, n_bytes = [], 0
    for line in whole:
        lines.append(line.decode("ascii", errors="replace").split())
        n_bytes += len(line) + 1
        if lines[-1][:1] == [last]:
            return lines, n_bytes
    raise DataError(f"{path} has no header that ends with a line {last}; it is another kind of file.")
