"""Cells: sums of the points or of the depth images in them, numbers of distinct cells, and flat pieces of
cells.

The twins of `cell_moments` and `piece_cuts` are in `mixture.em.partition`, that of `distinct_keys` in
`gmmtorch.linalg`, whose fused kernel runs on the CPU. Pieces are cut for all levels in one launch.

A pixel (u, v) of depth z sees the point z (a + u b + v c) + t. All moments of a patch of 4 × 4 pixels are
therefore sums of z and z², multiplied by u, v and their products. A patch that is smaller than a cell, across
the view and in depth, is added to the cell that contains its mean. The pixels of any other patch are added
one by one. The points themselves are never stored. One launch passes over all images: in one item on a CPU;
on CUDA each patch is an item.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel, Team, buffers, templated

KEY_BITS = 20
"""Bits of one cell coordinate in a key, as in `cells.h`."""
REACH = float(1 << (KEY_BITS - 1))
"""Cells from the reference point, along each axis, in which points of depth images can lie."""
PATCH = 4
"""Side of a patch in pixels, as in `depth_cells.h`."""

_WIDTH = 10  # features in 3D
_DISTINCT = FusedKernel("mixtures/cells.h", "distinct_keys", shares=True)
_MOMENTS = templated("mixtures/cells.h", "cell_moments", (1, 2, 3), shares=True)
_REAL = torch.float32, torch.float64
_DEPTHS = templated("mixtures/depth_cells.h", "depth_cells", _REAL, shares=True)
_RANGES = templated("mixtures/depth_cells.h", "range_sums", _REAL)
_VALUES = templated("mixtures/cells.h", "value_sums", _REAL, shares=True)
_CURVE = templated("mixtures/cells.h", "curve_keys", (1, 2, 3), rounds_each=True)
_MEANS = FusedKernel("mixtures/cells.h", "mean_features")
_MOST_CELLS_ON_GPU = 1 << 18
_FACTORS = np.array([2 ** (-step / 3) for step in range(3 * KEY_BITS + 7)])
_ORDERED = FusedKernel("mixtures/depth_cells.h", "ordered_cells")
_FEATURES = FusedKernel("mixtures/depth_cells.h", "cell_features", rounds_each=True)


def distinct_keys(keys: Tensor) -> tuple[Tensor, Tensor]:
    """The distinct keys (C,) of `keys` (N,), int64, in the order of their first occurrence; and the index
    (N,) of each key among them.
    """
    keys, n = keys.contiguous(), keys.shape[0]
    n_places = 1 << (2 * n).bit_length()
    place = torch.full((n_places,), -1, dtype=torch.int64)
    distinct = torch.empty_like(keys)
    number = torch.empty_like(keys)
    n_distinct = torch.zeros(1, dtype=torch.int64)
    _DISTINCT(1, keys, n, place, n_places, distinct, number, n_distinct)
    return distinct[: int(n_distinct)], number


def curve_keys(points: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """The places (N,), int16, of points (N, D), float64, D ≤ 3, on a curve through the box from `low` to
    `high` (D,). The twin is in `gmmtorch.linalg`, to the bit."""
    keys = torch.empty(len(points), dtype=torch.int16, device=points.device)
    _CURVE[points.shape[1]](len(points), points, low, high, keys)
    return keys


def are_cell_moments_fused(points: Tensor, weight: Tensor | None, max_cells: int) -> bool:
    """Whether the fused kernel sums these points. On a GPU its table has at most 400 bytes a
    cell."""
    fits = points.device.type == "cpu" or min(len(points), max_cells) <= _MOST_CELLS_ON_GPU
    return fits and is_fused(points, *([] if weight is None else [weight]))


def cell_moments(
    points: Tensor,
    weight: Tensor | None,
    box: tuple[Tensor, Tensor],
    finest: float,
    most_along: int,
    max_cells: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """The mean quadratic features (C, F) of points (N, D) in at most `max_cells` cells, the weight (C,) of
    each cell, and the cell (N,) of each point.

    Cells are in the order of their keys. The cell of a point x is ⌊(x − low)/side · 2^(−steps/3)⌋, with the
    least side from `finest` on of which `most_along` cells hold all points, and as few steps as `max_cells`
    allows.

    Args:
        points, weight: (N, D) and (N,), float64; None: one. box: lowest and highest coordinates (D,).
    """
    (n, dim), device, on_cpu = points.shape, points.device, points.device.type == "cpu"
    most, width = min(n, max_cells), 1 + dim + dim * (dim + 1) // 2
    n_places = 1 << (2 * most).bit_length()
    n_rows = most if on_cpu else n_places  # on CUDA the place of a cell is its number
    places = torch.empty(n_places, dtype=torch.int32) if on_cpu else None
    whole = torch.empty(2 * n_rows + n + 1, dtype=torch.int64, device=device)
    keys, rank, member, n_cells = whole.split((n_rows, n_rows, n, 1))
    sums, team = points.new_zeros(n_rows, width), Team.of(device)
    factors = torch.from_numpy(_FACTORS).to(device, non_blocking=True)
    given = points, weight, n, *box
    sizes = finest, most_along, factors, max_cells, n_places
    _MOMENTS[dim](team.n, *team, *given, *sizes, places, keys, member, sums, n_cells)
    found = int(n_cells)
    order = keys[:found].argsort() if on_cpu else keys.argsort()[n_rows - found :]  # a free place holds -1
    made = sums.new_empty(found * (width + 1))
    features, mass = made[: found * width].view(found, width), made[found * width :]
    _MEANS(found, order, sums, width, features, mass, rank)
    return features, mass, rank[member]


def value_sums(values: Tensor, member: Tensor, n_cells: int, middle: Tensor) -> Tensor | None:
    """Of the values (N, A) of points, less `middle` (A,), the number, the sums, and the sums of products of
    columns i ≤ j, in each of C cells: (C, 1 + A + A(A+1)/2); None without a fused kernel. Points whose values
    are not all finite add nothing. member: (N,) the cell of each point. The twin is in
    `mapping.attributes.moments`; sums differ by rounding."""
    if not is_fused(values, member, middle) or values.dtype not in _REAL:
        return None
    n, columns = values.shape
    width = 1 + columns + columns * (columns + 1) // 2
    sums = torch.zeros(n_cells, width, dtype=torch.float64, device=values.device)
    _VALUES[values.dtype](n, values, columns, member, middle, sums)
    return sums


class DepthCells(NamedTuple):
    """C cells in the order of their keys, and the points in them.

    corners (C, 3): lowest corner of each cell, in cells. sums (C, 10): quadratic features of the points
    relative to that corner. counts (C, S): points of each image.
    """

    corners: Tensor
    sums: Tensor
    counts: Tensor


class DepthViews(NamedTuple):
    """S depth images, and how their pixels lie in space.

    depths: (H, W) each, float32 or float64, metres along the optical axis, with any strides. rays (S, 4, 3):
    in cells, the ray of pixel (0, 0) at a depth of one metre, its steps from column to column and from row to
    row, and the camera, relative to the reference point. pitch (S,): the distance between the rays of
    neighbouring pixels at a depth of one metre, in cells; the larger one of rows and columns. max_range (S,):
    pixels at or beyond it (m) are left out.
    """

    depths: Sequence[Tensor]
    rays: np.ndarray
    pitch: np.ndarray
    max_range: np.ndarray


def depth_cells(views: DepthViews, side: float, max_cells: int) -> DepthCells | None:
    """The points of S depth images, summed into cells of `side` metres around a reference point.

    Pixels are left out if they are not above zero, not below `max_range`, or not finite. Returns None if
    there are more than `max_cells`, or if a patch or point is `REACH` cells or more away from the reference
    point along an axis.
    """
    if is_fused(*views.depths):
        return _fused(views, side, max_cells)
    return _batched(views, side, max_cells)


def _fused(views: DepthViews, side: float, max_cells: int) -> DepthCells | None:
    limits = np.stack([views.max_range, *_limits(views.pitch, side)], 1)
    n, given = len(views.depths), np.concatenate([views.rays.reshape(-1, 12), limits], 1)
    depths, rows = _rows_of(views.depths, given)
    device, on_cpu = rows.device, rows.device.type == "cpu"
    n_places = 1 << (2 * max_cells).bit_length()
    places = np.full(n_places, -1, np.int32) if on_cpu else None
    n_rows = max_cells if on_cpu else n_places  # on CUDA the place of a cell is its number
    sums, counts = buffers(device, torch.float64, (n_rows * _WIDTH, n_rows * n), is_zero=not on_cpu)
    (n_cells,) = buffers(device, torch.int64, (1,), is_zero=True)
    keys = np.empty(n_rows, np.int64) if on_cpu else torch.full((n_rows,), -1, device=device)
    n_items = 1 if on_cpu else max(-(-h // PATCH) * -(-w // PATCH) for h, w in (d.shape for d in depths))
    tables = max_cells, n_places, places, keys, sums, counts, n_cells
    _DEPTHS[depths[0].dtype](1 if on_cpu else n * n_items, rows, n, n_items, *tables)
    found = int(n_cells[0])
    if found > max_cells:
        return None
    order = keys[:found].argsort() if on_cpu else keys.argsort()[n_rows - found :]  # a free place holds -1
    made = torch.empty(found * (3 + _WIDTH + n), dtype=torch.float64, device=device)
    parts = made.split([found * width for width in (3, _WIDTH, n)])
    _ORDERED(found, order, keys, sums, counts, n, *parts)
    corners, features, numbers = parts
    return DepthCells(corners.view(found, 3), features.view(found, _WIDTH), numbers.view(found, n))


def _rows_of(depths: Sequence[Tensor], given: np.ndarray) -> tuple[Sequence[Tensor], Tensor]:
    """Images (H, W) of one type; and rows (S, 5 + n) of eight bytes for kernels: the address, shape and
    strides of each, and the numbers `given` (S, n) for it."""
    if len({depth.dtype for depth in depths}) > 1:
        depths = [depth.double() for depth in depths]
    rows = np.empty((len(depths), 5 + given.shape[1]))
    rows.view(np.int64)[:, :5] = [(depth.data_ptr(), *depth.shape, *depth.stride()) for depth in depths]
    rows[:, 5:] = given
    return depths, torch.from_numpy(rows).view(torch.int64).to(depths[0].device, non_blocking=True)


def range_sums(depths: Sequence[Tensor], camera: np.ndarray, max_range: np.ndarray) -> Tensor | None:
    """The sum of the ranges of the pixels of S depth images (m), and their number (2,); None without a fused
    kernel. The twin is `DepthFrame.ranges`. camera: f_x, f_y, c_x, c_y (S, 4). max_range: (S,)."""
    if not is_fused(*depths):
        return None
    depths, rows = _rows_of(depths, np.concatenate([camera, max_range[:, None]], 1))
    n_items = max(len(depth) for depth in depths)
    sums = torch.empty(len(depths) * n_items, 2, dtype=torch.float64, device=rows.device)
    _RANGES[depths[0].dtype](len(sums), rows, n_items, sums)
    return sums.sum(0)


def _limits(pitch: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray]:
    """The largest difference of depth of a whole patch, and its largest depth, in metres."""
    return np.full_like(pitch, side), 1 / (PATCH * pitch)


def cell_features(cells: DepthCells, center: Tensor, side: float) -> Tensor | None:
    """Mean features (C, 10) of cells about a center (3,), given in cells, in metres; None without a fused
    kernel. The twin is in `mapping.learning.fitting`, to the bit."""
    if not is_fused(*cells, center):
        return None
    features = torch.empty_like(cells.sums)
    _FEATURES(len(features), cells.corners, cells.sums, center, side, features)
    return features


def _corners(keys: Tensor) -> Tensor:
    whole = torch.stack([keys >> (2 * KEY_BITS), keys >> KEY_BITS, keys], 1) & ((1 << KEY_BITS) - 1)
    return whole.double() - REACH


def _batched(views: DepthViews, side: float, max_cells: int) -> DepthCells | None:
    """The twin."""
    limits = zip(*(values.tolist() for values in _limits(views.pitch, side)), strict=True)
    numbers = torch.from_numpy(views.rays), views.max_range.tolist(), limits
    placed = [_placed(*view) for view in zip(views.depths, *numbers, strict=True)]
    if not bool(torch.stack([inside for *_, inside in placed]).all()):
        return None
    keys = torch.cat([_pack(cell, valid) for _, cell, valid, _ in placed])
    unique, member = torch.unique(keys, return_inverse=True)
    n_cells = len(unique)
    sums = torch.zeros(n_cells, _WIDTH, dtype=torch.float64, device=keys.device)
    counts = torch.zeros(len(placed), n_cells, dtype=torch.float64, device=keys.device)
    parts = member.split([valid.numel() for _, _, valid, _ in placed])
    for (points, cell, valid, _), count, part in zip(placed, counts, parts, strict=True):
        weight = valid.double()
        count.index_add_(0, part, weight)
        sums.index_add_(0, part, _features(points - cell) * weight[:, None])
    used = (sums[:, 0] > 0).nonzero().squeeze(1)  # pixels that are left out have a cell of their own
    if len(used) > max_cells:
        return None
    return DepthCells(_corners(unique[used]), sums[used], counts.T[used])


def _placed(
    depth: Tensor, given: Tensor, max_range: float, limits: tuple[float, float]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points (N, 3) and their cells (N, 3), in cells, of all pixels; which of them are valid (N,); and
    whether all valid ones are within reach."""
    height, width = depth.shape
    padded = torch.nn.functional.pad(depth, (0, -width % PATCH, 0, -height % PATCH)).double()
    z = padded.unflatten(1, (-1, PATCH)).unflatten(0, (-1, PATCH)).transpose(1, 2).flatten(0, 1).flatten(1)
    valid = (z > 0) & (z < max_range) & torch.isfinite(z)
    z = torch.where(valid, z, 0.0)  # (patches, pixels)
    ray, across, down, camera = given.to(z.device)
    u, v = (torch.arange(n, dtype=z.dtype, device=z.device) for n in (padded.shape[1], padded.shape[0]))
    rays = ray + u[:, None] * across + v[:, None, None] * down  # (H, W, 3)
    rays = (
        rays.unflatten(1, (-1, PATCH)).unflatten(0, (-1, PATCH)).transpose(1, 2).flatten(0, 1).flatten(1, 2)
    )
    points = z[..., None] * rays  # relative to the camera
    far, near = z.amax(1), torch.where(valid, z, torch.inf).amin(1)
    deepest, farthest_whole = limits
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


