"""Cells that a mesh meets: against clipped polygons, points drawn on it, Open3D's distances, and counting."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.voxelize import occupied_cells
from gmmtorch.simulation.furniture import ball, box
from gmmtorch.simulation.mesh_world import MeshWorld


def lattice(low: tuple[int, ...], high: tuple[int, ...]) -> Box:
    return Box(torch.tensor(low), torch.tensor(high))


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
    window = lattice((-2, -1, 0), (4, 5, 5))
    for size in (0.4, 1.5, 6.0):
        triangles = 4 * torch.rand(12, 1, 3, generator=generator, dtype=torch.float64)
        triangles = triangles + size * torch.randn(12, 3, 3, generator=generator, dtype=torch.float64)
        for triangle in triangles:
            found = occupied_cells(triangle[None] * 0.25, 0.25, window)
            for cell in itertools.product(*(range(n) for n in window.shape)):
                low = np.array(cell) + window.low.numpy()
                assert bool(found[cell]) == (clipped(triangle.numpy(), low) > 1e-12), (cell, triangle)


def test_points_on_a_mesh_lie_in_its_cells_and_its_cells_are_near_it(generator):
    mesh = torch.cat([ball((1.03, 0.95, 1.2), 0.87), box((0.31, 0.22, 0.13), (2.24, 1.93, 0.37))])
    window = lattice((0, 0, 0), (24, 24, 24))
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
    floor = box((0, 0, -5.0), (2.0, 1.0, 0.6))[-4:-2]  # its top, as two triangles at z = 3 · 0.2
    assert bool((floor[..., 2] == 0.6).all())
    found = occupied_cells(floor, 0.2, lattice((-3, -3, -3), (15, 9, 9)))
    cells = found.nonzero() - 3
    assert cells[:, 2].unique().tolist() == [3]
    # Its edges at 2 m and 1 m lie in planes too.
    assert cells[:, 0].unique().tolist() == list(range(11))
    assert cells[:, 1].unique().tolist() == list(range(6))
    assert len(cells) == 66


def test_a_hall_of_50_m_marks_one_layer_for_each_surface():
    nx, ny, nz = 250, 200, 40
    found = occupied_cells(box((0.1, 0.1, 0.1), (49.9, 39.9, 7.9)), 0.2, lattice((0, 0, 0), (nx, ny, nz)))
    shell = torch.ones(nx, ny, nz, dtype=torch.bool)
    shell[1:-1, 1:-1, 1:-1] = False
    assert torch.equal(found, shell)


def test_a_diagonal_plane_marks_only_the_cells_that_it_divides():
    corners = torch.tensor([[0.0, 0, 0.5], [4, 4, 0.5], [4, 4, 0.9]], dtype=torch.float64)
    found = occupied_cells(corners[None], 1.0, lattice((0, 0, 0), (4, 4, 1)))
    assert torch.equal(found[:, :, 0], torch.eye(4, dtype=torch.bool))


def test_the_box_does_not_change_the_cells(generator):
    mesh = 5 * torch.rand(30, 3, 3, generator=generator, dtype=torch.float64)
    whole = occupied_cells(mesh, 0.3, lattice((-1, -1, -1), (20, 20, 20)))
    part = occupied_cells(mesh, 0.3, lattice((4, 2, 7), (9, 13, 12)))
    assert torch.equal(part, whole[5:10, 3:14, 8:13])
    assert not bool(occupied_cells(mesh, 0.3, lattice((50, 0, 0), (55, 5, 5))).any())


def test_cells_are_the_same_500_km_away(generator):
    mesh = 3 * torch.rand(20, 3, 3, generator=generator, dtype=torch.float64)
    shift = torch.tensor([2_500_000, -1_000_000, 5])
    here = occupied_cells(mesh, 0.2, lattice((0, 0, 0), (16, 16, 16)))
    there = occupied_cells(mesh + 0.2 * shift, 0.2, Box(shift, shift + 16))
    assert torch.equal(here, there)


@pytest.mark.parametrize("end", [(3.3, 0.4, 0.4), (0.4, 3.3, 0.4), (2.7, 1.9, 3.1)])
def test_a_triangle_without_area_counts_as_its_line(end):
    start, end = torch.tensor([0.4, 0.4, 0.4]).double(), torch.tensor(end).double()
    line = torch.stack([start, end, (start + end) / 2])[None]
    found = occupied_cells(line, 1.0, lattice((0, 0, 0), (4, 4, 4)))
    along = start + torch.linspace(0, 1, 5000, dtype=torch.float64)[:, None] * (end - start)
    expected = torch.zeros(4, 4, 4, dtype=torch.bool)
    expected[along.floor().long().unbind(1)] = True
    assert torch.equal(found, expected)


def test_no_triangles_mark_nothing_and_invalid_ones_are_refused():
    window = lattice((0, 0, 0), (3, 3, 3))
    nothing: Tensor = torch.zeros(0, 3, 3)
    assert not bool(occupied_cells(nothing, 0.2, window).any())
    with pytest.raises(InvalidArgumentError, match=r"shape \(3, 3\)"):
        occupied_cells(torch.zeros(3, 3), 0.2, window)
    with pytest.raises(DataError, match="NaN"):
        occupied_cells(torch.full((1, 3, 3), torch.nan), 0.2, window)
    with pytest.raises(InvalidArgumentError, match="resolution"):
        occupied_cells(nothing, 0.0, window)
