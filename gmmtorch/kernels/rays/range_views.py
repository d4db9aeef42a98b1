"""How points agree with range images: which are in front of the surfaces, and which no image shows.

`localization.local_map.FreeSpace` has the twin, which lists every point in every image under every motion.
"""

from __future__ import annotations

from torch import Tensor

from gmmtorch.kernels.compiler import templated

_VIEWS = templated("rays/range_views.h", "range_views", (2, 3))


def range_views(
    points: Tensor,
    motions: tuple[Tensor, Tensor],
    frames: tuple[Tensor, Tensor],
    images: tuple[Tensor, Tensor],
    size: tuple[int, int],
    limits: tuple[float, float, float],
) -> tuple[Tensor, Tensor]:
    """Numbers (B,), float64, of the points (N, D) under each of B motions that are in front of the surface of
    any image, and of those that no image shows.

    Args:
        motions: rotations (B, D, D) and translations (B, D), world ← points. frames: of the images,
            (K, D, D) and (K, D), image ← world.
        images: nearest and farthest return (K, C) in each cell, metres; infinity and zero without.
        size: columns and rows of cells. limits: side of a cell (rad); metres, and share of the range, that a
            point may be in front of or behind a surface.

    A point differs from the twin's only if it meets an edge of a cell, or a surface's margin, within
    rounding.
    """
    n, dim = motions[1].shape
    counts = points.new_empty(n, 2)
    given = points.T, len(points), *motions, *frames, len(images[0]), *images
    _VIEWS[dim](n, *given, *size, *limits, counts)
    free, unknown = counts.unbind(1)
    return free, unknown
