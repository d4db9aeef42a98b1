"""Depth images summed into cells: count, mean and second moment of each cell, and the counts of each image.

A pixel (u, v) of depth z sees the point z (a + u b + v c) + t. All moments of a patch of 4 × 4 pixels are
therefore sums of z and z², multiplied by u, v and their products. A patch that is smaller than a cell, across
the view and in depth, is added to the cell that contains its mean. The pixels of any other patch are added
one by one. The points themselves are never stored.

On a CPU the fused kernel passes over an image in one item; on CUDA each patch is an item. Its cells are those
of the twin, except for patches and points within rounding of the side of a cell; sums differ by rounding.
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
_COLUMNS = """
            for (int u = 0; u < PATCH; ++u) of_columns[u] = (vec)(0.0);
#if !defined(__CUDA_ARCH__)
            if (full && column_step == 1) {  // column u of eight patches, from four vectors of columns
                typedef KIND loose __attribute__((ext_vector_type(8), aligned(alignof(KIND))));
                vec x[4];
                const loose* given = (const loose*)(corner + v * row_step);
                for (int i = 0; i < 4; ++i) {
                    x[i] = __builtin_convertvector(given[i], vec);
                    if (row + 2 * PATCH > n_rows) continue;
                    __builtin_prefetch(corner + (v + PATCH) * row_step + LANES * i);
                }
                const vec a0 = __builtin_shufflevector(x[0], x[1], 0, 4, 8, 12, 1, 5, 9, 13);
                const vec a1 = __builtin_shufflevector(x[2], x[3], 0, 4, 8, 12, 1, 5, 9, 13);
                const vec a2 = __builtin_shufflevector(x[0], x[1], 2, 6, 10, 14, 3, 7, 11, 15);
                const vec a3 = __builtin_shufflevector(x[2], x[3], 2, 6, 10, 14, 3, 7, 11, 15);
                of_columns[0] = __builtin_shufflevector(a0, a1, 0, 1, 2, 3, 8, 9, 10, 11);
                of_columns[1] = __builtin_shufflevector(a0, a1, 4, 5, 6, 7, 12, 13, 14, 15);
                of_columns[2] = __builtin_shufflevector(a2, a3, 0, 1, 2, 3, 8, 9, 10, 11);
                of_columns[3] = __builtin_shufflevector(a2, a3, 4, 5, 6, 7, 12, 13, 14, 15);
            } else
#endif
            for (int u = 0; u < PATCH; ++u)
                for (int l = 0; l < LANES; ++l) {
                    const int64_t place = PATCH * l + u;
                    if (full || column + place < n_columns)
                        set(of_columns[u], l, (double)corner[v * row_step + place * column_step]);
                }
