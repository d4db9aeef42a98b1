"""Evidence of components in the cells of a box, from the rays that `component_rays` draws."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.kernels import THINNING, Seen, cast_components, is_fused
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.rays.component_rays import RayDensity, counted_viewpoints, drawn_rays, ray_numbers
from gmmtorch.occupancy import (
    Box,
    CellEvidence,
    RayBundle,
    cast_evidence,
    intersection,
    near_interval,
    sum_evidence,
)

_MOST_DRAWS = 1 << 19  # draws at a time, about 250 bytes each
_FARTHEST = 2.0**31  # cells from the world's origin
_MOST_CELLS = 1 << 23  # of the window of the fused kernel, 16 bytes each


def component_evidence(
    components: Components,
    resolution: float,
    box: Box,
    *,
    rays_per_cell: float = 4.0,
    least: int = 8,
    most: int = 512,
    cutoff: float = 2.5,
    shell: float = 0.0,
    hits_per_ray: int = 1,
    thinned: bool = False,
    empty_rays_per_cell: float | None = None,
    empty_cutoff: float | None = None,
) -> CellEvidence:
    """Evidence of components in the cells of a box, from their rays.

    Viewpoints whose rays cannot reach the box are skipped, which does not change the result. Rays are
    drawn in portions, which bounds the memory.

    rays_per_cell, least, most, cutoff: see `component_rays`.
    shell: cells. Within this distance of its component's surface a ray adds no misses. Otherwise rays at flat
        angles add misses to the cells that contain the surface, and most cells of a floor become free. 0
        is the thesis's choice.
    hits_per_ray: number of points drawn for each ray. Points are cheap compared with ray traversal, and the
        hits, few for each cell, are the noisy part.
    thinned: in the first half of the way, follow only a quarter of a viewpoint's rays, with four times the
        weight. Rays converge toward the sensor, so they are as dense there as at the end, at half the work.
    empty_rays_per_cell, empty_cutoff: `rays_per_cell` and `cutoff` of components of no-return beams, if they
        differ.
    """
    check_whole("hits_per_ray", hits_per_ray, 1)
    if not 0 <= shell < math.inf:
        raise InvalidArgumentError(f"shell={shell} must be finite, at least zero cells.")
    density = RayDensity(resolution, rays_per_cell, least, most, cutoff)
    of_empty = RayDensity(
        resolution,
        rays_per_cell if empty_rays_per_cell is None else empty_rays_per_cell,
        least,
        most,
        cutoff if empty_cutoff is None else empty_cutoff,
    )
    seen = counted_viewpoints(components, resolution)
    if is_fused(components.means, box.low):
        found = _fused(components, seen, box, (density, of_empty), shell, hits_per_ray, thinned)
        if found is not None:
            return found
    if density == of_empty:
        return _drawn(components, seen, box, density, shell, hits_per_ray, thinned)
    is_empty = components.max_range[components.seen_by[seen]]
    return sum_evidence(
        _drawn(components, seen[chosen], box, each, shell, hits_per_ray, thinned)
        for chosen, each in ((~is_empty, density), (is_empty, of_empty))
    )


def _drawn(
    components: Components,
    seen: Tensor,
    box: Box,
    density: RayDensity,
    shell: float,
    hits_per_ray: int,
    thinned: bool,
) -> CellEvidence:
    """`component_evidence` of the viewpoints `seen` (C,), from a list of their rays."""
    seen = seen[_in_reach(components, seen, box, density)]
    # If a component's points cannot be in the box, only its passing rays matter.
    ends_here = (
        _in_reach(components, seen, box, density, ends_only=True)
        & ~components.max_range[components.seen_by[seen]]
    )
    times = torch.where(ends_here, hits_per_ray, 1)
    number = ray_numbers(components, seen, density)
    parts = [
        _evidence(components, seen[some], box, density, number[some], times[some], shell, thinned)
        for some in _portions(number * times)
    ]
    return parts[0] if len(parts) == 1 else sum_evidence(parts)


def _fused(
    components: Components,
    seen: Tensor,
    box: Box,
    densities: tuple[RayDensity, RayDensity],
    shell: float,
    hits_per_ray: int,
    thinned: bool,
) -> CellEvidence | None:
    """`component_evidence` by the fused kernel; None for input that the twin corrects, refuses or splits."""
    if len(seen) == 0:
        return CellEvidence.empty(seen.device)
    density, of_empty = densities
    cutoff = torch.where(components.max_range, of_empty.cutoff, density.cutoff)
    extent = _extent(components, seen, cutoff, density.resolution)
    if extent is None:
        return None
    window = intersection(box, extent)
    if window is None:
        return CellEvidence.empty(seen.device)
    if math.prod(window.shape) > _MOST_CELLS:
        return None
    count = components.seen_count[seen].double()
    found = cast_components(
        components.means.double(),
        components.covariances.double(),
        components.origins.double(),
        components.max_range,
        components.ids,
        Seen(components.seen_by[seen], components.seen_from[seen], count),
        torch.stack([*box, *window]).double(),
        resolution=density.resolution,
        rays_per_cell=(density.rays_per_cell, of_empty.rays_per_cell),
        least=density.least,
        most=density.most,
        cutoff=(density.cutoff, of_empty.cutoff),
        shell=shell * density.resolution,
        hits_per_ray=hits_per_ray,
        thinned=thinned,
    )
    return None if found is None else CellEvidence.from_dense(window.low, *found)


def _extent(components: Components, seen: Tensor, cutoff: Tensor, resolution: float) -> Box | None:
    """Cells that the rays of the viewpoints `seen` (C,) can meet; None if they are too far away.

    Args:
        cutoff: (K,), deviations.
    """
    means, origins = components.means.double(), components.origins.double()
    spread = cutoff[:, None] * components.covariances.double().diagonal(dim1=1, dim2=2).sqrt()
    corners = torch.cat([means - spread, means + spread, origins[components.seen_from[seen]]])
    cells = (corners / resolution).floor().nan_to_num(math.inf)
    if not bool(cells.abs().max() < _FARTHEST):
        return None
    cells = cells.long()
    return Box(cells.amin(0) - 1, cells.amax(0) + 2)


def _portions(draws: Tensor) -> Iterator[slice]:
    """Consecutive viewpoints (C,) with at most `_MOST_DRAWS` draws, or a single one; one empty slice if C
    = 0.
    """
    so_far, begin = torch.cumsum(draws, 0), 0
    while begin < len(draws) or begin == 0:
        room = int(so_far[begin] - draws[begin]) + _MOST_DRAWS if len(draws) else 0
        end = max(begin + 1, int(torch.searchsorted(so_far, room, right=True)))
        yield slice(begin, end)
        begin = end


def _evidence(
    components: Components,
    seen: Tensor,
    box: Box,
    density: RayDensity,
    number: Tensor,
    times: Tensor,
    shell: float,
    thinned: bool,
) -> CellEvidence:
    """`component_evidence` of the viewpoints `seen` (C,), with `number` (C,) rays and `times` as many
    hits.
    """
    resolution = density.resolution
    drawn, viewpoint, followed = drawn_rays(components, seen, density, number, times)
    rays, viewpoint = RayBundle(*(field[followed] for field in drawn)), viewpoint[followed]
    stops, weights = rays.ends, rays.weights * times[viewpoint]
    if shell > 0:
        stops = _before_surface(components, components.seen_by[seen][viewpoint], rays, shell * resolution)
    starts = rays.origins
    if thinned:
        starts, stops, weights = _thinned(starts, stops, weights, viewpoint)
    passing = torch.zeros_like(weights, dtype=torch.bool)
    struck = drawn.ends[drawn.is_hit], drawn.weights[drawn.is_hit]
    return cast_evidence(starts, stops, passing, resolution, box, weights, hit_places=struck)


def _thinned(
    starts: Tensor, stops: Tensor, weights: Tensor, viewpoint: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The second halves of rays (R,), sorted by viewpoint, and the first halves of a quarter of them.

    The first half ends where the second begins, in a cell that only the second half counts as left.
    """
    n_each = torch.bincount(viewpoint)
    n_some = (n_each + THINNING - 1) // THINNING
    number = torch.arange(len(viewpoint), device=viewpoint.device)
    number = number - (torch.cumsum(n_each, 0) - n_each)[viewpoint]
    # The first points of a Sobol sequence fill the cube; every fourth point would fill one corner.
    some = (number < n_some[viewpoint]).nonzero().squeeze(1)
    for_how_many = (n_each / n_some.clamp_min(1))[viewpoint[some]]
    middle = starts + 0.5 * (stops - starts)
    return (
        torch.cat([middle, starts[some]]),
        torch.cat([stops, middle[some]]),
        torch.cat([weights, weights[some] * for_how_many]),
    )


