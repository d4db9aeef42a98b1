"""Bit streams of whole numbers: each column is written in the shortest of a few codes; see docs/formats.md.

NumPy instead of torch: the bytes live on the CPU, and every code is a handful of vector operations without a
loop over numbers.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gmmtorch.errors import DataError, InvalidArgumentError

Ints = NDArray[np.int64]

MAX_WIDTH = 62
"""Largest width of a number in bits: int64 without the sign and without the bit that zigzag adds."""
MAX_BYTES = 1 << 28
"""Largest length of a stream, about 25 million components. A reader expands every bit to a byte."""
_BLOCK = 1 << 16  # numbers processed at a time; their bits take up to 24 bytes each
_CANDIDATES = np.array([-1, 0, 1])  # offsets of the low bits that a Rice code tries
_GROUP = 7  # bits in a group of a single number


class Code(IntEnum):
    """The code of a column."""

    FIXED = 0  # each number minus the smallest, in the width of the largest difference
    RICE = 1  # each number minus the smallest, in a Rice code
    DIFFERENCES = 2  # the first number, then differences, zigzag, in a Rice code


def zigzag(values: Ints) -> Ints:
    """Maps 0, −1, 1, −2, 2, … to 0, 1, 2, 3, 4, …"""
    return (values << 1) ^ (values >> 63)


def unzigzag(codes: Ints) -> Ints:
    """The inverse of `zigzag`."""
    return (codes >> 1) ^ -(codes & 1)


class Coding(NamedTuple):
    """The code of a column, its parameter (width, or number of low bits), its base, and its size in bits."""

    code: Code
    parameter: int
    base: int
    n_bits: float


def best_code(values: Ints) -> Coding:
    """The shortest code of these whole numbers."""
    if not len(values):
        return Coding(Code.FIXED, 0, 0, 0.0)
    base, largest = int(values.min()), int(values.max())
    extent = largest - base
    if extent >> (MAX_WIDTH - 1) or (extent + abs(base)) >> MAX_WIDTH:
        raise InvalidArgumentError(f"Numbers from {base} to {largest} take more than {MAX_WIDTH} bits.")
    if base == largest:
        return Coding(Code.FIXED, 0, base, 0.0)
    codings = [
        Coding(
            code, int(parameter[0]), int(values[0]) if code is Code.DIFFERENCES else base, float(n_bits[0])
        )
        for code, (parameter, n_bits) in _codings(values[None]).items()
        if code is not Code.DIFFERENCES or _path_length(values) < 2.0**MAX_WIDTH
    ]
    return min(codings, key=lambda coding: coding.n_bits)


def _path_length(values: Ints) -> float:
    """|first number| plus all absolute differences: the reader limits this sum."""
    return abs(float(values[0])) + float(np.abs(np.diff(values).astype(np.float64)).sum())


def _codings(rows: Ints) -> dict[Code, tuple[Ints, NDArray[np.float64]]]:
    """Parameters (T,) of each code for rows (T, N), N > 0, and the sizes in bits (T,)."""
    base = rows.min(1)
    width = np.array([extent.bit_length() for extent in (rows.max(1) - base).tolist()])
    return {
        Code.FIXED: (width, width * float(rows.shape[1])),
        Code.RICE: _rice_codes(rows - base[:, None]),
        Code.DIFFERENCES: _rice_codes(zigzag(rows[:, 1:] - rows[:, :-1])),
    }


class BitWriter:
    """Writes bits, most significant first."""

    def __init__(self) -> None:
        self._parts: list[NDArray[np.uint8]] = []

    def to_bytes(self) -> bytes:
        """All bits; the last byte is filled with zeros."""
        data = np.packbits(np.concatenate(self._parts)).tobytes() if self._parts else b""
        if len(data) > MAX_BYTES:
            raise InvalidArgumentError(
                f"{len(data):,} bytes are more than {MAX_BYTES:,}; write several parts."
            )
        return data

    def fixed(self, values: Ints, widths: Ints | int) -> None:
        """Writes each number ≥ 0 in its width of bits."""
        for begin in range(0, len(values), _BLOCK):
            block = values[begin : begin + _BLOCK]
            if isinstance(widths, int):
                bits = block[:, None] >> _shifts(widths)
            else:
                which, shift = _bit_places(widths[begin : begin + _BLOCK])
                bits = block[which] >> shift
            self._parts.append((bits & 1).astype(np.uint8).reshape(-1))

    def one(self, value: int, width: int) -> None:
        """Writes one number ≥ 0 in `width` bits: the bits of `fixed`, without arrays."""
        bits = [(value >> shift) & 1 for shift in range(width - 1, -1, -1)]
        self._parts.append(np.array(bits, np.uint8))

    def rice(self, values: Ints, low: Ints | int) -> None:
        """Writes each number ≥ 0: the part above its `low` bits in unary (zeros, then a one); then all low
        bits."""
        ends = np.cumsum((values >> low) + 1)
        bits = np.zeros(int(ends[-1]) if len(ends) else 0, np.uint8)
        bits[ends - 1] = 1
        self._parts.append(bits)
        self.fixed(values & ((np.int64(1) << low) - 1), low)

    def number(self, value: int) -> None:
        """Writes one whole number: zigzag, groups of 7 bits, lowest first, each after a bit for "more"."""
        code = 2 * value if value >= 0 else -2 * value - 1
        if code.bit_length() > MAX_WIDTH + 1:
            raise InvalidArgumentError(f"{value} does not fit into {MAX_WIDTH} bits.")
        while True:
            more, group = code >> _GROUP, code & ((1 << _GROUP) - 1)
            self.one((more > 0) << _GROUP | group, 1 + _GROUP)
            if not more:
                return
            code = more

    def column(self, values: Ints) -> None:
        """Writes whole numbers in their shortest `Code`: code, parameter, base, numbers."""
        coding = best_code(values)
        self.one(coding.code, 2)
        self.one(coding.parameter, 6)
        self.number(coding.base)
        if coding.code is Code.FIXED:
            self.fixed(values - coding.base, coding.parameter)
        elif coding.code is Code.RICE:
            self.rice(values - coding.base, coding.parameter)
        else:
            self.rice(zigzag(np.diff(values)), coding.parameter)

    def rice_column(self, values: Ints) -> None:
        """Writes numbers ≥ 0 in a Rice code, after its low bits: at least one bit for each number."""
        low = int(_rice_codes(values[None])[0][0])
        self.one(low, 6)
        self.rice(values, low)


class BitReader:
    """Reads what `BitWriter` wrote. Raises `DataError` for streams that it cannot have written.

    The memory of a read is bounded by the length of the data; callers check the counts that they read with
    `require`.
    """

    def __init__(self, data: bytes) -> None:
        if len(data) > MAX_BYTES:
            raise DataError(f"{len(data):,} bytes are more than the {MAX_BYTES:,} that are read.")
        self._bits = np.unpackbits(np.frombuffer(data, np.uint8))
        self._at = 0

    @property
    def left(self) -> int:
        """Number of bits that are not read yet."""
        return len(self._bits) - self._at

    def require(self, n_bits: int) -> None:
        """Raises unless at least `n_bits` bits are left."""
        if n_bits > self.left:
            raise DataError(f"{n_bits:,} bits are announced, {self.left:,} are left: it is truncated.")

    def finish(self) -> None:
        """Raises if anything but the zeros of the last byte is left."""
        if self.left > 7 or self._bits[self._at :].any():
            raise DataError(f"{self.left:,} bits are left over: it is damaged.")

    def fixed(self, n: int, widths: Ints | int) -> Ints:
        """Reads n numbers of these widths."""
        if isinstance(widths, int):
            least = most = widths
        else:
            least, most = (int(widths.min()), int(widths.max())) if n else (0, 0)
        if n and not 0 <= least <= most <= MAX_WIDTH:
            raise DataError(f"Numbers of {most} bits; at most {MAX_WIDTH} are read.")
        self.require(n * widths if isinstance(widths, int) else int(widths.sum()))
        values = np.zeros(n, np.int64)
        for begin in range(0, n, _BLOCK):
            if isinstance(widths, int):
                rows = values[begin : begin + _BLOCK]
                bits = self._next(len(rows) * widths).reshape(len(rows), widths)
                rows[:] = (bits << _shifts(widths)).sum(1)
                continue
            block = widths[begin : begin + _BLOCK]
            which, shift = _bit_places(block)
            bits = self._next(len(which)) << shift
            wide = np.flatnonzero(block)
            if len(wide):
                values[begin + wide] = np.add.reduceat(bits, (np.cumsum(block) - block)[wide])
        return values

    def one(self, width: int) -> int:
        """Reads one number of `width` bits."""
        self.require(width)
        value = 0
        for bit in self._bits[self._at : self._at + width].tolist():
            value = value << 1 | bit
        self._at += width
        return value

    def _next(self, n: int) -> Ints:
        self._at += n
        return self._bits[self._at - n : self._at].astype(np.int64)

    def number(self) -> int:
        """Reads one whole number."""
        code = shift = 0
        while True:
            group = self.one(1 + _GROUP)
            code |= (group & ((1 << _GROUP) - 1)) << shift
            shift += _GROUP
            if code.bit_length() > MAX_WIDTH + 1 or shift > 70:
                raise DataError(f"A number has more than {MAX_WIDTH} bits: it is damaged.")
            if not group >> _GROUP:
                return code >> 1 if code % 2 == 0 else -((code + 1) >> 1)

    def rice(self, n: int, low: Ints | int) -> Ints:
        """Reads n numbers ≥ 0."""
        self.require(n)
        ones = np.flatnonzero(self._bits[self._at :])[:n]
        if len(ones) < n:
            raise DataError(f"{n:,} numbers are announced, {len(ones):,} are present: it is truncated.")
        if n == 0:
            return np.zeros(0, np.int64)
        high = ones.copy()  # the number of zeros before each one
        high[1:] -= ones[:-1] + 1
        self._at += int(ones[-1]) + 1
        widest = int(np.max(low)) + int(high.max()).bit_length()
        if widest > MAX_WIDTH:
            raise DataError(f"A number has {widest} bits; at most {MAX_WIDTH} are read.")
        return (high << low) | self.fixed(n, low)

    def column(self, n: int) -> Ints:
        """Reads n whole numbers, |x| < 2⁶²."""
        code, parameter = self.one(2), self.one(6)
        base = self.number()
        if code == Code.FIXED:
            return _shifted_by(base, self.fixed(n, parameter))
        if code == Code.RICE:
            return _shifted_by(base, self.rice(n, parameter))
        if code != Code.DIFFERENCES:
            raise DataError(f"A column has the unknown code {code}: it is damaged.")
        steps = np.append(np.int64(base), unzigzag(self.rice(max(n - 1, 0), parameter)))
        if float(np.abs(steps.astype(np.float64)).sum()) >= 2.0**MAX_WIDTH:
            raise DataError("The sum of a column's differences is too large: it is damaged.")
        return steps.cumsum()[:n]

    def rice_column(self, n: int) -> Ints:
        """Reads n numbers ≥ 0."""
        return self.rice(n, self.one(6))

    def scaled(self, scales: Ints) -> Ints:
        """Reads one whole number for each scale."""
        t = self.one(4)
        return unzigzag(self.rice(len(scales), np.maximum(scales - t, 0)))


def within(values: Ints, name: str, least: int, largest: int) -> Ints:
    """The values, if all are from `least` to `largest`; otherwise raises `DataError`."""
    if len(values) and not (int(values.min()) >= least and int(values.max()) <= largest):
        raise DataError(f"The {name} reach from {values.min()} to {values.max()}, not {least} to {largest}.")
    return values


def _bit_places(width: Ints) -> tuple[Ints, Ints]:
    """For each bit of numbers of these widths, highest first: the number's row, and the bit's exponent."""
    which = np.repeat(np.arange(len(width)), width)
    return which, np.cumsum(width)[which] - 1 - np.arange(len(which))


def _shifts(width: int) -> Ints:
    """Exponents of the bits of a number of this width, highest first."""
    return np.arange(width - 1, -1, -1)


def _shifted_by(base: int, above: Ints) -> Ints:
    if len(above) and int(above.max()) + abs(base) >= 1 << MAX_WIDTH:
        raise DataError("A column's numbers are too large: it is damaged.")
    return above + base


def _rice_codes(rows: Ints) -> tuple[Ints, NDArray[np.float64]]:
    """Low bits (T,) of the shortest Rice codes of rows (T, N) of numbers ≥ 0, and sizes in bits (T,).

    Sizes are floats, which do not overflow.
    """
    t, n = rows.shape
    if not n:
        return np.zeros(t, np.int64), np.zeros(t)
    about = np.log2(_sums(rows) / n + 1).astype(np.int64)
    low = np.minimum(np.maximum(about[:, None] + _CANDIDATES, 0), MAX_WIDTH - 1)
    size = _sums(rows[:, None] >> low[:, :, None]) + (low + 1.0) * n
    best = (np.arange(t), np.argmin(size, axis=1))
    return low[best], size[best]


def _sums(values: Ints) -> NDArray[np.float64]:
    """Sums over the last axis, float64."""
    return np.add.reduce(values, axis=-1, dtype=np.float64)