"""
_BODY = """
    // Patches item, item + n_items, ... of an image, LANES side by side.
    const double *a = view, *b = view + 3, *c = view + 6, *t = view + 9;
    double now[3] = {0.5, 0.5, 0.5};
    int64_t number = -1;
    bool overflows = *n_cells > max_cells;
    // The number of a cell, or -1 beyond max_cells.
    auto number_of = [&](const double* cell) {
        int64_t key = 0;
        for (int i = 0; i < 3; ++i) key = (key << KEY_BITS) | (int64_t)(cell[i] + REACH);
        uint64_t hash = (uint64_t)key * 0x9E3779B97F4A7C15ull;
        int64_t at = (int64_t)((hash ^ (hash >> 32)) & (uint64_t)(n_places - 1));
#if defined(__CUDA_ARCH__)
        // The number is the place: threads claim places of `keys`, which are -1 as long as they are free.
        typedef unsigned long long word;
        for (int64_t tried = 0; tried < n_places; ++tried, at = (at + 1) & (n_places - 1)) {
            const int64_t found = (int64_t)atomicCAS((word*)(keys + at), ~0ull, (word)key);
            if (found == key) return at;
            if (found < 0) return (int64_t)atomicAdd((word*)n_cells, 1ull) < max_cells ? at : (int64_t)-1;
        }
        atomicAdd((word*)n_cells, (word)max_cells + 1);
        return (int64_t)-1;
#else
        // Cells are numbered in the order of their first points. A free place holds -1.
        while (places[at] >= 0 && keys[places[at]] != key) at = (at + 1) & (n_places - 1);
        if (places[at] >= 0) return (int64_t)places[at];
        if (*n_cells >= max_cells) {
            *n_cells = max_cells + 1;
            return (int64_t)-1;
        }
        const int64_t made = (*n_cells)++;
        places[at] = (int32_t)made;
        keys[made] = key;
        for (int f = 0; f < WIDTH; ++f) sums[made * WIDTH + f] = 0.0;
        for (int64_t i = 0; i < n_images; ++i) counts[made * n_images + i] = 0.0;
        return made;
#endif
    };
    // Adds n points in a cell, with these sums of features about its corner.
    auto add = [&](const double* cell, double n, const double* features) {
        if (cell[0] != now[0] || cell[1] != now[1] || cell[2] != now[2]) {
            for (int i = 0; i < 3; ++i) now[i] = cell[i];
            number = number_of(cell);
            overflows = overflows || number < 0;
        }
        if (overflows) return;
        GMM_ADD(sums + number * WIDTH, n);
        for (int f = 1; f < WIDTH; ++f) GMM_ADD(sums + number * WIDTH + f, features[f]);
        GMM_ADD(counts + number * n_images + image, n);
    };
    const int64_t n_across = (n_columns + PATCH * LANES - 1) / (PATCH * LANES);
    const int64_t n_blocks = n_across * ((n_rows + PATCH - 1) / PATCH);
    for (int64_t block = item; block < n_blocks && !overflows; block += n_items) {
        const int64_t row = PATCH * (block / n_across), column = PATCH * LANES * (block % n_across);
        const auto* corner = depth + row * row_step + column * column_step;
        const int64_t n_rows_here = GMM_MIN((int64_t)PATCH, n_rows - row);
        const bool full = column + PATCH * LANES <= n_columns;
        vec n = (vec)(0.0), near = (vec)(1e300), far = (vec)(0.0);
        vec s[3], m[6];  // sums of z, uz, vz, and of zz, uzz, vzz, uuzz, uvzz, vvzz
        for (int f = 0; f < 3; ++f) s[f] = (vec)(0.0);
        for (int f = 0; f < 6; ++f) m[f] = (vec)(0.0);
        for (int64_t v = 0; v < n_rows_here; ++v) {
            vec z0 = (vec)(0.0), z1 = z0, y0 = z0, y1 = z0, y2 = z0;
            vec of_columns[PATCH];
            COLUMNS
            for (int u = 0; u < PATCH; ++u) {
                vec z = of_columns[u];
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
        const mask is_whole = (far - near <= deepest) & (far <= farthest_whole) & (n > 0.0);
        const vec whole = is_whole ? (vec)(1.0) : (vec)(0.0);
        vec ray[3], lane, first[3], second[6], shift[3], cell[3], features[WIDTH], beyond = (vec)(0.0);
        for (int l = 0; l < LANES; ++l) set(lane, l, (double)(column + PATCH * l));
        for (int i = 0; i < 3; ++i) {
            ray[i] = a[i] + lane * b[i] + (double)row * c[i];
            first[i] = ray[i] * s[0] + b[i] * s[1] + c[i] * s[2];
            const vec mean = first[i] / n + t[i];
            cell[i] = down(mean);
            shift[i] = t[i] - cell[i];
            const mask within = (mean > -REACH) & (mean < REACH);
            beyond = within ? beyond : (vec)(1.0);
            features[1 + i] = first[i] + n * shift[i];
        }
        overflows = overflows || any((beyond > 0.0) & is_whole);
        if (overflows) break;
        for (int j = 0; j < 3; ++j) {
            const vec z = m[0] * ray[j] + m[1] * b[j] + m[2] * c[j];
            const vec u = m[1] * ray[j] + m[3] * b[j] + m[4] * c[j];
            const vec v = m[2] * ray[j] + m[4] * b[j] + m[5] * c[j];
            for (int i = 0; i <= j; ++i) second[i * (5 - i) / 2 + j] = ray[i] * z + b[i] * u + c[i] * v;
        }
        for (int i = 0, f = 4; i < 3; ++i)
            for (int j = i; j < 3; ++j, ++f)
                features[f] = second[f - 4] + first[i] * shift[j] + shift[i] * features[1 + j];
        for (int l = 0; l < LANES && !overflows; ++l) {
            if (get(n, l) == 0.0) continue;
            double p[WIDTH], corner_of[3];
            if (get(whole, l) > 0.0) {
                for (int i = 0; i < 3; ++i) corner_of[i] = get(cell[i], l);
                for (int f = 1; f < WIDTH; ++f) p[f] = get(features[f], l);
                add(corner_of, get(n, l), p);
                continue;
            }
            const int64_t begin = PATCH * l, end = GMM_MIN(begin + PATCH, n_columns - column);
            for (int64_t v = 0; v < n_rows_here && !overflows; ++v)
            for (int64_t u = begin; u < end && !overflows; ++u) {
                const double z = (double)corner[v * row_step + u * column_step];
                if (!(z > 0.0 && z < max_range)) continue;
                double x[3];
                for (int i = 0; i < 3; ++i) {
                    const double q = z * (a[i] + (double)(column + u) * b[i] + (double)(row + v) * c[i]);
                    const double at = q + t[i];
                    if (!(fabs(at) < REACH)) overflows = true;
                    corner_of[i] = floor(at);
                    x[i] = p[1 + i] = q + (t[i] - corner_of[i]);
                }
                for (int i = 0, f = 4; i < 3; ++i)
                    for (int j = i; j < 3; ++j, ++f) p[f] = x[i] * x[j];
                if (!overflows) add(corner_of, 1.0, p);
            }
        }
    }
    if (overflows) *n_cells = max_cells + 1;
"""
_KERNELS = {
    dtype: FusedKernel(
        f"depth_cells_{kind}",
        f"const {kind}* depth, int64 n_rows, int64 n_columns, int64 row_step, int64 column_step,"
        " const double* view, double max_range, double deepest, double farthest_whole, int64 image,"
        " int64 n_images, int64 n_items, int64 max_cells, int64 n_places, int32* places, int64* keys,"
        " double* sums, double* counts, int64* n_cells",
        SIMD
        + _BODY.replace("COLUMNS", _COLUMNS.replace("KIND", kind))
        .replace("KEY_BITS", str(KEY_BITS))
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
    if is_fused(*(view.depth for view in views)):
        return _fused(views, side, max_cells)
    return _batched(views, side, max_cells)


def _limits(view: DepthView, side: float) -> tuple[float, float]:
    """The largest difference of depth of a whole patch, and its largest depth, in metres."""
    return side, 1 / (PATCH * view.pitch)


def _fused(views: Sequence[DepthView], side: float, max_cells: int) -> DepthCells | None:
    device, on_cpu = views[0].depth.device, views[0].depth.device.type == "cpu"
    n_places = 1 << (2 * max_cells).bit_length()
    places = torch.full((n_places,), -1, dtype=torch.int32) if on_cpu else None
    n_rows = max_cells if on_cpu else n_places  # on CUDA the place of a cell is its number
    keys = torch.empty(n_rows, dtype=torch.int64) if on_cpu else torch.full((n_rows,), -1, device=device)
    make = torch.empty if on_cpu else torch.zeros
    sums = make(n_rows, _WIDTH, dtype=torch.float64, device=device)
    counts = make(n_rows, len(views), dtype=torch.float64, device=device)
    n_cells = torch.zeros(1, dtype=torch.int64, device=device)
    tables = max_cells, n_places, places, keys, sums, counts, n_cells
    for image, view in enumerate(views):
        depth = view.depth
        height, width = depth.shape
        n_items = 1 if on_cpu else -(-height // PATCH) * -(-width // PATCH)
        rays, sizes = view.rays.to(device).contiguous(), (height, width, *depth.stride())
        given = rays, view.max_range, *_limits(view, side), image, len(views), n_items
        _KERNELS[depth.dtype](n_items, depth, *sizes, *given, *tables, device=device)
    found = int(n_cells)
    if found > max_cells:
        return None
    used = torch.arange(found) if on_cpu else (keys >= 0).nonzero().squeeze(1)
    order = used[keys[used].argsort()]
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
