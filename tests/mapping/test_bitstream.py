"""Columns of whole numbers as bits, against codes by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mapping.codec.bitstream import BitReader, BitWriter, zigzag

whole_numbers = st.lists(st.integers(-(2**59), 2**59) | st.integers(-9, 9), max_size=40)


@settings(max_examples=100)
@given(values=whole_numbers)
def test_integer_columns_are_decoded_exactly(values):
    column = np.array(values, np.int64)
    writer = BitWriter()
    writer.column(column)
    reader = BitReader(writer.to_bytes())
    assert reader.column(len(column)).tolist() == values
    reader.finish()


@given(values=st.lists(st.integers(-(2**40), 2**40)), scales=st.data())
def test_scaled_and_single_numbers_are_decoded(values, scales):
    scale = np.array(
        [max(abs(v).bit_length() + scales.draw(st.integers(-3, 3)), 0) for v in values], np.int64
    )
    writer = BitWriter()
    writer.one(2, 4)  # as in batches of version 1
    codes, widths = zigzag(np.array(values, np.int64)).tolist(), np.maximum(scale - 2, 0).tolist()
    for code, width in zip(codes, widths, strict=True):  # the part above its low bits in unary
        for bit in [0] * (code >> width) + [1]:
            writer.one(bit, 1)
    for code, width in zip(codes, widths, strict=True):
        writer.one(code & ((1 << width) - 1), width)
    small = zigzag(np.array(values, np.int64)) % 1000
    writer.short(small)
    for value in values:
        writer.number(value)
    reader = BitReader(writer.to_bytes())
    assert reader.scaled(scale).tolist() == values
    assert reader.short(len(values)).tolist() == [int(v) for v in zigzag(np.array(values, np.int64)) % 1000]
    assert [reader.number() for _ in values] == values
    reader.finish()


def test_rice_codes_equal_those_by_hand():
    """With 2 low bits, 5 = 1·4 + 01 is 0 1 01 and 2 = 0·4 + 10 is 1 10."""
    writer = BitWriter()
    writer.rice(np.array([5, 2]), 2)
    assert writer.to_bytes() == bytes([0b011_01_10_0])


def test_golomb_codes_equal_those_by_hand():
    """With 1 low bit, 9 has m = 9 // 2 + 1 = 5 = 1·01 in binary, so 0 0 1, then 01 and the low bit 1; 0 has
    m = 1, so 1, then the low bit 0."""
    writer = BitWriter()
    writer.golomb(np.array([9, 0]), 1)
    assert writer.to_bytes() == bytes([0b001_1_01_1_0])


@given(values=st.lists(st.integers(0, 2**60) | st.integers(0, 9), min_size=1), low=st.integers(0, 20))
def test_golomb_codes_are_decoded_also_beside_powers_of_two(values, low):
    column = np.array([*values, 0, (1 << 53) - 1, 1 << 54, (1 << 60) - 1, (1 << 60) - (1 << low)], np.int64)
    writer = BitWriter()
    writer.golomb(column, low)
    reader = BitReader(writer.to_bytes())
    assert reader.golomb(len(column), low).tolist() == column.tolist()
    reader.finish()


@pytest.mark.parametrize("bits", ["0" * 70 + "1", "0" * 62 + "1" + "0" * 70, "0001"])
def test_damaged_golomb_codes_are_refused(bits):
    """A length beyond that of any number, and streams that end within one."""
    data = np.packbits(np.array(list(bits), np.uint8)).tobytes()
    with pytest.raises(DataError):
        BitReader(data).golomb(1, 9)


@pytest.mark.parametrize(
    ("values", "code"),
    [
        ([7] * 50, "fixed"),
        (list(range(1000, 1050)), "differences"),
        ([4, 0, 1, 9, 2, 6, 0, 3, 1, 12, 5, 2, 0, 7, 3, 1, 20, 4] * 3, "rice"),
        ([0] * 40 + [1, 2, 0, 300], "golomb"),
        ([3, 0, 2, 1] * 12, "fixed"),
    ],
)
def test_the_shortest_column_code_is_chosen(values, code):
    writer, width = BitWriter(), (max(values) - min(values)).bit_length()
    writer.column(np.array(values, np.int64))
    data = writer.to_bytes()
    assert ("fixed", "rice", "differences", "golomb")[BitReader(data).one(2)] == code
    assert len(data) <= math.ceil((8 + 70 + width * len(values)) / 8)


@given(
    ends=st.tuples(*[st.sampled_from([0, 1 << 53, 1 << 60, (1 << 61) - 1, -(1 << 61), -(1 << 62) + 1])] * 2),
    n=st.integers(1, 40),
    rises=st.booleans(),
)
def test_every_encodable_column_is_decoded(ends, n, rises):
    """Alternating extreme values overflow the sum of differences, however few bits they take."""
    column = np.array([ends[number % 2] for number in range(n)], np.int64)
    column = np.sort(column) if rises else column
    writer = BitWriter()
    try:
        writer.column(column)
    except InvalidArgumentError:
        assert max(map(abs, ends)) >= 1 << 60
        return
    reader = BitReader(writer.to_bytes())
    assert reader.column(n).tolist() == column.tolist()
    reader.finish()
