"""Messages: damaged and forged datagrams are refused, and take no memory."""

from __future__ import annotations

import math
import struct
import warnings
from collections import Counter
from dataclasses import replace
from random import Random

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.random_components import random_components
from sharing.message_examples import channel_examples, examples, forged, sealed
from sharing.structured_bodies import structured

from gmmtorch.errors import DataError
from gmmtorch.mapping import LARGEST_VARIANCE, MOST_POINTS, BitWriter, Components
from gmmtorch.mapping.codec import component_batch as batches
from gmmtorch.team.sharing.messages import message_registry
from gmmtorch.team.sharing.messages.component_messages import (
    MOST_COMPONENTS_SENT,
    ComponentsMessage,
    CountsMessage,
    encode_components,
    encode_counts,
)
from gmmtorch.team.sharing.messages.datagrams import CODECS, FARTHEST, Kind
from gmmtorch.team.sharing.messages.message_registry import Message, decode
from gmmtorch.team.sharing.messages.mission_messages import (
    PlanMessage,
    PointsMessage,
    ViewsMessage,
    encode_plan,
    encode_points,
    encode_views,
)
from gmmtorch.team.sharing.messages.record_messages import (
    AnnouncementMessage,
    CalibrationMessage,
    CorrectionMessage,
    CountersMessage,
    FrameMessage,
    SupersessionMessage,
    encode_announcements,
    encode_record,
)
from gmmtorch.team.sharing.replica.replica import Replica
from gmmtorch.team.sharing.view_library import ViewLibrary


@pytest.fixture(scope="module")
def sound() -> list[bytes]:
    return examples()


def test_every_kind_decodes_to_its_message(sound):
    kinds = [ComponentsMessage] * 3 + [CountsMessage] * 3 + [PointsMessage, ViewsMessage, PlanMessage]
    kinds += [AnnouncementMessage, SupersessionMessage, CountersMessage, CorrectionMessage, FrameMessage]
    kinds.append(CalibrationMessage)
    assert [type(decode(datagram)) for datagram in sound] == kinds
    version = {8: 0x20, 9: 0x20}  # views and plans
    assert [datagram[0] for datagram in sound] == [
        version.get(kind, 0x10) | kind for kind in [*range(1, 14), 15, 0]
    ]


def test_every_damage_of_a_datagram_is_detected(sound):
    for datagram in [*sound, *channel_examples()]:
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
    for first, versions in (
        (0x24, "version 2.*version 1"),
        (0x19, "version 1.*version 2"),
        (0x38, "version 3"),
    ):
        with pytest.raises(DataError, match=versions):
            decode(sealed(bytes([first]) + bytes(9)))
    with pytest.raises(DataError, match="kind 14"):
        decode(sealed(b"\x1e" + bytes(9)))
    with pytest.raises(DataError, match="1201 bytes"):
        decode(bytes(1201))
    with pytest.raises(DataError, match="empty"):
        decode(b"")


def assert_sound(message: Message) -> None:
    """Finite, bounded and positive definite, and no larger than a datagram can hold."""
    for value in vars(message.components if isinstance(message, ComponentsMessage) else message).values():
        if isinstance(value, torch.Tensor):
            assert value.numel() <= 1 << 17
            assert not value.is_floating_point() or bool(torch.isfinite(value).all())
    if isinstance(message, ComponentsMessage):
        c = message.components.checked()
        assert not torch.linalg.cholesky_ex(c.covariances).info.any()
        assert 1 <= len(c) <= MOST_COMPONENTS_SENT
        assert len(c.seen_by) <= MOST_COMPONENTS_SENT
        assert float(c.covariances.abs().max()) <= LARGEST_VARIANCE
        assert float(c.support.max()) <= MOST_POINTS
        assert 0 <= int(c.ids.min()) <= int(c.ids.max()) < 1 << 60
        assert sum(value.numel() for value in c.attributes.tensors().values()) <= 1 << 17
    if isinstance(message, CountsMessage):
        assert all(0 <= count <= 2.0**40 for count in message.counts.values())
    for places in places_of(message):
        assert not places.numel() or float(places.abs().max()) <= FARTHEST


def places_of(message: Message) -> list[torch.Tensor]:
    if isinstance(message, ComponentsMessage):
        return [message.components.means, message.components.origins]
    if isinstance(message, PointsMessage):
        return [message.origin, message.ends]
    if isinstance(message, ViewsMessage):
        return [message.poses[:, :3]]
    if isinstance(message, PlanMessage):
        return [message.path[:, :3], message.views[:, :3]]
    if isinstance(message, CorrectionMessage | FrameMessage) and message.pose is not None:
        return [message.pose[: message.dim]]
    return []


