"""Evidence of components: the shell of surfaces that frees no cells, denser hits, and thinned rays."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
import torch
from exploration.ray_cases import dense, evidence_of, one
from mapping.random_components import normal_components
from torch import Tensor

from gmmtorch.mapping.components import Components
from gmmtorch.occupancy.voxels.cells import Box, sum_evidence

RESOLUTION = 0.2


# -- the shell ------------------------------------------------------------------------------------


def rotation_to(normal: Tensor) -> Tensor:
    """A rotation (3, 3) whose last column is the unit normal."""
    start = torch.cat([normal[:, None], torch.eye(3, dtype=torch.float64)[:, :2]], 1)
    q, _ = torch.linalg.qr(start)
    return q[:, [1, 2, 0]] * torch.sign(q[:, 0] @ normal)


def sheet(
    normal: tuple[float, ...], origin: tuple[float, ...], count: float = 1000.0
) -> tuple[Components, Tensor, float]:
    """A component that is almost a plane, with the unit normal (3,) and offset of the plane."""
    unit = torch.tensor(normal, dtype=torch.float64)
    unit = unit / unit.norm()
    q = rotation_to(unit)
    deviations = torch.tensor([0.5, 0.4, 1e-6], dtype=torch.float64)
    covariance = q @ torch.diag(deviations**2) @ q.T
    mean = (3.03, 0.57, 0.45)
    component = one((covariance + covariance.T) / 2, mean, origin, count)
    return component, unit, float(unit @ component.means[0])


AROUND = Box(torch.tensor([-15, -25, -25]), torch.tensor([40, 35, 35]))


def distances(unit: Tensor, offset: float) -> tuple[Tensor, Tensor]:
    """Least and largest distance (nx, ny, nz), in cells, of the points of each cell of AROUND from a
    plane, by its corners."""
    sides = [torch.arange(a, b) for a, b in zip(AROUND.low.tolist(), AROUND.high.tolist(), strict=True)]
    cells = torch.stack(torch.meshgrid(*sides, indexing="ij"), -1).double()
    corners = torch.stack(
        [
            (cells + torch.tensor(c, dtype=torch.float64)) @ unit - offset / RESOLUTION
            for c in itertools.product((0, 1), repeat=3)
        ]
    )
    across = (corners.amin(0) < 0) & (corners.amax(0) > 0)
    return torch.where(across, 0.0, corners.abs().amin(0)), corners.abs().amax(0)


VIEWS = {
    "frontal": ((1.0, 0.0, 0.0), (0.1, 0.5, 0.5)),
    "grazing": ((0.0, 0.0, 1.0), (0.1, 0.5, 1.15)),
    "tilted": ((1.0, 0.5, 0.7), (0.1, 0.5, 1.2)),
    "tilted and grazing": ((0.1, -0.2, 1.0), (0.1, 0.5, 1.7)),
}


@pytest.mark.parametrize(
    ("view", "shell"),
    [("frontal", 2.5), ("grazing", 1.0), ("tilted", 0.5), ("tilted", 2.5), ("tilted and grazing", 1.0)],
)
def test_no_cell_that_a_surface_cuts_is_freed(view: str, shell: float) -> None:
    component, unit, offset = sheet(*VIEWS[view])
    plain = dense(evidence_of(component, RESOLUTION, AROUND), AROUND)
    found = dense(evidence_of(component, RESOLUTION, AROUND, shell=shell), AROUND)
    nearest, farthest = distances(unit, offset)
    assert torch.equal(found[0], plain[0])
    assert bool((found[1] <= plain[1] + 1e-4).all())
    within = farthest < shell - 1e-3
    assert float(found[1][within].sum()) == 0
    if shell > 1 or (shell == 1 and view != "frontal"):
        assert float(plain[1][within].sum()) > 0
    # Rays stop at the distance of the shell from the plane: cells farther away are unaffected.
    beyond = nearest > shell + 1e-3
    assert float(plain[1][beyond].sum()) > 100
    torch.testing.assert_close(found[1][beyond], plain[1][beyond], rtol=1e-6, atol=1e-4)


def test_no_return_components_have_no_shell() -> None:
    component, _, _ = sheet(*VIEWS["tilted"])
    empty = replace(component, max_range=torch.tensor([True]))
    one, other = (evidence_of(empty, RESOLUTION, AROUND, shell=shell) for shell in (0.0, 3.0))
    for a, b in zip(one, other, strict=True):
        assert torch.equal(a, b)


def test_a_sensor_within_the_shell_frees_no_cells() -> None:
    component, _, _ = sheet((0.0, 0.0, 1.0), (2.0, 0.5, 0.55))  # half a cell above the plane
    evidence = evidence_of(component, RESOLUTION, AROUND, shell=1.0)
    assert float(evidence.misses.sum()) == 0
    assert float(evidence.hits.sum()) == pytest.approx(1000.0)


# -- fewer rays near the sensor -------------------------------------------------------------------


@pytest.mark.parametrize(("view", "empty"), [("frontal", True), ("grazing", False), ("tilted", False)])
def test_thinned_rays_have_the_same_expected_misses(view: str, empty: bool) -> None:
    component, _, _ = sheet(*VIEWS[view])
    component = replace(component, max_range=torch.tensor([empty]))
    options = {"least": 20_000, "most": 20_000, "shell": 1.0}
    limit, found = (
        dense(evidence_of(component, RESOLUTION, AROUND, **options, thinned=thinned), AROUND)
        for thinned in (False, True)
    )
    assert torch.equal(found[0], limit[0])
    many = limit[1] > 20
    assert int(many.sum()) > 20
    torch.testing.assert_close(found[1][many], limit[1][many], rtol=0.1, atol=2.0)
    assert float(found[1].sum()) == pytest.approx(float(limit[1].sum()), rel=2e-3)


def test_all_rays_count_as_misses_in_the_cell_of_the_sensor() -> None:
    component, _, _ = sheet(*VIEWS["tilted"])
    for least in range(1, 10):
        plain, thinned = (
            evidence_of(component, RESOLUTION, AROUND, least=least, most=least, thinned=thinned)
            for thinned in (False, True)
        )
        if least == 1:
            assert torch.equal(plain.cells, thinned.cells)
        sensor = (component.origins[0] / RESOLUTION).floor().long()
        begun = [float(e.misses[(e.cells == sensor).all(1)]) for e in (plain, thinned)]
        assert begun == pytest.approx([1000.0, 1000.0], rel=1e-5)


@pytest.mark.parametrize("thinned", [False, True])
@pytest.mark.parametrize("shell", [0.0, 1.0])
def test_evidence_of_disjoint_boxes_sums_to_the_whole(shell: float, thinned: bool) -> None:
    options = {"shell": shell, "hits_per_ray": 8, "thinned": thinned}
    components = normal_components(30, 3, seed=4, empty=0.2)
    whole = Box(torch.tensor([-12] * 3), torch.tensor([12] * 3))
    halves = []
    for octant in itertools.product((0, 1), repeat=3):
        low = torch.tensor([(-12, 3)[side] for side in octant])
        high = torch.tensor([(3, 12)[side] for side in octant])
        halves.append(evidence_of(components, RESOLUTION, Box(low, high), **options))
    expected = evidence_of(components, RESOLUTION, whole, **options)
    assert float(expected.hits.sum()) > 10
    torch.testing.assert_close(
        dense(sum_evidence(halves), whole), dense(expected, whole), rtol=1e-5, atol=1e-4
    )
