"""Culling keeps all cells and boxes that a cone meets, and drops most others."""

from __future__ import annotations

import itertools

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from occupancy.cone_cases import draw_ends, normal, one_each, only, random_covariances, uniform

from gmmtorch.occupancy import cones as culling
from gmmtorch.occupancy.cones import (
    CUTOFF,
    Cones,
    WhitenedCones,
    ball_rows,
    candidate_pairs,
    cone_bounds,
    cross,
    face_rows,
    outside_ball,
    outside_cone,
)
from gmmtorch.occupancy.grid import VoxelGrid
from gmmtorch.occupancy.voxels.cells import cells_in_chunks

GRIDS = {2: VoxelGrid((-2.0, -1.8), 0.2, (20, 18)), 3: VoxelGrid((-2.0, -1.8, -2.1), 0.4, (10, 9, 11))}


def some_cones(dim: int, n: int, seed: int, inside: bool = False) -> Cones:
    generator = torch.Generator().manual_seed(seed)
    deviations = 10 ** uniform(generator, n, dim, low=-2, high=-0.3)
    means = normal(generator, n, dim)
    origins = means + 0.3 * deviations if inside else 2 * normal(generator, n, dim)
    return one_each(means, random_covariances(generator, deviations), origins)


def ends_within(cones: Cones, n: int) -> torch.Tensor:
    """Ends of rays within the cutoff."""
    ends = draw_ends(cones, n)
    white = WhitenedCones.of(cones)
    return ends[(white.apply((ends - cones.means).T).norm(dim=0) < CUTOFF)]


@given(dim=st.sampled_from([2, 3]), seed=st.integers(0, 10**6), inside=st.booleans(), size=st.floats(0.01, 3))
def test_a_box_that_a_ray_meets_is_a_candidate(dim, seed, inside, size):
    cones = some_cones(dim, 1, seed, inside)
    generator = torch.Generator().manual_seed(seed)
    ends = ends_within(cones, 64)
    share = uniform(generator, len(ends), 1)
    low = cones.origins + share * (ends - cones.origins) - size * uniform(generator, len(ends), dim)
    met = [box for box, _ in candidate_pairs(cones, low, low + size)]
    assert torch.cat(met).tolist() == list(range(len(ends)))


def test_most_boxes_without_rays_are_no_candidates(monkeypatch):
    monkeypatch.setattr(culling, "_PAIRS_AT_ONCE", 5000)
    cones = some_cones(3, 30, 0)
    low = GRIDS[3].centers() - 0.2
    pairs = [torch.stack(pair, 1) for pair in candidate_pairs(cones, low, low + 0.4)]
    kept = torch.cat(pairs)
    assert len(torch.unique(kept, dim=0)) == len(kept)  # no pair twice
    assert 0 < len(kept) < 0.25 * len(low) * 30


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("seed", range(6))
def test_a_face_that_a_ray_crosses_is_visited(dim, seed):
    grid, cones = GRIDS[dim], some_cones(dim, 4, seed, inside=seed % 3 == 0)
    for axis, rows in enumerate(face_rows(cones, grid)):
        visited = set()
        for row, cells in cells_in_chunks(rows.first, rows.number, 1000):
            key = [rows.cone[row], rows.forward[row].long(), rows.plane[row], *cells]
            visited |= set(zip(*(k.tolist() for k in key), strict=True))
        crossed = set()
        for index in range(4):
            cone = only(cones, index)
            start, stop = grid.to_units(cone.origins)[0], grid.to_units(ends_within(cone, 300))
            for forward, plane in itertools.product((0, 1), range(grid.shape[axis] + 1)):
                sign = 1 if forward else -1
                through = (sign * (plane - start[axis]) > 0) & (sign * (stop[:, axis] - plane) > 0)
                if plane == (0 if forward else grid.shape[axis]):
                    continue  # no cell of the grid lies before this plane
                share = (plane - start[axis]) / (stop[through, axis] - start[axis])
                place = (start + share[:, None] * (stop[through] - start)).floor().long()
                others = [b for b in range(dim) if b != axis]
                for cell in place[:, others].tolist():
                    if all(0 <= i < grid.shape[b] for i, b in zip(cell, others, strict=True)):
                        crossed.add((index, forward, plane, *cell))
        assert crossed
        assert crossed <= visited
        total = 4 * grid.n_cells // grid.shape[axis] * grid.shape[axis]
        if seed % 3:
            assert len(visited) < 0.5 * total


