"""A mixture from a depth image in milliseconds, through moments that are summed in the image.

A pixel (u, v) of depth z sees the point (u z/f, v z/f, z), with u and v relative to the optical axis. All
moments of a block of pixels are therefore sums of z and z², multiplied by 1, u, v and their products.
Strided convolutions compute these sums without computing the points. Blocks that are flat together
are merged into cells of up to 32 × 32 pixels, so that walls become few cells and edges stay sharp. EM
then runs on the cells (see `cells`). A block is flat if its inverse depth is linear in u and v. The
points alone do not show this: the points of a few pixels lie close to the plane through them and the
camera, even across a depth step.

Camera frame: x right, y down, z forward, metres.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike
from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em import loop
from gmmtorch.mixture.em.initialization import flat_pieces, replicated
from gmmtorch.mixture.em.truncated import Rows
from gmmtorch.mixture.gaussian_mixture import GaussianMixture
from gmmtorch.pinhole import check_intrinsics, metric_depth

_BLOCK = 8  # side of the smallest cell in pixels
_LEVELS = 2  # number of times that the side can double
_FARTHEST = 1e15  # metres; larger values are invalid, and their squares may overflow
_LEAST_VARIANCE = 1e-3  # added to the variance of a cell's pixels along u and v (pixels²)


def pool_depth_image(
    depth: ArrayLike,
    intrinsics: ArrayLike,
    *,
    max_range: float = float("inf"),
    noise: float = 0.01,
    depth_scale: float | None = None,
) -> Rows:
    """Cells of a depth image (H, W), in metres along the optical axis: mean features and pixel counts.

    `depth_scale`: metres per unit of the image; None: metres, in a floating type.

    Excludes pixels that are not finite, not above zero, or not below `max_range`. Four cells become one if
    the root mean square deviation of depth from a plane is at most half of `noise` (m), times z² beyond
    one metre, because the error of depth cameras grows with z². Sums of features are those of the
    back-projected points, to float32 precision of the depth range within a block.

    Raises `InvalidArgumentError` for invalid arguments, and if no pixel remains.
    """
    image = metric_depth(depth, depth_scale).detach()
    matrix = check_intrinsics(intrinsics, tuple(image.shape))
    if not max_range > 0:
        raise InvalidArgumentError(f"max_range={max_range} must be above zero metres.")
    if not 0 < noise < float("inf"):
        raise InvalidArgumentError(f"noise={noise} must be above zero metres.")
    sums, inverse = _block_features(image, matrix, max_range)
    whole, found = torch.ones_like(sums[0], dtype=torch.bool), []
    for _ in range(_LEVELS):
        parent, inverse = _sum_of_four(sums), _sum_of_four(inverse)
        flat = _is_flat(inverse, noise / 2) & _all_of_four(whole)
        found.append(sums[:, whole & ~_four_of_each(flat) & (sums[0] > 0)])
        sums, whole = parent, flat
    found.append(sums[:, whole & (sums[0] > 0)])
    cells = torch.cat(found, 1).T
    if cells.shape[0] == 0:
        raise InvalidArgumentError(
            "depth has no pixel above zero and below max_range; there is nothing to fit."
        )
    return Rows(cells / cells[:, :1], cells[:, 0].contiguous(), are_points=False)


def fit_depth_image(
    depth: ArrayLike,
    intrinsics: ArrayLike,
    n_components: int = 50,
    *,
    max_range: float = float("inf"),
    noise: float = 0.01,
    max_iter: int = 4,
    depth_scale: float | None = None,
) -> GaussianMixture:
    """A mixture of a depth image (H, W) in the camera frame. `moved(T_world_camera)` moves it.

    `intrinsics` is the pinhole matrix (3, 3) in pixels. `depth_scale` is the number of metres per unit of
    the image, such as 0.001 for millimetres; an image of integers needs it.

    The start is the flat pieces of the cells (see `pool_depth_image`), followed by `max_iter` iterations
    of EM on the cells. `noise` squared is the smallest variance of a component (m²).

    Raises `InvalidArgumentError` for invalid arguments, and for fewer cells than components.
    """
    check_whole("n_components", n_components, 1)
    check_whole("max_iter", max_iter, 1)
    with torch.inference_mode():  # gradient book-keeping would take a tenth of the time
        cells = pool_depth_image(depth, intrinsics, max_range=max_range, noise=noise, depth_scale=depth_scale)
        n_cells = cells.weight.shape[0]
        if n_cells < n_components:
            raise InvalidArgumentError(
                f"n_components={n_components} is more than the {n_cells} cells of the image; reduce it."
            )
        share = (cells.weight / cells.weight.sum())[:, None]
        center = (cells.points * share).sum(0)
        features = em.shift_features(cells.values, -center)
        centered = Rows(features, cells.weight, are_points=False)
        first, _ = flat_pieces(centered.points, cells.weight, n_components, noise**2, features)
        step = loop.em_step(centered, noise**2)
        found = loop.run_em(step, replicated(first, n_components), tol=0.0, max_iter=max_iter)
        weights, means, covariances = found.parameters
        means = means + center
    return GaussianMixture.from_parameters(
        (weights / weights.sum()).clone(),
        means.clone(),
        covariances.clone(),
        lower_bounds=found.lower_bounds,
        reg_covar=noise**2,
    )


def _block_features(depth: Tensor, intrinsics: Tensor, max_range: float) -> tuple[Tensor, Tensor]:
    """Sums of features over blocks of pixels: of the points, and of (u, v, 1/z), (10, h, w) each.

    u and v are in pixels: relative to the optical axis for the points, and to the middle of the largest
    cell for (u, v, 1/z). h and w are rounded up to whole largest cells.
    """
    side = _BLOCK << _LEVELS
    padded = torch.nn.functional.pad(depth, (0, -depth.shape[1] % side, 0, -depth.shape[0] % side))
    valid = (padded > 0) & (padded < min(max_range, _FARTHEST))  # False for NaN
    of_one, (of_z, of_zz), (of_w, of_ww) = _block_sums(valid, padded)
    u, v = (
        (_BLOCK - 1) / 2 + _BLOCK * torch.arange(n, dtype=torch.float64, device=depth.device)
        for n in (of_one.shape[2], of_one.shape[1])
    )
    fx, fy, cx, cy = (float(intrinsics[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    middle = (side - 1) / 2
    local = u % side - middle, (v % side - middle)[:, None]
    count, su, sv, suu, suv, svv = _about(of_one, *local)
    sw, suw, svw, *_ = _about(of_w, *local)
    axis = u - cx, (v - cy)[:, None]
    sz, sx, sy, *_ = _about(of_z, *axis)
    szz, sxz, syz, sxx, sxy, syy = _about(of_zz, *axis)
    points = [count, sx / fx, sy / fy, sz, sxx / fx**2, sxy / (fx * fy), sxz / fx, syy / fy**2, syz / fy, szz]
    return torch.stack(points), torch.stack([count, su, sv, sw, suu, suv, suw, svv, svw, of_ww[0]])


def _block_sums(valid: Tensor, z: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Σ1, (Σz, Σz²) and (Σw, Σw²), w = 1/z, over the valid pixels of blocks of an image (H, W).

    Each is multiplied by 1, d, e, d², de, e², with d and e in pixels from the middle of the block: (6, h, w),
    float64. Pixels are summed in float32 relative to a value of the block (0 if none is valid), so that
    thin and distant cells keep their digits.
    """
    images = torch.empty(5, *z.shape, dtype=torch.float32, device=z.device)
    images[0] = valid
    middles, missing = [], ~valid
    for place, image in ((1, z), (3, z.reciprocal())):
        middle = _some_value(valid, image)
        blocks = image.unflatten(1, (-1, _BLOCK)).unflatten(0, (-1, _BLOCK))
        local = images[place].unflatten(1, (-1, _BLOCK)).unflatten(0, (-1, _BLOCK))
        if image.dtype == torch.float32:
            torch.sub(blocks, middle[:, None, :, None], out=local)
        else:
            local.copy_(blocks - middle[:, None, :, None])
        images[place].masked_fill_(missing, 0.0)  # replaces NaN too
        torch.square(images[place], out=images[place + 1])
        middles.append(middle.double())
    d = torch.arange(_BLOCK, dtype=torch.float32, device=z.device) - (_BLOCK - 1) / 2
    d, e = d.expand(_BLOCK, _BLOCK), d[:, None].expand(_BLOCK, _BLOCK)
    monomials = torch.stack([torch.ones_like(d), d, e, d * d, d * e, e * e])
    found = torch.nn.functional.conv2d(images[:, None], monomials[:, None], stride=_BLOCK).double()
    one = found[0]
    of_z, of_w = (
        (first + middle * one, second + middle * (2 * first + middle * one))
        for middle, first, second in zip(middles, found[1::2], found[2::2], strict=True)
    )
    return one, of_z, of_w


