"""Evidence of rays in a box of the lattice, against a walk in exact arithmetic."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from occupancy.exact_dda import voxels_left
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, MemoryLimitError
from gmmtorch.occupancy.voxels.cells import Box, CellEvidence, occupied_cells, sum_evidence, to_lattice
from gmmtorch.occupancy.voxels.ray_casting import cast_evidence, near_interval
from gmmtorch.simulation.furniture import ball
from gmmtorch.simulation.furniture import box as box_mesh
from gmmtorch.simulation.mesh_world import MeshWorld

Counts = dict[tuple[int, ...], tuple[float, float]]


def box(low: Sequence[int], high: Sequence[int]) -> Box:
    return Box(torch.tensor(low), torch.tensor(high))


def counts(evidence: CellEvidence) -> Counts:
    cells = [tuple(cell) for cell in evidence.cells.tolist()]
    assert len(set(cells)) == len(cells)
    return dict(zip(cells, zip(evidence.hits.tolist(), evidence.misses.tolist(), strict=True), strict=True))


def by_a_walk(starts, stops, is_hit, within: Box, weights=None) -> Counts:
    """Counts of rays in grid units, one ray and one cell at a time."""
    found: Counts = {}
    low, high = within.low.tolist(), within.high.tolist()
    weights = torch.ones(len(stops)) if weights is None else weights
    for start, stop, hit, weight in zip(starts, stops, is_hit.tolist(), weights.tolist(), strict=True):
        ended = [tuple(stop.floor().long().tolist())] if hit else []
        for index, cells in ((1, voxels_left(start.tolist(), stop.tolist())), (0, ended)):
            for cell in cells:
                if all(a <= x < b for a, x, b in zip(low, cell, high, strict=True)):
                    both = list(found.get(cell, (0.0, 0.0)))
                    both[index] += weight
                    found[cell] = (both[0], both[1])
    return found


def random_rays(n: int, seed: int, spread: float = 6.0):
    generator = torch.Generator().manual_seed(seed)
    rays = spread * torch.randn(2, n, 3, generator=generator, dtype=torch.float64)
    return rays[0], rays[1], torch.rand(n, generator=generator) < 0.7


SMALL, LARGE = box([-3, -2, 0], [4, 5, 3]), box([-60, -60, -60], [60, 60, 60])


@pytest.mark.parametrize("within", [SMALL, LARGE])
@pytest.mark.parametrize("seed", range(2))
def test_counts_equal_an_exact_walk(within, seed):
    starts, stops, is_hit = random_rays(30, seed)
    for resolution in (0.25, 1.0, 8.0):
        evidence = cast_evidence(starts * resolution, stops * resolution, is_hit, resolution, within)
        assert counts(evidence) == by_a_walk(starts, stops, is_hit, within)
        assert evidence.hits.dtype == evidence.misses.dtype == torch.float32


@settings(deadline=None, max_examples=60)
@given(
    rays=st.lists(st.tuples(*[st.integers(-12, 12)] * 6), min_size=1, max_size=8),
    corner=st.tuples(*[st.integers(-4, 4)] * 3),
    shift=st.sampled_from([0, 1 << 21]),
)
def test_rays_on_planes_edges_and_corners(rays, corner, shift):
    # Halves: many start, end or run on planes, and many cross two or three at once.
    ends = torch.tensor(rays, dtype=torch.float64).view(-1, 2, 3) / 2 + shift
    low = torch.tensor(corner) + shift
    within, is_hit = Box(low, low + 3), torch.arange(len(ends)) % 3 > 0
    evidence = cast_evidence(ends[:, 0], ends[:, 1], is_hit, 1.0, within)
    assert counts(evidence) == by_a_walk(ends[:, 0], ends[:, 1], is_hit, within)


def test_rounding_does_not_move_a_point_to_another_cell():
    # -1e-20 lies in cell -1, although -1e-20 + 5 is 5.
    start = torch.tensor([[-1e-20, 0.5, 0.5], [2.5, 0.5, 0.5]], dtype=torch.float64)
    stop = torch.tensor([[1.5, 0.5, 0.5], [-1e-20, 0.5, 0.5]], dtype=torch.float64)
    is_hit = torch.tensor([True, True])
    for within in (LARGE, box([-5, 0, 0], [2, 1, 1])):
        assert counts(cast_evidence(start, stop, is_hit, 1.0, within)) == by_a_walk(
            start, stop, is_hit, within
        )


def test_one_origin_is_used_for_all_rays():
    _, stops, is_hit = random_rays(20, 4)
    origin = torch.tensor([0.3, -0.2, 1.1], dtype=torch.float64)
    found = cast_evidence(origin, stops, is_hit, 1.0, SMALL)
    assert counts(found) == by_a_walk(origin.expand(20, 3), stops, is_hit, SMALL)


def test_far_ends_are_trimmed_and_far_worlds_are_exact():
    start = torch.tensor([[0.5, 0.5, 0.5]], dtype=torch.float64)
    far = torch.tensor([[4e9, 0.5, 0.5]], dtype=torch.float64)
    row = cast_evidence(start, far, torch.tensor([True]), 1.0, box([0, 0, 0], [50, 1, 1]))
    assert row.misses.tolist() == [1.0] * 50
    assert row.hits.sum() == 0
    starts, stops, is_hit = random_rays(20, 5)
    shift = 5e5 * torch.ones(3, dtype=torch.float64)  # 500 km; 4e6 cells of 1/8 m
    starts, stops = starts + 8 * shift, stops + 8 * shift
    low = (8 * shift).long() - 4
    within = Box(low, low + 8)
    assert counts(cast_evidence(starts / 8, stops / 8, is_hit, 0.125, within)) == by_a_walk(
        starts, stops, is_hit, within
    )


def test_no_rays_and_empty_boxes_give_no_evidence():
    starts, stops, is_hit = random_rays(5, 0)
    for within in (box([100, 0, 0], [110, 9, 9]), box([0, 0, 0], [0, 5, 5]), box([2, 2, 2], [1, 1, 1])):
        assert len(cast_evidence(starts, stops, is_hit, 1.0, within).cells) == 0
    none = torch.zeros(0, 3, dtype=torch.float64)
    found = cast_evidence(none, none, is_hit[:0], 1.0, SMALL)
    assert found.cells.shape == (0, 3)
    assert found.hits.shape == found.misses.shape == (0,)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e30])
@pytest.mark.parametrize("which", ["origins", "ends"])
def test_rays_that_are_not_finite_are_refused(value, which):
    rays = {"origins": torch.zeros(2, 3, dtype=torch.float64), "ends": torch.ones(2, 3, dtype=torch.float64)}
    rays[which][1, 2] = value
    with pytest.raises(InvalidArgumentError, match=f"{which} must be finite"):
        cast_evidence(rays["origins"], rays["ends"], torch.tensor([True, True]), 0.2, SMALL)


def test_too_many_cells_are_refused():
    starts, stops = torch.zeros(1, 3, dtype=torch.float64), torch.full((1, 3), 10.0, dtype=torch.float64)
    with pytest.raises(MemoryLimitError, match=r"resolution=0\.001 m"):
        cast_evidence(starts, stops, torch.tensor([True]), 0.001, box([0] * 3, [10_000] * 3))
    with pytest.raises(InvalidArgumentError, match="resolution=0"):
        to_lattice(starts, 0.0)


def test_from_dense_keeps_all_cells_with_evidence(generator):
    hits, misses = (torch.rand(2, 4, 5, 3, generator=generator) - 0.6).clamp_min(0)
    evidence = CellEvidence.from_dense(torch.tensor([-7, 2, 9]), hits, misses)
    expected = {
        (x - 7, y + 2, z + 9): (float(hits[x, y, z]), float(misses[x, y, z]))
        for x in range(4)
        for y in range(5)
        for z in range(3)
        if hits[x, y, z] + misses[x, y, z] > 0
    }
    assert counts(evidence) == expected


def test_sum_evidence_adds_cell_by_cell():
    parts = [
        cast_evidence(*random_rays(50, seed)[:2], torch.ones(50, dtype=torch.bool), 1.0, SMALL)
        for seed in range(3)
    ]
    expected: dict[tuple[int, ...], list[float]] = {}
    for part in parts:
        for cell, (h, m) in counts(part).items():
            both = expected.setdefault(cell, [0.0, 0.0])
            both[0], both[1] = both[0] + h, both[1] + m
    assert counts(sum_evidence(parts)) == {cell: tuple(both) for cell, both in expected.items()}
    assert counts(sum_evidence(reversed(parts))) == counts(sum_evidence(parts))
    assert len(sum_evidence([]).cells) == 0
    assert len(sum_evidence([CellEvidence.empty(), CellEvidence.empty()]).cells) == 0
    one = torch.ones(1)
    ends = [CellEvidence(torch.full((1, 3), x), one, one) for x in (-(2**31), 2**31)]
    with pytest.raises(InvalidArgumentError, match="cannot be summed"):
        sum_evidence(ends)


@pytest.mark.parametrize("seed", range(2))
def test_near_interval_contains_all_hulls_that_meet_the_box(seed):
    generator = torch.Generator().manual_seed(seed)
    apex = 8 * torch.randn(300, 3, generator=generator, dtype=torch.float64)
    middle = 8 * torch.randn(300, 3, generator=generator, dtype=torch.float64)
    half = 2 * torch.rand(300, 3, generator=generator, dtype=torch.float64)
    within = box([0, -2, 1], [3, 1, 5])
    first, last = near_interval(apex, middle - half, middle + half, within)
    draws = 4000
    place = middle + half * (2 * torch.rand(draws, 300, 3, generator=generator, dtype=torch.float64) - 1)
    point = apex + torch.rand(draws, 300, 1, generator=generator, dtype=torch.float64) * (place - apex)
    met = ((point >= within.low) & (point <= within.high)).all(2).any(0)
    assert bool((first <= last)[met].all())
    assert 0 < int(met.sum()) <= int((first <= last).sum()) < 300
    # Near hulls come within half a cell, so that samples meet a box that is larger by 1.5 cells.
    wide = ((point >= within.low - 1.5) & (point <= within.high + 1.5)).all(2).any(0)
    assert float((first <= last)[~wide].double().mean()) < 0.05


# -- hit_places -------------------------------------------------------------------------------------


@pytest.mark.parametrize("within", [SMALL, LARGE, box([5, -4, -3], [9, 6, 4])])
@pytest.mark.parametrize("seed", range(2))
def test_hits_are_counted_at_hit_places(within, seed):
    starts, stops, is_hit = random_rays(25, seed)
    generator = torch.Generator().manual_seed(seed + 100)
    struck = 9 * torch.randn(120, 3, generator=generator, dtype=torch.float64)  # also beyond all rays
    weight = 0.1 + torch.rand(120, generator=generator, dtype=torch.float64)
    weights = 0.1 + torch.rand(25, generator=generator, dtype=torch.float64)
    found = cast_evidence(starts, stops, is_hit, 1.0, within, weights, (struck, weight))
    missed = by_a_walk(starts, stops, torch.zeros(len(starts), dtype=torch.bool), within, weights)
    hits = by_a_walk(struck, struck, torch.ones(len(struck), dtype=torch.bool), within, weight)
    expected = {
        cell: (hits.get(cell, (0.0, 0.0))[0], missed.get(cell, (0.0, 0.0))[1])
        for cell in missed.keys() | hits.keys()
    }
    assert counts(found).keys() == expected.keys()
    for cell, both in expected.items():
        assert counts(found)[cell] == pytest.approx(both, rel=1e-6)


def test_hit_places_replace_the_ends_and_must_be_finite():
    start, stop, struck = torch.full((1, 3), 0.5), torch.full((1, 3), 3.5), torch.tensor([True])
    nothing = (torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))
    found = counts(cast_evidence(start, stop, struck, 1.0, LARGE, hit_places=nothing))
    assert (0, 0, 0) in found
    assert (3, 3, 3) not in found
    with pytest.raises(InvalidArgumentError, match="hit_places"):
        cast_evidence(start, stop, struck, 1.0, LARGE, hit_places=(stop * float("nan"), torch.ones(1)))


# -- cells that a mesh meets ---------------------------------------------------------------------------


def clipped(triangle: np.ndarray, low: np.ndarray) -> float:
    """Area of a triangle (3, 3) within the unit cube at `low`, by clipping it at six planes."""
    polygon = list(triangle)
    for axis, (sign, at) in itertools.product(range(3), ((1, 0), (-1, 1))):
        kept = []
        for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True):
            a, b = sign * (p[axis] - low[axis] - at), sign * (q[axis] - low[axis] - at)
            if a >= 0:
                kept.append(p)
            if a * b < 0:
                kept.append(p + a / (a - b) * (q - p))
        polygon = kept
        if not polygon:
            return 0.0
    return sum(
        np.linalg.norm(np.cross(q - polygon[0], r - polygon[0])) / 2
        for q, r in itertools.pairwise(polygon[1:])
    )


def test_a_cell_is_occupied_if_and_only_if_a_triangle_meets_it(generator):
    window = box((-2, -1, 0), (4, 5, 5))
    for size in (0.4, 1.5, 6.0):
        triangles = 4 * torch.rand(12, 1, 3, generator=generator, dtype=torch.float64)
        triangles = triangles + size * torch.randn(12, 3, 3, generator=generator, dtype=torch.float64)
        for triangle in triangles:
            found = occupied_cells(triangle[None] * 0.25, 0.25, window)
            for cell in itertools.product(*(range(n) for n in window.shape)):
                low = np.array(cell) + window.low.numpy()
                assert bool(found[cell]) == (clipped(triangle.numpy(), low) > 1e-12), (cell, triangle)


def test_points_on_a_mesh_lie_in_its_cells_and_its_cells_are_near_it(generator):
    mesh = torch.cat([ball((1.03, 0.95, 1.2), 0.87), box_mesh((0.31, 0.22, 0.13), (2.24, 1.93, 0.37))])
    window = box((0, 0, 0), (24, 24, 24))
    found = occupied_cells(mesh, 0.1, window)
    share = torch.rand(400, len(mesh), 3, generator=generator, dtype=torch.float64) + 1e-9
    points = torch.einsum("ntc,tcd->ntd", share / share.sum(2, keepdim=True), mesh).flatten(0, 1)
    cells = (points / 0.1).floor().long()
    assert bool(found[cells.unbind(1)].all())
    centers = (torch.cartesian_prod(*[torch.arange(24)] * 3) + 0.5).double() * 0.1
    room = MeshWorld(mesh).clearance(centers).view(24, 24, 24)
    assert bool(found[room < 0.05 - 1e-5].all())
    assert float(room[found].max()) <= 0.05 * 3**0.5 + 1e-5
    assert bool((room[~found] >= 0.05 - 1e-5).all())


def test_a_floor_in_a_lattice_plane_counts_only_for_the_cells_above():
    floor = box_mesh((0, 0, -5.0), (2.0, 1.0, 0.6))[-4:-2]  # its top, as two triangles at z = 3 · 0.2
    assert bool((floor[..., 2] == 0.6).all())
    found = occupied_cells(floor, 0.2, box((-3, -3, -3), (15, 9, 9)))
    cells = found.nonzero() - 3
    assert cells[:, 2].unique().tolist() == [3]
    # Its edges at 2 m and 1 m lie in planes too.
    assert cells[:, 0].unique().tolist() == list(range(11))
    assert cells[:, 1].unique().tolist() == list(range(6))
    assert len(cells) == 66


def test_a_hall_of_50_m_marks_one_layer_for_each_surface():
    nx, ny, nz = 250, 200, 40
    found = occupied_cells(box_mesh((0.1, 0.1, 0.1), (49.9, 39.9, 7.9)), 0.2, box((0, 0, 0), (nx, ny, nz)))
    shell = torch.ones(nx, ny, nz, dtype=torch.bool)
    shell[1:-1, 1:-1, 1:-1] = False
    assert torch.equal(found, shell)


def test_a_diagonal_plane_marks_only_the_cells_that_it_divides():
    corners = torch.tensor([[0.0, 0, 0.5], [4, 4, 0.5], [4, 4, 0.9]], dtype=torch.float64)
    found = occupied_cells(corners[None], 1.0, box((0, 0, 0), (4, 4, 1)))
    assert torch.equal(found[:, :, 0], torch.eye(4, dtype=torch.bool))


def test_cells_are_the_same_500_km_away(generator):
    mesh = 3 * torch.rand(20, 3, 3, generator=generator, dtype=torch.float64)
    shift = torch.tensor([2_500_000, -1_000_000, 5])
    here = occupied_cells(mesh, 0.2, box((0, 0, 0), (16, 16, 16)))
    there = occupied_cells(mesh + 0.2 * shift, 0.2, Box(shift, shift + 16))
    assert torch.equal(here, there)


@pytest.mark.parametrize("end", [(3.3, 0.4, 0.4), (0.4, 3.3, 0.4), (2.7, 1.9, 3.1)])
def test_a_triangle_without_area_counts_as_its_line(end):
    start, end = torch.tensor([0.4, 0.4, 0.4]).double(), torch.tensor(end).double()
    line = torch.stack([start, end, (start + end) / 2])[None]
    found = occupied_cells(line, 1.0, box((0, 0, 0), (4, 4, 4)))
    along = start + torch.linspace(0, 1, 5000, dtype=torch.float64)[:, None] * (end - start)
    expected = torch.zeros(4, 4, 4, dtype=torch.bool)
    expected[along.floor().long().unbind(1)] = True
    assert torch.equal(found, expected)


def test_no_triangles_mark_nothing_and_invalid_ones_are_refused():
    window = box((0, 0, 0), (3, 3, 3))
    nothing: Tensor = torch.zeros(0, 3, 3)
    assert not bool(occupied_cells(nothing, 0.2, window).any())
    with pytest.raises(InvalidArgumentError, match=r"shape \(3, 3\)"):
        occupied_cells(torch.zeros(3, 3), 0.2, window)
    with pytest.raises(DataError, match="NaN"):
        occupied_cells(torch.full((1, 3, 3), torch.nan), 0.2, window)
    with pytest.raises(InvalidArgumentError, match="resolution"):
        occupied_cells(nothing, 0.0, window)