def encoded_again(message: Message, kind: Kind) -> list[bytes]:
    """The datagrams of a decoded message."""
    if isinstance(message, ComponentsMessage):
        return encode_components(message.components, _CODEC[kind])
    if isinstance(message, CountsMessage):
        return encode_counts(message.sender, message.counts, _CODEC[kind])
    if isinstance(message, PointsMessage):
        return encode_points(message.sender, message.frame, message.origin, message.ends, message.is_hit)
    if isinstance(message, ViewsMessage):
        return encode_views(message)
    if isinstance(message, PlanMessage):
        m = message
        return encode_plan(m.sender, m.number, m.time, m.step, m.path, m.views)
    if isinstance(message, AnnouncementMessage):
        return encode_announcements(message.sender, message.incarnation, message.held)
    return [encode_record(message)]


_CODEC = {
    kind: codec
    for kinds in ((1, 2, 3), (4, 5, 6))
    for kind, codec in zip(map(Kind, kinds), CODECS, strict=True)
}


def content(message: Message) -> list[object]:
    """The values of a message, comparable."""
    if isinstance(message, ComponentsMessage):
        c = message.components
        return [getattr(c, name).tolist() for name in ("ids", "means", "covariances", "support", "max_range")]
    if isinstance(message, PointsMessage):  # except the part number
        return [message.sender, message.origin.tolist(), message.ends.tolist(), message.is_hit.tolist()]
    if isinstance(message, AnnouncementMessage):
        return [message.sender, message.incarnation, message.held.pairs()]
    rows = vars(message).values()
    return [value.tolist() if hasattr(value, "tolist") else value for value in rows]


def joined(found: list[Message]) -> list[object]:
    """The content of a message that takes several datagrams."""
    if len(found) > 1 and all(isinstance(message, ComponentsMessage) for message in found):
        return content(ComponentsMessage(Components.concatenate([m.components for m in found])))
    return content(found[0]) if len(found) == 1 else []


def try_decode(datagram: bytes) -> bool:
    try:
        message = decode(datagram)
    except DataError:
        return False
    assert_sound(message)
    return True


@settings(max_examples=300)
@given(kind=st.integers(1, 14), body=st.binary(max_size=1300))
def test_noise_is_refused_or_valid_if_it_has_a_valid_checksum(kind, body):
    assert not try_decode(body)
    body = body[:400]
    try_decode(sealed(b"\x11" + sealed(b"\x01" + body)) if kind == 1 else sealed(bytes([0x10 | kind]) + body))


def test_forged_datagrams_are_refused_or_valid(sound):
    rng, n_accepted = np.random.default_rng(0), 0
    for trial in range(1500):
        datagram = sound[trial % len(sound)]
        body = bytearray(datagram[1:-4])
        for place in rng.integers(0, len(body), rng.integers(1, 5)):
            body[place] = rng.integers(0, 256)
        n_accepted += try_decode(forged(datagram, bytes(body[: len(body) - rng.choice([0, 0, 0, 1, 7])])))
    assert n_accepted > 50  # so that enough accepted messages are checked


@pytest.mark.parametrize("n", [2**20, 2**40, 2**61])
@pytest.mark.parametrize("kind", [4, 8, 9])
def test_false_lengths_take_no_memory(n, kind):
    """The largest number of ids or poses that the format can state."""
    writer = BitWriter()
    for value in {4: (1, 1, 0, n, 0), 8: (1, 0, n, 0), 9: (1, 1, 1, 1, n)}[kind]:
        writer.number(value)
    with pytest.raises(DataError):
        decode(sealed(bytes([0x10 | kind]) + writer.to_bytes() + bytes(900)))


@pytest.mark.parametrize(("kind", "place"), [(3, 8), (6, 5), (7, 40)])
def test_a_signalling_nan_is_refused_without_a_warning(sound, kind, place):
    """A cast of such a float32 would warn."""
    (datagram,) = (each for each in sound if each[0] & 15 == kind)
    body = datagram[1:-4]
    changed = body[:place] + struct.pack("<I", 0x7F800001) + body[place + 4 :]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(DataError):
            decode(forged(datagram, changed))


# -- forged by a stranger that knows the format ----------------------------------------------------------