def _some_value(valid: Tensor, image: Tensor) -> Tensor:
    """The largest valid one of four values of each block (h, w), or 0: much faster than the largest of
    all."""
    near, far = _BLOCK // 4, _BLOCK - 1 - _BLOCK // 4
    four = [
        torch.where(valid[i::_BLOCK, j::_BLOCK], image[i::_BLOCK, j::_BLOCK], 0.0)
        for i in (near, far)
        for j in (near, far)
    ]
    return torch.stack(four).amax(0)


def _about(sums: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, ...]:
    """Σg, Σgu, Σgv, Σgu², Σguv, Σgv² for u = a + d, v = b + e, from the sums (6, h, w) over d and e."""
    s, sd, se, sdd, sde, see = sums
    su, sv = a * s + sd, b * s + se
    return s, su, sv, a * (su + sd) + sdd, a * sv + b * sd + sde, b * (sv + se) + see


def _is_flat(sums: Tensor, deviation: float) -> Tensor:
    """Whether depth deviates from a plane by at most `deviation` (m, times z² beyond one metre), (h, w).

    Uses the variance of inverse depth w given u and v. On a plane w is linear in u and v, and a deviation
    of w is that of depth divided by z².
    """
    u, v, w, uu, uv, uw, vv, vw, ww = sums[1:] / sums[0].clamp_min(1)
    # The added variance keeps the slope of pixels in one line finite.
    suu, suv, svv = uu - u * u + _LEAST_VARIANCE, uv - u * v, vv - v * v + _LEAST_VARIANCE
    suw, svw, sww = uw - u * w, vw - v * w, ww - w * w
    explained = (svv * suw * suw - 2 * suv * suw * svw + suu * svw * svw) / (suu * svv - suv * suv)
    return sww - explained <= (deviation * w.square().clamp_min(1)).square()


def _sum_of_four(sums: Tensor) -> Tensor:
    rows = sums[:, ::2] + sums[:, 1::2]
    return rows[..., ::2] + rows[..., 1::2]


def _all_of_four(flags: Tensor) -> Tensor:
    rows = flags[::2] & flags[1::2]
    return rows[:, ::2] & rows[:, 1::2]


def _four_of_each(flags: Tensor) -> Tensor:
    return flags.repeat_interleave(2, 0).repeat_interleave(2, 1)
