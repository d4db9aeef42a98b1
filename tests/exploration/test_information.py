"""Information of a beam against enumeration, its cells against ray casting, and discounts by a dictionary."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from exploration.voxel_worlds import surroundings_from
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels.rays.beam_information import banded_csqmi, first_block, shannon, sharpened
from gmmtorch.kernels.rays.ray_traversal import traverse
from gmmtorch.team.exploration.planning.view_evaluator import (
    InformationDiscount,
    beam_templates,
    cells_along,
    depth_kernel,
    needed_band,
    pinhole_beams,
)

FOV = (1.5184, 1.0123)


@given(st.integers(0, 2**32), st.floats(0.2, 12.0))
def test_template_cells_equal_ray_traversal_in_order(seed, reach):
    generator = torch.Generator().manual_seed(seed)
    directions = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    directions /= directions.norm(dim=1, keepdim=True)
    cells, bounds, lengths = cells_along(directions, reach)
    half = 14
    starts = torch.full((20, 3), half + 0.5, dtype=torch.float64)
    ends = starts + reach * directions
    shape = (2 * half + 1,) * 3
    found = [set() for _ in range(20)]
    for visits in traverse(starts, ends, shape):
        for voxel, ray in zip(*(part.tolist() for part in visits), strict=True):
            found[ray].add(voxel)
    strides = torch.tensor([shape[1] * shape[2], shape[2], 1])
    for ray, length in enumerate(lengths.tolist()):
        mine = ((cells[ray, :length] + half) * strides).sum(1).tolist()
        last = int(((ends[ray].floor().long()) * strides).sum())
        assert len(set(mine)) == length
        assert set(mine) == found[ray] | {last}
        assert mine[-1] == last
        middle = (bounds[ray, 1 : length + 1] + bounds[ray, :length])[:, None] / 2 * directions[ray]
        assert torch.equal((middle + 0.5).floor().long(), cells[ray, :length])
        assert float(bounds[ray, 0]) == 0
        assert float(bounds[ray, length]) == reach
        assert bool((bounds[ray].diff() >= 0).all())
        assert not bool(cells[ray, length:].any())


@pytest.mark.parametrize("n_beams", [1, 7, 160, 1000])
def test_solid_angles_tile_the_image(n_beams):
    directions, solid_angles = pinhole_beams(*FOV, n_beams)
    assert 0.75 * n_beams <= len(directions) <= 1.25 * n_beams
    u, v = math.tan(FOV[0] / 2), math.tan(FOV[1] / 2)
    whole = 4 * math.asin(u * v / math.sqrt((1 + u * u) * (1 + v * v)))  # of a rectangular pyramid
    assert float(solid_angles.sum()) == pytest.approx(whole, rel=1e-12)
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(len(directions)).double())
    assert bool((directions[:, 1].abs() <= u * directions[:, 0]).all())
    assert bool((directions[:, 2].abs() <= v * directions[:, 0]).all())
    assert float(directions[:, 1:].sum(0).abs().max()) < 1e-9  # as many to either side
    assert float(solid_angles.max() / solid_angles.min()) < 1.7


def test_beam_templates_reject_cameras_without_view():
    for fov in (0.0, -1.0, math.pi, math.nan):
        with pytest.raises(InvalidArgumentError, match="horizontal_fov"):
            pinhole_beams(fov, 1.0, 10)
        with pytest.raises(InvalidArgumentError, match="vertical_fov"):
            pinhole_beams(1.0, fov, 10)
    with pytest.raises(InvalidArgumentError, match="n_beams"):
        pinhole_beams(1.0, 1.0, 0)
    for far in (0.0, math.inf, math.nan):
        with pytest.raises(InvalidArgumentError, match="max_range"):
            beam_templates(*FOV, far, 0.2, 10, 4)
    with pytest.raises(InvalidArgumentError, match="coarser"):
        beam_templates(*FOV, 6.0, 1e-4, 160, 16)


N_CELLS = 8
MAPS = torch.tensor(list(itertools.product([0.0, 1.0], repeat=N_CELLS)), dtype=torch.float64)
FIRST = torch.where(MAPS.any(1), MAPS.argmax(1), N_CELLS)  # of each map the cell that is hit

probabilities = st.one_of(st.sampled_from([0.0, 1.0, 0.5, 0.125]), st.floats(0.0, 1.0))
beams = st.lists(probabilities, min_size=N_CELLS, max_size=N_CELLS).map(
    lambda o: torch.tensor(o, dtype=torch.float64)
)


def ended(occupancy):
    """Cells (..., C + 1), the last of which stands for no return."""
    return torch.cat([occupancy, occupancy.new_ones(*occupancy.shape[:-1], 1)], -1)


def csqmi(occupancy, depths, sigma, band):
    lengths = torch.tensor(occupancy.shape[-1]).expand(occupancy.shape[:-1])
    kernel = depth_kernel(depths.expand_as(occupancy), sigma, band, lengths).to(occupancy)
    return banded_csqmi(first_block(ended(occupancy)), first_block(sharpened(ended(occupancy))), kernel)


def fsmi(occupancy, delta_occ=1.5, delta_emp=1 / 1.5):
    return shannon(first_block(ended(occupancy)), ended(occupancy), delta_occ, delta_emp)


def map_probability(occupancy):
    return torch.where(MAPS > 0, occupancy, 1 - occupancy).prod(1)


def uneven_depths(n_cells=N_CELLS, seed=1):
    """Of cells as rays cross them: some ways through a cell are very short."""
    generator = torch.Generator().manual_seed(seed)
    steps = torch.rand(n_cells, generator=generator, dtype=torch.float64) * 0.2 + 1e-4
    return steps.cumsum(0)


def readings(depths, sigma):
    """p(z | map) on a fine grid of readings z (256, Z); no hit reads far behind."""
    means = torch.cat([depths, depths[-1:] + 40 * sigma])[FIRST]
    step = sigma / 20
    z = torch.arange(float(depths[0]) - 9 * sigma, float(depths[-1]) + 49 * sigma, step, dtype=torch.float64)
    return torch.exp(-0.5 * ((z - means[:, None]) / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))


def enumerated_csqmi(occupancy, depths, sigma):
    """−log (∫Σ p(m, z) p(m) p(z))² / (∫Σ p(m, z)² ∫Σ p(m)² p(z)²), term by term."""
    prior = map_probability(occupancy)
    likelihood = readings(depths, sigma)
    joint = prior[:, None] * likelihood
    apart = prior[:, None] * joint.sum(0)
    return torch.log((joint**2).sum() * (apart**2).sum() / (joint * apart).sum() ** 2)


@given(beams)
def test_first_hit_equals_enumeration_of_maps(occupancy):
    expected = torch.zeros(N_CELLS + 1, dtype=torch.float64)
    expected.index_add_(0, FIRST, map_probability(occupancy))
    torch.testing.assert_close(first_block(ended(occupancy)), expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("sigma", [0.02, 0.05, 0.15])
@given(occupancy=beams)
def test_csqmi_equals_enumeration_of_maps(sigma, occupancy):
    depths = uneven_depths()
    expected = enumerated_csqmi(occupancy, depths, sigma)
    got = csqmi(occupancy, depths, sigma, band=N_CELLS)
    torch.testing.assert_close(got, expected.clamp_min(0), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("delta_occ", "delta_emp"), [(1.5, 1 / 1.5), (20.0, 0.3)])
@given(occupancy=beams)
def test_fsmi_equals_the_expected_divergence_of_updated_cells(delta_occ, delta_emp, occupancy):
    """f(δ, r) is the Kullback–Leibler divergence of a cell from what it was before its odds r become rδ."""

    def divergence(o, delta):
        after = o * delta / (o * delta + (1 - o))
        terms = [(after, o), (1 - after, 1 - o)]
        return sum(a * math.log(a / b) for a, b in terms if a > 0)

    cells = occupancy.tolist()
    expected = 0.0
    for first, probability in enumerate(first_block(ended(occupancy)).tolist()):
        told = sum(divergence(o, delta_emp) for o in cells[:first])
        told += divergence(cells[first], delta_occ) if first < N_CELLS else 0.0
        expected += probability * told
    assert float(fsmi(occupancy, delta_occ=delta_occ, delta_emp=delta_emp)) == pytest.approx(
        expected, abs=1e-12
    )


def both(occupancy, depths):
    return csqmi(occupancy, depths, 0.05, needed_band(depths, 0.05)), fsmi(occupancy)


@pytest.mark.parametrize("n_cells", [64, 400])
def test_csqmi_in_float32_is_accurate_for_long_beams(n_cells, generator):
    rows = torch.rand(5, n_cells, generator=generator, dtype=torch.float64)
    rows = torch.cat([rows, rows**6, torch.full((1, n_cells), 0.5), torch.full((1, n_cells), 0.125)])
    rows[::2, ::7] = 0
    rows[1::3, n_cells // 2] = 1
    rows[2, :] = 1e-7
    depths = uneven_depths(n_cells)
    exact = both(rows, depths)
    single = both(rows.float(), depths.float())
    for got, expected in zip(single, exact, strict=True):
        assert got.dtype == torch.float32
        torch.testing.assert_close(got.double(), expected, rtol=1e-4, atol=2e-5)


@pytest.mark.parametrize("prior", [0.125, 0.5, None])
def test_needed_band_follows_the_depths(prior, generator):
    """Cells 1 cm apart in one part of a beam and 20 cm in the other: the chosen band is as good as none."""
    depths = torch.cat([torch.arange(20) * 0.01, 0.2 + torch.arange(20) * 0.2]).double()
    occupancy = (
        torch.rand(50, 40, generator=generator, dtype=torch.float64)
        if prior is None
        else torch.full((1, 40), prior, dtype=torch.float64)
    )
    full = csqmi(occupancy, depths, 0.05, band=39)
    torch.testing.assert_close(both(occupancy, depths)[0], full, rtol=0, atol=1e-4)
    narrow = csqmi(occupancy, depths, 0.05, band=2)
    assert float((narrow - full).abs().max()) > 1e-2
    even = 0.2 * torch.arange(40).double()
    assert needed_band(even, 0.05) == 1
    two = csqmi(occupancy, even, 0.05, band=2)
    torch.testing.assert_close(two, csqmi(occupancy, even, 0.05, band=39), rtol=0, atol=1e-4)


SHAPE = (12, 9, 8)
COUNTS = (3, 3, 2)


def window(low: tuple[int, int, int]):
    return surroundings_from(torch.ones(SHAPE, dtype=torch.bool), low)


corners = st.tuples(*[st.integers(-3, 3).map(lambda n: 4 * n)] * 3)


@given(lows=st.lists(corners, min_size=1, max_size=5), seed=st.integers(0, 99))
def test_weights_equal_a_dictionary_for_any_window(lows, seed):
    generator = torch.Generator().manual_seed(seed)
    discount, kept = InformationDiscount(), {}
    for now, low in enumerate(lows):
        measured = torch.rand(18, generator=generator) * (torch.rand(18, generator=generator) < 0.5)
        discount.note(window(low), measured, float(now))
        for share, block in zip(measured.tolist(), itertools.product(*map(range, COUNTS)), strict=True):
            name = tuple(a // 4 + b for a, b in zip(low, block, strict=True))
            kept[name] = kept.get(name, 1.0) * (1 - 0.25 * share)
    for low in lows:
        expected = [
            kept.get(tuple(a // 4 + b for a, b in zip(low, block, strict=True)), 1.0)
            for block in itertools.product(*map(range, COUNTS))
        ]
        torch.testing.assert_close(discount.weights(window(low)), torch.tensor(expected))


def test_note_counts_once_for_each_time():
    discount = InformationDiscount()
    assert discount.weights(window((0, 0, 0))).tolist() == [1.0] * 18
    for _ in range(3):
        discount.note(window((0, 0, 0)), torch.ones(18), 2.0)
    assert discount.weights(window((0, 0, 0))).tolist() == [0.75] * 18
    discount.note(window((0, 0, 0)), torch.ones(18), 4.0)
    assert discount.weights(window((0, 0, 0))).tolist() == [0.5625] * 18