class Listeners:
    """A replica and a view library that receive every valid message."""

    def __init__(self) -> None:
        self.replica = Replica(0, incarnation=1, most_components=2000)
        self.library = ViewLibrary(0, incarnation=1)

    def hear(self, datagram: bytes, message: Message) -> None:
        self.replica.receive(datagram, message)
        if isinstance(message, ViewsMessage):
            self.library.receive(message, 0.0)


@pytest.mark.parametrize("kind", list(Kind))
@settings(max_examples=40)
@given(rng=st.randoms(use_true_random=False))
def test_structured_bodies_are_refused_or_can_be_encoded_again(kind, rng):
    datagram = structured(kind, rng)
    try:
        message = decode(datagram)
    except DataError:
        assert not Replica(0, incarnation=1).receive(datagram)
        return
    assert_sound(message)
    Listeners().hear(datagram, message)
    again = [decode(each) for each in encoded_again(message, kind)]
    if len(again) == 1 or isinstance(message, ComponentsMessage):
        assert joined(again) == content(message)


def test_many_structured_bodies_are_accepted_and_many_refused():
    """Both outcomes occur often enough, and no state of the receivers raises."""
    listeners = Listeners()
    for kind in Kind:
        found: Counter[bool] = Counter()
        for seed in range(30):
            datagram = structured(kind, Random(seed))
            found[try_decode(datagram)] += 1
            try:
                listeners.hear(datagram, decode(datagram))
            except DataError:
                assert not listeners.replica.receive(datagram)
        assert min(found[True], found[False]) >= 2, (kind, found)


FIELDS = {  # number of the example, place in its body, layout, invalid values
    "first mean of float components": (1, 13, "<d", [math.nan, 1e300, 2 * FARTHEST, -1e9]),
    "first variance": (1, 13 + 9 * 24, "<d", [-1.0, 1e300]),
    "first support": (1, 13 + 9 * 72, "<d", [1e300, 1e13]),
    "first origin": (1, 13 + 9 * (24 + 48 + 8 + 1 + 16), "<d", [1e300, 2 * FARTHEST, -1e9]),
    "sensor position of a thesis message": (2, 8, "<f", [3e38, 2 * FARTHEST, -1e9]),
    "mean of a thesis message": (2, 20, "<f", [3e38, 2 * FARTHEST, -1e9]),
    "origin of points": (6, 6, "<d", [1e300, 2 * FARTHEST, -1e9]),
    "a point": (6, 36, "<f", [3e38, 2 * FARTHEST, -1e9]),
}


@pytest.mark.parametrize("field", FIELDS)
def test_impossible_numbers_are_refused(sound, field):
    number, place, layout, values = FIELDS[field]
    body = sound[number][1:-4]
    for value in values:
        stored = struct.pack(layout, value)
        with pytest.raises(DataError):
            decode(forged(sound[number], body[:place] + stored + body[place + len(stored) :]))


def test_messages_without_components_are_refused(sound):
    """In every codec; in float64, K, S and E are zero."""
    with pytest.raises(DataError, match="0 components"):
        decode(forged(sound[1], struct.pack("<BIII", 3, 0, 1 << 31, 1 << 31)))
    with pytest.raises(DataError, match="0 components"):
        decode(bytes.fromhex("1203000000000000000000000000c8edadeb"))
    assert not Replica(0).receive(bytes.fromhex("1203000000000000000000000000c8edadeb"))
    with pytest.raises(DataError, match="0 components"):
        decode(b"\x11" + batches.encode(Components.empty(3)))
    for datagram in (sealed(b"\x13"), *(sealed(bytes([0x10 | kind, 2])) for kind in (5, 6))):
        with pytest.raises(DataError):
            decode(datagram)


@pytest.mark.parametrize("shift", [1.0, 1.01])
def test_positions_beyond_the_limit_of_messages_are_refused(shift):
    """Files may contain positions that messages may not."""
    one = random_components(3, k=1, extent=0.0, n_origins=1, max_sightings=1, deviations=(0.01, 0.1))
    far = replace(one, means=one.means + shift * FARTHEST)
    assert try_decode(b"\x11" + batches.encode(far)) == (shift == 1.0)


def test_unexpected_errors_of_a_reader_refuse_the_datagram(sound, monkeypatch):
    for error in (ValueError, OverflowError, ZeroDivisionError, IndexError, RuntimeError):

        def careless(body: bytes, error: type[Exception] = error) -> Message:
            raise error("oh")

        monkeypatch.setitem(message_registry._KINDS, Kind.PLAN, ("plans", careless))
        with pytest.raises(DataError, match="oh"):
            decode(sound[8])
