"""Beams of a camera and the cells they meet, against ray casting and solid angles in closed form."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels.rays.ray_traversal import traverse
from gmmtorch.team.exploration.information.beam_templates import beam_templates, cells_along, pinhole_beams

FOV = (1.5184, 1.0123)


@given(st.integers(0, 2**32), st.floats(0.2, 12.0))
def test_template_cells_equal_ray_traversal_in_order(seed, reach):
    generator = torch.Generator().manual_seed(seed)
    directions = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    directions /= directions.norm(dim=1, keepdim=True)
    cells, bounds, lengths = cells_along(directions, reach)
    half = 14
    starts = torch.full((20, 3), half + 0.5, dtype=torch.float64)
    ends = starts + reach * directions
    shape = (2 * half + 1,) * 3
    found = [set() for _ in range(20)]
    for visits in traverse(starts, ends, shape):
        for voxel, ray in zip(visits.voxel.tolist(), visits.ray.tolist(), strict=True):
            found[ray].add(voxel)
    strides = torch.tensor([shape[1] * shape[2], shape[2], 1])
    for ray, length in enumerate(lengths.tolist()):
        mine = ((cells[ray, :length] + half) * strides).sum(1).tolist()
        last = int(((ends[ray].floor().long()) * strides).sum())
        assert len(set(mine)) == length
        assert set(mine) == found[ray] | {last}
        assert mine[-1] == last
        middle = (bounds[ray, 1 : length + 1] + bounds[ray, :length])[:, None] / 2 * directions[ray]
        assert torch.equal((middle + 0.5).floor().long(), cells[ray, :length])
        assert float(bounds[ray, 0]) == 0
        assert float(bounds[ray, length]) == reach
        assert bool((bounds[ray].diff() >= 0).all())
        assert not bool(cells[ray, length:].any())


def test_template_cells_of_axis_parallel_and_diagonal_rays():
    directions = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0.6, 0.8, 0]], dtype=torch.float64)
    cells, bounds, lengths = cells_along(directions, 3.2)
    assert lengths.tolist()[:2] == [4, 4]
    assert cells[0, :4].tolist() == [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]
    assert cells[1, :4].tolist() == [[0, 0, 0], [0, -1, 0], [0, -2, 0], [0, -3, 0]]
    assert bounds[0, :5].tolist() == pytest.approx([0, 0.5, 1.5, 2.5, 3.2])


@pytest.mark.parametrize("n_beams", [1, 7, 160, 1000])
def test_solid_angles_tile_the_image(n_beams):
    directions, solid_angles = pinhole_beams(*FOV, n_beams)
    assert 0.75 * n_beams <= len(directions) <= 1.25 * n_beams
    u, v = math.tan(FOV[0] / 2), math.tan(FOV[1] / 2)
    whole = 4 * math.asin(u * v / math.sqrt((1 + u * u) * (1 + v * v)))  # of a rectangular pyramid
    assert float(solid_angles.sum()) == pytest.approx(whole, rel=1e-12)
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(len(directions)).double())
    assert bool((directions[:, 1].abs() <= u * directions[:, 0]).all())
    assert bool((directions[:, 2].abs() <= v * directions[:, 0]).all())
    assert float(directions[:, 1:].sum(0).abs().max()) < 1e-9  # as many to either side
    assert float(solid_angles.max() / solid_angles.min()) < 1.7


def test_templates_are_rotations_of_one_camera():
    templates = beam_templates(*FOV, max_range=2.0, resolution=0.2, n_beams=40, n_yaws=8)
    solid_angle = float(pinhole_beams(*FOV, 40)[1].sum())
    volume = solid_angle * 2.0**3 / 3 / 0.2**3
    torch.testing.assert_close(templates.volumes.sum((1, 2)), torch.full((8,), volume, dtype=torch.float64))
    # A quarter turn is exact on the lattice: (x, y) → (−y, x). Depths only to rounding.
    quarter = templates.offsets[0] @ torch.tensor([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    assert torch.equal(templates.offsets[2], quarter)
    torch.testing.assert_close(templates.depths[2], templates.depths[0])
    for yaw, beam in ((0, 0), (3, 17), (7, 39)):
        length = int(templates.lengths[yaw, beam])
        offsets = templates.offsets[yaw, beam]
        for axis in range(3):
            for k in range(templates.leading.shape[-1]):
                inside = [abs(int(o)) <= k for o in offsets[:length, axis]] + [False]
                assert int(templates.leading[yaw, beam, axis, k]) == inside.index(False)


def test_beam_templates_reject_cameras_without_view():
    for fov in (0.0, -1.0, math.pi, math.nan):
        with pytest.raises(InvalidArgumentError, match="horizontal_fov"):
            pinhole_beams(fov, 1.0, 10)
        with pytest.raises(InvalidArgumentError, match="vertical_fov"):
            pinhole_beams(1.0, fov, 10)
    with pytest.raises(InvalidArgumentError, match="n_beams"):
        pinhole_beams(1.0, 1.0, 0)
    for far in (0.0, math.inf, math.nan):
        with pytest.raises(InvalidArgumentError, match="max_range"):
            beam_templates(*FOV, far, 0.2, 10, 4)
    with pytest.raises(InvalidArgumentError, match="coarser"):
        beam_templates(*FOV, 6.0, 1e-4, 160, 16)
