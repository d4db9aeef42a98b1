"""Cells: sums of the points or of the depth images in them, numbers of distinct cells, and flat pieces of
cells.

The twins of `cell_moments` and `piece_cuts` are in `mixture.em.partition`, that of `distinct_keys` in
`gmmtorch.linalg`; their fused kernels run on the CPU. Cells and their numbers equal the twin's; sums differ
by rounding. Pieces are cut for all levels in one launch. They are those of the twin, except where a decision
depends on rounding: a point within rounding of a cut, or two directions of equal extent.

A pixel (u, v) of depth z sees the point z (a + u b + v c) + t. All moments of a patch of 4 × 4 pixels are
therefore sums of z and z², multiplied by u, v and their products. A patch that is smaller than a cell, across
the view and in depth, is added to the cell that contains its mean. The pixels of any other patch are added
one by one. The points themselves are never stored. On a CPU the fused kernel passes over an image in one
item; on CUDA each patch is an item. Its cells are those of the twin, except for patches and points within
rounding of the side of a cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.kernels.choice import is_fused
from gmmtorch.kernels.compiler import FusedKernel

KEY_BITS = 20
"""Bits of one cell coordinate in a key, as in `cells.h`."""
REACH = float(1 << (KEY_BITS - 1))
"""Cells from the reference point, along each axis, in which points of depth images can lie."""
PATCH = 4
"""Side of a patch in pixels, as in `depth_cells.h`."""

_WIDTH = 10  # features in 3D
_FACTORS = torch.tensor(
    [2 ** (-step / 3) for step in range(3 * KEY_BITS + 7)], dtype=torch.float64, device="cpu"
)
_DISTINCT = FusedKernel("mixtures/cells.h", "distinct_keys", shares=True)
_MOMENTS = {dim: FusedKernel("mixtures/cells.h", f"cell_moments<{dim}>", shares=True) for dim in (1, 2, 3)}
_SORTED = FusedKernel("mixtures/cells.h", "sorted_cells", shares=True)
_DEPTHS = {
    dtype: FusedKernel("mixtures/depth_cells.h", f"depth_cells<{kind}>", shares=True, strided=("depth",))
    for dtype, kind in ((torch.float32, "float"), (torch.float64, "double"))
}


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
    _DISTINCT(1, keys, n, place, n_places, distinct, number, n_distinct, device=keys.device)
    return distinct[: int(n_distinct)], number


def cell_moments(
    points: Tensor, weight: Tensor, finest: float, most_along: int, max_cells: int
) -> tuple[Tensor, Tensor, Tensor]:
    """At most `max_cells` cells of points (N, D), in the order of their keys: mean features (C, F) and weight
    (C,); and the cell (N,) of each point.

    Cells have side `finest`, or more if there were more than `most_along` along an axis. The side grows in
    steps of a third of an octave until the limit holds. The cell of x is ⌊(x − low)/side · 2^(−steps/3)⌋.

    Args:
        points, weight: (N, D) and (N,), float64, on the CPU.
    """
    n, dim = points.shape
    width, most = 1 + dim + dim * (dim + 1) // 2, min(n, max_cells)
    n_places = 1 << (2 * most).bit_length()
    places, keys, member, n_cells = torch.empty(n_places + most + n + 1, dtype=torch.int64).split(
        (n_places, most, n, 1)
    )
    sums = points.new_zeros(most, width)
    given = points.contiguous(), weight.contiguous(), n, finest, most_along, _FACTORS, max_cells, n_places
    _MOMENTS[dim](1, *given, places, keys, member, sums, n_cells, device=points.device)
    found = int(n_cells)
    made = points.new_empty(found * (width + 1))
    features, mass = made[: found * width].view(found, width), made[found * width :]
    order = keys[:found].argsort()
    _SORTED(1, order, found, width, sums, n, places, member, features, mass, device=points.device)
    return features, mass, member


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
        _DEPTHS[depth.dtype](n_items, depth, *sizes, *given, *tables, device=device)
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


DIMENSIONS = (1, 2, 3)

_CUTS = {dim: FusedKernel("mixtures/piece_cuts.h", f"piece_cuts<{dim}>", shares=True) for dim in DIMENSIONS}


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


def are_piece_cuts_fused(points: Tensor, weight: Tensor, features: Tensor) -> bool:
    """Whether the fused kernel computes with these cells."""
    given = points, weight, features
    fits = points.device.type == "cpu" and points.shape[1] in DIMENSIONS
    return fits and all(tensor.dtype == torch.float64 for tensor in given) and is_fused(*given)


def piece_cuts(points: Tensor, weight: Tensor, features: Tensor, rule: CutRule) -> tuple[Tensor, int]:
    """The piece (N,) of each cell, and the number of pieces.

    Args:
        points (N, D), weight (N,), features (N, F): means, weights and mean features of the cells, float64,
            on the CPU. N ≥ 1.
    """
    n, width = features.shape
    most = n if rule.max_components < 0 else max(1, min(n, rule.max_components))
    sums, halves = points.new_empty(most, width), points.new_empty(most, 6)
    work, along = points.new_empty(most, 2 * points.shape[1] + 2), points.new_empty(n)
    number, labels = torch.empty(most, dtype=torch.int64), torch.empty(n, dtype=torch.int64)
    n_pieces = torch.empty(1, dtype=torch.int64)
    given = points.contiguous(), features.contiguous(), weight.contiguous(), n
    made = sums, work, halves, along, number, labels, n_pieces
    _CUTS[points.shape[1]](1, *given, *rule, *made, device=points.device)
    return labels, int(n_pieces)
