"""Messages: whatever comes in that nobody sent is refused, and takes no memory."""

from __future__ import annotations

import math
import struct
import warnings

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sharing.message_examples import (
    examples,
    sealed,
)

from gmmtorch.errors import DataError
from gmmtorch.mapping.bitstream import BitWriter
from gmmtorch.sharing.messages import (
    ComponentsMessage,
    CountsMessage,
    PlanMessage,
    PointsMessage,
    ViewsMessage,
    decode,
)


@pytest.fixture(scope="module")
def sound() -> list[bytes]:
    return examples()


def test_every_kind_says_what_it_is(sound):
    kinds = [type(decode(datagram)) for datagram in sound]
    assert kinds == [ComponentsMessage] * 3 + [CountsMessage] * 3 + [PointsMessage, ViewsMessage, PlanMessage]
    assert [datagram[0] for datagram in sound] == [0x11, 0x12, 0x13, 0x14, 0x15, 0x16, 0x17, 0x18, 0x19]


def test_every_cut_flipped_bit_and_added_byte_is_noticed(sound):
    for datagram in sound:
        for length in range(len(datagram)):
            with pytest.raises(DataError):
                decode(datagram[:length])
        for bit in range(8 * len(datagram)):
            damaged = bytearray(datagram)
            damaged[bit // 8] ^= 1 << bit % 8
            with pytest.raises(DataError):
                decode(bytes(damaged))
        with pytest.raises(DataError):
            decode(datagram + b"\0")


def test_other_versions_kinds_and_sizes_are_refused_by_name():
    with pytest.raises(DataError, match="version 2"):
        decode(sealed(b"\x24" + bytes(9)))
    with pytest.raises(DataError, match="kind 15"):
        decode(sealed(b"\x1f" + bytes(9)))
    with pytest.raises(DataError, match="1201 bytes"):
        decode(bytes(1201))
    with pytest.raises(DataError, match="empty"):
        decode(b"")


def assert_sound(message: object) -> None:
    """No NaN, nothing infinite or indefinite, and no more than a datagram can hold."""
    for value in vars(message.components if isinstance(message, ComponentsMessage) else message).values():
        if isinstance(value, torch.Tensor):
            assert value.numel() <= 1 << 17
            assert not value.is_floating_point() or bool(torch.isfinite(value).all())
    if isinstance(message, ComponentsMessage):
        message.components.checked()
        assert not torch.linalg.cholesky_ex(message.components.covariances).info.any()
    if isinstance(message, CountsMessage):
        assert all(0 <= count <= 2.0**40 for count in message.counts.values())


def try_decode(datagram: bytes) -> bool:
    try:
        message = decode(datagram)
    except DataError:
        return False
    assert_sound(message)
    return True


@settings(max_examples=300)
@given(data=st.binary(max_size=1300))
def test_noise_is_refused(data):
    assert not try_decode(data)


@settings(max_examples=600)
@given(kind=st.integers(1, 9), body=st.binary(max_size=400))
def test_noise_with_a_sound_checksum_is_refused_or_sound(kind, body):
    try_decode(sealed(b"\x11" + sealed(b"\x01" + body)) if kind == 1 else sealed(bytes([0x10 | kind]) + body))


def forged(datagram: bytes, body: bytes) -> bytes:
    """A datagram of the same kind with another body and checksums that are right."""
    return datagram[:1] + sealed(body) if datagram[0] == 0x11 else sealed(datagram[:1] + body)


def test_thousands_of_forged_datagrams_are_refused_or_sound(sound):
    rng, n_accepted = np.random.default_rng(0), 0
    for trial in range(3000):
        datagram = sound[trial % len(sound)]
        body = bytearray(datagram[1:-4])
        for place in rng.integers(0, len(body), rng.integers(1, 5)):
            body[place] = rng.integers(0, 256)
        n_accepted += try_decode(forged(datagram, bytes(body[: len(body) - rng.choice([0, 0, 0, 1, 7])])))
    assert n_accepted > 100  # so that what is accepted was looked at


@pytest.mark.parametrize("n", [2**20, 2**40, 2**61])
@pytest.mark.parametrize("kind", [4, 8, 9])
def test_numbers_that_nothing_backs_take_no_memory(n, kind):
    """As many ids of one robot, or poses, as the format can announce."""
    writer = BitWriter()
    for value in {4: (1, 1, 0, n, 0), 8: (1, 0, n, 0), 9: (1, 1, 1, 1, n)}[kind]:
        writer.number(value)
    with pytest.raises(DataError):
        decode(sealed(bytes([0x10 | kind]) + writer.to_bytes() + bytes(900)))


@pytest.mark.parametrize(("kind", "place"), [(3, 8), (6, 5), (7, 40)])
def test_a_nan_that_signals_is_refused_without_a_warning(sound, kind, place):
    """As any other is; to cast such a float32 is what warns."""
    (datagram,) = (each for each in sound if each[0] & 15 == kind)
    body = datagram[1:-4]
    changed = body[:place] + struct.pack("<I", 0x7F800001) + body[place + 4 :]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(DataError):
            decode(forged(datagram, changed))


def test_float_components_that_are_none_are_refused(sound):
    datagram = sound[1]
    body = datagram[1:-4]
    for place, value in ((13, math.nan), (13 + 9 * 24, -1.0)):  # the first mean, the first variance
        changed = body[:place] + struct.pack("<d", value) + body[place + 8 :]
        with pytest.raises(DataError):
            decode(forged(datagram, changed))
    with pytest.raises(DataError, match="0 components"):
        decode(forged(datagram, struct.pack("<BIII", 3, 0, 1 << 31, 1 << 31)))