DIMENSIONS = (1, 2, 3)

_CUTS = templated("mixtures/piece_cuts.h", "piece_cuts", DIMENSIONS, shares=True)
_TEAM_CUTS = templated("mixtures/piece_cuts.h", "team_cuts", DIMENSIONS, shares=True)
_MOST_ON_GPU = 1 << 12  # pieces: each is compared with all others


class CutRule(NamedTuple):
    """When a piece is cut: the options of `FlatnessRule`, the most levels, and the weight of thickness in the
    priority of a cut. max_components: −1 for no limit."""

    n_levels: int
    max_components: int
    thickness: float
    length: float
    min_weight: float
    min_weight_thick: float
    outlier_gap: float
    thickness_priority: float


def are_piece_cuts_fused(points: Tensor, weight: Tensor, features: Tensor, limit: int | None) -> bool:
    """Whether the fused kernels compute with these cells, for at most `limit` pieces."""
    given = points, weight, features
    is_small = points.device.type == "cpu" or len(points) <= _MOST_ON_GPU
    fits = points.shape[1] in DIMENSIONS and (is_small or (limit or _MOST_ON_GPU) < _MOST_ON_GPU)
    return fits and all(tensor.dtype == torch.float64 for tensor in given) and is_fused(*given)


def piece_cuts(
    points: Tensor, weight: Tensor, features: Tensor, rule: CutRule, team: Team | None = None
) -> tuple[Tensor, int]:
    """The piece (N,) of each cell, and the number of pieces.

    On a GPU, sums are whole multiples of about 2⁻⁶⁰ times the sum of all absolute values, so that they do not
    depend on the order of the cells.

    Args:
        points (N, D), weight (N,), features (N, F): means, weights and mean features of the cells, float64.
            N ≥ 1.
        team: workers that share the cells; None: one on a CPU, many on a GPU.
    """
    n, width = features.shape
    most = n if rule.max_components < 0 else max(1, min(n, rule.max_components))
    given = points, features, weight, n
    if points.device.type != "cpu" or team is not None:
        return _team_cuts(given, rule, most, team)
    sizes = most * width, most * (2 * points.shape[1] + 2), most * 6, n
    work, labels = buffers(points.device, torch.float64, sizes), torch.empty(n, dtype=torch.int64)
    number, n_pieces = np.empty(most, np.int64), np.empty(1, np.int64)
    _CUTS[points.shape[1]](1, *given, *rule, *work, number, labels, n_pieces)
    return labels, int(n_pieces[0])


