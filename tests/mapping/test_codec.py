"""The codec: rounding errors, values at the limits, and independence of the batches."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.map_cases import assert_same_components
from mapping.random_components import counts_add_up, drawn, random_components, rotations

from gmmtorch import Components, WindowedRule
from gmmtorch.datasets import load
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation import metrics, queries
from gmmtorch.mapping import ORIGIN_STEP, decode, encode, learn_window, quantized, spatial_order
from gmmtorch.mapping.codec import component_batch, lattice
from gmmtorch.mapping.codec.quantization import COUNT_ERROR
from gmmtorch.occupancy import occupancy_probability, point_evidence

dims = pytest.mark.parametrize("dim", [2, 3])
coarse = pytest.mark.parametrize("coarse", [False, True])

# Least and largest factor by which a deviation in any direction changes: the extreme singular values of
# (I + N) diag(f), N strictly lower triangular with entries up to 1/8 (the last of 3D up to 1/8 + 1/64), f
# within 2^(±1/8), over all signs.
STRETCH = {2: (0.8614, 1.1608), 3: (0.8114, 1.2388)}
# The same for the coarse lattice: entries up to 1/2 (1/2 + 1/4), f within 2^(±1/4).
COARSE_STRETCH = {2: (0.6565, 1.5232), 3: (0.4568, 2.0187)}


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


@coarse
@settings(max_examples=40)
@given(components=drawn)
def test_decoded_components_equal_quantized_ones_and_quantization_is_idempotent(components, coarse):
    once = quantized(components, coarse)
    batch = encode(once)
    assert batch[0] == (4 if coarse and len(once) else 2)
    assert_same_components(decode(batch), once)
    assert_same_components(quantized(once), once)
    assert_same_components(quantized(once, coarse), once)
    assert encode(decode(batch)) == batch
    assert coarse or encode(components) == batch
    assert counts_add_up(once)
    assert torch.equal(once.max_range, components.max_range)
    assert torch.equal(once.ids, components.ids)


@coarse
@settings(max_examples=40)
@given(components=drawn)
def test_codec_rounds_within_the_stated_bounds(components, coarse):
    found = quantized(components, coarse)
    for i in range(len(components)):
        meant, stored = components.covariances[i].numpy(), found.covariances[i].numpy()
        offset = (components.means[i] - found.means[i]).numpy()
        whitened = np.abs(
            scipy.linalg.solve_triangular(scipy.linalg.cholesky(stored, lower=True), offset, lower=True)
        )
        rounding = 1e-9 * (1 + np.abs(components.means[i].numpy()).max())  # of a number of metres itself
        smallest = math.sqrt(np.linalg.eigvalsh(stored)[0])
        assert np.linalg.norm(whitened) <= math.sqrt(components.dim) * (
            lattice.MEAN_ERROR * (4 if coarse else 1) + rounding / smallest
        )
        ratio = np.sqrt(scipy.linalg.eigh(meant, stored, eigvals_only=True))
        low, high = COARSE_STRETCH[components.dim] if coarse else STRETCH[components.dim]
        assert 1 / high - 1e-3 <= ratio[0] <= ratio[-1] <= 1 / low + 1e-3
    error = (found.support / components.support - 1).abs()
    most = (1 + COUNT_ERROR) ** 3 - 1 if coarse else COUNT_ERROR  # rounded twice
    assert float(error.max() if len(error) else 0.0) <= most + 1e-12


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
    assert torch.equal(there.means - shift, quantized(replace(components, means=means)).means)
    assert torch.equal(there.covariances, here.covariances)

    turn = torch.eye(dim, dtype=torch.float64)
    turn[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    covariances = turn @ components.covariances @ turn.T
    turned = quantized(replace(components, means=components.means @ turn.T, covariances=covariances))
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
    c = c.with_viewpoints(seen)
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
