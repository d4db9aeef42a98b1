"""Depth images summed into cells: count, mean and second moment of each cell, and the counts of each image.

A pixel (u, v) of depth z sees the point z (a + u b + v c) + t. All moments of a patch of 4 × 4 pixels are
therefore sums of z and z², multiplied by u, v and their products. A patch that is smaller than a cell, across
the view and in depth, is added to the cell that contains its mean. The pixels of any other patch are added
one by one. The points themselves are never stored.

The fused kernel runs on the CPU. Its cells are those of the twin, except for patches and points within
rounding of the side of a cell; sums differ by rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel
from gmmtorch.kernels.simd import SIMD

KEY_BITS = 20
"""Bits of one cell coordinate in a key."""
REACH = float(1 << (KEY_BITS - 1))
"""Cells from the reference point, along each axis, in which points can lie."""
PATCH = 4
"""Side of a patch in pixels."""

_WIDTH = 10  # features in 3D
_BODY = """
    // One item for an image: cells are numbered in the order of their first points. A free place holds -1.
    int64_t n_found = *n_cells, number = -1;
    double now[3] = {0.5, 0.5, 0.5};
    const double *a = view, *b = view + 3, *c = view + 6, *t = view + 9;
    // Adds n points with these sums and products, about the camera, to the cell of their mean.
    auto add = [&](double n, const double* first, const double* second) {
        double cell[3];
        bool inside = n_found <= max_cells, same = true;
        for (int i = 0; i < 3; ++i) {
            const double q = first[i] / n + t[i];
            inside = inside && fabs(q) < REACH;  // false for NaN
            cell[i] = floor(q);
            same = same && cell[i] == now[i];
        }
        if (!inside) n_found = max_cells + 1;
        if (!inside) return;
        if (!same) {
            int64_t key = 0;
            for (int i = 0; i < 3; ++i) {
                now[i] = cell[i];
                key = (key << KEY_BITS) | (int64_t)(cell[i] + REACH);
            }
            uint64_t hash = (uint64_t)key * 0x9E3779B97F4A7C15ull;
            int64_t at = (int64_t)((hash ^ (hash >> 32)) & (uint64_t)(n_places - 1));
            while (places[at] >= 0 && keys[places[at]] != key) at = (at + 1) & (n_places - 1);
            if (places[at] < 0) {
                if (n_found >= max_cells) {
                    n_found = max_cells + 1;
                    return;
                }
                places[at] = n_found;
                for (int f = 0; f < WIDTH; ++f) sums[n_found * WIDTH + f] = 0.0;
                for (int64_t i = 0; i < n_images; ++i) counts[n_found * n_images + i] = 0.0;
                keys[n_found++] = key;
            }
            number = places[at];
        }
        double* sum = sums + number * WIDTH;
        double o[3];
        for (int i = 0; i < 3; ++i) o[i] = t[i] - now[i];
        sum[0] += n;
        for (int i = 0, f = 4; i < 3; ++i) {
            sum[1 + i] += first[i] + n * o[i];
            for (int j = i; j < 3; ++j, ++f)
                sum[f] += second[f - 4] + first[i] * o[j] + o[i] * (first[j] + n * o[j]);
        }
        counts[number * n_images + image] += n;
    };
    for (int64_t row = 0; row < n_rows; row += PATCH)
    for (int64_t column = 0; column < n_columns; column += PATCH * LANES) {
        const auto* corner = depth + row * row_step + column * column_step;
        const int64_t n_rows_here = GMM_MIN((int64_t)PATCH, n_rows - row);
        const bool full = column + PATCH * LANES <= n_columns;
        vec n = (vec)(0.0), near = (vec)(1e300), far = (vec)(0.0);
        vec s[3], m[6];  // sums of z, uz, vz, and of zz, uzz, vzz, uuzz, uvzz, vvzz
        for (int f = 0; f < 3; ++f) s[f] = (vec)(0.0);
        for (int f = 0; f < 6; ++f) m[f] = (vec)(0.0);
        for (int64_t v = 0; v < n_rows_here; ++v) {
            vec z0 = (vec)(0.0), z1 = z0, y0 = z0, y1 = z0, y2 = z0;
            for (int u = 0; u < PATCH; ++u) {
                vec z = (vec)(0.0);
                for (int l = 0; l < LANES; ++l) {
                    const int64_t place = PATCH * l + u;
                    if (full || column + place < n_columns)
                        set(z, l, (double)corner[v * row_step + place * column_step]);
                }
                const mask good = (z > 0.0) & (z < max_range);  // false for NaN
                z = good ? z : (vec)(0.0);
                n += good ? (vec)(1.0) : (vec)(0.0);
                near = (good & (z < near)) ? z : near;
                far = z > far ? z : far;
                const vec zz = z * z;
                z0 += z, z1 += z * (double)u;
                y0 += zz, y1 += zz * (double)u, y2 += zz * (double)(u * u);
            }
            const double w = (double)v;
            s[0] += z0, s[1] += z1, s[2] += z0 * w;
            m[0] += y0, m[1] += y1, m[2] += y0 * w, m[3] += y2, m[4] += y1 * w, m[5] += y0 * (w * w);
        }
        if (!any(n > 0.0)) continue;
        const mask is_whole = (far - near <= deepest) & (far <= farthest_whole);
        vec ray[3], lane, first[3], second[6];
        for (int l = 0; l < LANES; ++l) set(lane, l, (double)(column + PATCH * l));
        for (int i = 0; i < 3; ++i) {
            ray[i] = a[i] + lane * b[i] + (double)row * c[i];
            first[i] = ray[i] * s[0] + b[i] * s[1] + c[i] * s[2];
        }
        for (int j = 0; j < 3; ++j) {
            const vec z = m[0] * ray[j] + m[1] * b[j] + m[2] * c[j];
            const vec u = m[1] * ray[j] + m[3] * b[j] + m[4] * c[j];
            const vec v = m[2] * ray[j] + m[4] * b[j] + m[5] * c[j];
            for (int i = 0; i <= j; ++i) second[i * (5 - i) / 2 + j] = ray[i] * z + b[i] * u + c[i] * v;
        }
        const vec whole = is_whole ? (vec)(1.0) : (vec)(0.0);
        for (int l = 0; l < LANES; ++l) {
            if (get(n, l) == 0.0) continue;
            double p[3], pp[6];
            if (get(whole, l) > 0.0) {
                for (int f = 0; f < 3; ++f) p[f] = get(first[f], l);
                for (int f = 0; f < 6; ++f) pp[f] = get(second[f], l);
                add(get(n, l), p, pp);
                continue;
            }
            const int64_t begin = PATCH * l, end = GMM_MIN(begin + PATCH, n_columns - column);
            for (int64_t v = 0; v < n_rows_here; ++v)
            for (int64_t u = begin; u < end; ++u) {
                const double z = (double)corner[v * row_step + u * column_step];
                if (!(z > 0.0 && z < max_range)) continue;
                for (int i = 0; i < 3; ++i)
                    p[i] = z * (a[i] + (double)(column + u) * b[i] + (double)(row + v) * c[i]);
                for (int i = 0, f = 0; i < 3; ++i)
                    for (int j = i; j < 3; ++j, ++f) pp[f] = p[i] * p[j];
                add(1.0, p, pp);
            }
        }
    }
    *n_cells = n_found;
