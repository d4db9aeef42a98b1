"""The codec: rounding errors, valid components from any bytes, and independence of the batches."""

from __future__ import annotations

import base64
import hashlib
import math
import zlib
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels.twins import by_both
from mapping.first_version_batches import FIRST_VERSION
from mapping.map_cases import assert_same_components
from mapping.random_components import random_components, rotations

from gmmtorch.datasets import load
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.experiments.evaluation import metrics, queries
from gmmtorch.kernels.codes import context_coding
from gmmtorch.mapping.codec import component_batch, context_model, lattice
from gmmtorch.mapping.codec.bitstream import BitReader, BitWriter, Code, best_code, zigzag
from gmmtorch.mapping.codec.component_batch import decode, encode
from gmmtorch.mapping.codec.quantization import COUNT_ERROR, ORIGIN_STEP, quantized, spatial_order
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.rules import WindowedRule
from gmmtorch.mapping.learning.windows import learn_window
from gmmtorch.occupancy.evidence import occupancy_probability
from gmmtorch.occupancy.forms.point import point_evidence

dims = pytest.mark.parametrize("dim", [2, 3])

# Least and largest factor by which a deviation in any direction changes: the extreme singular values of
# (I + N) diag(f), N strictly lower triangular with entries up to 1/8 (the last of 3D up to 1/8 + 1/64), f
# within 2^(±1/8), over all signs.
STRETCH = {2: (0.8614, 1.1608), 3: (0.8114, 1.2388)}

drawn = st.builds(
    random_components,
    dim=st.sampled_from([2, 3]),
    k=st.integers(0, 30),
    seed=st.integers(0, 10**6),
    center=st.sampled_from([0.0, -3.7, 5e5, 4.2e6]),
    extent=st.sampled_from([0.0, 1.0, 300.0, 2e4]),
    deviations=st.sampled_from([(1e-4, 100.0), (5e-3, 1.0), (0.1, 0.1), (1e-4, 1e-3), (20.0, 5e3)]),
    counts=st.sampled_from([(0.01, 1e9), (1.0, 100.0)]),
    n_origins=st.integers(3, 40),
    max_sightings=st.integers(1, 3),
)


def sightings(components: Components) -> list[dict[tuple[float, ...], float]]:
    """Origin → count of each component."""
    found: list[dict[tuple[float, ...], float]] = [{} for _ in range(len(components))]
    c = components
    for by, place, count in zip(
        c.seen_by.tolist(), c.origins[c.seen_from].tolist(), c.seen_count.tolist(), strict=True
    ):
        found[by][tuple(place)] = found[by].get(tuple(place), 0.0) + count
    return found


# -- encoded and decoded ---------------------------------------------------------------------------------


@settings(max_examples=40)
@given(components=drawn)
def test_decoded_components_equal_quantized_ones_and_quantization_is_idempotent(components):
    once = quantized(components)
    assert_same_components(decode(encode(components)), once)
    assert_same_components(quantized(once), once)
    assert encode(once) == encode(components)


@settings(max_examples=40)
@given(components=drawn)
def test_codec_rounds_within_the_stated_bounds(components):
    found = quantized(components)
    for i in range(len(components)):
        meant, stored = components.covariances[i].numpy(), found.covariances[i].numpy()
        offset = (components.means[i] - found.means[i]).numpy()
        whitened = np.abs(
            scipy.linalg.solve_triangular(scipy.linalg.cholesky(stored, lower=True), offset, lower=True)
        )
        rounding = 1e-9 * (1 + np.abs(components.means[i].numpy()).max())  # of a number of metres itself
        smallest = math.sqrt(np.linalg.eigvalsh(stored)[0])
        assert np.linalg.norm(whitened) <= math.sqrt(components.dim) * (
            lattice.MEAN_ERROR + rounding / smallest
        )
        ratio = np.sqrt(scipy.linalg.eigh(meant, stored, eigvals_only=True))
        low, high = STRETCH[components.dim]
        assert 1 / high - 1e-3 <= ratio[0] <= ratio[-1] <= 1 / low + 1e-3
    error = (found.support / components.support - 1).abs()
    assert float(error.max() if len(error) else 0.0) <= COUNT_ERROR + 1e-12


