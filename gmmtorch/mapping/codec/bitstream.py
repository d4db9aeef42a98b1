"""Bit streams of whole numbers: each column is written in the shortest of a few codes; see docs/formats.md.

NumPy instead of torch: the bytes live on the CPU, and every code is a handful of vector operations without a
loop over numbers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gmmtorch.errors import DataError, InvalidArgumentError

Ints = NDArray[np.int64]

MAX_WIDTH = 62
"""Largest width of a number in bits: int64 without the sign and without the bit that zigzag adds."""
MAX_BYTES = 1 << 28
"""Largest length of a stream, about 25 million components. A reader expands every bit to a byte."""
_BLOCK = 1 << 16  # numbers processed at a time; their bits take up to 24 bytes each
_GROUP = 7  # bits in a group of a single number
_FIXED, _RICE, _DIFFERENCES, _GOLOMB = range(4)
"""Codes of a column: each number minus the smallest, in the width of the largest difference; the same in a
Rice code; the first number, then differences, zigzag, in a Rice code; the numbers of the second in an
exponential Golomb code."""
_IS_GOLOMB = 63
"""In place of the low bits of a Rice code: an exponential Golomb code follows."""


def zigzag(values: Ints) -> Ints:
    """Maps 0, −1, 1, −2, 2, … to 0, 1, 2, 3, 4, …"""
    return (values << 1) ^ (values >> 63)


def unzigzag(codes: Ints) -> Ints:
    """The inverse of `zigzag`."""
    return (codes >> 1) ^ -(codes & 1)


def _shortest_code(values: Ints) -> tuple[int, int, int]:
    """The shortest code of a column, its parameter (width, or number of low bits), and its base."""
    if not len(values):
        return _FIXED, 0, 0
    base, largest = int(values.min()), int(values.max())
    extent = largest - base
    if extent >> (MAX_WIDTH - 1) or (extent + abs(base)) >> MAX_WIDTH:
        raise InvalidArgumentError(f"Numbers from {base} to {largest} take more than {MAX_WIDTH} bits.")
    if base == largest:
        return _FIXED, 0, base
    width, (low, n_bits), steps = extent.bit_length(), _rice_code(values - base), np.diff(values)
    found = [(width * float(len(values)), _FIXED, width, base), (n_bits, _RICE, low, base)]
    low, n_bits = _golomb_code(values - base)
    found.append((n_bits, _GOLOMB, low, base))
    # The reader limits this sum.
    if abs(float(values[0])) + float(np.abs(steps.astype(np.float64)).sum()) < 2.0**MAX_WIDTH:
        low, n_bits = _rice_code(zigzag(steps))
        found.append((n_bits, _DIFFERENCES, low, int(values[0])))
    return min(found)[1:]


def _rice_code(values: Ints) -> tuple[int, float]:
    """Low bits of the shortest Rice code of numbers (N,) ≥ 0, and its size in bits: a float, which does not
    overflow."""
    n = len(values)
    if not n:
        return 0, 0.0
    about = int(np.log2(values.sum(dtype=np.float64) / n + 1))
    lows = [min(max(about + more, 0), MAX_WIDTH - 1) for more in (-1, 0, 1)]
    n_bits = [float((values >> low).sum(dtype=np.float64)) + (low + 1.0) * n for low in lows]
    best = int(np.argmin(n_bits))
    return lows[best], n_bits[best]


def _golomb_code(values: Ints) -> tuple[int, float]:
    """Low bits of the shortest exponential Golomb code of numbers (N,) ≥ 0, and its size in bits."""
    if not len(values):
        return 0, 0.0
    about = int(np.log2(np.median(values) + 1))
    lows = [max(about - less, 0) for less in (2, 1, 0)]
    n_bits = [float((2.0 * _lengths(values, low) + low + 1).sum()) for low in lows]
    best = int(np.argmin(n_bits))
    return lows[best], n_bits[best]


def _lengths(values: Ints, low: int) -> Ints:
    """Bits of (n >> low) + 1 after the first, of numbers (N,) ≥ 0."""
    whole = (values >> low) + 1
    lengths: Ints = np.frexp(whole.astype(np.float64))[1].astype(np.int64) - 1
    return lengths - (np.int64(1) << lengths > whole)  # float64 may round up to the next power of two


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
        """Writes each number ≥ 0 in `widths` bits, or each in its own."""
        for begin in range(0, len(values), _BLOCK):
            block = values[begin : begin + _BLOCK]
            if isinstance(widths, int):
                bits = block[:, None] >> _shifts(widths)
            else:
                width = widths[begin : begin + _BLOCK]
                bits = np.repeat(block, width) >> _exponents(width)
            self._parts.append((bits & 1).astype(np.uint8).reshape(-1))

    def one(self, value: int, width: int) -> None:
        """Writes one number ≥ 0 in `width` bits: the bits of `fixed`, without arrays."""
        bits = [(value >> shift) & 1 for shift in range(width - 1, -1, -1)]
        self._parts.append(np.array(bits, np.uint8))

    def rice(self, values: Ints, low: int) -> None:
        """Writes each number ≥ 0: the part above its `low` bits in unary (zeros, then a one); then all low
        bits."""
        self._unary(values >> low)
        self.fixed(values & ((np.int64(1) << low) - 1), low)

    def golomb(self, values: Ints, low: int) -> None:
        """Writes each number n ≥ 0: with m = (n >> low) + 1, how many bits m has after the first, in unary;
        then for each number these bits and the `low` bits of n."""
        lengths = _lengths(values, low)
        self._unary(lengths)
        self.fixed(values + (np.int64(1) << low) - (np.int64(1) << (lengths + low)), lengths + low)

    def _unary(self, values: Ints) -> None:
        """Writes each number ≥ 0 as so many zeros, then a one."""
        ends = np.cumsum(values + 1)
        bits = np.zeros(int(ends[-1]) if len(ends) else 0, np.uint8)
        bits[ends - 1] = 1
        self._parts.append(bits)

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
        """Writes whole numbers in their shortest code: code, parameter, base, numbers."""
        code, parameter, base = _shortest_code(values)
        self.one(code, 2)
        self.one(parameter, 6)
        self.number(base)
        if code == _FIXED:
            self.fixed(values - base, parameter)
        elif code == _GOLOMB:
            self.golomb(values - base, parameter)
        else:
            self.rice(zigzag(np.diff(values)) if code == _DIFFERENCES else values - base, parameter)

    def short(self, values: Ints) -> None:
        """Writes numbers ≥ 0 in a Rice or an exponential Golomb code, after its low bits: at least one bit
        for each number."""
        (low, n_bits), (other, n_other) = _rice_code(values), _golomb_code(values)
        if n_other + 6 < n_bits:
            self.one(_IS_GOLOMB, 6)
            self.one(other, 6)
            self.golomb(values, other)
        else:
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
            wide, ends = np.flatnonzero(block), np.cumsum(block)
            if len(wide):
                bits = self._next(int(ends[-1])) << _exponents(block)
                values[begin + wide] = np.add.reduceat(bits, (ends - block)[wide])
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
        if n == 0:
            return np.zeros(0, np.int64)
        high = self._unary(n)
        _check_width(int(np.max(low)) + int(high.max()).bit_length())
        return (high << low) | self.fixed(n, low)

    def golomb(self, n: int, low: int) -> Ints:
        """Reads n numbers ≥ 0 in an exponential Golomb code."""
        if n == 0:
            return np.zeros(0, np.int64)
        widths = self._unary(n) + low
        _check_width(int(widths.max()) + 1)
        return (np.int64(1) << widths) - (np.int64(1) << low) + self.fixed(n, widths)

    def _unary(self, n: int) -> Ints:
        """Reads n ≥ 1 numbers, each as so many zeros, then a one."""
        self.require(n)
        ones = np.flatnonzero(self._bits[self._at :])[:n]
        if len(ones) < n:
            raise DataError(f"{n:,} numbers are announced, {len(ones):,} are present: it is truncated.")
        self._at += int(ones[-1]) + 1
        ones[1:] -= ones[:-1] + 1
        return ones

    def column(self, n: int) -> Ints:
        """Reads n whole numbers, |x| < 2⁶²."""
        code, parameter = self.one(2), self.one(6)
        base = self.number()
        if code == _FIXED:
            return _shifted_by(base, self.fixed(n, parameter))
        if code == _RICE:
            return _shifted_by(base, self.rice(n, parameter))
        if code == _GOLOMB:
            return _shifted_by(base, self.golomb(n, parameter))
        steps = np.append(np.int64(base), unzigzag(self.rice(max(n - 1, 0), parameter)))
        if float(np.abs(steps.astype(np.float64)).sum()) >= 2.0**MAX_WIDTH:
            raise DataError("The sum of a column's differences is too large: it is damaged.")
        return steps.cumsum()[:n]

    def short(self, n: int) -> Ints:
        """Reads n numbers ≥ 0."""
        low = self.one(6)
        return self.golomb(n, self.one(6)) if low == _IS_GOLOMB else self.rice(n, low)

    def scaled(self, scales: Ints) -> Ints:
        """Reads one whole number for each scale."""
        t = self.one(4)
        return unzigzag(self.rice(len(scales), np.maximum(scales - t, 0)))


def within(values: Ints, name: str, least: int, largest: int) -> Ints:
    """The values, if all are from `least` to `largest`; otherwise raises `DataError`."""
    if len(values) and not (int(values.min()) >= least and int(values.max()) <= largest):
        raise DataError(f"The {name} reach from {values.min()} to {values.max()}, not {least} to {largest}.")
    return values


def _shifts(width: int) -> Ints:
    """Exponents of the bits of a number of this width, highest first."""
    return np.arange(width - 1, -1, -1)


def _exponents(widths: Ints) -> Ints:
    """Exponents of all bits of numbers of these widths, highest first."""
    ends = np.cumsum(widths)
    exponents: Ints = np.repeat(ends, widths) - 1 - np.arange(ends[-1])
    return exponents


def _check_width(widest: int) -> None:
    if widest > MAX_WIDTH:
        raise DataError(f"A number has {widest} bits; at most {MAX_WIDTH} are read.")


def _shifted_by(base: int, above: Ints) -> Ints:
    if len(above) and int(above.max()) + abs(base) >= 1 << MAX_WIDTH:
        raise DataError("A column's numbers are too large: it is damaged.")
    return above + base
