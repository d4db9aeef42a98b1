"""Evidence that is kept while cones change, against the evidence of all cones."""

from __future__ import annotations

import pytest
import torch
from occupancy.cone_cases import random_cones

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels.choice import kernels
from gmmtorch.occupancy.cones import Cones
from gmmtorch.occupancy.forms.point import KeptEvidence, PointForm
from gmmtorch.occupancy.grid import VoxelGrid

H = 0.3


def taken(cones: Cones, rows: torch.Tensor) -> Cones:
    return Cones(*(part[rows] for part in cones))


def joined(*parts: Cones) -> Cones:
    return Cones(*(torch.cat(fields) for fields in zip(*parts, strict=True)))


def moved(cones: Cones, x: float) -> Cones:
    shift = torch.zeros(cones.dim, dtype=torch.float64)
    shift[0] = x
    return cones._replace(means=cones.means + shift, origins=cones.origins + shift)


def states(dim: int) -> list[Cones]:
    """A map that grows, also below its lowest corner, loses and changes cones, and is emptied."""
    base, far = random_cones(dim, 40, 0, room=True), moved(random_cones(dim, 10, 1, room=True), -9.0)
    grown = joined(base, far)
    without = taken(grown, torch.arange(5, 50))
    counted = without._replace(counts=without.counts * (1 + (torch.arange(45) == 7)))
    swapped = taken(counted, torch.cat([torch.tensor([9]), torch.arange(9), torch.arange(10, 45)]))
    doubled = joined(swapped, taken(swapped, torch.arange(3)))
    none = taken(base, torch.arange(0))
    remote = moved(taken(base, torch.arange(4)), 1e8)
    return [base, grown, without, counted, counted, swapped, doubled, none, joined(base, remote), base]


def box(dim: int, low: float, high: float) -> VoxelGrid:
    return VoxelGrid.covering([low] * dim, [high] * dim, H)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("choice", ["fused", "torch"])
def test_kept_evidence_is_that_of_all_cones(dim, choice):
    if choice == "fused":
        pytest.importorskip("warp", reason="needs the extra [fast]: warp-lang")
    tolerance = 0.0 if choice == "fused" else 1e-12
    kept = KeptEvidence(H)
    with kernels(choice):
        for number, cones in enumerate(states(dim)):
            grid = box(dim, *((-0.5, 6.5), (-2.0, 5.0), (0.0, 7.0))[number // 2 % 3])
            found = kept.update(cones, grid)
            expected = PointForm(cones, H)(kept.centers(grid))
            for values, wanted in zip(found, expected, strict=True):
                torch.testing.assert_close(values.flatten(), wanted, rtol=tolerance, atol=tolerance)


def test_only_cells_near_changed_cones_are_evaluated():
    near, far = random_cones(2, 40, 0, room=True), moved(random_cones(2, 40, 1, room=True), 30.0)
    grid, kept = VoxelGrid.covering([-1.0, -1.0], [37.0, 7.0], H), KeptEvidence(H)
    kept.update(joined(near, far), grid)
    everything = kept.n_evaluated
    kept.update(joined(near, far), grid)
    assert kept.n_evaluated == 0
    kept.update(joined(near, taken(far, torch.arange(39))), grid)
    assert 0 < kept.n_evaluated < everything / 2


def test_cells_off_the_lattice_are_refused():
    with pytest.raises(InvalidArgumentError, match="multiples of resolution"):
        KeptEvidence(H).update(random_cones(2, 3, 0), VoxelGrid((0.1, 0.0), H, (4, 4)))