@settings(max_examples=40)
@given(components=drawn)
def test_origins_and_their_shares_are_decoded_within_a_step(components):
    for meant, found in zip(sightings(components), sightings(quantized(components)), strict=True):
        total = sum(meant.values())
        places, stored = np.array(list(meant)), np.array(list(found))
        nearest = np.abs(places[:, None] - stored[None]).max(-1).argmin(1)
        assert np.abs(places - stored[nearest]).max() <= ORIGIN_STEP / 2 * (1 + 1e-9)
        merged = np.zeros(len(stored))
        np.add.at(merged, nearest, np.array(list(meant.values())) / total)
        shares = np.array(list(found.values())) / sum(found.values())
        ratio = (shares / shares.max()) / (merged / merged.max())
        assert np.abs(np.log2(ratio)).max() <= 0.25 + 1e-9  # half a step of 2^(1/2), to the largest


@settings(max_examples=40)
@given(components=drawn)
def test_decoded_counts_sum_to_the_support_and_flags_and_ids_are_exact(components):
    found = quantized(components)
    total = torch.zeros_like(found.support).index_add_(0, found.seen_by, found.seen_count)
    torch.testing.assert_close(total, found.support)
    assert torch.equal(found.max_range, components.max_range)
    assert torch.equal(found.ids, components.ids)


