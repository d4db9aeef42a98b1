"""Where the points of a PCD or PLY file are, from its header."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gmmtorch.datasets.point_files.clouds import file_head, header_end, pcd_header
from gmmtorch.errors import DataError

AXES = ("x", "y", "z")
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
    """Where the points of a PCD or PLY file are.

    text: lines (else records); skip: header lines and other elements' lines (text) or bytes (records)
    before the first point; width: numbers in a line, or bytes in a record; axes: column (text), or dtype
    and byte offset (records), of x, y and z.
    """

    n_points: int
    text: bool
    skip: int
    width: int
    axes: list[Any]


def pcd_layout(path: Path) -> Layout | None:
    """None: a compressed file, which can only be read whole."""
    header = pcd_header(path)
    kind, fields = header["DATA"][0], header["FIELDS"]
    if kind == "binary_compressed":
        return None
    if kind not in ("ascii", "binary"):
        raise DataError(f"{path} has DATA {kind}; known are ascii, binary and binary_compressed.")
    if not header.get("POINTS", [""])[0].isdecimal():
        raise DataError(f"{path} does not say how many points it holds (POINTS); it is damaged.")
    counts = [int(count) for count in header.get("COUNT", ["1"] * len(fields))]
    sizes = [int(size) for size in header["SIZE"]]
    codes = [f"<{kind.lower()}{size}" for kind, size in zip(header["TYPE"], sizes, strict=True)]
    skip = header_end(path, b"DATA")
    text = kind == "ascii"
    widths = counts if text else [c * s for c, s in zip(counts, sizes, strict=True)]
    axes = _axes(path, fields, widths, None if text else codes)
    return Layout(int(header["POINTS"][0]), text, _lines(path, skip) if text else skip, sum(widths), axes)


def ply_layout(path: Path) -> Layout | None:
    """None: points have lists, or stand after elements that do; such a file can only be read whole."""
    lines = [line.decode("ascii", errors="replace").split() for line in file_head(path).split(b"\n")]
    if lines[0] != ["ply"]:
        raise DataError(f"{path} does not start with 'ply'; it is not a PLY file.")
    form, element = "", ""
    counts: dict[str, int] = {}
    codes: dict[str, list[tuple[str, str]]] = {}
    for words in lines[: lines.index(["end_header"])]:
        if words[:1] == ["format"]:
            form = words[1]
        elif words[:1] == ["element"]:
            element = words[1]
            counts[element], codes[element] = int(words[2]), []
        elif words[:1] == ["property"]:
            codes[element].append((words[-1], "list" if words[1] == "list" else _PLY_CODES[words[1]]))
    if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise DataError(f"{path} has format {form!r}; known are ascii and binary, of either byte order.")
    if "vertex" not in counts:
        raise DataError(f"{path} does not say how many points it holds (element vertex); it is damaged.")
    text, skip = form == "ascii", header_end(path, b"end_header")
    before = list(counts)[: list(counts).index("vertex")]
    if any(code == "list" for name in [*before, "vertex"] for _, code in codes[name]):
        return None
    order = ">" if form == "binary_big_endian" else "<"
    sizes = {
        name: [np.dtype(code).itemsize for _, code in of] for name, of in codes.items() if name in before
    }
    vertex = [f"{order}{code}" for _, code in codes["vertex"]]
    widths = [1 if text else np.dtype(code).itemsize for code in vertex]
    axes = _axes(path, [name for name, _ in codes["vertex"]], widths, None if text else vertex)
    if text:
        skip = _lines(path, skip) + sum(counts[name] for name in before)
    else:
        skip += sum(counts[name] * sum(sizes[name]) for name in before)
    return Layout(counts["vertex"], text, skip, sum(widths), axes)


def _axes(path: Path, fields: list[str], widths: list[int], codes: list[str] | None) -> list[Any]:
    """Where x, y and z are in a line, or, with the `codes` of the fields, in a record."""
    missing = [axis for axis in AXES if axis not in fields]
    if missing:
        raise DataError(f"{path} has no field {missing[0]}, only {', '.join(fields)}; it holds no points.")
    starts = [sum(widths[: fields.index(axis)]) for axis in AXES]
    if codes is None:
        return starts
    return [(np.dtype(codes[fields.index(axis)]), start) for axis, start in zip(AXES, starts, strict=True)]


def _lines(path: Path, n_bytes: int) -> int:
    """Lines in the first bytes of a file."""
    return file_head(path)[:n_bytes].count(b"\n")
