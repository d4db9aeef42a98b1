"""What robots say of the views that they hold: what comes out is what went in, and nothing else comes in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sharing.message_examples import sealed, views

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mapping.codec.bitstream import BitWriter
from gmmtorch.sharing.messages.fields import write_intervals, write_keys
from gmmtorch.sharing.messages.message_registry import (
    MAX_BYTES,
    ViewsHeldMessage,
    ViewsMessage,
    decode,
    encode_views,
)
from gmmtorch.sharing.replica.intervals import Intervals
from gmmtorch.sharing.replica.record_keys import END, first_key
from gmmtorch.sharing.view_announcements import ViewsDetail, encode_views_held

DIGEST = bytes(range(1, 9))
keys = st.builds(
    lambda robot, life, number: first_key(robot, life) + number,
    st.integers(0, 20),
    st.integers(0, 1) | st.integers(0, (1 << 24) - 1),
    st.integers(0, 300),
) | st.integers(0, END - 1)


def of(numbers) -> Intervals:
    return Intervals.of(np.array(sorted(numbers), np.int64))


def detail_of(alive, dead, byte: int = 3, seed: int = 0) -> ViewsDetail:
    living = np.array(sorted(alive), np.int64)
    checks = np.random.default_rng(seed).integers(0, 256, len(living))
    return ViewsDetail(0, END, of(alive) | of(dead), living, byte, checks)


def run(robot: int, n: int) -> range:
    return range(first_key(robot, 77), first_key(robot, 77) + n)


def examples() -> list[bytes]:
    alive = {*run(2, 9), *list(run(3, 30))[::3]}
    return [
        *encode_views_held(900, DIGEST),
        *encode_views_held(5, DIGEST, detail_of(alive, run(3, 30))),
        *encode_views(views(6, 3)),
    ]


# -- what comes out ----------------------------------------------------------------------------------------


@given(sender=st.integers(0, 1023), digest=st.binary(min_size=8, max_size=8))
def test_digests(sender, digest):
    (datagram,) = encode_views_held(sender, digest)
    assert len(datagram) <= 14 + (sender > 63)
    message = decode(datagram)
    assert isinstance(message, ViewsHeldMessage)
    assert (message.sender, message.digest, message.detail) == (sender, digest, None)


@settings(max_examples=80)
@given(
    alive=st.sets(keys, max_size=200),
    dead=st.sets(keys, max_size=200),
    byte=st.integers(0, 7),
    max_bytes=st.sampled_from([1000, MAX_BYTES]),
)
def test_details_say_all_that_is_known_and_each_datagram_its_part(alive, dead, byte, max_bytes):
    dead -= alive
    sent = detail_of(alive, dead, byte)
    datagrams = encode_views_held(7, DIGEST, sent, max_bytes)
    assert all(len(datagram) <= max_bytes for datagram in datagrams)
    scope, known, found, checks = Intervals.empty(), Intervals.empty(), [], []
    for message in map(decode, datagrams):
        assert (message.sender, message.digest, message.detail.byte) == (7, DIGEST, byte)
        assert message.detail.scope.covers(message.detail.known)
        assert not scope & message.detail.scope
        assert message.detail.dead == of(dead) & message.detail.scope
        scope, known = scope | message.detail.scope, known | message.detail.known
        found += message.detail.alive.tolist()
        checks += message.detail.checks.tolist()
    assert scope == Intervals.span(0, END)
    assert known == sent.known
    assert found == sorted(alive)
    assert checks == sent.checks.tolist()


def test_details_of_a_team_take_few_bytes():
    """Of 16 robots 300 views each, of which twenty are alive."""
    alive = {key for robot in range(16) for key in list(run(robot, 300))[5::15]}
    dead = {key for robot in range(16) for key in run(robot, 300)} - alive
    sizes = [len(datagram) for datagram in encode_views_held(3, DIGEST, detail_of(alive, dead))]
    assert sum(sizes) <= 16 * 20 + 2 * len(alive) + 2 * 40


@given(alive=st.sets(keys, max_size=60), dead=st.sets(keys, max_size=60))
def test_tombstones_arrive_in_any_number(alive, dead):
    sent = views(0)
    sent = ViewsMessage(sent.ids, sent.poses, sent.values, sent.stamps, of(dead))
    found = Intervals.empty()
    for datagram in encode_views(sent):
        found |= decode(datagram).removed
    assert found == of(dead)


# -- the format, by hand from docs/messages.md -------------------------------------------------------------


def test_a_detail_by_hand():
    """Robot 1 knows the first three views of robot 0's life 0, and of these the second is alive."""
    body = bytes([2]) + DIGEST + bytes([6, 0, 0])  # sender 1; byte 3 of fingerprints; of all keys
    body += bytes([2, 0, 4])  # one interval, from 0 on, of three
    body += bytes([2, 0, 2, 2]) + bytes([0xAB])  # one life, 0, of it one: number 1; its check
    (datagram,) = encode_views_held(
        1, DIGEST, ViewsDetail(0, END, Intervals.span(0, 3), np.array([1]), 3, np.array([0xAB]))
    )
    assert datagram == sealed(b"\x1e" + body)
    assert encode_views_held(1, DIGEST) == [sealed(b"\x1e" + bytes([2]) + DIGEST)]


