"""Rays of components: the same ones for a component each time, in whatever company it is asked for."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.linalg import safe_cholesky
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.rays.component_draws import normals
from gmmtorch.occupancy.forms.monte_carlo import RayBundle
from gmmtorch.occupancy.grid import check_resolution
from gmmtorch.occupancy.voxels.boxes import Box, to_lattice
from gmmtorch.occupancy.voxels.cell_evidence import CellEvidence, sum_evidence
from gmmtorch.occupancy.voxels.ray_casting import cast_evidence, near_interval

_EFFECTIVE_AREA = 4 * math.pi
_THINNING = 4
_MOST_DRAWS = 1 << 19  # at a time: they take some 250 bytes each meanwhile


def component_rays(
    components: Components,
    resolution: float,
    *,
    rays_per_cell: float = 4.0,
    least: int = 8,
    most: int = 512,
    cutoff: float = 2.5,
) -> RayBundle:
    """Rays from where components were seen to points that they stand for (thesis 3.2.3).

    A sighting gets about `rays_per_cell` rays for each cell that its component hides from the sensor,
    where 4π √|Σ₂| is what a Gaussian hides (∫p² of its shadow p, inverted), Σ₂ its covariance across
    the view; each carries its share of the sighting's count. The points are the first of one Sobol
    sequence, rotated on the unit cube by a hash of the component's id (Cranley and Patterson 1976), and
    turned into normal draws whose radius is that of a Gaussian cut off at `cutoff` deviations. So a
    component's rays depend on nothing but itself: not on its company, nor on the order, nor on what
    was drawn before, and those of more than one batch can be added or left out one by one.

    Args:
        components: in three dimensions. Those without a count get no rays.
        resolution: side (m) of the cells.
        least, most: bounds on the rays of a sighting.

    Raises `InvalidArgumentError` for components in the plane, or numbers that are out of range.
    """
    density = _Density(resolution, rays_per_cell, least, most, cutoff)
    seen = _counted(components, resolution)
    number = _numbers(components, seen, density)
    return _rays(components, seen, density, number, torch.ones_like(seen))[0]


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
) -> CellEvidence:
    """Evidence of components in the cells of a box, by their rays: see `component_rays`.

    Sightings whose rays cannot reach the box are left out before any is drawn, which changes nothing. Of
    very many some are drawn at a time, which bounds the memory that they take.

    shell: cells. A component knows its surface, as a grid of rays does not: within that distance of it
        a ray says nothing of free space. Without that, rays that come in flat call the very cells free
        that the surface lies in (of a floor most are crossed more often than hit). 0 is the thesis's.
    hits_per_ray: points drawn for each ray that is followed. To draw one costs little beside following
        its ray, and it is hits, few to a cell, that are noisy.
    thinned: rays that are dense enough where they end crowd on their way. In its first half only a fourth of
        a sighting's are followed, each for four: as dense there as at the end, at half the work.
    """
    check_whole("hits_per_ray", hits_per_ray, 1)
    if not 0 <= shell < math.inf:
        raise InvalidArgumentError(f"shell={shell} must be finite, at least zero cells.")
    density = _Density(resolution, rays_per_cell, least, most, cutoff)
    seen = _counted(components, resolution)
    seen = seen[_in_reach(components, seen, box, density)]
    # Where a component's own points cannot be in the box, only rays that pass are wanted.
    ends_here = (
        _in_reach(components, seen, box, density, ends_only=True)
        & ~components.max_range[components.seen_by[seen]]
    )
    times = torch.where(ends_here, hits_per_ray, 1)
    number = _numbers(components, seen, density)
    parts = [
        _evidence(components, seen[some], box, density, number[some], times[some], shell, thinned)
        for some in _portions(number * times)
    ]
    return parts[0] if len(parts) == 1 else sum_evidence(parts)


def _portions(draws: Tensor) -> Iterator[slice]:
    """Sightings (C,) in a row of `_MOST_DRAWS` draws at most, or one by itself; of none an empty one."""
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
    density: _Density,
    number: Tensor,
    times: Tensor,
    shell: float,
    thinned: bool,
) -> CellEvidence:
    """`component_evidence` of sightings `seen` (C,), by `number` (C,) of rays and `times` (C,) the hits."""
    resolution = density.resolution
    drawn, sighting, followed = _rays(components, seen, density, number, times)
    rays, sighting = RayBundle(*(field[followed] for field in drawn)), sighting[followed]
    stops, weights = rays.ends, rays.weights * times[sighting]
    if shell > 0:
        stops = _before_surface(components, components.seen_by[seen][sighting], rays, shell * resolution)
    starts = rays.origins
    if thinned:
        starts, stops, weights = _thinned(starts, stops, weights, sighting)
    passing = torch.zeros_like(weights, dtype=torch.bool)
    struck = drawn.ends[drawn.is_hit], drawn.weights[drawn.is_hit]
    return cast_evidence(starts, stops, passing, resolution, box, weights, hit_places=struck)


def _thinned(
    starts: Tensor, stops: Tensor, weights: Tensor, sighting: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The second halves of rays (R,), those of a sighting in a row, and the first halves of a fourth of them.

    A half ends where the other begins, in a cell that only the second leaves.
    """
    n_each = torch.bincount(sighting)
    n_some = (n_each + _THINNING - 1) // _THINNING
    number = torch.arange(len(sighting), device=sighting.device)
    number = number - (torch.cumsum(n_each, 0) - n_each)[sighting]
    # The first ones of a Sobol sequence fill the cube; every fourth would fill one corner of it.
    some = (number < n_some[sighting]).nonzero().squeeze(1)
    for_how_many = (n_each / n_some.clamp_min(1))[sighting[some]]
    middle = starts + 0.5 * (stops - starts)
    return (
        torch.cat([middle, starts[some]]),
        torch.cat([stops, middle[some]]),
        torch.cat([weights, weights[some] * for_how_many]),
    )


