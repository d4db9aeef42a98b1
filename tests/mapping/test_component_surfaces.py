"""Selected and summed components, and the shell of surfaces that frees no cells."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
import torch
from mapping.component_cases import counts_add_up, random_components
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.association import summed
from gmmtorch.mapping.rays.component_evidence import component_evidence
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.cell_evidence import CellEvidence, sum_evidence

RESOLUTION = 0.2


# -- parts and sums -------------------------------------------------------------------------------


def sightings(components: Components, row: int) -> list[tuple[tuple[float, ...], float]]:
    """(origin, count) pairs of a component, in order."""
    return [
        (tuple(components.origins[viewpoint].tolist()), count)
        for by, viewpoint, count in zip(
            components.seen_by.tolist(),
            components.seen_from.tolist(),
            components.seen_count.tolist(),
            strict=True,
        )
        if by == row
    ]


@pytest.mark.parametrize("rows", [[4, 0, 11, 7], [], list(range(12)), list(range(11, -1, -1)), [5]])
def test_selected_components_equal_those_of_a_loop(rows: list[int]) -> None:
    components = random_components(12, 3, seed=1, empty=0.3)
    # Sightings in any order, and a component without any.
    order = torch.randperm(len(components.seen_by), generator=torch.Generator().manual_seed(0))
    order = order[components.seen_by[order] != 7]
    shuffled = {n: getattr(components, n)[order] for n in ("seen_by", "seen_from", "seen_count")}
    components = replace(components, **shuffled)
    chosen = components.selected(torch.tensor(rows, dtype=torch.int64)).checked()
    assert len(chosen) == len(rows)
    for place, row in enumerate(rows):
        for name in ("means", "covariances", "support", "max_range", "ids"):
            assert torch.equal(getattr(chosen, name)[place], getattr(components, name)[row])
        assert sightings(chosen, place) == sightings(components, row)
    assert len(chosen.seen_by) == sum(len(sightings(components, row)) for row in rows)
    assert torch.equal(chosen.origins, components.origins)


def batch(ids: list[tuple[int, int]], counts: list[float], seed: int) -> Components:
    """Components with these ids and counts and one origin."""
    components = random_components(len(ids), 3, seed, n_origins=1)
    support = torch.tensor(counts, dtype=torch.float64)
    return replace(
        components, ids=torch.tensor(ids, dtype=torch.int64), support=support, seen_count=support.clone()
    )


def test_summed_counts_equal_those_of_a_dictionary() -> None:
    parts = [
        batch([(1, 0), (1, 1), (1, 2)], [3.0, 5.0, 7.0], 0),
        batch([(0, 9), (0, 3)], [11.0, 13.0], 1),
        batch([(1, 1), (0, 3), (1, 1)], [0.5, 0.25, 2.0], 2),
    ]
    found = summed(Components.concatenate(parts)).checked()
    totals: dict[tuple[int, int], float] = {}
    first: dict[tuple[int, int], Tensor] = {}
    for part in parts:
        for key, count, mean in zip(part.ids.tolist(), part.support.tolist(), part.means, strict=True):
            totals[tuple(key)] = totals.get(tuple(key), 0.0) + count
            first.setdefault(tuple(key), mean)
    assert [tuple(key) for key in found.ids.tolist()] == sorted(totals)
    assert found.support.tolist() == [totals[key] for key in sorted(totals)]
    assert torch.equal(found.means, torch.stack([first[key] for key in sorted(totals)]))
    assert counts_add_up(found)


def test_summing_distinct_or_no_components_changes_nothing() -> None:
    alone = batch([(0, 0), (0, 4), (2, 1)], [1.0, 2.0, 3.0], 0)
    found = summed(alone)
    for name in ("means", "support", "ids", "seen_by", "seen_from", "seen_count"):
        assert torch.equal(getattr(found, name), getattr(alone, name))
    assert len(summed(Components.empty(3))) == 0


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
    mean = torch.tensor([3.03, 0.57, 0.45], dtype=torch.float64)
    component = Components(
        means=mean[None],
        covariances=(covariance + covariance.T)[None] / 2,
        support=torch.tensor([count], dtype=torch.float64),
        max_range=torch.tensor([False]),
        ids=torch.tensor([[1, 5]]),
        origins=torch.tensor([origin], dtype=torch.float64),
        seen_by=torch.tensor([0]),
        seen_from=torch.tensor([0]),
        seen_count=torch.tensor([count], dtype=torch.float64),
    )
    return component, unit, float(unit @ mean)


def dense(evidence: CellEvidence, box: Box) -> Tensor:
    both = torch.zeros(2, *box.shape, dtype=torch.float64)
    x, y, z = (evidence.cells - box.low).unbind(1)
    both[0, x, y, z], both[1, x, y, z] = evidence.hits.double(), evidence.misses.double()
    return both


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
    plain = dense(component_evidence(component, RESOLUTION, AROUND), AROUND)
    found = dense(component_evidence(component, RESOLUTION, AROUND, shell=shell), AROUND)
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


@pytest.mark.parametrize("view", ["frontal", "grazing"])
def test_all_cells_along_a_lattice_aligned_surface_are_kept(view: str) -> None:
    component, unit, offset = sheet(*VIEWS[view])
    nearest, _ = distances(unit, offset)
    plain = dense(component_evidence(component, RESOLUTION, AROUND), AROUND)
    found = dense(component_evidence(component, RESOLUTION, AROUND, shell=1.0), AROUND)
    cut = nearest == 0
    assert float(found[1][cut].sum()) == 0
    assert (float(plain[1][cut].sum()) > 100) == (view == "grazing")


def test_no_return_components_have_no_shell() -> None:
    component, _, _ = sheet(*VIEWS["tilted"])
    empty = replace(component, max_range=torch.tensor([True]))
    one, other = (component_evidence(empty, RESOLUTION, AROUND, shell=shell) for shell in (0.0, 3.0))
    for a, b in zip(one, other, strict=True):
        assert torch.equal(a, b)


def test_a_sensor_within_the_shell_frees_no_cells() -> None:
    component, _, _ = sheet((0.0, 0.0, 1.0), (2.0, 0.5, 0.55))  # half a cell above the plane
    evidence = component_evidence(component, RESOLUTION, AROUND, shell=1.0)
    assert float(evidence.misses.sum()) == 0
    assert float(evidence.hits.sum()) == pytest.approx(1000.0)


# -- hits drawn more densely ----------------------------------------------------------------------

LARGE = Box(torch.tensor([-4096] * 3), torch.tensor([4096] * 3))


@pytest.mark.parametrize("shell", [0.0, 1.0])
def test_hits_per_ray_does_not_change_the_misses(shell: float) -> None:
    components = random_components(25, 3, seed=2, empty=0.3)
    once, often = (
        component_evidence(components, RESOLUTION, LARGE, shell=shell, hits_per_ray=n) for n in (1, 8)
    )
    missed = [dict(zip(map(tuple, e.cells.tolist()), e.misses.tolist(), strict=True)) for e in (once, often)]
    for cell in missed[0].keys() | missed[1].keys():
        assert missed[0].get(cell, 0.0) == pytest.approx(missed[1].get(cell, 0.0), rel=1e-5)


def test_denser_hits_are_more_accurate() -> None:
    near = Box(torch.tensor([-15, -25, -25]), torch.tensor([60, 35, 35]))
    errors: dict[int, float] = {1: 0.0, 8: 0.0}
    for number in range(6):
        component, _, _ = sheet(*VIEWS["tilted"])
        component = replace(component, ids=torch.tensor([[1, number]]))
        limit = dense(component_evidence(component, RESOLUTION, near, least=50_000, most=50_000), near)[0]
        for n in errors:
            hits = dense(component_evidence(component, RESOLUTION, near, hits_per_ray=n), near)[0]
            errors[n] += float((hits - limit).abs().sum()) / 6
    assert 0 < errors[8] < 0.5 * errors[1]


# -- fewer rays near the sensor -------------------------------------------------------------------


@pytest.mark.parametrize(("view", "empty"), [("frontal", True), ("grazing", False), ("tilted", False)])
def test_thinned_rays_have_the_same_expected_misses(view: str, empty: bool) -> None:
    component, _, _ = sheet(*VIEWS[view])
    component = replace(component, max_range=torch.tensor([empty]))
    options = {"least": 20_000, "most": 20_000, "shell": 1.0}
    limit, found = (
        dense(component_evidence(component, RESOLUTION, AROUND, **options, thinned=thinned), AROUND)
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
            component_evidence(component, RESOLUTION, AROUND, least=least, most=least, thinned=thinned)
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
    components = random_components(30, 3, seed=4, empty=0.2)
    whole = Box(torch.tensor([-12] * 3), torch.tensor([12] * 3))
    halves = []
    for octant in itertools.product((0, 1), repeat=3):
        low = torch.tensor([(-12, 3)[side] for side in octant])
        high = torch.tensor([(3, 12)[side] for side in octant])
        halves.append(component_evidence(components, RESOLUTION, Box(low, high), **options))
    expected = component_evidence(components, RESOLUTION, whole, **options)
    assert float(expected.hits.sum()) > 10
    torch.testing.assert_close(
        dense(sum_evidence(halves), whole), dense(expected, whole), rtol=1e-5, atol=1e-4
    )


def test_invalid_arguments_are_refused() -> None:
    component, _, _ = sheet(*VIEWS["frontal"])
    for options, message in (
        ({"shell": -0.1}, "shell=-0.1"),
        ({"shell": float("nan")}, "shell=nan"),
        ({"shell": float("inf")}, "shell=inf"),
        ({"hits_per_ray": 0}, "hits_per_ray=0"),
    ):
        with pytest.raises(InvalidArgumentError, match=message):
            component_evidence(component, RESOLUTION, AROUND, **options)