@settings(max_examples=60)
@given(
    seed=st.integers(0, 10**6),
    dim=st.sampled_from([2, 3]),
    rank=st.integers(0, 2),
    negative=st.sampled_from([0.0, 1e-12, 1e-7]),
)
def test_nearly_singular_covariances_are_decoded_positive_definite(seed, dim, rank, negative):
    components = random_components(dim, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    turn = rotations(len(components), dim, generator)
    values = torch.rand(len(components), dim, generator=generator, dtype=torch.float64) + 0.1
    values[:, rank:] = -negative
    flat = turn @ torch.diag_embed(values) @ turn.transpose(1, 2)
    found = quantized(replace(components, covariances=(flat + flat.transpose(1, 2)) / 2))
    assert int(torch.linalg.cholesky_ex(found.covariances).info.max()) == 0
    assert bool(torch.isfinite(found.means).all())
    assert_same_components(quantized(found), found)


@dims
def test_quantization_commutes_with_whole_metre_shifts_and_quarter_turns(dim):
    components = random_components(dim, deviations=(1e-3, 2.0))
    here = quantized(components)
    shift = torch.tensor([512.0, -4096.0, 64.0], dtype=torch.float64)[:dim]
    means = torch.round(components.means * 2**20) / 2**20  # so that the sum is exact
    origins = torch.round(components.origins * 2**20) / 2**20
    there = quantized(replace(components, means=means + shift, origins=origins + shift))
    torch.testing.assert_close(
        there.means - shift, quantized(replace(components, means=means)).means, rtol=0, atol=0
    )
    assert torch.equal(there.covariances, here.covariances)

    turn = torch.eye(dim, dtype=torch.float64)
    turn[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    turned = quantized(
        replace(
            components, means=components.means @ turn.T, covariances=turn @ components.covariances @ turn.T
        )
    )
    assert torch.equal(turned.means, here.means @ turn.T)
    assert torch.equal(turned.covariances, turn @ here.covariances @ turn.T)


@pytest.mark.parametrize("size", [1, 7, 40])
@dims
def test_splitting_a_batch_does_not_change_its_decoded_components(dim, size):
    whole = quantized(random_components(dim))
    parts = [decode(encode(whole.selected(torch.arange(i, min(i + size, 40))))) for i in range(0, 40, size)]
    joined = quantized(Components.concatenate(parts))
    for name in ("means", "covariances", "support", "max_range", "ids", "seen_by", "seen_count"):
        assert torch.equal(getattr(joined, name), getattr(whole, name)), name
    assert torch.equal(joined.origins[joined.seen_from], whole.origins[whole.seen_from])


# -- edges -----------------------------------------------------------------------------------------------


def test_zero_counts_stay_zero():
    components = random_components(3, k=3)
    nothing = replace(components, support=torch.tensor([0.0, 1e-9, 0.01], dtype=torch.float64))
    nothing = replace(nothing, seen_count=nothing.support[components.seen_by] / 3)
    found = quantized(nothing)
    assert found.support.tolist()[:2] == [0.0, 0.0]
    assert found.support[2] == pytest.approx(0.01, rel=COUNT_ERROR)
    assert_same_components(decode(encode(nothing)), found)
    assert encode(found) == encode(nothing)


def test_equal_origins_are_merged_and_unused_origins_are_dropped():
    c = random_components(2, k=1, n_origins=4, max_sightings=1)
    places = [[9.0, 9.0], [1.0, 2.0], [1.0, 2.0 + ORIGIN_STEP / 4], [3.0, 4.0]]
    c = replace(
        c,
        origins=torch.tensor(places, dtype=torch.float64),
        seen_by=torch.zeros(3, dtype=torch.int64),
        seen_from=torch.tensor([2, 3, 1]),
        seen_count=torch.tensor([1.0, 2.0, 1.0], dtype=torch.float64) * c.support / 4,
    )
    found = quantized(c)
    assert found.origins.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert (found.seen_count / found.support).tolist() == [0.5, 0.5]


def test_a_component_without_origins_is_kept():
    c = random_components(2, k=2)
    seen = c.seen_by == 0
    c = replace(c, seen_by=c.seen_by[seen], seen_from=c.seen_from[seen], seen_count=c.seen_count[seen])
    assert_same_components(decode(encode(c)), quantized(c))
    assert len(quantized(c)) == 2


@settings(max_examples=50)
@given(
    dim=st.sampled_from([2, 3]),
    center=st.sampled_from([0.0, lattice.FARTHEST, -lattice.FARTHEST]),
    extent=st.sampled_from([0.0, 1e6, 2 * lattice.FARTHEST, 4 * lattice.FARTHEST]),
    deviations=st.sampled_from([(2.0**-21, 1.0), (1.0, 2.0**19), (2.0**19, 2.0**19.9), (2.0**19.9, 2.0**20)]),
    seed=st.integers(0, 10**6),
)
def test_encoded_components_at_the_coordinate_limit_are_decoded(dim, center, extent, deviations, seed):
    """Rounding beyond the limit is an error; cells that extend beyond it are allowed."""
    far = lattice.FARTHEST
    made = random_components(dim, k=8, extent=extent, deviations=deviations, seed=seed)
    moved = {name: (getattr(made, name) + center).clamp(-far, far) for name in ("means", "origins")}
    components = replace(made, **moved)
    try:
        batch = encode(components)
    except InvalidArgumentError:
        assert center or extent > 1e6 or deviations[1] > 2.0**19
        return
    assert_same_components(decode(batch), quantized(components))
    assert_same_components(quantized(decode(batch)), decode(batch))


@pytest.mark.parametrize("exponent", [-20, -7, 0, 3, 6])
def test_cells_as_large_as_the_coordinate_range_are_decoded(monkeypatch, exponent):
    """Two corners of the coordinate range in cells of any size that the encoder may choose."""
    corners = torch.tensor([[-lattice.FARTHEST] * 3, [lattice.FARTHEST] * 3], dtype=torch.float64)
    wide = random_components(3, k=2, deviations=(2.0**18, 2.0**19))
    components = quantized(replace(wide, means=corners, origins=wide.origins * 0))
    monkeypatch.setattr(component_batch, "cell_exponent", lambda places: exponent)
    assert_same_components(decode(encode(components)), components)


def test_nearly_equal_deviations_are_encoded_in_descending_order():
    """The deviations lie halfway between two steps, so that each may be rounded either way."""
    turns = rotations(300, 3, torch.Generator().manual_seed(0))
    for deviation in 2.0 ** ((torch.arange(8) + 0.5) / lattice.PER_OCTAVE):
        covariances = turns @ (deviation.double() ** 2 * torch.eye(3, dtype=torch.float64)) @ turns.mT
        components = replace(random_components(3, k=300), covariances=(covariances + covariances.mT) / 2)
        assert_same_components(decode(encode(components)), quantized(components))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("means", 1e9),
        ("means", math.nan),
        ("means", math.inf),
        ("covariances", 1e13),
        ("covariances", math.nan),
        ("support", 1e13),
        ("support", -1.0),
        ("support", math.nan),
        ("origins", -1e9),
        ("origins", math.nan),
        ("ids", 2**62),
    ],
)
def test_components_that_cannot_be_stored_are_refused(name, value):
    components = random_components(3, k=5, max_sightings=1, n_origins=1)
    changed = getattr(components, name).clone()
    changed.view(-1)[0] = value
    with pytest.raises(InvalidArgumentError, match="ids" if name == "ids" else rf"{name}\[0\]"):
        encode(replace(components, **{name: changed}))


