"""Rays from the sensor origins of components to points drawn from the components (thesis 3.2.3).

A viewpoint gets about `rays_per_cell` rays for each cell that its component hides from the sensor. A Gaussian
hides the area 4π √|Σ₂| (the inverse of ∫p² of its shadow p), Σ₂ its covariance across the view. Each ray has
an equal share of the viewpoint's count. End points are the first points of one Sobol sequence, rotated on the
unit cube by a hash of the component's id (Cranley and Patterson 1976), and transformed to normal draws
truncated at the radius `cutoff` (deviations). The rays of a component therefore depend only on the component,
and the rays of several batches can be added or removed one by one.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_number, check_whole
from gmmtorch.kernels import hidden_area, truncated_normals
from gmmtorch.linalg import safe_cholesky
from gmmtorch.mapping.components import Components
from gmmtorch.occupancy import RayBundle, check_resolution, to_lattice


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