def test_tombstones_by_hand():
    sent = views(0)
    removed = Intervals(np.array([2, 3, 10, 12], np.int64))
    (datagram,) = encode_views(ViewsMessage(sent.ids, sent.poses, sent.values, sent.stamps, removed))
    nothing = bytes([0, 0, 0])  # no ids; a column of no stamps: code and parameter, base
    assert datagram == sealed(b"\x18" + nothing + bytes([4, 4, 0, 14, 2]))


# -- hostile -----------------------------------------------------------------------------------------------


def test_every_cut_flipped_bit_and_added_byte_is_noticed():
    assert [datagram[0] for datagram in examples()] == [0x1E, 0x1E, 0x18]
    for datagram in examples():
        damaged = [datagram[:length] for length in range(len(datagram))]
        for bit in range(8 * len(datagram)):
            flipped = bytearray(datagram)
            flipped[bit // 8] ^= 1 << bit % 8
            damaged.append(bytes(flipped))
        for data in [*damaged, datagram + b"\0"]:
            with pytest.raises(DataError):
                decode(data)


def check_sound(datagram: bytes) -> bool:
    """Whether it is read; if so, it is written again as it can be."""
    try:
        message = decode(datagram)
    except DataError:
        return False
    if isinstance(message, ViewsMessage):
        assert Intervals.span(0, END).covers(message.removed)
        assert [decode(again).ids.tolist() for again in encode_views(message)] in (
            [message.ids.tolist()],
            [],
        )
        return True
    assert isinstance(message, ViewsHeldMessage)
    assert message.sender < 1024
    if message.detail is not None:
        detail = message.detail
        assert 0 <= detail.begin < detail.end <= END
        assert detail.scope.covers(detail.known)
        assert detail.known.covers(Intervals.of(detail.alive))
        assert (np.diff(detail.alive) > 0).all()
        assert len(detail.checks) == len(detail.alive) <= 8 * MAX_BYTES
        assert not detail.dead & Intervals.of(detail.alive)
    return True


@settings(max_examples=400)
@given(kind=st.sampled_from([8, 14]), body=st.binary(max_size=300))
def test_noise_with_a_sound_checksum_is_refused_or_sound(kind, body):
    check_sound(sealed(bytes([0x10 | kind]) + body))


def test_thousands_of_forged_datagrams_are_refused_or_sound():
    rng, n_accepted = np.random.default_rng(0), 0
    sound = examples()
    for trial in range(3000):
        datagram = sound[trial % len(sound)]
        body = bytearray(datagram[1:-4])
        for place in rng.integers(0, len(body), rng.integers(1, 4)):
            body[place] = rng.integers(0, 256)
        kept = len(body) - rng.choice([0, 0, 0, 1, 5])
        n_accepted += check_sound(sealed(datagram[:1] + bytes(body[:kept])))
    assert n_accepted > 100  # so that what is accepted was looked at


def written(*numbers: int, known: Intervals, alive: list[int]) -> bytes:
    writer = BitWriter()
    writer.number(1)
    writer.fixed(np.zeros(8, np.int64), 8)
    for number in numbers:
        writer.number(number)
    write_intervals(writer, known, numbers[1])
    write_keys(writer, np.array(alive, np.int64))
    writer.fixed(np.zeros(len(alive), np.int64), 8)
    return sealed(b"\x1e" + writer.to_bytes())


def test_details_of_nonsense_are_refused():
    known = Intervals.span(10, 20)
    assert check_sound(written(7, 5, END - 50, known=known, alive=[10, 19]))
    for numbers, alive in (
        ((8, 5, END - 50), [10]),  # fingerprints have eight bytes
        ((-1, 5, END - 50), [10]),
        ((0, -1, END - 50), [10]),
        ((0, 5, -1), [10]),  # beyond all keys
        ((0, 50, END - 50), []),  # of no keys
        ((0, 5, END - 15), [10]),  # known beyond the scope
        ((0, 5, END - 50), [20]),  # alive, and not known
    ):
        with pytest.raises(DataError):
            decode(written(*numbers, known=known, alive=alive))


@pytest.mark.parametrize(
    "changed",
    [
        {"byte": 8},
        {"known": Intervals.span(10, END + 1)},
        {"alive": np.array([10, 25])},  # and not known
        {"alive": np.array([12, 11])},
        {"checks": np.array([1])},
        {"checks": np.array([1, 256])},
    ],
)
def test_details_that_nobody_would_read_are_not_written(changed):
    detail = ViewsDetail(0, END, Intervals.span(10, 20), np.array([10, 11]), 3, np.array([1, 2]))
    assert len(encode_views_held(1, DIGEST, detail)) == 1
    with pytest.raises(InvalidArgumentError):
        encode_views_held(1, DIGEST, replace(detail, **changed))


def test_digests_that_nobody_would_read_are_not_written():
    for sender, digest in ((1024, DIGEST), (-1, DIGEST), (1, DIGEST[1:])):
        with pytest.raises(InvalidArgumentError):
            encode_views_held(sender, digest)


@pytest.mark.parametrize("n", [2**20, 2**40, 2**61])
def test_numbers_that_nothing_backs_take_no_memory(n):
    for numbers in ((0, 0, 0, n), (0, 0, 0, 0, n), (0, 0, 0, 0, 1, 0, n, 0)):
        writer = BitWriter()
        writer.number(1)
        writer.fixed(np.zeros(8, np.int64), 8)
        for number in numbers:
            writer.number(number)
        with pytest.raises(DataError):
            decode(sealed(b"\x1e" + writer.to_bytes() + bytes(900)))