def _before_surface(components: Components, of: Tensor, rays: RayBundle, distance: float) -> Tensor:
    """Where rays of components (R,) come within `distance` (m) of the surface that they end on, (R, 3):
    the plane through their end across the direction in which their component is thinnest."""
    used, row = torch.unique(of, return_inverse=True)
    thinnest = torch.linalg.eigh(components.covariances[used].double()).eigenvectors[:, :, 0]
    way = rays.ends - rays.origins
    closing = (thinnest[row] * way).sum(1).abs()
    share = (distance / closing.clamp_min(torch.finfo(closing.dtype).tiny)).clamp_max(1)
    return rays.ends - torch.where(rays.is_hit, share, 0.0)[:, None] * way


@dataclass(frozen=True)
class _Density:
    """How densely rays are drawn: see `component_rays`."""

    resolution: float
    rays_per_cell: float
    least: int
    most: int
    cutoff: float

    def __post_init__(self) -> None:
        check_resolution(self.resolution)
        for name in ("rays_per_cell", "cutoff"):
            if not 0 < getattr(self, name) < math.inf:
                raise InvalidArgumentError(f"{name}={getattr(self, name)} must be finite, above zero.")
        if check_whole("most", self.most, 1) < check_whole("least", self.least, 1):
            raise InvalidArgumentError(f"most={self.most} must be at least least={self.least}.")


def _counted(components: Components, resolution: float) -> Tensor:
    """The sightings (C,) of sound components that have a count."""
    if components.dim != 3:
        raise InvalidArgumentError(f"components have {components.dim} dimensions; their rays need 3.")
    to_lattice(components.means, resolution, "means")
    to_lattice(components.origins, resolution, "origins")
    return (components.seen_count > 0).nonzero().squeeze(1)


