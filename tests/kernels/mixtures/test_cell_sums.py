"""Sums over cells, their numbers, and flat pieces: fused kernels against twins, and twins against points."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kernels.twins import by_both
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import CutRule, DepthViews, depth_cells, distinct_keys, kernels, piece_cuts
from gmmtorch.kernels.compiler import Team
from gmmtorch.linalg import dense_ranks, order_along_curve
from gmmtorch.mapping.attributes.moments import _cell_sums
from gmmtorch.mapping.learning.fitting import DepthFrame, PooledFrames, mean_range, pool_frames
from gmmtorch.mixture.em.exact import quadratic_features, shift_features
from gmmtorch.mixture.em.partition import Cells, FlatnessRule, Partition, partition, pool_into_cells

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
    twin, fused = by_both(lambda: pool_frames(frames, side, max_cells))
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


@given(
    seeds=st.lists(st.integers(0, 1000), min_size=1, max_size=5),
    types=st.lists(st.sampled_from([torch.float32, torch.float64]), min_size=5, max_size=5),
    stride=st.integers(1, 3),
)
def test_frames_together_give_the_sums_of_each_frame_alone(seeds, types, stride):
    frames = [
        frame(
            noisy_depth(seed, (7 + seed % 40, 5 + seed % 50), dtype),
            pose(0.01 * seed, (0.01 * seed, 0.0, 0.0)),
            pixel_stride=stride,
            max_range=1.0 + 0.01 * seed,
        )
        for seed, dtype in zip(seeds, types, strict=False)
    ]
    draw = np.random.default_rng(seeds[0])
    rays, pitch = draw.standard_normal((len(frames), 4, 3)), 0.01 + draw.random(len(frames))
    max_range = 1 + draw.random(len(frames))
    views = DepthViews([one.depth for one in frames], rays, pitch, max_range)
    with kernels("fused"):
        together = depth_cells(views, SIDE, 5000)
        alone = [
            depth_cells(DepthViews(*(v[i : i + 1] for v in views)), SIDE, 5000) for i in range(len(frames))
        ]
    assert together is not None
    corners, place = torch.unique(torch.cat([one.corners for one in alone]), dim=0, return_inverse=True)
    assert torch.equal(corners, together.corners)
    sums = torch.zeros_like(together.sums).index_add_(0, place, torch.cat([one.sums for one in alone]))
    torch.testing.assert_close(sums, together.sums, rtol=1e-12, atol=1e-9)
    for column, part in enumerate(torch.split(place, [len(one.sums) for one in alone])):
        assert torch.equal(together.counts[part, column], alone[column].counts[:, 0])


def test_ranges_are_the_distances_of_the_points():
    one = frame(noisy_depth(1), pose(0.3, (0.1, 5.0, -2.0)), max_range=1e6)
    torch.testing.assert_close(one.ranges, (one.points - one.origin).norm(dim=1))


@given(st.lists(st.tuples(st.integers(0, 1000), st.booleans()), min_size=1, max_size=4), st.integers(1, 3))
def test_the_mean_range_of_frames_is_that_of_their_pixels(images, stride):
    frames = [
        frame(
            noisy_depth(seed, (9 + seed % 30, 5 + seed % 60), torch.float64 if wide else torch.float32),
            pose(),
            pixel_stride=stride,
            max_range=math.inf if seed % 3 else 2.0,
        )
        for seed, wide in images
    ]
    frames.append(frame(torch.full((3, 3), 2.0), pose()))
    for one in frames:
        one.depth[one.depth > 1e300] = math.nan  # their sum is infinite
    twin, fused = by_both(lambda: mean_range(frames))
    assert fused == pytest.approx(twin, rel=1e-13)


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


@given(
    n=st.integers(2, 600),
    dim=st.sampled_from([1, 2, 3]),
    seed=st.integers(0, 10_000),
    finest=st.sampled_from([0.0, 1e-3, 0.3, 100.0]),
    share=st.sampled_from([0.01, 0.3, 0.9]),
    is_weighted=st.booleans(),
)
def test_cells_of_points_are_those_of_the_twin(n, dim, seed, finest, share, is_weighted):
    draw = torch.Generator().manual_seed(seed)
    points = torch.randn(n, dim, generator=draw).double() * 10.0 ** (seed % 7 - 3)
    points[torch.randint(n, (n // 2,), generator=draw)] = points[0].clone()
    weight = torch.randint(1, 9, (n,), generator=draw).double() if is_weighted else None
    twin, fused = by_both(lambda: pool_into_cells(points, max(1, int(share * n)), finest, weight))
    assert torch.equal(fused.member, twin.member)
    torch.testing.assert_close(fused.weight, twin.weight)
    torch.testing.assert_close(
        fused.features, twin.features, rtol=1e-12, atol=1e-13 * float(points.abs().max())
    )


@pytest.mark.cpu_only
@pytest.mark.parametrize("kind", ["few", "many", "equal", "extreme", "strided"])
def test_hashed_ranks_equal_the_sorted_ones(kind, generator):
    keys = torch.randint(0, 300 if kind == "few" else 1 << 40, (20_000,), generator=generator)
    if kind == "equal":
        keys = torch.full_like(keys, 7)
    if kind == "extreme":
        keys[::3], keys[1::3], keys[2::7] = -(2**63), 2**63 - 1, -1
    if kind == "strided":
        keys = (torch.arange(20_000) % 5000) << 40  # equal low bits
    found = by_both(lambda: dense_ranks(keys))
    assert torch.equal(found[0][0], found[1][0])
    assert found[0][1] == found[1][1] == keys.unique().numel()


@given(
    n=st.integers(1, 200),
    dim=st.sampled_from([1, 2, 3]),
    seed=st.integers(0, 10_000),
    scale=st.sampled_from([0.0, 1e-305, 1e-3, 1.0, 1e8]),
)
def test_the_order_along_a_curve_is_that_of_the_twin(n, dim, seed, scale):
    places = torch.randn(n, dim, generator=torch.Generator().manual_seed(seed)).double() * scale
    twin, fused = by_both(lambda: order_along_curve(places))
    assert torch.equal(fused, twin)


@pytest.mark.cpu_only
def test_keys_are_numbered_by_their_first_occurrence():
    with kernels("fused"):
        distinct, number = distinct_keys(torch.tensor([5, -3, 5, 8, -3]))
        assert distinct_keys(torch.tensor([], dtype=torch.int64))[0].numel() == 0
    assert distinct.tolist() == [5, -3, 8]
    assert number.tolist() == [0, 1, 0, 2, 1]


def cells(n: int, dim: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Cells of several surfaces and a few outliers: means, weights and mean features."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(n, dim, generator=generator, dtype=torch.float64) * 4 - 2
    surface = torch.randint(4, (n,), generator=generator)
    points[surface == 0, 0] = 0.3 * points[surface == 0, -1]
    points[surface == 1, -1] = points[surface == 1, 0].sin()
    points[torch.rand(n, generator=generator) < 0.02] *= 7
    points -= points.mean(0)
    weight = torch.randint(1, 30, (n,), generator=generator).double()
    features = quadratic_features(points)
    features[:, 1 + dim :] += 1e-4 * torch.rand(n, features.shape[1] - 1 - dim, generator=generator).double()
    return points, weight, features


def cut_by_both(rule: FlatnessRule, *given_: Tensor) -> Partition:
    """The pieces of the fused kernel, after a comparison with those of the twin."""
    points, weight, *features = given_
    twin, fused = by_both(lambda: partition(points, weight, rule, *features))
    assert fused.n_pieces == twin.n_pieces
    assert torch.equal(fused.labels, twin.labels)
    return fused


@given(
    n=st.integers(1, 400),
    dim=st.sampled_from([1, 2, 3]),
    seed=st.integers(0, 10_000),
    limit=st.sampled_from([None, 1, 2, 7, 60]),
    least=st.sampled_from([0.0, 3.0, 40.0]),
    thickness=st.sampled_from([0.0, 0.02, 0.2]),
)
def test_pieces_are_those_of_the_twin(n, dim, seed, limit, least, thickness):
    rule = FlatnessRule(
        thickness=thickness, length=0.5, min_weight=least, min_weight_thick=1.0, max_components=limit
    )
    found = cut_by_both(rule, *cells(n, dim, seed))
    assert limit is None or found.n_pieces <= limit
    assert torch.bincount(found.labels, minlength=found.n_pieces).min() > 0


@pytest.mark.cpu_only
@given(
    n=st.integers(1, 400),
    dim=st.sampled_from([1, 2, 3]),
    seed=st.integers(0, 10_000),
    limit=st.sampled_from([-1, 1, 2, 7, 60]),
    least=st.sampled_from([0.0, 3.0, 40.0]),
    thickness=st.sampled_from([0.0, 0.02, 0.2]),
    n_workers=st.sampled_from([1, 7, 64, 1000]),
    n_levels=st.sampled_from([1, 3, 64]),
)
def test_many_workers_cut_the_same_pieces_as_one(n, dim, seed, limit, least, thickness, n_workers, n_levels):
    rule = CutRule(n_levels, limit, thickness, 0.5, least, 1.0, 3.0, 30.0)
    points, weight, features = cells(n, dim, seed)
    with kernels("fused"):
        labels, n_pieces = piece_cuts(points, weight, features, rule)
        shared, n_shared = piece_cuts(points, weight, features, rule, Team(n_workers, None))
    assert n_shared == n_pieces
    assert torch.equal(shared, labels)


def test_pieces_without_extent_stay_whole():
    one = torch.zeros(5, 3, dtype=torch.float64)
    assert cut_by_both(FlatnessRule(thickness=0.0, min_weight=1.0), one, one[:, 0] + 1).n_pieces == 1


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_pieces_do_not_depend_on_the_unit(scale):
    points, weight, _ = cells(300, 3, 1)
    rule = FlatnessRule(0.02 * scale, 0.5 * scale, max_components=40, outlier_gap=3 * scale)
    found = cut_by_both(rule, points * scale, weight)
    metres = cut_by_both(FlatnessRule(0.02, 0.5, max_components=40), points, weight)
    assert found.n_pieces == metres.n_pieces


@pytest.mark.cpu_only
def test_outliers_become_pieces_of_their_own():
    points = torch.cat([torch.linspace(-1, 1, 50)[:, None].expand(50, 3), torch.full((1, 3), 90.0)]).double()
    points -= points.mean(0)
    rule = FlatnessRule(thickness=0.02, length=1.0, min_weight=5.0, min_weight_thick=5.0)
    assert cut_by_both(rule, points, torch.ones(51).double()).labels[-1] == 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("n", "columns"), [(0, 1), (1, 1), (500, 1), (500, 3), (500, 5)])
def test_values_of_cells_are_summed_without_those_that_are_not_numbers(n, columns, dtype):
    draw = torch.Generator().manual_seed(n + columns)
    values = (1e4 + torch.randn(n, columns, generator=draw)).to(dtype)
    bad = torch.tensor([math.nan, math.inf, -math.inf])[torch.randint(3, (n,), generator=draw)].to(dtype)
    broken = torch.rand(n, generator=draw) < 0.2
    values[:, -1] = torch.where(broken, bad, values[:, -1])
    member = torch.randint(7, (n,), generator=draw)
    weight = torch.ones(8, dtype=torch.float64)
    (twin, middle), (fused, same) = by_both(
        lambda: _cell_sums(values, Cells(torch.zeros(8, 10).double(), weight, member))
    )
    torch.testing.assert_close(fused, twin, rtol=1e-12, atol=1e-9)
    torch.testing.assert_close(same, middle, rtol=0, atol=0)
    for cell in range(8):
        own = values[(member == cell) & ~broken].double() - middle
        products = own.T @ own
        rows = torch.triu_indices(columns, columns)
        expected = torch.cat([torch.full_like(middle[:1], len(own)), own.sum(0), products[rows[0], rows[1]]])
        torch.testing.assert_close(fused[cell], expected, rtol=1e-12, atol=1e-9)
