"""Sums of depth images over cells: the fused kernel against its twin, and the twin against points."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import kernels
from gmmtorch.mapping.learning.fitting import DepthFrame, PooledFrames, pool_frames
from gmmtorch.mixture.em.exact import quadratic_features, shift_features

INTRINSICS = torch.tensor([[64.0, 0, 31.5], [0, 64.0, 23.5], [0, 0, 1]], dtype=torch.float64)
SIDE = 0.125


def pose(turn: float = 0.0, at: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Tensor:
    """The camera turned about an oblique axis, at a position."""
    axis = torch.tensor([[0, -3, 2], [3, 0, -1], [-2, 1, 0]], dtype=torch.float64)
    made = torch.eye(4, dtype=torch.float64)
    made[:3, :3] = torch.linalg.matrix_exp(turn * axis)
    made[:3, 3] = torch.tensor(at, dtype=torch.float64)
    return made


def frame(depth: Tensor, at: Tensor, **options: float) -> DepthFrame:
    return DepthFrame.of(depth, at, INTRINSICS, **options)


def noisy_depth(seed: int, shape: tuple[int, int] = (48, 64), dtype: torch.dtype = torch.float32) -> Tensor:
    """A slanted wall with noise, steps and pixels that are not valid."""
    generator = torch.Generator().manual_seed(seed)
    depth = 1.5 + 0.02 * torch.arange(shape[1]) + 0.01 * torch.randn(*shape, generator=generator)
    depth[:, shape[1] // 2 :] += 0.7
    bad = torch.tensor([0.0, -1.0, math.nan, math.inf, -math.inf, 1e308], dtype=torch.float64)
    where = torch.rand(*shape, generator=generator) < 0.1
    drawn = torch.randint(len(bad), shape, generator=generator)
    return torch.where(where, bad[drawn], depth.double()).to(dtype)


def pooled_by_both(frames: list[DepthFrame], side: float = SIDE, max_cells: int = 5000) -> PooledFrames:
    """The cells of the fused kernel, after a comparison with those of the twin."""
    with kernels("fused"):
        fused = pool_frames(frames, side, max_cells)
    with kernels("torch"):
        twin = pool_frames(frames, side, max_cells)
    assert torch.equal(fused.counts, twin.counts)
    torch.testing.assert_close(fused.features, twin.features, rtol=1e-13, atol=1e-11)
    torch.testing.assert_close(fused.center, twin.center)
    return fused


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("stride", [1, 3])
def test_cells_hold_the_moments_of_all_points(dtype, stride):
    given = [(noisy_depth(seed, dtype=dtype), pose(0.3 * seed, (0.1 * seed, 5.0, -2.0))) for seed in range(3)]
    frames = [frame(*pair, pixel_stride=stride, max_range=1e6) for pair in given]
    found = pooled_by_both(frames)
    clouds = [one.scan().points for one in frames]
    assert found.counts.sum(0).tolist() == [len(cloud) for cloud in clouds]
    features = quadratic_features(torch.cat(clouds) - found.center)
    torch.testing.assert_close((found.features * found.weight[:, None]).sum(0), features.sum(0))
    # A cell is a cube, or a cube and the patches of its size whose means are inside.
    variance = found.features[:, [4, 7, 9]] - found.features[:, 1:4] ** 2
    assert float(variance.max()) < SIDE**2


def test_ranges_are_the_distances_of_the_points():
    one = frame(noisy_depth(1), pose(0.3, (0.1, 5.0, -2.0)), max_range=1e6)
    torch.testing.assert_close(one.ranges, (one.points - one.origin).norm(dim=1))


def test_points_on_sides_of_cells_belong_to_the_cell_above():
    # All values are multiples of powers of two, so that many points and patches lie exactly on sides.
    v, u = torch.meshgrid(torch.arange(48), torch.arange(64), indexing="ij")
    for depth in (torch.full((48, 64), 2.0), 1.0 + 0.125 * ((u + v) % 3), 8.0 + 0.5 * (u // 8)):
        found = pooled_by_both([frame(depth.double(), torch.eye(4).double())])
        assert float(found.counts.sum()) == depth.numel()


@pytest.mark.parametrize("shape", [(1, 1), (1, 70), (5, 3), (33, 31), (7, 129)])
def test_images_of_any_size_are_summed(shape):
    found = pooled_by_both([frame(noisy_depth(1, shape), pose(0.2)), frame(torch.ones(shape), pose())])
    depth = noisy_depth(1, shape)
    assert float(found.counts[:, 0].sum()) == int(((depth > 0) & torch.isfinite(depth)).sum())
    assert float(found.counts[:, 1].sum()) == math.prod(shape)


def test_images_without_valid_pixels_give_no_cells():
    for value in (0.0, -1.0, math.nan, math.inf):
        found = pooled_by_both([frame(torch.full((9, 9), value), pose())])
        assert found.features.shape == (0, 10)


def test_pixels_at_the_largest_range_are_left_out():
    depth = torch.tensor([[1.0, 2.0, 3.0], [2.0, 1.9999, 2.0001]])
    found = pooled_by_both([frame(depth, pose(), max_range=2.0)])
    assert float(found.counts.sum()) == 2


def test_cells_grow_until_they_are_few_enough():
    frames = [frame(noisy_depth(0), pose(), max_range=1e6)]
    many, few = pooled_by_both(frames, 0.01), pooled_by_both(frames, 0.01, max_cells=40)
    assert len(few.weight) <= 40 < len(many.weight)
    sums = [(cells.features * cells.weight[:, None]) for cells in (many, few)]
    moved = shift_features(sums[0].sum(0), many.center - few.center)
    torch.testing.assert_close(sums[1].sum(0), moved)


def test_points_far_apart_have_larger_cells_and_points_beyond_a_map_are_refused():
    depth = torch.ones(8, 8, dtype=torch.float64)
    depth[3, 3] = 2e5
    found = pooled_by_both([frame(depth, pose())])
    assert float(found.counts.sum()) == 64
    for value in (1e9, 1e300):
        depth[3, 3] = value
        with pytest.raises(InvalidArgumentError, match="134217728"):
            pool_frames([frame(depth, pose())], SIDE, 1000)
