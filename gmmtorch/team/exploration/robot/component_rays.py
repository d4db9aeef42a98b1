"""Rays from the sensor origins of components to points drawn from the components (thesis 3.2.3).

A viewpoint gets about `rays_per_cell` rays for each cell that its component hides from the sensor. A Gaussian
hides the area 4π √|Σ₂| (the inverse of ∫p² of its shadow p), Σ₂ its covariance across the view. Each ray has
an equal share of the viewpoint's count. End points are the first points of one Sobol sequence, rotated on the
unit cube by a hash of the component's id (Cranley and Patterson 1976), and transformed to normal draws
truncated at the radius `cutoff` (deviations). The rays of a component therefore depend only on the component,
and the rays of several batches can be added or removed one by one.

`component_evidence` counts these rays in the cells of a box.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import THINNING, cast_components, hidden_area, is_fused, truncated_normals
from gmmtorch.linalg import safe_cholesky
from gmmtorch.mapping import Components
from gmmtorch.occupancy import (
    Box,
    CellEvidence,
    RayBundle,
    cast_evidence,
    intersection,
    near_interval,
    sum_evidence,
    to_lattice,
)


@dataclass(frozen=True)
class RayRule:
    """How many rays components have, and how these are counted in cells of side `resolution` (m).

    rays_per_cell: of a viewpoint, for each cell that its component hides; `least` to `most` in all.
    cutoff: radius (deviations) at which draws are truncated.
    empty_rays_per_cell, empty_cutoff: the same of components of no-return beams; None: as the others.
    shell: cells. Within this distance of its component's surface a ray adds no misses. Otherwise rays at flat
        angles add misses to the cells that contain the surface, and most cells of a floor become free. 0
        is the thesis's choice.
    hits_per_ray: number of points drawn for each ray. Points are cheap compared with ray traversal, and the
        hits, few for each cell, are the noisy part.

    In the first half of the way, only a quarter of a viewpoint's rays are followed, with four times the
    weight. Rays converge toward the sensor, so they are as dense there as at the end, at half the work.
    """

    resolution: float
    rays_per_cell: float = 4.0
    least: int = 8
    most: int = 512
    cutoff: float = 2.5
    empty_rays_per_cell: float | None = None
    empty_cutoff: float | None = None
    shell: float = 0.0
    hits_per_ray: int = 1

    @property
    def of_empty(self) -> RayRule:
        """The rule of components of no-return beams."""
        rays, cutoff = self.empty_rays_per_cell, self.empty_cutoff
        return replace(
            self,
            rays_per_cell=self.rays_per_cell if rays is None else rays,
            cutoff=self.cutoff if cutoff is None else cutoff,
        )


def counted_viewpoints(components: Components, resolution: float) -> Tensor:
    """The viewpoints (C,) that have a count. Checks the components."""
    if components.dim != 3:
        raise InvalidArgumentError(f"components have {components.dim} dimensions; their rays need 3.")
    to_lattice(components.means, resolution, "means")
    to_lattice(components.origins, resolution, "origins")
    return (components.seen_count > 0).nonzero().squeeze(1)


def ray_numbers(components: Components, seen: Tensor, rule: RayRule) -> Tensor:
    """Number of rays (C,) of each of the viewpoints `seen` (C,)."""
    by, viewpoint = components.seen_by[seen], components.seen_from[seen]
    toward = components.means[by].double() - components.origins[viewpoint].double()
    hidden = hidden_area(toward, components.covariances[by].double()) / rule.resolution**2
    wanted = (rule.rays_per_cell * hidden).ceil().nan_to_num(0)  # NaN is refused when rays are drawn
    return wanted.clamp(rule.least, rule.most).long()


def drawn_rays(
    components: Components, seen: Tensor, rule: RayRule, once: Tensor, times: Tensor
) -> tuple[RayBundle, Tensor, Tensor]:
    """`times` · `once` rays of each viewpoint `seen` (C,); the viewpoint (R,) of each ray; and the rows
    (F,) of the first `once` rays of each viewpoint."""
    used, by = torch.unique(components.seen_by[seen], return_inverse=True)
    mean, covariance = components.means[used].double(), components.covariances[used].double()
    origin, count = (
        components.origins[components.seen_from[seen]].double(),
        components.seen_count[seen].double(),
    )
    factor = safe_cholesky(covariance)
    number = once * times
    viewpoint = torch.repeat_interleave(number)
    first = torch.cumsum(number, 0) - number
    draw = torch.arange(len(viewpoint), device=seen.device) - first[viewpoint]
    component = by[viewpoint]
    longest = rule.most * (int(times.max()) if len(times) else 1)
    normal = truncated_normals(components.ids[used], component, draw, longest, rule.cutoff)
    # Sums and products of single columns: a matrix product may round differently in another batch.
    ends = []
    for row in range(3):
        place = mean[:, row][component]
        for column in range(row + 1):
            place = place + factor[:, row, column][component] * normal[column]
        ends.append(place)
    rays = RayBundle(
        origin[viewpoint],
        torch.stack(ends, 1),
        (count / number)[viewpoint],
        ~components.max_range[used][component],
    )
    return rays, viewpoint, (draw < once[viewpoint]).nonzero().squeeze(1)


_MOST_DRAWS = 1 << 19  # draws at a time, about 250 bytes each
_FARTHEST = 2.0**31  # cells from the world's origin
_MOST_CELLS = 1 << 23  # of the window of the fused kernel, 16 bytes each


def component_evidence(components: Components, box: Box, rule: RayRule) -> CellEvidence:
    """Evidence of components in the cells of a box, from their rays.

    Viewpoints whose rays cannot reach the box are skipped, which does not change the result. Rays are
    drawn in portions, which bounds the memory. Raises `InvalidArgumentError` for components that are not in
    3D, or that are no place of the lattice.
    """
    seen = counted_viewpoints(components, rule.resolution)
    if is_fused(components.means, box.low):
        found = _fused(components, seen, box, rule)
        if found is not None:
            return found
    of_empty = rule.of_empty
    if rule == of_empty:
        return _drawn(components, seen, box, rule)
    is_empty = components.max_range[components.seen_by[seen]]
    return sum_evidence(
        _drawn(components, seen[chosen], box, each)
        for chosen, each in ((~is_empty, rule), (is_empty, of_empty))
    )


def _drawn(components: Components, seen: Tensor, box: Box, rule: RayRule) -> CellEvidence:
    """`component_evidence` of the viewpoints `seen` (C,), from a list of their rays."""
    seen = seen[_in_reach(components, seen, box, rule)]
    # If a component's points cannot be in the box, only its passing rays matter.
    ends_here = (
        _in_reach(components, seen, box, rule, ends_only=True)
        & ~components.max_range[components.seen_by[seen]]
    )
    times = torch.where(ends_here, rule.hits_per_ray, 1)
    number = ray_numbers(components, seen, rule)
    parts = [
        _evidence(components, seen[some], box, rule, number[some], times[some])
        for some in _portions(number * times)
    ]
    return parts[0] if len(parts) == 1 else sum_evidence(parts)


def _fused(components: Components, seen: Tensor, box: Box, rule: RayRule) -> CellEvidence | None:
    """`component_evidence` by the fused kernel; None for input that the twin corrects, refuses or splits."""
    if len(seen) == 0:
        return CellEvidence.empty(seen.device)
    of_empty = rule.of_empty
    cutoff = torch.where(components.max_range, of_empty.cutoff, rule.cutoff)
    extent = _extent(components, seen, cutoff, rule.resolution)
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
        (components.seen_by[seen], components.seen_from[seen], count),
        torch.stack([*box, *window]).double(),
        resolution=rule.resolution,
        rays_per_cell=(rule.rays_per_cell, of_empty.rays_per_cell),
        least=rule.least,
        most=rule.most,
        cutoff=(rule.cutoff, of_empty.cutoff),
        shell=rule.shell * rule.resolution,
        hits_per_ray=rule.hits_per_ray,
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
    components: Components, seen: Tensor, box: Box, rule: RayRule, number: Tensor, times: Tensor
) -> CellEvidence:
    """`component_evidence` of the viewpoints `seen` (C,), with `number` (C,) rays and `times` as many
    hits.
    """
    drawn, viewpoint, followed = drawn_rays(components, seen, rule, number, times)
    rays, viewpoint = RayBundle(*(field[followed] for field in drawn)), viewpoint[followed]
    stops, weights = rays.ends, rays.weights * times[viewpoint]
    if rule.shell > 0:
        stops = _before_surface(
            components, components.seen_by[seen][viewpoint], rays, rule.shell * rule.resolution
        )
    starts = rays.origins
    starts, stops, weights = _thinned(starts, stops, weights, viewpoint)
    passing = torch.zeros_like(weights, dtype=torch.bool)
    struck = drawn.ends[drawn.is_hit], drawn.weights[drawn.is_hit]
    return cast_evidence(starts, stops, passing, rule.resolution, box, weights, hit_places=struck)


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
    components: Components, seen: Tensor, box: Box, rule: RayRule, ends_only: bool = False
) -> Tensor:
    """Which of the viewpoints `seen` (C,) may have rays that reach the box, or that end in it."""
    by = components.seen_by[seen]
    spread = rule.cutoff * components.covariances.double().diagonal(dim1=1, dim2=2).sqrt()
    low, high = components.means.double() - spread, components.means.double() + spread
    origins = components.origins.double()[components.seen_from[seen]]
    scale = 1 / rule.resolution
    # The margin of half a cell covers the rounding of the draws.
    first, last = near_interval(origins * scale, low[by] * scale, high[by] * scale, box)
    return (first <= last) & (last >= 1) if ends_only else first <= last
