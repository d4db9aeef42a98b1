"""Meshes before they are flown in: what is dropped, what is refused, what does no harm."""

from __future__ import annotations

import logging

import pytest
import torch

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.simulation.worlds.mesh_world import checked_triangles
from gmmtorch.simulation.worlds.solids import box

CUBE = box((0, 0, 0), (1, 1, 1))


def test_triangles_without_area_are_dropped_and_counted(caplog):
    line = torch.tensor([[0.0, 0, 0], [1, 1, 1], [3, 3, 3]], dtype=torch.float64)
    point = torch.full((3, 3), 0.3, dtype=torch.float64)
    with caplog.at_level(logging.WARNING):
        kept = checked_triangles(torch.cat([CUBE[:5], line[None], CUBE[5:], point[None]]), "cube")
    assert torch.equal(kept, CUBE)
    assert "cube: dropped 2 of 14 triangles" in caplog.text


def test_needles_and_small_or_far_triangles_stay(caplog):
    needle = torch.tensor([[0.0, 0, 0], [10, 0, 0], [10, 1e-4, 0]], dtype=torch.float64)[None]
    triangles = torch.cat([needle, 1e-6 * CUBE, CUBE + 5e5])
    assert torch.equal(checked_triangles(triangles), triangles)
    assert caplog.text == ""


def test_holes_and_inverted_triangles_stay():
    holed = CUBE[:-3].clone()
    holed[::2] = holed[::2].flip(1)
    assert torch.equal(checked_triangles(holed), holed)


def test_single_precision_becomes_double():
    assert checked_triangles(CUBE.float()).dtype == torch.float64


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_corners_that_are_not_finite_are_refused(bad):
    triangles = CUBE.clone()
    triangles[7, 1, 2] = bad
    with pytest.raises(DataError, match=r"mine: 1 of 12 .*first is number 7"):
        checked_triangles(triangles, "mine")


def test_meshes_without_surface_are_refused():
    with pytest.raises(DataError, match="no triangles"):
        checked_triangles(torch.zeros(0, 3, 3))
    with pytest.raises(DataError, match="all 4 triangles have no area"):
        checked_triangles(torch.ones(4, 3, 3))
    with pytest.raises(InvalidArgumentError, match=r"\(12, 9\)"):
        checked_triangles(CUBE.view(12, 9))