@given(
    runs=st.lists(
        st.tuples(st.integers(0, 2**40), st.integers(0, 2**60), st.integers(1, 9)), min_size=1, max_size=5
    )
)
def test_any_ids_are_decoded_exactly(runs):
    ids = torch.tensor([[robot, first + i] for robot, first, n in runs for i in range(n)])
    components = replace(random_components(2, k=len(ids)), ids=ids)
    assert torch.equal(decode(encode(components)).ids, ids)


def test_components_thinner_than_a_micrometre_are_widened_to_one():
    c = random_components(3, k=1)
    flat = replace(c, covariances=torch.diag(torch.tensor([1e-4, 1e-4, 1e-16], dtype=torch.float64))[None])
    assert torch.linalg.eigvalsh(quantized(flat).covariances)[0, 0].sqrt() == pytest.approx(2.0**-20)


# -- size ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dim", "most"), [(2, 8.0), (3, 12.0)])
def test_a_component_with_one_origin_takes_few_bytes(dim, most):
    components = random_components(dim, k=300, extent=30.0, n_origins=20, max_sightings=1)
    ordered = replace(components.rearranged(spatial_order(components)), ids=components.ids)
    assert len(encode(ordered)) <= most * 300
    assert len(encode(components)) - len(encode(ordered)) > 0.7 * 300  # log2(300!)/300 is 6.8 bits


# -- a real map ------------------------------------------------------------------------------------------


def auc(components: Components, asked: queries.Queries, resolution: float) -> float:
    evidence = point_evidence(components.cones(), asked.points, resolution)
    theta = occupancy_probability(evidence.hits, evidence.misses)
    return metrics.roc(theta[asked.of(1)], theta[asked.of(0)]).auc


@pytest.mark.slow
@pytest.mark.real_data
def test_quantization_of_a_real_map_keeps_its_occupancy(real_data):
    frames = load("depth_frames", path=real_data / "kinect", pixel_stride=8)
    train, test = queries.split_indices(len(frames), 5)
    rule = WindowedRule(n_components=300, max_origins=2)
    learned = learn_window([frames[i] for i in train], rule, torch.Generator().manual_seed(0))
    learned = learned.rearranged(spatial_order(learned))
    ids = torch.stack([torch.zeros(len(learned)), torch.arange(len(learned))], 1).long()
    learned = replace(learned, ids=ids)
    origins, ends = queries.test_beams([frames[i] for i in test], 2000, 0)
    asked = queries.hit_and_free(origins, ends, "uniform", 0.05, 0)
    # Single roundings move the score up or down; their mean over three places of the lattice shows a loss.
    losses = []
    for shift in torch.rand(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64):
        moved = replace(learned, means=learned.means + shift, origins=learned.origins + shift)
        back = quantized(moved)
        back = replace(back, means=back.means - shift, origins=back.origins - shift)
        losses.append(auc(learned, asked, 0.05) - auc(back, asked, 0.05))
    assert abs(float(np.mean(losses))) < 1e-3
    assert len(encode(learned)) <= 11 * len(learned)
    assert_same_components(decode(encode(learned)), quantized(learned))


