"""Batches of components that are cut, changed or forged: refused, or decoded to valid components."""

from __future__ import annotations

import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.map_cases import assert_same_components
from mapping.random_components import random_components

from gmmtorch.errors import DataError
from gmmtorch.mapping.codec.bitstream import BitWriter
from gmmtorch.mapping.codec.component_batch import decode, encode
from gmmtorch.mapping.codec.quantization import quantized


def sealed(body: bytes) -> bytes:
    """The body with a valid checksum."""
    return body + zlib.crc32(body).to_bytes(4, "little")


@pytest.fixture(scope="module")
def sound() -> bytes:
    return encode(random_components(3, k=12))


def test_every_cut_and_every_flipped_bit_is_refused(sound):
    for length in range(len(sound)):
        with pytest.raises(DataError):
            decode(sound[:length])
    for bit in range(8 * len(sound)):
        damaged = bytearray(sound)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(DataError):
            decode(bytes(damaged))


def test_bytes_after_a_batch_are_refused(sound):
    for longer in (sound + b"\0", sealed(sound[:-4] + b"\0"), sealed(sound[:-4] + b"\1\2\3")):
        with pytest.raises(DataError):
            decode(longer)


def test_another_version_is_refused_by_name(sound):
    with pytest.raises(DataError, match="version 9"):
        decode(sealed(b"\x09" + sound[1:-4]))


@settings(max_examples=120)
@given(
    changes=st.lists(
        st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=4
    ),
    cut=st.sampled_from([0, 0, 1, 8]),
)
def test_forged_batches_are_refused_or_decode_to_valid_components(sound, changes, cut):
    body = bytearray(sound[:-4])
    for place, value in changes:
        body[1 + int(place * (len(body) - 1))] = value
    try:
        found = decode(sealed(bytes(body[: len(body) - cut])))
    except DataError:
        return
    found.checked()
    assert bool((found.seen_count >= 0).all())
    assert_same_components(decode(encode(found)), quantized(found))


@pytest.mark.parametrize("k", [2**20, 2**40, 2**61])
@pytest.mark.parametrize("what", ["components", "origins"])
def test_forged_array_lengths_allocate_no_memory(k, what):
    writer = BitWriter()
    for number in (3, k, 1) if what == "components" else (3, 1, k):
        writer.number(number)
    with pytest.raises(DataError, match="announced"):
        decode(sealed(b"\x01" + writer.to_bytes() + bytes(2000)))