def _in_reach(
    components: Components, seen: Tensor, box: Box, density: _Density, ends_only: bool = False
) -> Tensor:
    """Which sightings (C,), of those `seen` (C,), may have rays that reach the box, or that end there."""
    by = components.seen_by[seen]
    spread = density.cutoff * components.covariances.double().diagonal(dim1=1, dim2=2).sqrt()
    low, high = components.means.double() - spread, components.means.double() + spread
    origins = components.origins.double()[components.seen_from[seen]]
    scale = 1 / density.resolution
    # Half a cell more than the box covers the rounding of what is drawn.
    first, last = near_interval(origins * scale, low[by] * scale, high[by] * scale, box)
    return (first <= last) & (last >= 1) if ends_only else first <= last


def _numbers(components: Components, seen: Tensor, density: _Density) -> Tensor:
    """How many rays (C,) the density asks for of each of the sightings `seen` (C,)."""
    by, whence = components.seen_by[seen], components.seen_from[seen]
    toward = components.means[by].double() - components.origins[whence].double()
    hidden = _hidden_area(toward, components.covariances[by].double()) / density.resolution**2
    wanted = (density.rays_per_cell * hidden).ceil().nan_to_num(0)  # NaN is refused where rays are drawn
    return wanted.clamp(density.least, density.most).long()


def _rays(
    components: Components, seen: Tensor, density: _Density, once: Tensor, times: Tensor
) -> tuple[RayBundle, Tensor, Tensor]:
    """Rays of the sightings `seen` (C,), `times` (C,) the number `once` (C,) of each; which of the sightings
    each ray (R,) is of; and which rays (F,) would be all of them once."""
    used, by = torch.unique(components.seen_by[seen], return_inverse=True)
    mean, covariance = components.means[used].double(), components.covariances[used].double()
    origin, count = (
        components.origins[components.seen_from[seen]].double(),
        components.seen_count[seen].double(),
    )
    factor = safe_cholesky(covariance)
    number = once * times
    sighting = torch.repeat_interleave(number)
    first = torch.cumsum(number, 0) - number
    draw = torch.arange(len(sighting), device=seen.device) - first[sighting]
    component = by[sighting]
    longest = density.most * (int(times.max()) if len(times) else 1)
    normal = normals(components.ids[used], component, draw, longest, density.cutoff)
    # Row by row, by sums and products alone: a matrix product may round differently in other company.
    ends = []
    for row in range(3):
        place = mean[:, row][component]
        for column in range(row + 1):
            place = place + factor[:, row, column][component] * normal[column]
        ends.append(place)
    rays = RayBundle(
        origin[sighting],
        torch.stack(ends, 1),
        (count / number)[sighting],
        ~components.max_range[used][component],
    )
    return rays, sighting, (draw < once[sighting]).nonzero().squeeze(1)


def _hidden_area(toward: Tensor, covariance: Tensor) -> Tensor:
    """Area (C,), m², that Gaussians hide of what is behind them; `toward` (C, 3): from sensor to mean.

    The determinant of the covariance across a unit direction d is dᵀ adj(Σ) d.
    """
    scale = covariance.diagonal(dim1=1, dim2=2).amax(1).clamp_min(torch.finfo(torch.float64).tiny)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = (
        row.unbind(1) for row in (covariance / scale[:, None, None]).unbind(1)
    )
    largest = toward.abs().amax(1).clamp_min(torch.finfo(torch.float64).tiny)
    x, y, z = (toward / largest[:, None]).unbind(1)
    a, b, c = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    mixed = x * y * (xz * yz - xy * zz) + x * z * (xy * yz - xz * yy) + y * z * (xy * xz - xx * yz)
    length = x * x + y * y + z * z
    along = (a * x * x + b * y * y + c * z * z + 2 * mixed) / length
    # Seen from its very mean a component has no direction: as large as it can look.
    determinant = torch.where(length > 0, along, a + b + c).clamp_min(0)
    return _EFFECTIVE_AREA * scale * determinant.sqrt()