def test_ball_rows_contain_all_ends():
    grid, cones = GRIDS[3], some_cones(3, 4, 2)
    cones = cones._replace(max_range=torch.tensor([False, True, False, False]))
    rows = ball_rows(cones, grid)
    assert rows.cone.tolist() == [0, 2, 3]
    held = {index: set() for index in rows.cone.tolist()}
    for row, cells in cells_in_chunks(rows.first, rows.number, 77):
        for index, *cell in zip(rows.cone[row].tolist(), *(c.tolist() for c in cells), strict=True):
            held[index].add(tuple(cell))
    for index, cells in held.items():
        place = grid.to_units(ends_within(only(cones, index), 300)).floor().long()
        inside = ((place >= 0) & (place < torch.tensor(grid.shape))).all(1)
        assert {tuple(c) for c in place[inside].tolist()} <= cells


@pytest.mark.parametrize("size", [1, 7, 10**6])
def test_chunks_contain_each_cell_once(size):
    first = torch.tensor([[3, 0], [5, 5], [0, 2]])
    count = torch.tensor([[2, 3], [0, 4], [1, 2]])
    chunks = list(cells_in_chunks(first, count, size))
    assert max(len(row) for row, _ in chunks) <= size
    listed = [(int(r), *c.tolist()) for row, cells in chunks for r, c in zip(row, cells.T, strict=True)]
    assert listed == [(0, 3, 0), (0, 3, 1), (0, 3, 2), (0, 4, 0), (0, 4, 1), (0, 4, 2), (2, 0, 2), (2, 0, 3)]


def test_cone_bounds_is_the_box_around_ellipsoid_and_sensor_origin():
    cones = some_cones(3, 5, 1)
    low, high = cone_bounds(cones, 2.0)
    for i in range(5):
        surface = torch.nn.functional.normalize(
            draw_ends(
                one_each(
                    *(torch.zeros(1, 3).double(), torch.eye(3).double()[None], torch.zeros(1, 3).double())
                ),
                20000,
            )
        )
        points = cones.means[i] + 2 * surface @ torch.linalg.cholesky(cones.covariances[i]).T
        points = torch.cat([points, cones.origins[i : i + 1]])
        torch.testing.assert_close(points.amin(0), low[i], atol=0.02, rtol=0)
        torch.testing.assert_close(points.amax(0), high[i], atol=0.02, rtol=0)


@given(dim=st.sampled_from([2, 3]), seed=st.integers(0, 10**6))
def test_outside_tests_never_exclude_a_cell_that_is_reached(dim, seed):
    """The bounds against a dense sample of each whitened cell."""
    generator = torch.Generator().manual_seed(seed)
    ray, mean = 3 * normal(generator, dim, 20), 6 * normal(generator, dim, 1)
    edges = normal(generator, dim, dim, 20) * 2
    offset = ray - mean
    f = torch.cartesian_prod(*[torch.linspace(-0.5, 0.5, 9).double()] * dim)
    shift = torch.einsum("ne,edp->ndp", f, edges)
    w, d = ray + shift, offset + shift
    across = cross(d, w).norm(dim=1) / w.norm(dim=1)
    along = (d * w).sum(1) / w.norm(dim=1)
    out = outside_cone(ray, offset, edges, CUTOFF)
    met = (across < CUTOFF) & (along < CUTOFF)
    assert not bool((met & out).any())
    assert not bool(((d.norm(dim=1) < CUTOFF) & outside_ball(offset, edges, CUTOFF)).any())
