"""Beams that pass through components: kernel and twin, and a count by points along the beams."""

from __future__ import annotations

import pytest
import torch
from kernels.twins import by_both
from torch import Tensor

from gmmtorch.kernels import PassLimits, beam_passes, kernels
from gmmtorch.occupancy.cones import whitening

LIMITS = PassLimits(through=1.0, reach=3.0, margin=0.3, grazing=4.0, explained=7.8)


def case(dim: int, k: int = 60, n: int = 300) -> tuple[Tensor, ...]:
    """Means, covariances, beams from the origin, and which of them have a return."""
    generator = torch.Generator().manual_seed(dim)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    axes, _ = torch.linalg.qr(normal(k, dim, dim))
    squares = torch.rand(k, dim, generator=generator, dtype=torch.float64) * 0.1 + 1e-4
    squares[: k // 2, 0] = 1e-4  # half of them are thin
    beams = 3 * normal(n, dim)
    means = torch.cat([2 * normal(k - 20, dim), beams[:20]])  # some have returns
    covariances = axes @ (squares[:, :, None] * axes.mT)
    return means, covariances, beams, torch.arange(n) % 5 > 0


def counts(means: Tensor, covariances: Tensor, beams: Tensor, is_hit: Tensor) -> tuple[Tensor, Tensor]:
    deviations = torch.linalg.eigvalsh(covariances)[:, [0, -1]].sqrt()
    return beam_passes(whitening(covariances)[0], means, deviations, beams, is_hit, LIMITS)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_fused_count_equals_the_twin(dim):
    found = by_both(lambda: counts(*case(dim)))
    assert all(bool((part > 0).sum() > 5) for part in found[0])
    torch.testing.assert_close(found[1], found[0], rtol=0, atol=0)


@pytest.mark.parametrize("dim", [2, 3])
def test_passes_equal_a_count_along_the_beams(dim):
    means, covariances, beams, is_hit = case(dim, k=24, n=40)
    passed, returned = counts(means, covariances, beams, is_hit)
    precisions = torch.linalg.inv(covariances)
    steps = torch.linspace(-1, 2, 12_001, dtype=torch.float64)[:, None]  # of the beam's whole line
    for k in range(len(means)):
        n_passed = n_returned = 0
        for beam, hit in zip(beams, is_hit, strict=True):
            offset = steps * beam - means[k]
            square = (offset @ precisions[k] * offset).sum(1)
            inside = steps[square < 9.0]
            end = beam - means[k]
            if square.min() >= 1:
                continue
            n_returned += int(hit and (end * (precisions[k] @ end)).sum() < LIMITS.explained)
            unit = beam / beam.norm()
            along = (unit * (precisions[k] @ unit)).sum().rsqrt()
            thinnest = torch.linalg.eigvalsh(covariances[k])[0].sqrt()
            clear = inside.min() > 0 and (1 - inside.max()) * beam.norm() > LIMITS.margin
            n_passed += int(clear and along <= 4 * thinnest)
        assert (int(passed[k]), int(returned[k])) == (n_passed, n_returned)


@pytest.mark.parametrize("choice", ["torch", "fused"])
def test_nothing_passes_without_beams_or_components(choice):
    means, covariances, beams, is_hit = case(3)
    with kernels(choice):
        assert not bool(torch.stack(counts(means, covariances, beams[:0], is_hit[:0])).any())
        assert [len(part) for part in counts(means[:0], covariances[:0], beams, is_hit)] == [0, 0]
        ends_at_the_sensor = torch.zeros(3, 3, dtype=torch.float64)
        assert not bool(counts(means, covariances, ends_at_the_sensor, is_hit[:3])[0].any())
