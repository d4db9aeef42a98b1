"""PCD files: their header, and their points as text, as records, or compressed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gmmtorch.datasets.point_files.point_rows import (
    AXES,
    PACKED,
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

_MAX_POINT_BYTES = 1 << 24
_CODES = {f"{kind}{size}": f"<{kind.lower()}{size}" for kind in "IU" for size in (1, 2, 4, 8)}
_CODES |= {"F4": "<f4", "F8": "<f8"}
_LZF_LITERALS = 32  # a smaller control byte announces literal bytes, another one repeats earlier bytes


def pcd_header(path: Path) -> dict[str, list[str]]:
    """Header fields of a PCD file, such as {"VIEWPOINT": ["0", "0", "0", "1", "0", "0", "0"]}."""
    return _entries(header_lines(path, "DATA")[0])


def _entries(lines: list[list[str]]) -> dict[str, list[str]]:
    return {words[0]: words[1:] for words in lines if words and not words[0].startswith("#")}


def pcd_fields(path: Path) -> dict[str, np.dtype]:
    """The types of the fields of a PCD file with one number each."""
    header = pcd_header(path)
    with damaged(path, "has a damaged header"):
        columns = zip(header["FIELDS"], header["TYPE"], header["SIZE"], strict=True)
        counts = header.get("COUNT", ["1"] * len(header["FIELDS"]))
        both = zip(columns, counts, strict=True)
        return {name: np.dtype(_CODES[f"{kind}{size}"]) for (name, kind, size), n in both if n == "1"}


def pcd_rows(path: Path, names: Sequence[str] = AXES) -> Rows:
    """The points of a PCD file, or its fields of these names. A field with packed colours is its 32 bits.

    Raises `DataError` if its header is damaged or its size another one.
    """
    lines, n_bytes = header_lines(path, "DATA")
    with damaged(path, "has a damaged header"):
        header = _entries(lines)
        (form,), (n_points,), fields = header["DATA"], map(whole_number, header["POINTS"]), header["FIELDS"]
        sides = [whole_number(word) for side in ("WIDTH", "HEIGHT") for word in header.get(side, ["1"])]
        counts = [whole_number(word) for word in header.get("COUNT", ["1"] * len(fields))]
        sizes = [whole_number(word) for word in header["SIZE"]]
        widths = [count * size for count, size in zip(counts, sizes, strict=True)]
        codes = [f"{kind}{size}" for kind, size in zip(header["TYPE"], sizes, strict=True)]
        check_fields(path, fields)
        if len(fields) != len(codes) or min(widths) < 1 or sum(widths) > _MAX_POINT_BYTES:
            raise ValueError("the sizes of the fields")
        if "WIDTH" in header and sides[0] * sides[1] != n_points:
            raise ValueError(f"POINTS {n_points} is not WIDTH times HEIGHT")
        columns = [fields.index(name) for name in names]
        offsets = [sum(widths[:column]) for column in columns]
        record = np.dtype(
            {
                "names": list(names),
                "formats": ["<u4" if fields[c] in PACKED else _CODES[codes[c]] for c in columns],
                "offsets": offsets,
                "itemsize": sum(widths),
            }
        )
    if form == "ascii":
        check_text(path, n_points)
        places = [sum(counts[:column]) for column in columns]
        return TextRows(path, n_points, len(lines), sum(counts), places)
    if form == "binary":
        check_size(path, n_bytes + n_points * record.itemsize, f"{n_points} points")
        return RecordRows(path, n_points, n_bytes, record)
    if form == "binary_compressed":
        data = _unpacked(path, n_bytes, n_points * record.itemsize)
        axes = [
            np.ndarray(n_points, record[name], data, n_points * offset, (widths[column],))
            for name, offset, column in zip(names, offsets, columns, strict=True)
        ]  # one field of all points follows the other
        with np.errstate(invalid="ignore"):  # a signalling NaN of a damaged file
            return ArrayRows(np.stack([axis.astype(np.float64) for axis in axes], 1), path.stem)
    raise DataError(f"{path} has DATA {form}; known are ascii, binary and binary_compressed.")


def _unpacked(path: Path, n_bytes: int, expected: int) -> bytes:
    """The `expected` bytes of a compressed file after a header of `n_bytes`: both lengths, then LZF."""
    data = path.read_bytes()[n_bytes:]
    packed, unpacked = np.frombuffer(data[:8].ljust(8, b"\0"), "<u4").tolist()
    check_size(path, n_bytes + 8 + packed, "compressed points")
    data = data[: 8 + packed]
    found = bytearray()
    try:
        place = 8
        # LZF repeats at most 264 bytes for three.
        while place < len(data) and len(found) <= expected <= 88 * packed + 264:
            control = data[place]
            place += 1
            if control < _LZF_LITERALS:
                found += data[place : place + control + 1]
                place += control + 1
                continue
            length = (control >> 5) + 2
            if length == 9:
                length += data[place]
                place += 1
            start = len(found) - ((control & 31) << 8) - data[place] - 1
            place += 1
            piece = found[start : start + length] if start >= 0 else b""
            found += (piece * -(-length // len(piece)))[:length]
    except (IndexError, ZeroDivisionError):
        expected = -1
    if not unpacked == expected == len(found) or place != len(data):
        raise DataError(
            f"{path} announces {unpacked:,} bytes of points, which its compressed ones are not; it is "
            "damaged. Write it again."
        )
    return bytes(found)
