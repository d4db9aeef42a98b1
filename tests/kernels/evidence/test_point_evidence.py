"""The fused point evidence against its twin, which test_point compares with quadrature."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kernels.cones_for_kernels import cones_of
from kernels.twins import by_both

from gmmtorch.kernels import Lists, kernels
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.windows import SIDES, few_points
from gmmtorch.mapping.query import Block
from gmmtorch.occupancy import Cones, PointForm
from gmmtorch.occupancy.cone_index import Hulls
from gmmtorch.occupancy.forms import point


def points_of(cones: Cones) -> torch.Tensor:
    """Points near and between, on the means, on the sensor origins, very far, and at infinity."""
    generator = torch.Generator().manual_seed(0)
    along = torch.rand(40, len(cones.means), 1, generator=generator, dtype=torch.float64) * 1.3
    between = (cones.origins + along * (cones.means - cones.origins)).flatten(0, 1)
    between = between + 0.2 * torch.randn(between.shape, generator=generator, dtype=torch.float64)
    far = cones.means[:3] + 1e6
    infinite = torch.full_like(far, torch.inf)
    return torch.cat([between, cones.means, cones.origins, cones.origins + 1e-9, far, infinite])


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["any", "flat", "around"])
@pytest.mark.parametrize(("resolution", "cutoff"), [(0.05, 3.0), (0.5, 5.0)])
def test_fused_evidence_equals_the_twin(dim, kind, resolution, cutoff, monkeypatch):
    cones = cones_of(dim, kind)
    points = points_of(cones)
    form = PointForm(cones, resolution, cutoff)
    found = by_both(lambda: form(points))
    assert found[0].misses.count_nonzero() > 1000
    bound = 1e-11 * cones.counts.sum()
    monkeypatch.setattr(point, "_FEW_PAIRS", 0)  # also from the lists of an index
    with kernels("fused"):
        listed = form(points)
    for one, other in zip(found[0] * 2, [*found[1], *listed], strict=True):
        assert torch.isfinite(other).all()
        torch.testing.assert_close(other, one, rtol=1e-10, atol=float(bound))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("scale", [1e-5, 1.0, 1e4, 1e9])
def test_quick_tests_in_single_precision_leave_out_no_evidence(dim, scale):
    one = cones_of(dim, "any")
    shifts = torch.tensor([3000.0, 0.0, -0.01], dtype=torch.float64).repeat(20)[:, None]
    cones = one._replace(
        means=(one.means + shifts) * scale,
        covariances=one.covariances * scale**2,
        origins=(one.origins + shifts) * scale,
    )
    places = points_of(one._replace(means=one.means + shifts, origins=one.origins + shifts))
    form = PointForm(cones, 0.05 * scale, 3.0)
    for found, other in zip(*by_both(lambda: form(places * scale)), strict=True):
        assert torch.equal(found > 0, other > 0)
        torch.testing.assert_close(found, other, rtol=1e-6, atol=1e-9 * float(cones.counts.sum()))


@given(
    dim=st.sampled_from([2, 3]),
    kind=st.sampled_from(["any", "flat", "around"]),
    seed=st.integers(0, 10_000),
    n_points=st.integers(1, 30),
    n_blocks=st.integers(1, 3),
)
def test_evidence_of_a_few_points_equals_the_twin(dim, kind, seed, n_points, n_blocks):
    cones = cones_of(dim, kind)
    draw = torch.Generator().manual_seed(seed)
    seen_by, seen_from = torch.randint(60, (2, 90), generator=draw)
    seen_count = torch.rand(90, generator=draw).double() * 100 - 5
    parts = [cones.means, cones.covariances, cones.counts, cones.max_range, torch.zeros(60, 2).long()]
    blocks = []
    for number in range(n_blocks):
        moved = [parts[0] + 30 * number, *parts[1:], cones.origins + 30 * number]
        blocks.append(Block(Components(*moved, seen_by, seen_from, seen_count.clamp_min(0))))
    points = points_of(cones)[torch.randint(2000, (n_points,), generator=draw).to(cones.means.device)]
    (twin, n_twin), (fused, n_fused) = by_both(lambda: few_points(blocks, points, SIDES))
    assert n_twin == n_fused
    np.testing.assert_allclose(fused, twin, rtol=1e-9, atol=1e-11 * 90 * 100)


def test_fused_evidence_does_not_depend_on_the_other_points():
    cones = cones_of(3, "any")
    points = points_of(cones)
    form = PointForm(cones, 0.1)
    with kernels("fused"):
        together, alone = form(points), [form(points[i : i + 1]) for i in range(0, 200, 7)]
    assert torch.equal(together.misses[:200:7], torch.cat([part.misses for part in alone]))


def test_evidence_of_points_with_gradients_comes_from_the_twin():
    cones = cones_of(3, "any")
    points = points_of(cones)[:50].requires_grad_()
    with kernels("fused"):
        found = PointForm(cones, 0.1)(points)
    assert torch.autograd.grad(found.misses.sum(), points)[0].abs().sum() > 0


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["any", "flat", "around"])
@pytest.mark.parametrize("smoothed", [False, True])
def test_fused_hull_tests_equal_the_twin(dim, kind, smoothed, generator):
    cones = cones_of(dim, kind)
    points = points_of(cones)
    points = points[torch.isfinite(points).all(1)]
    n_cones = len(cones.means)
    given = Lists.of(torch.tensor([n_cones, 0, 3]), torch.randint(n_cones, (n_cones + 3,)).int())
    lists = torch.randint(3, (len(points),), generator=generator)
    hulls, radius = Hulls(cones, 0.1, 3.0, smoothed), torch.rand(len(points)).double()
    found = by_both(lambda: hulls.near(given, lists, points, radius))
    assert 0 < len(found[0].entries) < int(given.lengths()[lists].sum())
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)
