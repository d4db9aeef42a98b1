"""The fused casting of components against its twin, which test_component_rays compares with moments."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from exploration.ray_cases import evidence_of
from kernels.twins import by_both
from mapping.random_components import random_components

from gmmtorch.errors import NumericalError
from gmmtorch.kernels import kernels
from gmmtorch.mapping.components import Components
from gmmtorch.occupancy.voxels.cells import Box, CellEvidence

OPTIONS = {
    "plain": {},
    "thinned": {"thinned": True, "shell": 0.5, "hits_per_ray": 8},
    "empty apart": {"thinned": True, "shell": 0.5, "empty_rays_per_cell": 2.0, "empty_cutoff": 1.5},
    "few": {"rays_per_cell": 0.1, "least": 1, "most": 3, "cutoff": 1.0, "thinned": True},
}
CORNERS = {
    "everything": ([-4096] * 3, [4096] * 3),
    "slab": ([-5, -100, -100], [3, 100, 100]),
    "cell": ([0, 0, 0], [1, 1, 1]),
    "far": ([900, 900, 900], [999, 999, 999]),
}


def box_of(name: str) -> Box:
    return Box(*(torch.tensor(corner) for corner in CORNERS[name]))


def cases() -> dict[str, Components]:
    some = random_components(3, 30, extent=8.0)
    planes = torch.zeros_like(some.means)  # means and sensors on grid planes and corners
    at_mean = replace(some, origins=some.means[:7].clone())
    axes = torch.diag_embed(torch.tensor([[0.3, 0.2, 0.01]], dtype=torch.float64).square().expand(30, 3))
    return {
        "random": some,
        "on grid planes": replace(some, means=(some.means / 0.2).round() * 0.2, covariances=axes),
        "at one corner": replace(some, means=planes, covariances=axes),
        "sensor at the mean": at_mean,
        "without counts": replace(some, seen_count=torch.where(some.seen_by % 2 == 0, 0.0, some.seen_count)),
        "tiny": replace(some, covariances=some.covariances * 1e-12),
        "far from the origin": replace(some, means=some.means + 1e5, origins=some.origins + 1e5),
    }


def both(components: Components, box: Box, **options) -> tuple[CellEvidence, CellEvidence]:
    return by_both(lambda: in_order(evidence_of(components, 0.2, box, **options)))


def in_order(evidence: CellEvidence) -> CellEvidence:
    row = torch.unique(evidence.cells, dim=0, return_inverse=True)[1]
    return CellEvidence(*(value[row.argsort()] for value in evidence))


@pytest.mark.parametrize("kind", OPTIONS)
@pytest.mark.parametrize("box", CORNERS)
@pytest.mark.parametrize("case", cases())
def test_fused_casting_equals_the_twin_up_to_rounding(case, box, kind):
    one, other = both(cases()[case], box_of(box), **OPTIONS[kind])
    assert torch.equal(one.cells, other.cells)
    torch.testing.assert_close(other.hits, one.hits, rtol=1e-6, atol=0)
    torch.testing.assert_close(other.misses, one.misses, rtol=1e-6, atol=0)


def test_evidence_of_a_part_of_the_world_is_that_part_of_all_evidence():
    with kernels("fused"):
        components, options = cases()["random"], OPTIONS["thinned"]
        whole = evidence_of(components, 0.2, box_of("everything"), **options)
        slab = box_of("slab")
        part = evidence_of(components, 0.2, slab, **options)
    inside = ((whole.cells >= slab.low) & (whole.cells < slab.high)).all(1)
    assert torch.equal(whole.cells[inside], part.cells)
    # Viewpoints whose points cannot be in the slab draw fewer of them, which changes the sums' rounding.
    torch.testing.assert_close(whole.misses[inside], part.misses, rtol=1e-6, atol=0)


def test_covariances_without_a_factor_are_repaired_as_by_the_twin():
    some = random_components(3, 4)
    flat = some.covariances.clone()
    flat[1] = torch.diag(torch.tensor([0.04, 0.04, 0.0], dtype=torch.float64))
    one, other = both(replace(some, covariances=flat), box_of("everything"))
    assert torch.equal(one.misses, other.misses)
    flat[1, 0, 0] = torch.nan
    with kernels("fused"), pytest.raises(NumericalError, match=r"covariances\["):
        evidence_of(replace(some, covariances=flat), 0.2, box_of("everything"))
