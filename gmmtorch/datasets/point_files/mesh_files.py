"""PLY, OBJ and STL files: the elements of PLY files, as text or records of either byte order, and triangles.

Polygons become fans of triangles. Sizes that a header announces are compared with the data before anything is
allocated.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.base import number_rows
from gmmtorch.datasets.point_files.point_rows import (
    AXES,
    ArrayRows,
    RecordRows,
    Rows,
    TextRows,
    check_fields,
    check_size,
    check_text,
    damaged,
    header_lines,
    whole_number,
)
from gmmtorch.errors import DataError

_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_CODES = {
    **dict.fromkeys(("char", "int8"), "b"),
    **dict.fromkeys(("uchar", "uint8"), "B"),
    **dict.fromkeys(("short", "int16"), "h"),
    **dict.fromkeys(("ushort", "uint16"), "H"),
    **dict.fromkeys(("int", "int32"), "i"),
    **dict.fromkeys(("uint", "uint32"), "I"),
    **dict.fromkeys(("float", "float32"), "f"),
    **dict.fromkeys(("double", "float64"), "d"),
}
Columns = dict[str, Any]
"""Of an element by the name of the property: numbers (N,), or for lists arrays (F, k), one for each k."""


class _Property(NamedTuple):
    """A property of an element: its type, and if it is a list, the type of its length."""

    name: str
    code: str
    count_code: str = ""


class _Header(NamedTuple):
    """The elements in the order of the file. n_lines, n_bytes: size of the header."""

    order: str
    is_text: bool
    counts: dict[str, int]
    properties: dict[str, list[_Property]]
    n_lines: int
    n_bytes: int


def _read_header(path: Path) -> _Header:
    lines, n_bytes = header_lines(path, "end_header")
    if lines[0] != ["ply"]:
        raise DataError(f"{path} does not start with 'ply'; it is not a PLY file.")
    form = element = ""
    counts: dict[str, int] = {}
    properties: dict[str, list[_Property]] = {}
    with damaged(path, "has a damaged header"):
        for words in lines[1:-1]:
            match words:
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case ["format", form, _]:
                    pass
                case ["element", element, number] if element not in counts:
                    counts[element], properties[element] = whole_number(number), []
                case ["property", "list", count_code, code, name]:
                    properties[element].append(_Property(name, _CODES[code], _CODES[count_code]))
                case ["property", code, name]:
                    properties[element].append(_Property(name, _CODES[code]))
                case _:
                    raise ValueError(" ".join(words))
        if "vertex" not in counts:
            raise DataError(f"{path} does not state its number of points (element vertex); it is damaged.")
        for name, count in counts.items():
            names = [p.name for p in properties[name]]
            if (count and not names) or len({*names}) != len(names):
                raise ValueError(f"element {name} has properties {names}")
        check_fields(path, [p.name for p in properties["vertex"] if not p.count_code])
    if form not in _ORDERS:
        raise DataError(f"{path} has format {form!r}; known are ascii, and binary of either byte order.")
    return _Header(_ORDERS[form], form == "ascii", counts, properties, len(lines), n_bytes)


def ply_fields(path: Path) -> dict[str, np.dtype]:
    """The types of the properties of the points of a PLY file that are one number."""
    return {p.name: np.dtype(p.code) for p in _read_header(path).properties["vertex"] if not p.count_code}


def ply_rows(path: Path, fields: Sequence[str] = AXES) -> Rows:
    """The points (element vertex) of a PLY file, or their properties of these names.

    Raises `DataError` if it is damaged.

    Points with lists, and records after lists, are read as a whole.
    """
    header = _read_header(path)
    names = list(header.counts)
    place = names.index("vertex")
    before, n_points = names[:place], header.counts["vertex"]
    known = [p.name for p in header.properties["vertex"]]
    if header.is_text and not _has_lists(header, ["vertex"]):
        check_text(path, sum(header.counts.values()))
        n_before, n_after = (sum(header.counts[name] for name in of) for of in (before, names[place + 1 :]))
        columns = [known.index(name) for name in fields]
        return TextRows(path, n_points, header.n_lines, len(known), columns, n_before, n_after)
    if header.is_text or _has_lists(header, [*before, "vertex"]):
        vertices = ply_elements(path)["vertex"]
        return ArrayRows(np.stack([vertices[name] for name in fields], 1).astype(np.float64), path.stem)
    if _has_lists(header, names):
        ply_elements(path)  # reads the lists, because only their lengths tell whether the file is complete
    else:
        n_bytes = sum(header.counts[name] * _record(header, name).itemsize for name in names)
        check_size(path, header.n_bytes + n_bytes, f"{n_points} points")
    start = header.n_bytes + sum(header.counts[name] * _record(header, name).itemsize for name in before)
    return RecordRows(path, n_points, start, _record(header, "vertex")[list(fields)])


def _has_lists(header: _Header, names: Sequence[str]) -> bool:
    return any(p.count_code for name in names for p in header.properties[name])


def _record(header: _Header, name: str, lengths: Sequence[int] = ()) -> np.dtype:
    """The layout of a record of an element whose lists have these lengths."""
    left = list(lengths)
    fields: list[Any] = []
    for p in header.properties[name]:
        if p.count_code:
            fields += [
                (f"#{p.name}", header.order + p.count_code),
                (p.name, header.order + p.code, (left.pop(0),)),
            ]
        else:
            fields += [(p.name, header.order + p.code)]
    return np.dtype(fields)


def ply_elements(path: Path) -> dict[str, Columns]:
    """The elements of a PLY file by name. Raises `DataError` unless they are the whole file."""
    header = _read_header(path)
    raw: np.ndarray = np.memmap(path, np.uint8, "r")[header.n_bytes :]
    if header.is_text:
        check_text(path, 0)
        words = raw.tobytes().decode("ascii", errors="replace").split()
        raw = number_rows(words, 1, f"{path}, number").reshape(-1).view(np.uint8)
        # From here on, the numbers are records of doubles.
        doubles = {
            name: [_Property(p.name, "d", p.count_code and "d") for p in properties]
            for name, properties in header.properties.items()
        }
        header = header._replace(properties=doubles)
    found, start = {}, 0
    for name in header.counts:
        with damaged(path, f"has an element {name} that cannot be read"):
            found[name], start = _element(raw, start, header, name)
    if start != len(raw):
        raise DataError(f"{path} has more data than its header announces; it is damaged. Write it again.")
    return found


def _element(raw: np.ndarray, start: int, header: _Header, name: str) -> tuple[Columns, int]:
    """The columns of an element whose first record is at the byte `start`, and the byte after the last."""
    count, properties = header.counts[name], header.properties[name]
    lists = [p.name for p in properties if p.count_code]
    if count == 0 or not lists:
        table = np.frombuffer(raw, _record(header, name, [0] * len(lists)), count, start)
        return {p.name: [] if p.count_code else table[p.name] for p in properties}, start + table.nbytes
    lengths = _records(raw, start, header, name, 1)[1]
    layout = _record(header, name, lengths[0].tolist())
    if layout.itemsize * count <= len(raw) - start:
        table = np.frombuffer(raw, layout, count, start)
        if all((table[f"#{of}"] == table[f"#{of}"][0]).all() for of in lists):
            found = {p.name: [table[p.name]] if p.count_code else table[p.name] for p in properties}
            return found, start + table.nbytes
    starts, lengths = _records(raw, start, header, name, count)
    kinds, firsts, kind = np.unique(lengths, axis=0, return_index=True, return_inverse=True)
    columns: Columns = {p.name: [] if p.count_code else np.empty(count, p.code) for p in properties}
    for index in np.argsort(firsts):
        layout = _record(header, name, kinds[index].tolist())
        rows = np.flatnonzero(kind.reshape(-1) == index)
        places = starts[rows, None] + np.arange(layout.itemsize)
        table = raw[places].view(layout)[:, 0]
        for p in properties:
            if p.count_code:
                columns[p.name].append(table[p.name])
            else:
                columns[p.name][rows] = table[p.name]
    return columns, int(starts[-1]) + _record(header, name, lengths[-1].tolist()).itemsize


def _records(
    raw: np.ndarray, start: int, header: _Header, name: str, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """The bytes (count,) at which records with lists begin, and the lengths (count, L) of their lists."""
    gap, steps = 0, []  # of each list: bytes before it, the reader of its length, bytes of an entry
    for p in header.properties[name]:
        size = np.dtype(p.code).itemsize
        if p.count_code:
            steps.append((gap, struct.Struct(header.order + p.count_code), size))
        gap = 0 if p.count_code else gap + size
    starts, lengths = [], []
    for _ in range(count):
        starts.append(start)
        for before, number, size in steps:
            (length,) = number.unpack_from(raw.data, start + before)
            if not 0 <= length * size <= len(raw) - start or length != int(length):
                raise ValueError(f"a list of {length} entries")
            lengths.append(int(length))
            start += before + number.size + int(length) * size
        start += gap
    if start > len(raw):
        raise ValueError("its last record is cut")
    return np.array(starts), np.array(lengths).reshape(count, len(steps))


_INDICES = ("vertex_indices", "vertex_index")
_STL_HEADER_BYTES = 80
_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)")


def read_triangles(path: Path) -> Tensor:
    """Triangles (T, 3, 3), float64, of a PLY, OBJ or STL file.

    Raises `DataError` if the file is unreadable or truncated, has no triangle, or has a corner that is not
    finite.
    """
    readers: dict[str, Callable[[Path], np.ndarray]] = {".ply": _ply, ".obj": _obj, ".stl": _stl}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise DataError(f"{path} is not a PLY, OBJ or STL file; convert the mesh to one of these formats.")
    with damaged(path, "contains no readable triangles"):
        triangles = reader(path)
    if len(triangles) == 0:
        raise DataError(f"{path} contains no readable triangles; give a PLY, OBJ or STL file with faces.")
    if not np.isfinite(triangles).all():
        raise DataError(f"{path}: a corner is NaN or infinite; the file is damaged.")
    return torch.from_numpy(triangles)


def _fans(corners: np.ndarray, polygons: list[np.ndarray]) -> np.ndarray:
    """Triangles (T, 3, 3) of polygons: arrays (F, k) of rows of `corners` (V, 3)."""
    indices = [p[:, [0, i, i + 1]] for p in polygons for i in range(1, p.shape[1] - 1)]
    faces = np.concatenate(indices) if indices else np.empty((0, 3), np.int64)
    with np.errstate(invalid="ignore"):  # NaN
        whole = faces.astype(np.int64)
    if faces.size and not (whole.min() >= 0 and whole.max() < len(corners) and (whole == faces).all()):
        raise ValueError("a face refers to a missing corner")
    return corners[whole]


def _ply(path: Path) -> np.ndarray:
    elements = ply_elements(path)
    vertices, faces = elements["vertex"], elements.get("face", {})
    corners = np.stack([vertices[axis] for axis in AXES], 1).astype(np.float64)
    return _fans(corners, next((faces[key] for key in _INDICES if key in faces), []))


def _obj(path: Path) -> np.ndarray:
    corners: list[list[bytes]] = []
    polygons: dict[int, list[list[int]]] = {}  # by the number of corners
    with path.open("rb") as file:
        for line in file:
            words = line.split()
            if words[:1] == [b"v"]:
                corners.append(words[1:4])
            elif words[:1] == [b"f"]:
                numbers = [int(word.split(b"/")[0]) for word in words[1:]]
                polygon = [n - 1 if n > 0 else len(corners) + n for n in numbers]
                polygons.setdefault(len(polygon), []).append(polygon)
    tables = [np.array(same, np.int64).reshape(len(same), size) for size, same in polygons.items()]
    return _fans(np.array(corners, np.float64).reshape(-1, 3), tables)


def _stl(path: Path) -> np.ndarray:
    data = path.read_bytes()
    start = _STL_HEADER_BYTES + 4
    count = int.from_bytes(data[_STL_HEADER_BYTES:start], "little")
    if len(data) == start + count * _STL_TRIANGLE.itemsize:
        return np.frombuffer(data, _STL_TRIANGLE, count, start)["corners"].astype(np.float64)
    if not data.lstrip().startswith(b"solid"):
        raise ValueError(f"{count} triangles are announced, but it has {len(data)} bytes")
    return np.array(_VERTEX.findall(data), np.float64).reshape(-1, 3, 3)