# -- damaged batches -----------------------------------------------------------------------------------


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
@pytest.mark.parametrize("version", [1, 2])
def test_forged_array_lengths_allocate_no_memory(k, what, version):
    writer = BitWriter()
    if version == 2:
        writer.one(1 << 5, 6)  # 3D, cells of 2⁻²⁰ m
    sizes = (k, 1) if what == "components" else (1, k)
    for number in (*sizes, 0) if version == 2 else (3, *sizes):
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
    near, far = seen_from_afar(4000, nearest=True), seen_from_afar(4000, nearest=False)
    bytes_of_far = encode(far)
    monkeypatch.setattr(context_coding, "MOST_STEPS", 32)
    assert_same_components(decode(encode(near)), quantized(near))
    with pytest.raises(InvalidArgumentError, match="4000 components have viewpoints"):
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


@pytest.mark.parametrize("name", sorted(FIRST_VERSION))
def test_batches_of_version_1_are_read_as_they_were(name):
    """The digests of what gmmtorch 2.0 decoded from batches that it had written."""
    batch, digest = FIRST_VERSION[name]
    found = decode(base64.b85decode(batch))
    values = b"".join(value.numpy().tobytes() for value in found.tensors().values())
    assert hashlib.blake2b(values, digest_size=16).hexdigest() == digest
    assert_same_components(decode(encode(found)), quantized(found))


@settings(max_examples=40)
@given(components=drawn)
def test_the_twin_writes_and_reads_the_bytes_of_the_kernel(components):
    twin, fused = by_both(lambda: encode(components))
    assert twin == fused
    for found in by_both(lambda: decode(fused)):
        assert_same_components(found, quantized(components))


@settings(max_examples=80)
@given(
    changes=st.lists(
        st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=4
    ),
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
    writer = context_model._RangeCoder()
    ideal = 0.0
    for slot, bit in bits:
        chance = writer.chances[slot] / 65536
        ideal -= math.log2(1 - chance if bit else chance)
        writer.bit(slot, int(bit))
    assert 8 * len(writer.to_bytes().rstrip(b"\0")) <= ideal * 1.001 + 16
    for number in numbers:
        writer.whole(40, number)
    reader = context_model._RangeCoder(writer.to_bytes())
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


# -- bit streams ---------------------------------------------------------------------------------------


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
    writer.rice(zigzag(np.array(values, np.int64)), np.maximum(scale - 2, 0))
    small = zigzag(np.array(values, np.int64)) % 1000
    writer.rice_column(small)
    for value in values:
        writer.number(value)
    reader = BitReader(writer.to_bytes())
    assert reader.scaled(scale).tolist() == values
    assert reader.rice_column(len(values)).tolist() == [
        int(v) for v in zigzag(np.array(values, np.int64)) % 1000
    ]
    assert [reader.number() for _ in values] == values
    reader.finish()


def test_rice_codes_equal_those_by_hand():
    """With 2 low bits, 5 = 1·4 + 01 is 0 1 01 and 2 = 0·4 + 10 is 1 10."""
    writer = BitWriter()
    writer.rice(np.array([5, 2]), 2)
    assert writer.to_bytes() == bytes([0b011_01_10_0])


@pytest.mark.parametrize(
    ("values", "code"),
    [
        ([7] * 50, Code.FIXED),
        (list(range(1000, 1050)), Code.DIFFERENCES),
        ([0] * 40 + [1, 2, 0, 30], Code.RICE),
        ([3, 0, 2, 1] * 12, Code.FIXED),
    ],
)
def test_the_shortest_column_code_is_chosen(values, code):
    column = np.array(values, np.int64)
    coding = best_code(column)
    assert coding.code is code
    writer = BitWriter()
    writer.column(column)
    assert len(writer.to_bytes()) <= math.ceil((8 + 70 + coding.n_bits) / 8)


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