def _team_cuts(
    given: tuple[Tensor, Tensor, Tensor, int], rule: CutRule, most: int, team: Team | None
) -> tuple[Tensor, int]:
    """`piece_cuts` by a team, whose phases are launched one by one if it cannot wait."""
    points, features, weight, n = given
    dim, device, width = points.shape[1], points.device, features.shape[1]
    team = team or Team.of(device, n)
    bound = weight @ features.abs()
    reach = 2 * dim**0.5 * points.abs().max()
    bound = torch.cat([bound, torch.stack([bound[0], bound[0] * reach, bound[0] * reach * reach])])
    scales = torch.exp2(60 - bound.clamp_min(1e-200).log2().ceil())
    reals = (most * (2 * dim + 1), most, n)
    wholes = (most * width, most * 6, most, most, n, 4)
    work = points.new_empty(sum(reals)).split(reals)
    *tables, after = torch.zeros(sum(wholes), dtype=torch.int64, device=device).split(wholes)
    before = torch.tensor([0, 0, 1, 0]).to(device, non_blocking=True)
    is_stepped = team.arrived is None
    while True:
        phases = 1 if is_stepped else 1 << 62, before, after
        rows = *team, *given, *rule, scales, *work, *tables, *phases
        _TEAM_CUTS[dim](team.n, *rows)
        _, _, n_pieces, is_done = after.tolist()
        if is_done:
            return tables[-1], n_pieces
        before.copy_(after)
