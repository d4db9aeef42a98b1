"""Information of a beam against enumeration of all maps, with readings integrated by quadrature."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.kernels.rays.beam_information import banded_csqmi, first_block, shannon, sharpened
from gmmtorch.team.exploration.information.beam_templates import depth_kernel, needed_band

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


@given(beams)
def test_fsmi_of_a_noise_free_sensor_equals_shannon_information(occupancy):
    prior = map_probability(occupancy)
    reading = torch.zeros(N_CELLS + 1, dtype=torch.float64).index_add_(0, FIRST, prior)
    possible = prior > 0
    # What a map says of the reading is certain: Σ p(m, z) log p(m, z)/(p(m) p(z)) = −Σ p(m) log p(z(m)).
    expected = -(prior[possible] * reading[FIRST[possible]].log()).sum()
    got = fsmi(occupancy, delta_occ=1e14, delta_emp=1e-14)
    # Where a cell is occupied by less than 1/δ the limit is not reached.
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-10)


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
def test_csqmi_in_float32_is_accurate_for_long_beams(n_cells):
    generator = torch.Generator().manual_seed(0)
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
def test_needed_band_follows_the_depths(prior):
    """Cells 1 cm apart in one part of a beam and 20 cm in the other: the chosen band is as good as none."""
    depths = torch.cat([torch.arange(20) * 0.01, 0.2 + torch.arange(20) * 0.2]).double()
    generator = torch.Generator().manual_seed(0)
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


def test_depth_kernel_equals_the_dense_kernel_within_its_band():
    depths, lengths = uneven_depths(), torch.tensor([8, 5, 1, 0])
    kernel = depth_kernel(depths.expand(4, 8), 0.1, 3, lengths)
    assert kernel.shape == (3, 4, 9)
    for row, length in enumerate(lengths.tolist()):
        for s, i in itertools.product(range(1, 4), range(9)):
            there = i + s < length
            expected = math.exp(-(float(depths[i + s] - depths[i]) ** 2) / (4 * 0.01)) if there else 0.0
            assert float(kernel[s - 1, row, i]) == pytest.approx(expected, abs=1e-12)
