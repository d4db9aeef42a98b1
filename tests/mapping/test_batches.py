"""Batches of components: damaged and earlier ones, and the two coders."""

from __future__ import annotations

import base64
import hashlib
import math
import zlib
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels.twins import by_both
from mapping.earlier_batches import EARLIER
from mapping.map_cases import assert_same_components
from mapping.random_components import around_a_sensor, drawn, random_components

from gmmtorch import Components
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.kernels.codes import context_coding
from gmmtorch.mapping import BitWriter, decode, encode, encode_quantized, quantize, quantized, spatial_order
from gmmtorch.mapping.codec import context_model
from gmmtorch.mapping.codec.range_coder import RangeCoder

dims = pytest.mark.parametrize("dim", [2, 3])


@dims
@pytest.mark.parametrize("wrong", [-1, 1 << 24, 1 << 62])
def test_components_seen_from_an_origin_that_is_none_are_not_written(dim, wrong):
    values = quantize(random_components(dim, k=3, seed=3))
    seen_from = values.seen_from.clone()
    seen_from[-1] = wrong
    with pytest.raises((InvalidArgumentError, LookupError)):
        encode_quantized(replace(values, seen_from=seen_from))


# -- damaged batches -----------------------------------------------------------------------------------


def sealed(body: bytes) -> bytes:
    """The body with a valid checksum."""
    return body + zlib.crc32(body).to_bytes(4, "little")


@pytest.fixture(scope="module", params=["fine", "coarse", "around a sensor", "frames of a sensor"])
def sound(request) -> bytes:
    if request.param == "around a sensor":
        return encode(around_a_sensor(12))
    if request.param == "frames of a sensor":
        return encode(Components.concatenate(frames_of_a_sensor(2)).selected(torch.arange(18, 30)))
    return encode(quantized(random_components(3, k=12), coarse=request.param == "coarse"))


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
@pytest.mark.parametrize("version", [1, 2, 4])
def test_forged_array_lengths_allocate_no_memory(k, what, version):
    writer = BitWriter()
    if version > 1:
        writer.one(1 << 5, 6)  # 3D, cells of 2⁻²⁰ m
    sizes = (k, 1) if what == "components" else (1, k)
    for number in (*sizes, 0) if version > 1 else (3, *sizes):
        writer.number(number)
    with pytest.raises(DataError, match=r"announced|it is damaged"):
        decode(sealed(bytes([version]) + writer.to_bytes() + bytes(2000)))


@pytest.mark.parametrize("n", [1, 60, 500])
def test_streams_that_end_in_any_number_of_zeros_are_decoded(n):
    """Equal counts of many origins cost almost nothing: zeros remain beyond what a reader looks ahead."""
    one = random_components(3, k=1, n_origins=n, max_sightings=1)
    count = torch.ones(n, dtype=torch.float64)
    every = torch.arange(n)
    made = replace(one, seen_by=0 * every, seen_from=every, seen_count=count, support=count.sum()[None])
    for found in by_both(lambda: decode(encode(made))):
        assert_same_components(found, quantized(made))


def test_a_limit_on_components_is_kept_before_they_are_read(sound):
    assert len(decode(sound, most=40)) == 12
    with pytest.raises(DataError, match="12 components and"):
        decode(sound, most=11)


def seen_from_afar(n: int, nearest: bool) -> Components:
    """n components, each seen from an origin of its own beside it, or from a random one."""
    generator = torch.Generator().manual_seed(0)
    c = random_components(3, k=n, n_origins=n, max_sightings=1, extent=100.0)
    every = torch.arange(n)
    origins = c.means + 0.1 if nearest else c.means[torch.randperm(n, generator=generator)] + 0.1
    return replace(c, origins=origins, seen_by=every, seen_from=every, seen_count=c.support)


def test_steps_do_not_grow_with_components_times_origins(monkeypatch):
    """Origins that are near cost few steps; a batch that takes many for each byte is neither written nor
    read."""
    near, far = seen_from_afar(1500, nearest=True), seen_from_afar(1500, nearest=False)
    bytes_of_far = encode(far)
    monkeypatch.setattr(context_coding, "MOST_STEPS", 32)
    assert_same_components(decode(encode(near)), quantized(near))
    with pytest.raises(InvalidArgumentError, match="1500 components have viewpoints"):
        encode(far)
    with pytest.raises(DataError, match="damaged"):
        decode(bytes_of_far)


@dims
def test_origins_at_equal_distances_are_ranked_as_the_twin_ranks_them(dim):
    """Components in the middle of a grid of origins, eight or more of which are equally far."""
    axis = torch.arange(-3.0, 4.0, dtype=torch.float64)
    origins = torch.cartesian_prod(*[axis] * dim)
    n = len(origins)
    c = random_components(dim, k=12, n_origins=n, max_sightings=1)
    seen_from = torch.randint(n, (12, 40), generator=torch.Generator().manual_seed(1)).flatten()
    c = replace(
        c,
        means=(c.means * 0.1).round(),
        origins=origins[torch.randperm(n, generator=torch.Generator().manual_seed(2))],
        seen_by=torch.arange(12).repeat_interleave(40),
        seen_from=seen_from,
        seen_count=(c.support / 40).repeat_interleave(40),
    )
    twin, fused = by_both(lambda: encode(c))
    assert twin == fused
    for found in by_both(lambda: decode(fused)):
        assert_same_components(found, quantized(c))


# -- earlier versions and the two coders -----------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(EARLIER))
def test_earlier_batches_are_read_as_they_were(name):
    """The digests of what gmmtorch decoded from batches that it had written."""
    batch, digest = EARLIER[name]
    found = decode(base64.b85decode(batch))
    values = b"".join(value.numpy().tobytes() for value in found.tensors().values())
    assert hashlib.blake2b(values, digest_size=16).hexdigest() == digest
    assert_same_components(decode(encode(found)), quantized(found))


