"""Mixtures of depth images, against the back-projected points of the pixels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mixture import GaussianMixture
from gmmtorch.mixture.em.exact import quadratic_features
from gmmtorch.mixture.estimators.depth_image import fit_depth_image, pool_depth_image
from gmmtorch.pinhole import back_project

INTRINSICS = torch.tensor([[80.0, 0.0, 47.3], [0.0, 75.0, 30.9], [0.0, 0.0, 1.0]], dtype=torch.float64)


def tangents(height: int, width: int, intrinsics: Tensor = INTRINSICS) -> tuple[Tensor, Tensor]:
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (height, width)), indexing="ij")
    return (u - intrinsics[0, 2]) / intrinsics[0, 0], (v - intrinsics[1, 2]) / intrinsics[1, 1]


def plane(height: int, width: int, normal: tuple[float, float, float], distance: float) -> Tensor:
    """Depth (H, W) of the plane n·p = distance · |n|, which every pixel must see."""
    a, b = tangents(height, width)
    n = torch.tensor(normal, dtype=torch.float64)
    cosine = (n[0] * a + n[1] * b + n[2]) / n.norm()
    assert float(cosine.min()) > 0
    return distance / cosine


def points_of(depth: Tensor, intrinsics: Tensor = INTRINSICS, max_range: float = math.inf) -> Tensor:
    kept = torch.isfinite(depth) & (depth > 0) & (depth < max_range)
    return back_project(torch.where(kept, depth, 0.0).double(), intrinsics.double())


def bad_pixels(depth: Tensor, seed: int, share: float) -> Tensor:
    """The image with holes and with all kinds of invalid depth."""
    rng = np.random.default_rng(seed)
    values = rng.choice([0.0, math.nan, math.inf, -math.inf, -1.0], size=tuple(depth.shape))
    return torch.where(
        torch.from_numpy(rng.random(tuple(depth.shape)) < share), torch.from_numpy(values), depth
    )


# -- cells -----------------------------------------------------------------------------------------


@settings(max_examples=60)
@given(
    seed=st.integers(0, 10**6),
    height=st.integers(1, 70),
    width=st.integers(1, 70),
    share=st.sampled_from([0.0, 0.1, 0.9]),
    max_range=st.sampled_from([math.inf, 2.5]),
    smooth=st.booleans(),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_pooled_sums_equal_those_of_back_projected_points(
    seed, height, width, share, max_range, smooth, dtype
):
    depth = plane(height, width, (0.3, -0.2, 1.0), 2.0)
    if not smooth:
        depth = depth + torch.from_numpy(np.random.default_rng(seed).uniform(-1, 2, (height, width)))
    depth = bad_pixels(depth, seed, share).to(dtype)
    points = points_of(depth, max_range=max_range)
    if len(points) == 0:
        with pytest.raises(InvalidArgumentError, match="no pixel"):
            pool_depth_image(depth, INTRINSICS, max_range=max_range)
        return
    cells = pool_depth_image(depth, INTRINSICS, max_range=max_range)
    assert not cells.are_points
    assert cells.values.dtype == cells.weight.dtype == torch.float64
    assert float(cells.weight.sum()) == len(points)
    assert (cells.weight == cells.weight.round()).all()
    assert float(cells.weight.min()) >= 1
    assert float(cells.weight.max()) <= 32 * 32
    assert (cells.values[:, 0] == 1).all()
    sums = (cells.values * cells.weight[:, None]).sum(0)
    torch.testing.assert_close(sums, quadratic_features(points).sum(0), rtol=1e-6, atol=1e-5)


def brute_force_cells(depth: np.ndarray, noise: float) -> np.ndarray:
    """Rows (C, 11) of pixel count and mean features, by a tree of squares and least squares in 1/z."""
    height, width = depth.shape
    found = []

    def pixels(top: int, left: int, side: int) -> np.ndarray:
        rows, columns = np.arange(top, top + side), np.arange(left, left + side)
        v, u = np.meshgrid(rows[rows < height], columns[columns < width], indexing="ij")
        own = np.stack([u.ravel(), v.ravel(), depth[v, u].ravel()], 1)
        return own[own[:, 2] > 0]

    def is_flat(own: np.ndarray) -> bool:
        if len(own) == 0:
            return True
        w = 1 / own[:, 2]
        # Relative to the mean, so that few pixels, or pixels in one line, have a solution.
        design = own[:, :2] - own[:, :2].mean(0)
        residual = (w - w.mean()) - design @ np.linalg.lstsq(design, w - w.mean(), rcond=1e-9)[0]
        return np.sqrt((residual**2).mean()) <= noise / 2 * max(1.0, w.mean() ** 2)

    def whole(top: int, left: int, side: int) -> bool:
        """Whether the square is one cell; if not, its cells are stored."""
        own = pixels(top, left, side)
        if side == 8:
            return True
        half = side // 2
        corners = [(top + i, left + j) for i in (0, half) for j in (0, half)]
        intact = [whole(*corner, half) for corner in corners]
        if all(intact) and is_flat(own):
            return True
        for corner, one in zip(corners, intact, strict=True):
            if one:
                keep(pixels(*corner, half))
        return False

    def keep(own: np.ndarray) -> None:
        if len(own):
            fx, fy, cx, cy = (float(INTRINSICS[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
            u, v, z = own.T
            x, y = (u - cx) / fx * z, (v - cy) / fy * z
            features = np.stack([x**0, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z], 1).mean(0)
            found.append([len(own), *features])

    for top in range(0, height, 32):
        for left in range(0, width, 32):
            if whole(top, left, 32):
                keep(pixels(top, left, 32))
    return np.array(found)


@pytest.mark.parametrize("noise", [0.003, 0.02, 0.3])
@pytest.mark.parametrize("seed", range(4))
def test_cells_equal_brute_force(noise, seed):
    rng = np.random.default_rng(seed)
    height, width = 70, 101  # neither is a multiple of the cell size
    depth = plane(height, width, (0.2, 0.5, 1.0), 1.2)
    depth[:, 40:] = plane(height, width, (-0.8, 0.0, 1.0), 3.0)[:, 40:]
    depth[20:50, 10:30] = 0.8
    depth = depth * (1 + 0.004 * torch.from_numpy(rng.normal(size=(height, width))))
    depth = torch.where(bad_pixels(depth, seed, 0.2) > 0, bad_pixels(depth, seed, 0.2), 0.0)
    depth[torch.isinf(depth)] = 0.0
    cells = pool_depth_image(depth, INTRINSICS, noise=noise)
    found = torch.cat([cells.weight[:, None], cells.values], 1).numpy()
    expected = brute_force_cells(depth.numpy(), noise)
    assert len(set(expected[:, 0].round(-1))) > 2  # cells of several sizes
    found, expected = (rows[np.lexsort(rows[:, [3, 2, 0]].T.round(4))] for rows in (found, expected))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("distance", [0.8, 2.0, 9.0])
@pytest.mark.parametrize(
    "normal", [(0.0, 0.0, 1.0), (0.7, 0.0, 1.0), (-1.2, 0.1, 1.0), (0.3, 1.1, 1.0), (0.9, -0.8, 1.0)]
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_flat_wall_at_any_angle_gives_the_largest_cells(normal, distance, dtype):
    cells = pool_depth_image(plane(64, 96, normal, distance).to(dtype), INTRINSICS, noise=0.002)
    assert cells.weight.tolist() == [32.0 * 32.0] * 6


def test_a_step_in_one_column_of_pixels_splits_cells():
    depth = torch.full((50, 1), 1.5)
    assert len(pool_depth_image(depth, INTRINSICS).weight) == 2
    depth[13:] = 2.5
    assert float(pool_depth_image(depth, INTRINSICS).weight.max()) < 30


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("value", "is_seen"), [(1e-30, True), (1e-12, True), (1e12, True), (1e25, False)])
def test_tiny_or_huge_pixel_affects_no_other_cell(value, is_seen, dtype):
    depth = plane(64, 64, (0.1, 0.2, 1.0), 2.0).to(dtype)
    clean = pool_depth_image(depth, INTRINSICS)
    assert clean.weight.tolist() == [1024.0] * 4
    depth[5, 5] = value
    cells = pool_depth_image(depth, INTRINSICS)
    assert torch.isfinite(cells.values).all()
    assert float(cells.weight.sum()) == 64 * 64 - (not is_seen)
    others = cells.values[cells.weight == 1024]
    assert torch.equal(others[-3:], clean.values[-3:])


def test_image_is_not_modified():
    depth = plane(40, 40, (0.0, 0.0, 1.0), 2.0).requires_grad_()
    before = depth.detach().clone()
    cells = pool_depth_image(depth, INTRINSICS)
    assert torch.equal(depth.detach(), before)
    assert not cells.values.requires_grad


# -- mixtures --------------------------------------------------------------------------------------


def corner(height: int = 128, width: int = 160) -> tuple[Tensor, list[tuple[np.ndarray, float]]]:
    """Depth of a room corner, two walls and the floor, and their planes: unit normal, distance."""
    planes = [((-0.8, 0.0, 1.0), 2.5), ((0.9, 0.0, 1.0), 2.7), ((0.0, 1.0, 0.35), 1.4)]
    a, b = tangents(height, width)
    found, truth = torch.full((height, width), math.inf, dtype=torch.float64), []
    for normal, distance in planes:
        n = np.array(normal) / np.linalg.norm(normal)
        cosine = n[0] * a + n[1] * b + n[2]
        found = torch.minimum(found, torch.where(cosine > 0.05, distance / cosine, torch.inf))
        truth.append((n, distance))
    return found, truth


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_components_are_on_the_observed_planes(dtype):
    depth, planes = corner()
    noise = torch.randn(depth.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    mixture = fit_depth_image((depth + 0.002 * noise).to(dtype), INTRINSICS, 40, noise=0.01)
    assert isinstance(mixture, GaussianMixture)
    assert mixture.means.shape == (40, 3)
    assert float(mixture.weights.sum()) == pytest.approx(1)
    variances, directions = np.linalg.eigh(mixture.covariances.numpy())
    good, seen = 0.0, set()
    for weight, mean, variance, direction in zip(
        mixture.weights.numpy(), mixture.means.numpy(), variances, directions, strict=True
    ):
        offsets = [abs(n @ mean - d) for n, d in planes]
        nearest = int(np.argmin(offsets))
        aligned = abs(planes[nearest][0] @ direction[:, 0]) > math.cos(math.radians(5))
        if offsets[nearest] < 0.01 and aligned and variance[0] < 0.015**2:
            good += weight
            seen.add(nearest)
    assert good > 0.75  # the rest are pieces across an edge
    assert seen == {0, 1, 2}


def test_mixture_has_the_moments_of_the_points():
    depth = bad_pixels(corner()[0], 3, 0.1)
    mixture = fit_depth_image(depth, INTRINSICS, 30, noise=0.02, max_iter=5)
    points = points_of(depth).numpy()
    weights, means, covariances = (x.numpy() for x in (mixture.weights, mixture.means, mixture.covariances))
    center = weights @ means
    np.testing.assert_allclose(center, points.mean(0), atol=1e-6)
    offset = means - center
    within = np.einsum("k,kij->ij", weights, covariances)
    between = np.einsum("k,ki,kj->ij", weights, offset, offset)
    expected = np.cov(points.T, ddof=0) + 0.02**2 * np.eye(3)  # noise² is added to each variance
    np.testing.assert_allclose(within + between, expected, atol=1e-5)


def test_more_iterations_increase_the_likelihood():
    depth = corner()[0]
    points = points_of(depth)
    few, many = (fit_depth_image(depth, INTRINSICS, 40, max_iter=n) for n in (1, 10))
    assert (few.n_iter_, many.n_iter_) == (1, 10)
    assert (np.diff(many.lower_bounds_) > -1e-9).all()
    assert many.score(points) > few.score(points)
    assert many.lower_bound_ < many.score(points)
    assert few.reg_covar == pytest.approx(1e-4)


@pytest.mark.parametrize(("noise", "distance"), [(0.01, 3.0), (0.01, 60.0), (0.001, 8.0), (1e-4, 1.0)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_oblique_wall_is_as_thin_as_the_noise_at_any_distance(noise, distance, dtype):
    depth = plane(96, 128, (0.5, 0.3, 1.0), distance).to(dtype)
    mixture = fit_depth_image(depth, INTRINSICS, 12, noise=noise)
    thinnest = torch.linalg.eigvalsh(mixture.covariances)[:, 0].sqrt()
    torch.testing.assert_close(thinnest, torch.full_like(thinnest, noise), rtol=0.02, atol=0)


def test_one_component_per_cell_is_allowed():
    depth = plane(64, 64, (0.3, 0.1, 1.0), 2.0)
    mixture = fit_depth_image(depth, INTRINSICS, 4)
    assert sorted(mixture.weights.tolist()) == pytest.approx([0.25] * 4, abs=0.1)
    with pytest.raises(InvalidArgumentError, match=r"^n_components=5 .* 4 cells"):
        fit_depth_image(depth, INTRINSICS, 5)


# -- errors ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(4,), (1, 4, 4), (0, 4), (4, 0)])
def test_invalid_depth_image_is_named(shape):
    with pytest.raises(InvalidArgumentError, match=r"^depth has shape"):
        pool_depth_image(torch.zeros(shape), INTRINSICS)


@pytest.mark.parametrize("kind", [torch.from_numpy, np.asarray, np.ndarray.tolist])
@pytest.mark.parametrize("dtype", [np.uint16, np.int32])
def test_image_of_whole_numbers_needs_a_depth_scale(kind, dtype):
    metres = plane(64, 96, (0.3, 0.1, 1.0), 2.0).numpy()
    units = kind((metres * 1000).round().astype(dtype))
    expected = fit_depth_image(torch.from_numpy((metres * 1000).round() / 1000), INTRINSICS, 3)
    found = fit_depth_image(units, INTRINSICS, 3, depth_scale=0.001)
    torch.testing.assert_close(found.means, expected.means, rtol=1e-6, atol=1e-6)
    with pytest.raises(InvalidArgumentError, match=r"^depth is an image of whole numbers.*depth_scale"):
        fit_depth_image(units, INTRINSICS, 3)
    with pytest.raises(InvalidArgumentError, match=r"^depth_scale=-1 must be"):
        fit_depth_image(units, INTRINSICS, 3, depth_scale=-1)


@pytest.mark.parametrize(
    ("matrix", "reason"),
    [
        ([[80.0, 0.0, 0.0], [0.0, 75.0, 0.0], [47.3, 30.9, 1.0]], "looks transposed"),
        ([[80.0, 0.0, 47.3], [0.0, 75.0, 30.9], [0.0, 0.0, 2.0]], "last row must be 0 0 1"),
        ([[80.0, 0.0, 47.3], [0.0, 0.0, 30.9], [0.0, 0.0, 1.0]], "focal lengths must be above zero"),
        ([[80.0, 0.0, 47.3], [0.0, -75.0, 30.9], [0.0, 0.0, 1.0]], "focal lengths must be above zero"),
        ([[80.0, 9.0, 47.3], [0.0, 75.0, 30.9], [0.0, 0.0, 1.0]], "skew"),
        ([[80.0, 0.0, 473.0], [0.0, 75.0, 30.9], [0.0, 0.0, 1.0]], "principal point is far outside"),
        ([[80.0, 0.0, 47.3], [0.0, 75.0, -65.0], [0.0, 0.0, 1.0]], "principal point is far outside"),
        ([[80.0, 0.0, math.nan], [0.0, 75.0, 30.9], [0.0, 0.0, 1.0]], ""),
        ([[math.inf, 0.0, 47.3], [0.0, 75.0, 30.9], [0.0, 0.0, 1.0]], ""),
        (np.zeros((3, 3)), ""),
        (np.eye(4), ""),
    ],
)
def test_invalid_intrinsics_say_why(matrix, reason):
    with pytest.raises(InvalidArgumentError, match=rf"^intrinsics.*{reason}"):
        fit_depth_image(plane(64, 96, (0.3, 0.1, 1.0), 2.0), matrix, 3)


@pytest.mark.parametrize(
    "options",
    [
        *({"noise": value} for value in (0.0, -0.01, math.nan, math.inf)),
        *({"max_range": value} for value in (0.0, -1.0, math.nan)),
        *({"n_components": value} for value in (0, 2.5)),
        *({"max_iter": value} for value in (0, 2.5)),
    ],
)
def test_invalid_options_are_named(options: dict[str, Any]):
    with pytest.raises(InvalidArgumentError, match=f"^{next(iter(options))}="):
        fit_depth_image(torch.ones(64, 64), INTRINSICS, **{"n_components": 2, **options})


@pytest.mark.parametrize("value", [0.0, -2.0, math.nan, math.inf, 5.0])
def test_image_without_valid_pixels_is_rejected(value):
    with pytest.raises(InvalidArgumentError, match="no pixel"):
        fit_depth_image(torch.full((64, 64), value), INTRINSICS, 1, max_range=5.0)
