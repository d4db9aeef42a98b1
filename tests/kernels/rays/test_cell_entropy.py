"""Fused entropy of cells against its twin, whose entropy is that of scipy."""

from __future__ import annotations

import pytest
import torch
from scipy.stats import entropy

from gmmtorch.kernels import kernels
from gmmtorch.kernels.rays.cell_entropy import cell_entropy, entropy_removed, reduction_along_rays


def counts(n: int, seed: int) -> torch.Tensor:
    """Counts of cells: none, few, many, and far more misses than hits."""
    generator = torch.Generator().manual_seed(seed)
    kind = torch.randint(0, 4, (n,), generator=generator)
    scale = torch.tensor([0.0, 1.0, 50.0, 1e6])[kind]
    return torch.rand(n, generator=generator) * scale


def test_entropy_is_that_of_a_coin():
    hits, misses = torch.tensor([0.0, 3.0, 1e9]).double(), torch.tensor([0.0, 1.0, 0.0]).double()
    p = (hits + 1) / (hits + misses + 2)
    expected = [entropy([x, 1 - x], base=2) for x in p.tolist()]
    assert cell_entropy(hits, misses, 1.0).tolist() == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize(("prior", "clamp"), [(1.0, 0.05), (1.0, 0.0), (0.0, 0.0), (0.125, 0.4)])
@pytest.mark.parametrize("n", [0, 1, 256, 10_000])
def test_fused_sums_of_removed_entropy_are_those_of_the_twin(n, prior, clamp):
    before, added = (counts(n, 0), counts(n, 1)), (counts(n, 2), counts(n, 3))
    chosen = counts(n, 4) > 0.5
    found = []
    for choice in ("torch", "fused"):
        with kernels(choice):
            found.append(entropy_removed(before, added, chosen, prior, clamp))
    one, other = found
    assert other.n_new == one.n_new
    assert other.bits == pytest.approx(one.bits, abs=1e-6 * n)
    assert other.chosen_bits == pytest.approx(one.chosen_bits, abs=1e-6 * n)


@pytest.mark.parametrize("margin", [0, 1])
def test_fused_reduction_along_rays_is_that_of_the_twin(margin):
    generator = torch.Generator().manual_seed(0)
    shape = (9, 14, 7)
    hits, misses = (counts(9 * 14 * 7, seed).view(shape) for seed in (0, 1))
    size = torch.tensor(shape, dtype=torch.float64)
    starts, stops = torch.rand(2, 400, 3, generator=generator, dtype=torch.float64) * size
    starts[:50], stops[50:100] = starts[:50].round(), stops[50:100].round()  # on planes, edges and corners
    stops[100:110] = starts[100:110]  # of length zero
    stops[110:200] = 3 * stops[110:200] - size  # out of the grid
    starts[190:260] = 3 * starts[190:260] - size
    if margin == 0:
        starts, stops = (x.minimum(size - 1e-6).clamp_min(0) for x in (starts, stops))
    options = {"prior": 1.0, "observed": 1.0, "mark": 100.0, "margin": margin}
    found = []
    for choice in ("torch", "fused"):
        with kernels(choice):
            low = torch.zeros(3, dtype=torch.int64)
            found.append(reduction_along_rays(starts, stops, low, hits, misses, **options))
    assert found[0].max() > 100
    torch.testing.assert_close(found[1], found[0], rtol=1e-12, atol=1e-12)
