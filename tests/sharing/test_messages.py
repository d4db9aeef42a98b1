"""Messages of components, counts, points, views and plans: content, bytes by hand, and invalid input."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from invalid_values import each_value
from mapping.random_components import random_components
from sharing.message_examples import codecs, examples, frame_of_components, numbers, places, sealed, views

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mapping import BitWriter
from gmmtorch.mapping.codec.quantization import COUNT_ERROR, MOST_POINTS, quantize, quantized
from gmmtorch.mapping.components import Components
from gmmtorch.team.sharing import MAX_BYTES, PlanMessage, PointsMessage, decode, encode_plan
from gmmtorch.team.sharing.messages.component_messages import (
    MOST_COMPONENTS_SENT,
    CountsMessage,
    encode_components,
    encode_counts,
    fitted,
)
from gmmtorch.team.sharing.messages.datagrams import FARTHEST, Kind, first_byte, make_datagram, write_keys
from gmmtorch.team.sharing.messages.message_registry import kind_of
from gmmtorch.team.sharing.messages.mission_messages import (
    POINTS_PER_DATAGRAM,
    encode_points,
    encode_views,
    quantized_poses,
    quantized_views,
)
from gmmtorch.team.sharing.replica.record_keys import Intervals

# -- components ------------------------------------------------------------------------------------


@settings(max_examples=25)
@given(
    dim=st.sampled_from([2, 3]),
    k=st.integers(0, 3) | st.integers(0, 300),
    seed=st.integers(0, 999),
    center=places,
    extent=st.sampled_from([0.0, 6.0, 2e4]),
    max_sightings=st.integers(1, 3),
    robot=st.integers(0, 9),
)
def test_decoded_components_equal_the_quantized_ones(**options):
    components = random_components(**options)
    datagrams = encode_components(components)
    assert all(len(datagram) <= MAX_BYTES for datagram in datagrams)
    if not len(components):
        assert datagrams == []
        return
    found = Components.concatenate([decode(datagram).components for datagram in datagrams])
    expected = quantized(components)
    for name in ("means", "covariances", "support", "max_range", "ids", "seen_by", "seen_count"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    assert torch.equal(found.origins[found.seen_from], expected.origins[expected.seen_from])


@pytest.mark.parametrize("dim", [2, 3])
def test_float_components_are_decoded_exactly(dim):
    components = random_components(dim, k=40, center=5e5)
    datagrams = encode_components(components, "float")
    assert len(datagrams) > 1
    found = Components.concatenate([decode(datagram).components for datagram in datagrams])
    for name in ("means", "covariances", "support", "max_range", "ids", "seen_by", "seen_count"):
        assert torch.equal(getattr(found, name), getattr(components, name)), name
    assert torch.equal(found.origins[found.seen_from], components.origins[components.seen_from])


def test_thesis_components_are_57_bytes_each_and_float32():
    components = frame_of_components(50)
    datagrams = encode_components(components, "thesis")
    assert sum(map(len, datagrams)) == 57 * 50 + 5 * len(datagrams)
    found = Components.concatenate([decode(datagram).components for datagram in datagrams])
    for name in ("means", "covariances", "support"):
        assert torch.equal(getattr(found, name), getattr(components, name).float().double()), name
    assert torch.equal(found.seen_count, found.support[found.seen_by])
    assert torch.equal(found.origins[found.seen_from], components.origins.float().double().expand(50, 3))
    assert torch.equal(found.ids, components.ids)
    assert torch.equal(found.max_range, components.max_range)


@pytest.mark.parametrize("codec", ["float", "thesis"])
def test_covariances_that_round_to_indefinite_are_refused(codec):
    components = frame_of_components(3)
    flat = components.covariances.clone()
    flat[1] = torch.diag(torch.tensor([1.0, 1.0, -1e-12], dtype=torch.float64))
    with pytest.raises(InvalidArgumentError, match="codec=quantized"):
        encode_components(replace(components, covariances=flat), codec)
    assert len(encode_components(replace(components, covariances=flat))) == 1


def with_one(components: Components, name: str, value: float) -> Components:
    """The components with the first number of one field replaced."""
    changed = getattr(components, name).clone()
    changed.view(-1)[0] = value
    return replace(components, **{name: changed})


INVALID_COMPONENTS = {
    "means": [1e300, -2 * FARTHEST],
    "origins": [2 * FARTHEST],
    "covariances": [1e300, 2.0**41],
    "support": [2 * MOST_POINTS, math.nan],
    "ids": [-1, 1 << 60],
}


@pytest.mark.parametrize(("name", "value"), each_value(INVALID_COMPONENTS))
@codecs
def test_invalid_components_are_refused_before_sending(name, value, codec):
    one = random_components(3, k=3, n_origins=1, max_sightings=1)
    if name == "support":  # thesis messages contain only the counts of origins
        one = replace(one, seen_count=with_one(one, "support", value).support)
    with pytest.raises(InvalidArgumentError, match=name):
        encode_components(with_one(one, name, value), codec)


@pytest.mark.parametrize("max_sightings", [1, 5])
def test_datagrams_of_equal_components_are_bounded(max_sightings):
    """Thousands of equal components would fit into a datagram."""
    n = 3000
    one = random_components(3, k=1, n_origins=max_sightings, max_sightings=1)
    many = replace(
        one,
        means=one.means.expand(n, 3),
        covariances=(0.04 * torch.eye(3, dtype=torch.float64)).expand(n, 3, 3),
        support=one.support.expand(n),
        max_range=one.max_range.expand(n),
        ids=torch.stack([torch.zeros(n, dtype=torch.int64), torch.arange(n)], 1),
        seen_by=torch.arange(n).repeat_interleave(max_sightings),
        seen_from=torch.arange(max_sightings).repeat(n),
        seen_count=one.support.expand(n * max_sightings) / max_sightings,
    )
    for datagrams in (encode_components(many), [datagram for datagram, _ in fitted(quantize(many))]):
        found = [decode(datagram).components for datagram in datagrams]
        assert torch.equal(Components.concatenate(found).ids, many.ids)
        assert max(len(part.seen_by) for part in found) <= MOST_COMPONENTS_SENT
        assert max(len(part) for part in found) > MOST_COMPONENTS_SENT / max_sightings / 4


@pytest.mark.parametrize(
    ("n", "message"),
    [(900, "single component"), (MOST_COMPONENTS_SENT + 1, f"has {MOST_COMPONENTS_SENT + 1} viewpoints")],
)
@codecs
def test_a_component_with_too_many_origins_is_refused(codec, n, message):
    one = random_components(3, k=1, n_origins=n, max_sightings=1)
    many = replace(
        one,
        origins=torch.rand(n, 3, dtype=torch.float64) * 1e3,
        seen_by=torch.zeros(n, dtype=torch.int64),
        seen_from=torch.arange(n),
        seen_count=one.support.expand(n) / n,
    )
    with pytest.raises(InvalidArgumentError, match=message):
        encode_components(many, codec)
    with pytest.raises(InvalidArgumentError, match=message):
        list(fitted(quantize(many)))


def test_unknown_codecs_are_refused():
    for encode in (
        lambda: encode_components(Components.empty(3), "zip"),
        lambda: encode_counts(0, {}, "zip"),
    ):
        with pytest.raises(InvalidArgumentError, match="codec='zip'"):
            encode()


# -- counts ----------------------------------------------------------------------------------------


@example(sender=0, counts={(0, 0): 0.0, (0, 65): 0.0, (0, (1 << 60) - 125): 0.0})
@example(sender=0, counts={(0, 0): 0.0, (0, (1 << 60) - 1): 0.0})
@given(
    sender=numbers,
    counts=st.dictionaries(
        st.tuples(st.integers(0, 3) | numbers, numbers), st.just(0.0) | st.floats(1e-3, 1e12), max_size=60
    ),
)
def test_counts_are_decoded_within_their_step(sender, counts):
    found: dict[tuple[int, int], float] = {}
    for datagram in encode_counts(sender, counts):
        assert len(datagram) <= MAX_BYTES
        message = decode(datagram)
        assert isinstance(message, CountsMessage)
        assert message.sender == sender
        assert encode_counts(sender, message.counts) == [datagram]
        found |= message.counts
    assert list(found) == sorted(counts)
    for key, count in counts.items():
        assert found[key] == pytest.approx(count, rel=COUNT_ERROR + 1e-12, abs=0)


def test_counts_in_float_are_exact_and_in_the_thesis_codec_8_bytes():
    counts = {(robot, number): number + 0.3 for robot in (2, 0) for number in range(0, 900, 3)}
    exact = [decode(datagram) for datagram in encode_counts(4, counts, "float")]
    assert {key: count for message in exact for key, count in message.counts.items()} == counts
    datagrams = encode_counts(4, counts, "thesis")
    assert sum(map(len, datagrams)) == 8 * 600 + 6 * len(datagrams)
    rounded = {key: float(np.float32(count)) for key, count in counts.items()}
    assert {k: c for datagram in datagrams for k, c in decode(datagram).counts.items()} == rounded


@pytest.mark.parametrize("count", [-1.0, math.nan, math.inf, 1e13])
@codecs
def test_invalid_counts_are_refused(count, codec):
    with pytest.raises(InvalidArgumentError, match=r"counts\[\(1, 2\)\]"):
        encode_counts(0, {(1, 2): count}, codec)


# -- points ----------------------------------------------------------------------------------------


@given(
    n=st.integers(0, 3) | st.integers(0, 400),
    seed=st.integers(0, 99),
    center=places,
    sender=st.integers(0, 65535),
)
def test_points_are_decoded_to_float32_of_their_range(n, seed, center, sender):
    generator = torch.Generator().manual_seed(seed)
    ends = center + torch.rand(n, 3, generator=generator, dtype=torch.float64) * 12 - 6
    origin = torch.full((3,), center, dtype=torch.float64) + 0.123
    is_hit = torch.rand(n, generator=generator) < 0.6
    datagrams = encode_points(sender, 2**32 - 1, origin, ends, is_hit)
    assert len(datagrams) == math.ceil(n / POINTS_PER_DATAGRAM)
    found = [decode(datagram) for datagram in datagrams]
    for part, message in enumerate(found):
        assert isinstance(message, PointsMessage)
        assert (message.sender, message.frame, message.part) == (sender, 2**32 - 1, part)
        assert message.n_parts == len(datagrams)
        assert torch.equal(message.origin, origin)
    if found:
        assert max(map(len, datagrams)) <= MAX_BYTES
        torch.testing.assert_close(torch.cat([m.ends for m in found]), ends, rtol=1e-15, atol=1e-6)
        assert torch.equal(torch.cat([m.is_hit for m in found]), is_hit)


def test_points_take_12_bytes_a_bit_and_a_header():
    n = POINTS_PER_DATAGRAM
    ends = torch.rand(2 * n, 3, dtype=torch.float64)
    datagrams = encode_points(0, 0, ends[0], ends, torch.ones(2 * n, dtype=torch.bool))
    assert [len(datagram) for datagram in datagrams] == [41 + 12 * n + math.ceil(n / 8)] * 2
    assert 41 + 12 * (n + 1) + math.ceil((n + 1) / 8) > MAX_BYTES  # one more would not fit


INVALID_POINTS = {
    "sender": [65536],
    "frame": [-1, 1 << 32],
    "ends": [
        *(torch.full((4, 3), x, dtype=torch.float64) for x in (math.nan, math.inf, 1e39, 1.1 * FARTHEST)),
        torch.zeros(4, 2),
    ],
    "origin": [torch.tensor([0.0, 0.0, -1.1 * FARTHEST]), torch.tensor([0.0, math.inf, 0.0])],
    "is_hit": [torch.ones(3, dtype=torch.bool)],
}


@pytest.mark.parametrize(("name", "value"), each_value(INVALID_POINTS))
def test_invalid_points_are_refused(name, value):
    sound = {
        "sender": 0,
        "frame": 0,
        "origin": torch.zeros(3),
        "ends": torch.zeros(4, 3),
        "is_hit": torch.ones(4, dtype=torch.bool),
    }
    assert len(encode_points(**sound)) == 1
    with pytest.raises(InvalidArgumentError, match=name):
        encode_points(**{**sound, name: value})


def test_components_counts_and_views_take_few_bytes():
    assert sum(map(len, encode_components(frame_of_components(100)))) <= 10 * 100
    known = torch.randperm(5000, generator=torch.Generator().manual_seed(0))[:200].tolist()
    counts = {(i % 3, number): 1.0 + number % 97 for i, number in enumerate(known)}
    assert sum(map(len, encode_counts(0, counts))) <= 3 * 200
    assert len(encode_counts(0, {(0, number): 8.0 for number in range(1000, 1100)})[0]) <= 40  # a run
    assert len(encode_views(views(50))[0]) <= 7 * 50
    assert len(encode_views(views(0, 100))[0]) <= 2 * 100 + 20
    assert len(encode_views(replace(views(0), removed=Intervals.span(5, 500_000)))[0]) <= 15


# -- views and plans -------------------------------------------------------------------------------


@given(poses=st.lists(st.tuples(*[st.floats(-FARTHEST, FARTHEST)] * 3, st.floats(-1e3, 1e3)), max_size=20))
def test_pose_quantization_is_close_and_idempotent(poses):
    rows = torch.tensor(poses, dtype=torch.float64).reshape(-1, 4)
    found = quantized_poses(rows)
    assert float((found[:, :3] - rows[:, :3]).abs().max() if len(rows) else 0) <= 0.005 + 1e-7
    turned = torch.remainder(found[:, 3] - rows[:, 3] + math.pi, 2 * math.pi) - math.pi
    assert float(turned.abs().max() if len(rows) else 0) <= math.pi / 256 + 1e-9
    assert bool(((found[:, 3] >= -math.pi) & (found[:, 3] < math.pi)).all())
    assert torch.equal(quantized_poses(found), found)


def test_poses_in_whole_centimetres_are_decoded_exactly():
    poses = torch.tensor(
        [[0.29, -1.15, 4.35, math.pi / 2], [500000.07, 0.0, 0.01, -math.pi]], dtype=torch.float64
    )
    assert torch.equal(quantized_poses(poses), poses)


@given(
    n=st.integers(0, 3) | st.integers(0, 250),
    n_removed=st.integers(0, 3) | st.integers(0, 250),
    seed=st.integers(0, 99),
    center=places,
)
def test_views_are_decoded_within_their_step(n, n_removed, seed, center):
    sent = views(n, n_removed, seed, center)
    datagrams = encode_views(sent)
    assert bool(datagrams) == bool(n + n_removed)
    assert all(len(datagram) <= MAX_BYTES for datagram in datagrams)
    found = [decode(datagram) for datagram in datagrams]
    order = sorted(range(n), key=lambda row: sent.ids[row].tolist())
    for name in ("ids", "poses", "values", "stamps") if n else ():
        assert torch.equal(torch.cat([getattr(m, name) for m in found]), getattr(sent, name)[order]), name
    removed = Intervals.empty()
    for message in found:
        removed |= message.removed
    assert removed == sent.removed


@pytest.mark.parametrize("far", [(1 << 64) // 10, -(1 << 64) // 10, 1 << 60])  # in decimetres
def test_views_beyond_the_farthest_position_are_refused_without_overflow(far):
    writer = BitWriter()
    write_keys(writer, np.array([5]))
    for column in (far, 0, 0, 0, 1, 0):
        writer.column(np.array([column]))
    writer.number(0)
    with pytest.raises(DataError, match="farther out"):
        decode(make_datagram(Kind.VIEWS, writer.to_bytes()))


INVALID_VIEWS = {
    "ids": [
        torch.tensor([[0, 1], [0, 1]]),
        torch.tensor([[0, -1], [0, 1]]),
        torch.tensor([[0, 1 << 60], [0, 1]]),
        torch.tensor([[0.0, 1.0], [0.0, 2.0]]),
        torch.tensor([[1024, 1], [0, 1]]),
    ],
    "removed": [Intervals.span(-5, 5), Intervals.span(5, (1 << 62) + 1)],
    "poses": [*(torch.full((2, 4), x) for x in (math.nan, 1e9, 1.01 * FARTHEST)), torch.zeros(2, 3)],
    "values": [torch.tensor([1.0, 7e4]), torch.tensor([1.0, math.nan])],
    "stamps": [torch.tensor([1.0, math.inf]), torch.zeros(3)],
}


@pytest.mark.parametrize(("name", "value"), each_value(INVALID_VIEWS))
def test_invalid_views_are_refused(name, value):
    with pytest.raises(InvalidArgumentError, match=name):
        encode_views(replace(views(2, 2), **{name: value}))


@given(
    sender=numbers,
    number=numbers,
    time=st.integers(0, 10**9),
    step=st.integers(1, 10**4),
    n=st.integers(0, 60),
    n_views=st.integers(0, 20),
    speed=st.floats(0, 2),
)
def test_plans_are_decoded_within_their_step(sender, number, time, step, n, n_views, speed):
    along = torch.arange(n, dtype=torch.float64) * 0.2
    path = torch.stack([speed * along, 3 - along, along * 0 + 1.5, 1.2 * along], 1)
    (datagram,) = encode_plan(sender, number, time / 1000, step / 1000, path, views(n_views).poses)
    found = decode(datagram)
    assert isinstance(found, PlanMessage)
    assert (found.sender, found.number, found.time, found.step) == (sender, number, time / 1000, step / 1000)
    assert torch.equal(found.path, quantized_poses(path))
    assert torch.equal(found.views, quantized_views(views(n_views).poses))
    apart = found.views - quantized_poses(views(n_views).poses)
    assert bool((apart[:, :3].abs() <= 0.05 + 1e-9).all())
    turn = torch.atan2(apart[:, 3].sin(), apart[:, 3].cos()).abs()
    assert bool((turn <= math.pi / 32 + 1e-9).all())
    assert encode_plan(sender, number, time / 1000, step / 1000, found.path, found.views) == [datagram]


def test_a_plan_of_four_seconds_is_short():
    along = torch.arange(20, dtype=torch.float64) * 0.2
    path = torch.stack([along.cos() * 3, along.sin() * 3, 1 + 0.1 * along, along + math.pi / 2], 1)
    assert len(encode_plan(1, 17, 68.0, 0.2, path)[0]) <= 56
    assert len(encode_plan(1, 17, 68.0, 0.4, path[1::2])[0]) <= 43


def test_invalid_plans_are_refused():
    path = torch.zeros(4, 4)
    for changed, message in (
        ({"step": 0.0}, "step=0.0"),
        ({"step": math.nan}, "step"),
        ({"time": math.inf}, "time"),
        ({"number": -1}, "number=-1"),
        ({"sender": 1 << 60}, "sender"),
        ({"path": torch.full((2, 4), math.inf)}, "path"),
        ({"path": torch.zeros(1001, 4)}, "1001 poses"),
        ({"path": torch.rand(900, 4, dtype=torch.float64) * 1e6}, "room for 1200"),
        ({"views": torch.zeros(2, 3)}, "views"),
    ):
        sound = {"sender": 1, "number": 2, "time": 3.0, "step": 0.2, "path": path, "views": path}
        with pytest.raises(InvalidArgumentError, match=message):
            encode_plan(**{**sound, **changed})


# -- the format, by hand from docs/messages.md -----------------------------------------------------


def test_a_counts_message_equals_bytes_by_hand():
    """From robot 1: components 3 and 5 of robot 0 gained a point each."""
    stream = "00000010" + "00000010" + "00000000" + "00000100" + "00000110"  # sender; robots; 0, two ids, 3
    stream += "000000" + "01"  # b = 0; a gap of 2, less one
    stream += "00" + "000000" + "00000000"  # a column of no bits each, all 0: log2 of 1
    body = int(stream, 2).to_bytes(len(stream) // 8, "big")
    datagram = sealed(b"\x14" + body)
    message = decode(datagram)
    assert (message.sender, message.counts) == (1, {(0, 3): 1.0, (0, 5): 1.0})
    assert encode_counts(1, {(0, 5): 1.0, (0, 3): 1.0}) == [datagram]


def test_a_path_message_equals_bytes_by_hand():
    """Two poses of robot 0, a metre apart, the second turned right by 45°; no views."""
    poses = torch.tensor([[0.0, 0.01, 0.0, 0.0], [1.0, 0.01, 0.0, -math.pi / 4]], dtype=torch.float64)
    # Robot 0, 2 poses, no views; after 1 ms, 3 (zigzag 5) before plan 1 is expected; plan 1; 2 ms apart.
    stream = "1 1 1 01 1 1".replace(" ", "") + "00 10 00 001 01 10".replace(" ", "")
    stream += "00000000" + "00000010" + "00000000" + "00000000"  # the first pose; 1 = 2 zigzag
    # 100 along x, zigzag 200 = 12·16 + 8, and 12 + 1 = 1·101; -32 of 256 in yaw, 63 = 7·8 + 7, 7 + 1 = 1·000.
    stream += "0001" + "1" + "101_1000" + "0000" + "1" + "0001" + "000" + "000_111"
    stream = stream.replace("_", "")
    stream += "0" * (-len(stream) % 8)
    datagram = sealed(b"\x29" + int(stream, 2).to_bytes(len(stream) // 8, "big"))
    assert encode_plan(0, 1, 0.001, 0.002, poses) == [datagram]
    assert torch.equal(decode(datagram).path, poses)


def test_a_points_message_equals_bytes_by_hand():
    body = struct.pack("<HI3dHHH6fB", 7, 9, 500.0, 0.5, 1.0, 1, 3, 2, 1, 2, 3, -1, -2, -3, 0b01000000)
    message = decode(sealed(b"\x17" + body))
    assert (message.sender, message.frame, message.part, message.n_parts) == (7, 9, 1, 3)
    assert message.ends.tolist() == [[501.0, 2.5, 4.0], [499.0, -1.5, -2.0]]
    assert message.is_hit.tolist() == [False, True]


# -- kinds -----------------------------------------------------------------------------------------


def test_every_message_kind_has_a_name():
    """In the order of the kinds, so that a new kind needs a name here."""
    names = (
        ["calibrations"] + ["components"] * 3 + ["counts"] * 3 + ["points", "views", "plans", "announcements"]
    )
    names += ["supersessions", "counts", "corrections", "frames"]
    assert [kind_of(bytes([first_byte(kind)])) for kind in sorted(Kind)] == names
    assert [kind_of(datagram) for datagram in examples()] == [*names[1:], names[0]]