@pytest.mark.parametrize("coarse", [False, True])
@settings(max_examples=40)
@given(components=drawn)
def test_the_twin_writes_and_reads_the_bytes_of_the_kernel(components, coarse):
    once = quantized(components, coarse)
    twin, fused = by_both(lambda: encode(once))
    assert twin == fused
    for found in by_both(lambda: decode(fused)):
        assert_same_components(found, once)


@pytest.mark.parametrize("k", [1, 2, 60])
def test_the_twin_writes_and_reads_components_around_a_sensor(k):
    made = around_a_sensor(k)
    twin, fused = by_both(lambda: encode(made))
    assert twin == fused
    for found in by_both(lambda: decode(fused)):
        assert_same_components(found, made)


def test_ends_of_beams_of_one_length_take_fewer_bytes_around_their_sensor():
    """What the sphere tells: the same components, seen from elsewhere."""
    made = around_a_sensor(60)
    assert len(encode(made)) + 40 < len(encode(replace(made, origins=made.origins + 40.0)))


def frames_of_a_sensor(n: int) -> list[Components]:
    """Frames of a sensor that moves by a quarter of a metre, numbered in a row."""
    made = around_a_sensor(24)
    moved = [made.means + 0.25 * i for i in range(n)]
    return [
        quantized(
            replace(made, means=at, origins=made.origins + 0.25 * i, ids=made.ids + 24 * i), coarse=True
        )
        for i, at in enumerate(moved)
    ]


def test_frames_of_a_sensor_take_fewer_bytes_in_one_batch():
    """Also if the sensor returns to a place, and if a component has no viewpoint, or two."""
    frames = frames_of_a_sensor(4)
    both = Components.concatenate(frames)
    assert len(encode(both)) + 3 * 12 < sum(len(encode(frame)) for frame in frames)
    back = replace(both, seen_from=both.seen_from.flip(0))
    for odd in (
        both,
        back,
        replace(both, **without_viewpoint_of(both, 30)),
        replace(both, **seen_twice(both, 40)),
    ):
        made = quantized(odd, coarse=True)
        twin, fused = by_both(lambda made=made: encode(made))
        assert twin == fused
        for found in by_both(lambda fused=fused: decode(fused)):
            assert_same_components(found, made)


def without_viewpoint_of(c: Components, row: int) -> dict[str, torch.Tensor]:
    kept = c.seen_by != row
    return {name: getattr(c, name)[kept] for name in ("seen_by", "seen_from", "seen_count")}


def seen_twice(c: Components, row: int) -> dict[str, torch.Tensor]:
    first = c.seen_from[c.seen_by == row]
    other = (first + 1) % len(c.origins)
    return {
        "seen_by": torch.cat([c.seen_by, torch.tensor([row])]),
        "seen_from": torch.cat([c.seen_from, other]),
        "seen_count": torch.cat([c.seen_count, c.seen_count[c.seen_by == row]]),
    }


@settings(max_examples=80)
@given(
    changes=st.lists(
        st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=4
    )
)
def test_the_twin_and_the_kernel_agree_about_forged_batches(sound, changes):
    body = bytearray(sound[:-4])
    for place, value in changes:
        body[1 + int(place * (len(body) - 1))] = value

    def outcome() -> Components | None:
        try:
            return decode(sealed(bytes(body)))
        except DataError:
            return None

    twin, fused = by_both(outcome)
    assert (twin is None) == (fused is None)
    if twin is not None and fused is not None:
        assert_same_components(twin, fused)


@given(
    bits=st.lists(st.tuples(st.integers(0, 30), st.booleans()), max_size=400),
    numbers=st.lists(st.integers(-(2**59), 2**59) | st.integers(-40, 40), max_size=30),
)
def test_coded_bits_and_numbers_are_read_as_written_in_about_the_entropy(bits, numbers):
    """Against the sum of −log₂ of the chances, which exact arithmetic coding reaches."""
    writer = RangeCoder(context_model.first_tables(coarse=False))
    ideal = 0.0
    for slot, bit in bits:
        chance = writer.chances[slot] / 65536
        ideal -= math.log2(1 - chance if bit else chance)
        writer.bit(slot, int(bit))
    assert 8 * len(writer.to_bytes().rstrip(b"\0")) <= ideal * 1.001 + 16
    for number in numbers:
        writer.whole(40, number)
    reader = RangeCoder(context_model.first_tables(coarse=False), writer.to_bytes())
    assert [reader.bit(slot, 0) for slot, _ in bits] == [int(bit) for _, bit in bits]
    assert [reader.whole(40, 0) for _ in numbers] == numbers


def test_components_of_a_wall_take_fewer_bytes_than_scattered_ones():
    """What neighbours tell: the same components, along a plane or with means drawn in a box."""
    wall = random_components(3, k=400, extent=0.0, deviations=(0.2, 0.2), n_origins=1, max_sightings=1)
    place = torch.rand(400, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 20
    flat = torch.diag(torch.tensor([0.04, 0.0001, 0.04], dtype=torch.float64)).expand(400, 3, 3)

    def size(means: torch.Tensor) -> int:
        made = replace(wall, means=means, covariances=flat)
        return len(encode(replace(made.rearranged(spatial_order(made)), ids=wall.ids)))

    on_plane = place * torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)
    on_plane[:, 1] = 0.02 * torch.randn(400, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    assert size(on_plane) < size(place) - 6 * 400 / 8
