"""The fused point evidence against its twin, which test_point compares with quadrature."""

from __future__ import annotations

import pytest
import torch
from kernels.cones_for_kernels import cones_of
from kernels.twins import by_both

from gmmtorch.kernels import kernels
from gmmtorch.kernels.evidence.point_evidence import Lists
from gmmtorch.occupancy.cone_index import Hulls
from gmmtorch.occupancy.cones import Cones
from gmmtorch.occupancy.forms.point import PointForm


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
def test_fused_evidence_equals_the_twin(dim, kind, resolution, cutoff):
    cones = cones_of(dim, kind)
    points = points_of(cones)
    form = PointForm(cones, resolution, cutoff)
    found = by_both(lambda: form(points))
    assert found[0].misses.count_nonzero() > 1000
    bound = 1e-11 * cones.counts.sum()
    for one, other in zip(*found, strict=True):
        assert torch.isfinite(other).all()
        torch.testing.assert_close(other, one, rtol=1e-10, atol=float(bound))


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
def test_fused_hull_tests_equal_the_twin(dim, kind, smoothed):
    cones = cones_of(dim, kind)
    points = points_of(cones)
    points = points[torch.isfinite(points).all(1)]
    generator = torch.Generator().manual_seed(0)
    n_cones = len(cones.means)
    given = Lists.of(torch.tensor([n_cones, 0, 3]), torch.randint(n_cones, (n_cones + 3,)).int())
    lists = torch.randint(3, (len(points),), generator=generator)
    hulls, radius = Hulls(cones, 0.1, 3.0, smoothed), torch.rand(len(points)).double()
    found = by_both(lambda: hulls.near(given, lists, points, radius))
    assert 0 < len(found[0].entries) < int(given.lengths()[lists].sum())
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)
