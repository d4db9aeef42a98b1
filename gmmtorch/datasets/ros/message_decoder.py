"""Decodes ROS messages by their definitions: the packed form of ROS 1, and CDR (OMG) of ROS 2.

No code is generated, and no memory is allocated for a length that the data does not contain.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from gmmtorch.errors import DataError

BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
"""Kinds of fields in the definitions that rosbags parses (rosbags.interfaces.Nodetype)."""

_CODES = {
    **{f"{kind}int{bits}": f"{kind or 'i'}{bits // 8}" for kind in ("", "u") for bits in (8, 16, 32, 64)},
    **dict.fromkeys(("bool", "byte", "char", "octet"), "u1"),
    "float32": "f4",
    "float64": "f8",
}
_FIELDS_PER_BYTE = 8


class MessageDecoder:
    """Decodes messages into dictionaries of fields.

    Args:
        definitions: type name → (constants, fields), as rosbags parses them.
        packed: whether messages have the packed form of ROS 1, not CDR.
    """

    def __init__(self, definitions: dict[str, Any], packed: bool) -> None:
        self.definitions = definitions
        self._packed = packed

    def decode(self, data: bytes, name: str) -> dict[str, Any]:
        """The fields of a message of type `name`: numbers, strings, arrays, dictionaries and lists.

        A sequence of messages of fixed size becomes a structured array. Raises `DataError` if the data is
        shorter than it announces.
        """
        try:
            if self._packed:
                return _Cursor(data, "<", True, self.definitions).message(name)
            if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
                raise DataError(f"a message of type {name} is not encoded in CDR")
            order = "<" if data[1] == 1 else ">"
            return _Cursor(data[4:], order, False, self.definitions).message(name)
        except (struct.error, ValueError, KeyError, TypeError, RecursionError, OverflowError) as error:
            raise DataError(f"a message of type {name} cannot be decoded: {error}") from error


class _Cursor:
    """A position in the bytes of a message."""

    def __init__(self, data: bytes, order: str, packed: bool, definitions: dict[str, Any]) -> None:
        self._data, self._order, self._packed, self._definitions = data, order, packed, definitions
        self._at = 0
        self._fields_left = _FIELDS_PER_BYTE * len(data) + 1000  # definitions may nest without end

    def message(self, name: str) -> dict[str, Any]:
        return {field: self._field(desc) for field, desc in self._definitions[name][1]}

    def _field(self, desc: Any) -> Any:
        self._fields_left -= 1
        if self._fields_left < 0:
            raise ValueError("it has more fields than bytes")
        kind, content = desc
        if kind == NAME:
            return self.message(content)
        if kind == BASE:
            return self._string() if content[0] == "string" else self._numbers(content[0], 1)[0].item()
        inner, length = content
        count = length if kind == ARRAY else int(self._numbers("uint32", 1)[0])
        if count > len(self._data) - self._at:
            raise ValueError(
                f"{count} entries are announced, but {len(self._data) - self._at} bytes are left"
            )
        if inner[0] == BASE and inner[1][0] != "string":
            return self._numbers(inner[1][0], count)
        if inner[0] == NAME and count and (table := self._table(inner[1], count)) is not None:
            return table
        return [self._field(inner) for _ in range(count)]

    def _aligned(self, at: int, size: int) -> int:
        return at if self._packed else -(-at // size) * size

    def _numbers(self, kind: str, count: int) -> np.ndarray:
        dtype = np.dtype(self._order + _CODES[kind])
        if count == 0:
            return np.empty(0, dtype)
        start = self._aligned(self._at, dtype.itemsize)
        values = np.frombuffer(self._data, dtype, count, start)
        self._at = start + values.nbytes
        return values

    def _string(self) -> str:
        length = int(self._numbers("uint32", 1)[0])
        if length > len(self._data) - self._at:
            raise ValueError(f"a text of {length} bytes exceeds the message")
        text = self._data[self._at : self._at + length]
        self._at += length
        return text.rstrip(b"\0").decode("utf-8", errors="replace")

    def _table(self, name: str, count: int) -> np.ndarray | None:
        """`count` messages of fixed size as a structured array; None if their size varies."""
        first, end = self._layout(name, self._at)
        if not first:
            return None
        second, _ = self._layout(name, end)
        start, stride = first[0][2], second[0][2] - first[0][2]
        widest = max(np.dtype(code).itemsize for _, code, _ in first)
        same = [(field, code, at + stride) for field, code, at in first] == second
        if not same or stride != self._aligned(stride, widest):  # their alignment varies
            return None
        names, codes, places = zip(*first, strict=True)
        formats, offsets = [self._order + code for code in codes], [at - start for at in places]
        dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": end - start})
        last = start + (count - 1) * stride + dtype.itemsize
        if last > len(self._data):
            raise ValueError(f"{count} entries of {stride} bytes exceed the message")
        self._at = last
        return np.ndarray((count,), dtype, self._data, start, (stride,))

    def _layout(self, name: str, at: int) -> tuple[list[tuple[str, str, int]], int]:
        """(field, code, byte) of a message of numbers only that starts at a byte, and its end; else empty."""
        fields = []
        for field, (kind, content) in self._definitions[name][1]:
            if kind != BASE or content[0] == "string":
                return [], at
            code = _CODES[content[0]]
            size = np.dtype(code).itemsize
            at = self._aligned(at, size)
            fields.append((field, code, at))
            at += size
        return fields, at
