"""Rays from the sensor origins of components to points drawn from the components (thesis 3.2.3).

A viewpoint gets about `rays_per_cell` rays for each cell that its component hides from the sensor. A Gaussian
hides the area 4π √|Σ₂| (the inverse of ∫p² of its shadow p), Σ₂ its covariance across the view. Each ray has
an equal share of the viewpoint's count. End points are the first points of one Sobol sequence, rotated on the
unit cube by a hash of the component's id (Cranley and Patterson 1976), and transformed to normal draws
truncated at the radius `cutoff` (deviations). The rays of a component therefore depend only on the component,
and the rays of several batches can be added or removed one by one.

`component_evidence` counts these rays in the cells of a box; `MixtureTiles` finds the batches of components
whose rays may reach it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_number, check_whole
from gmmtorch.kernels import THINNING, cast_components, hidden_area, is_fused, truncated_normals
from gmmtorch.linalg import safe_cholesky
from gmmtorch.mapping import Components
from gmmtorch.occupancy import (
    Box,
    CellEvidence,
    RayBundle,
    RollingWindow,
    cast_evidence,
    check_resolution,
    cone_bounds,
    intersection,
    near_interval,
    sum_evidence,
    to_lattice,
)


class _Counting(NamedTuple):
    """How rays are counted, see `component_evidence`."""

    shell: float
    hits_per_ray: int
    thinned: bool


@dataclass(frozen=True)
class RayDensity:
    """The density of rays.

    resolution: side (m) of the cells. least, most: bounds on the number of rays of a viewpoint.
    """

    resolution: float
    rays_per_cell: float
    least: int
    most: int
    cutoff: float

    def __post_init__(self) -> None:
        check_resolution(self.resolution)
        for name in ("rays_per_cell", "cutoff"):
            check_number(name, getattr(self, name), above=True)
        if check_whole("most", self.most, 1) < check_whole("least", self.least, 1):
            raise InvalidArgumentError(f"most={self.most} must be at least least={self.least}.")


def counted_viewpoints(components: Components, resolution: float) -> Tensor:
    """The viewpoints (C,) that have a count. Checks the components."""
    if components.dim != 3:
        raise InvalidArgumentError(f"components have {components.dim} dimensions; their rays need 3.")
    to_lattice(components.means, resolution, "means")
    to_lattice(components.origins, resolution, "origins")
    return (components.seen_count > 0).nonzero().squeeze(1)


def ray_numbers(components: Components, seen: Tensor, density: RayDensity) -> Tensor:
    """Number of rays (C,) of each of the viewpoints `seen` (C,)."""
    by, viewpoint = components.seen_by[seen], components.seen_from[seen]
    toward = components.means[by].double() - components.origins[viewpoint].double()
    hidden = hidden_area(toward, components.covariances[by].double()) / density.resolution**2
    wanted = (density.rays_per_cell * hidden).ceil().nan_to_num(0)  # NaN is refused when rays are drawn
    return wanted.clamp(density.least, density.most).long()


def drawn_rays(
    components: Components, seen: Tensor, density: RayDensity, once: Tensor, times: Tensor
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
    longest = density.most * (int(times.max()) if len(times) else 1)
    normal = truncated_normals(components.ids[used], component, draw, longest, density.cutoff)
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
    how = _Counting(shell, hits_per_ray, thinned)
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
        found = _fused(components, seen, box, (density, of_empty), how)
        if found is not None:
            return found
    if density == of_empty:
        return _drawn(components, seen, box, density, how)
    is_empty = components.max_range[components.seen_by[seen]]
    return sum_evidence(
        _drawn(components, seen[chosen], box, each, how)
        for chosen, each in ((~is_empty, density), (is_empty, of_empty))
    )


def _drawn(
    components: Components,
    seen: Tensor,
    box: Box,
    density: RayDensity,
    how: _Counting,
) -> CellEvidence:
    """`component_evidence` of the viewpoints `seen` (C,), from a list of their rays."""
    seen = seen[_in_reach(components, seen, box, density)]
    # If a component's points cannot be in the box, only its passing rays matter.
    ends_here = (
        _in_reach(components, seen, box, density, ends_only=True)
        & ~components.max_range[components.seen_by[seen]]
    )
    times = torch.where(ends_here, how.hits_per_ray, 1)
    number = ray_numbers(components, seen, density)
    parts = [
        _evidence(components, seen[some], box, density, number[some], times[some], how)
        for some in _portions(number * times)
    ]
    return parts[0] if len(parts) == 1 else sum_evidence(parts)


def _fused(
    components: Components,
    seen: Tensor,
    box: Box,
    densities: tuple[RayDensity, RayDensity],
    how: _Counting,
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
        (components.seen_by[seen], components.seen_from[seen], count),
        torch.stack([*box, *window]).double(),
        resolution=density.resolution,
        rays_per_cell=(density.rays_per_cell, of_empty.rays_per_cell),
        least=density.least,
        most=density.most,
        cutoff=(density.cutoff, of_empty.cutoff),
        shell=how.shell * density.resolution,
        hits_per_ray=how.hits_per_ray,
        thinned=how.thinned,
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
    how: _Counting,
) -> CellEvidence:
    """`component_evidence` of the viewpoints `seen` (C,), with `number` (C,) rays and `times` as many
    hits.
    """
    resolution = density.resolution
    drawn, viewpoint, followed = drawn_rays(components, seen, density, number, times)
    rays, viewpoint = RayBundle(*(field[followed] for field in drawn)), viewpoint[followed]
    stops, weights = rays.ends, rays.weights * times[viewpoint]
    if how.shell > 0:
        stops = _before_surface(components, components.seen_by[seen][viewpoint], rays, how.shell * resolution)
    starts = rays.origins
    if how.thinned:
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


_REACH = 3.0  # deviations around the means that belong to the box
_MOST_TILES = 4096  # a batch in more tiles is tested in every search


class MixtureTiles:
    """Batches of components, each of one message or frame, hashed into cubes by the box around their rays.

    The time of a search grows with the number of near batches, not of all. Batches never change.

    Args:
        tile: side (m) of the cubes.
    """

    def __init__(self, tile: float = 8.0) -> None:
        if not 0 < tile < math.inf:
            raise InvalidArgumentError(f"tile={tile} must be finite metres above zero.")
        self.tile = tile
        self._batches: list[tuple[Components, list[float], list[float]]] = []
        """With the corners of the box around their rays, metres."""
        self._tiles: dict[tuple[int, ...], list[int]] = {}  # rows of the batches in each cube
        self._everywhere: list[int] = []

    def add(self, components: Components) -> None:
        """Adds a batch. Raises `InvalidArgumentError` for components that are not in 3D, and means,
        covariances or origins that are not finite."""
        if components.dim != 3:
            raise InvalidArgumentError(f"components have {components.dim} dimensions; tiles need 3.")
        if not len(components.seen_by):
            return  # it has no rays
        lows, highs = cone_bounds(components.cones(), _REACH)
        low, high = lows.amin(0).tolist(), highs.amax(0).tolist()
        if not all(map(math.isfinite, (*low, *high))):
            raise InvalidArgumentError("The components of a batch hold NaN or infinite values.")
        spans = self._spans(low, high)
        if math.prod(map(len, spans)) > _MOST_TILES:
            self._everywhere.append(len(self._batches))
        else:
            for place in itertools.product(*spans):
                self._tiles.setdefault(place, []).append(len(self._batches))
        self._batches.append((components, low, high))

    def near(self, box: Box, resolution: float) -> list[Components]:
        """Batches whose rays may reach a box of cells of side `resolution` (m), in the order of `add`.

        Rays must end within three deviations of their means, as those of `component_rays` do.
        """
        low = [x * resolution for x in box.low.tolist()]
        high = [x * resolution for x in box.high.tolist()]
        spans = self._spans(low, high)
        found = set(self._everywhere)
        if math.prod(map(len, spans)) < len(self._tiles):
            for place in itertools.product(*spans):
                found.update(self._tiles.get(place, ()))
        else:  # the box has more tiles than are in use
            for place, numbers in self._tiles.items():
                if all(x in span for x, span in zip(place, spans, strict=True)):
                    found.update(numbers)
        batches = [self._batches[number] for number in sorted(found)]
        return [
            components
            for components, first, last in batches
            if all(a <= d and c <= b for a, b, c, d in zip(first, last, low, high, strict=True))
        ]

    def _spans(self, low: list[float], high: list[float]) -> list[range]:
        """The tiles along each axis from one corner to the other, metres."""
        return [
            range(math.floor(a / self.tile), math.floor(b / self.tile) + 1)
            for a, b in zip(low, high, strict=True)
        ]


def regenerate(
    sliding: RollingWindow,
    boxes: Iterable[Box],
    tiles: MixtureTiles,
    evidence: Callable[[Components, float, Box], CellEvidence],
) -> None:
    """Fills empty boxes that the window has uncovered with the evidence of the mixture (thesis Fig 4.2).

    Rays are clipped to the boxes, so nothing is counted twice. `evidence(components, resolution, box)`.
    """
    for box in boxes:
        if near := tiles.near(box, sliding.resolution):
            sliding.add(evidence(Components.concatenate(near), sliding.resolution, box))