"""
_KERNELS = {
    dtype: FusedKernel(
        f"depth_cells_{kind}",
        f"const {kind}* depth, int64 n_rows, int64 n_columns, int64 row_step, int64 column_step,"
        " const double* view, double max_range, double deepest, double farthest_whole, int64 image,"
        " int64 n_images, int64 max_cells, int64 n_places, int64* places, int64* keys, double* sums,"
        " double* counts, int64* n_cells",
        SIMD
        + _BODY.replace("KEY_BITS", str(KEY_BITS))
        .replace("REACH", repr(REACH))
        .replace("PATCH", str(PATCH))
        .replace("WIDTH", str(_WIDTH)),
        shares=True,
        strided=("depth",),
    )
    for dtype, kind in ((torch.float32, "float"), (torch.float64, "double"))
}


class DepthCells(NamedTuple):
    """C cells in the order of their keys, and the points in them.

    corners (C, 3): lowest corner of each cell, in cells. sums (C, 10): quadratic features of the points
    relative to that corner. counts (C, S): points of each image.
    """

    corners: Tensor
    sums: Tensor
    counts: Tensor


class DepthView(NamedTuple):
    """A depth image, and how its pixels lie in space.

    depth: (H, W), float32 or float64, metres along the optical axis. rays (4, 3), float64, on the CPU, in
    cells: the ray of pixel (0, 0) at a depth of one metre, its steps from column to column and from row to
    row, and the camera, relative to the reference point. pitch: the distance between the rays of neighbouring
    pixels at a depth of one metre, in cells; the larger one of rows and columns. max_range: pixels at or
    beyond it (m) are left out.
    """

    depth: Tensor
    rays: Tensor
    pitch: float
    max_range: float


def depth_cells(views: Sequence[DepthView], side: float, max_cells: int) -> DepthCells | None:
    """The points of S depth images, summed into cells of `side` metres around a reference point.

    Pixels are left out if they are not above zero, not below `max_range`, or not finite. Returns None if
    there are more than `max_cells`, or if a patch or point is `REACH` cells or more away from the reference
    point along an axis.
    """
    if views[0].depth.device.type == "cpu" and is_fused(*(view.depth for view in views)):
        return _fused(views, side, max_cells)
    return _batched(views, side, max_cells)


def _limits(view: DepthView, side: float) -> tuple[float, float]:
    """The largest difference of depth of a whole patch, and its largest depth, in metres."""
    return side, 1 / (PATCH * view.pitch)


def _fused(views: Sequence[DepthView], side: float, max_cells: int) -> DepthCells | None:
    n_places = 1 << (2 * max_cells).bit_length()
    places, keys = torch.full((n_places,), -1), torch.empty(max_cells, dtype=torch.int64)
    sums = torch.empty(max_cells, _WIDTH, dtype=torch.float64)
    counts = torch.empty(max_cells, len(views), dtype=torch.float64)
    n_cells = torch.zeros(1, dtype=torch.int64)
    tables = max_cells, n_places, places, keys, sums, counts, n_cells
    for image, view in enumerate(views):
        depth = view.depth
        given = (
            depth,
            *depth.shape,
            *depth.stride(),
            view.rays.contiguous(),
            view.max_range,
            *_limits(view, side),
        )
        _KERNELS[depth.dtype](1, *given, image, len(views), *tables, device=depth.device)
    found = int(n_cells)
    if found > max_cells:
        return None
    order = keys[:found].argsort()
    return DepthCells(_corners(keys[order]), sums[order], counts[order])


def _corners(keys: Tensor) -> Tensor:
    whole = torch.stack([keys >> (2 * KEY_BITS), keys >> KEY_BITS, keys], 1) & ((1 << KEY_BITS) - 1)
    return whole.double() - REACH


# -- the twin -------------------------------------------------------------------------------------


def _batched(views: Sequence[DepthView], side: float, max_cells: int) -> DepthCells | None:
    """The twin."""
    placed = [_placed(view, side) for view in views]
    if not bool(torch.stack([inside for *_, inside in placed]).all()):
        return None
    keys = torch.cat([_pack(cell, valid) for _, cell, valid, _ in placed])
    unique, member = torch.unique(keys, return_inverse=True)
    n_cells = len(unique)
    sums = torch.zeros(n_cells, _WIDTH, dtype=torch.float64, device=keys.device)
    counts = torch.zeros(len(views), n_cells, dtype=torch.float64, device=keys.device)
    parts = member.split([valid.numel() for _, _, valid, _ in placed])
    for (points, cell, valid, _), count, part in zip(placed, counts, parts, strict=True):
        weight = valid.double()
        count.index_add_(0, part, weight)
        sums.index_add_(0, part, _features(points - cell) * weight[:, None])
    used = (sums[:, 0] > 0).nonzero().squeeze(1)  # pixels that are left out have a cell of their own
    if len(used) > max_cells:
        return None
    return DepthCells(_corners(unique[used]), sums[used], counts.T[used])


def _placed(view: DepthView, side: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points (N, 3) and their cells (N, 3), in cells, of all pixels; which of them are valid (N,); and
    whether all valid ones are within reach."""
    height, width = view.depth.shape
    padded = torch.nn.functional.pad(view.depth, (0, -width % PATCH, 0, -height % PATCH)).double()
    z = padded.unflatten(1, (-1, PATCH)).unflatten(0, (-1, PATCH)).transpose(1, 2).flatten(0, 1).flatten(1)
    valid = (z > 0) & (z < view.max_range) & torch.isfinite(z)
    z = torch.where(valid, z, 0.0)  # (patches, pixels)
    ray, across, down, camera = view.rays.to(z.device)
    u, v = (torch.arange(n, dtype=z.dtype, device=z.device) for n in (padded.shape[1], padded.shape[0]))
    rays = ray + u[:, None] * across + v[:, None, None] * down  # (H, W, 3)
    rays = (
        rays.unflatten(1, (-1, PATCH)).unflatten(0, (-1, PATCH)).transpose(1, 2).flatten(0, 1).flatten(1, 2)
    )
    points = z[..., None] * rays  # relative to the camera
    far, near = z.amax(1), torch.where(valid, z, torch.inf).amin(1)
    deepest, farthest_whole = _limits(view, side)
    is_whole = (far - near <= deepest) & (far <= farthest_whole)
    mean = points.sum(1) / valid.sum(1).clamp_min(1)[:, None]
    places = torch.where(is_whole[:, None, None], mean[:, None], points) + camera
    places = torch.where(valid[..., None], places, 0.0)
    inside = (places.abs() < REACH).all()  # False for NaN
    return (points + camera).flatten(0, 1), places.floor().flatten(0, 1), valid.flatten(), inside


def _pack(cells: Tensor, valid: Tensor) -> Tensor:
    key = torch.zeros_like(valid, dtype=torch.int64)
    for axis in range(3):
        key = key << KEY_BITS | (cells[:, axis] + REACH).long()
    return torch.where(valid, key, -1)


def _features(x: Tensor) -> Tensor:
    """[1, x, x_i x_j (i ≤ j)] (N, 10) of points (N, 3)."""
    return torch.cat([torch.ones_like(x[:, :1]), x, *(x[:, i : i + 1] * x[:, i:] for i in range(3))], 1)