def _before_surface(components: Components, of: Tensor, rays: RayBundle, distance: float) -> Tensor:
    """Points (R, 3) where rays of components `of` (R,) come within `distance` (m) of the surface of their
    end: the plane through the end, normal to the thinnest direction of the component."""
    used, row = torch.unique(of, return_inverse=True)
    thinnest = torch.linalg.eigh(components.covariances[used].double()).eigenvectors[:, :, 0]
    way = rays.ends - rays.origins
    closing = (thinnest[row] * way).sum(1).abs()
    share = (distance / closing.clamp_min(torch.finfo(closing.dtype).tiny)).clamp_max(1)
    return rays.ends - torch.where(rays.is_hit, share, 0.0)[:, None] * way


def _in_reach(
    components: Components, seen: Tensor, box: Box, density: RayDensity, ends_only: bool = False
) -> Tensor:
    """Which of the viewpoints `seen` (C,) may have rays that reach the box, or that end in it."""
    by = components.seen_by[seen]
    spread = density.cutoff * components.covariances.double().diagonal(dim1=1, dim2=2).sqrt()
    low, high = components.means.double() - spread, components.means.double() + spread
    origins = components.origins.double()[components.seen_from[seen]]
    scale = 1 / density.resolution
    # The margin of half a cell covers the rounding of the draws.
    first, last = near_interval(origins * scale, low[by] * scale, high[by] * scale, box)
    return (first <= last) & (last >= 1) if ends_only else first <= last
